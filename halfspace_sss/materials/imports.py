"""Materials from files of other standards: OpenPBR in MaterialX, volume scattering in glTF."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from halfspace_sss.backend import needed
from halfspace_sss.checks import check_choice
from halfspace_sss.materials.material import Material
from halfspace_sss.physics.medium import Medium

if TYPE_CHECKING:
    import MaterialX as mx  # noqa: N813
    import pygltflib

CHANNELS = ("R", "G", "B")
OPENPBR: dict[str, float | tuple[float, ...]] = {  # defaults of OpenPBR 1.1
    "subsurface_weight": 0.0, "subsurface_color": (0.8, 0.8, 0.8), "subsurface_radius": 1.0,
    "subsurface_radius_scale": (1.0, 0.5, 0.25), "subsurface_scatter_anisotropy": 0.0, "specular_ior": 1.5,
    "specular_weight": 1.0,
}  # fmt: skip
NO_MEDIUM: dict[str, float | tuple[float, ...]] = {  # in no medium; values that change nothing
    "subsurface_weight": 1.0, "base_metalness": 0.0, "transmission_weight": 0.0, "coat_weight": 0.0,
    "fuzz_weight": 0.0, "thin_film_weight": 0.0, "emission_luminance": 0.0, "geometry_opacity": 1.0,
    "specular_color": (1.0, 1.0, 1.0), "specular_roughness": 0.0,
}  # fmt: skip
ROUGHNESS = 0.3  # of OpenPBR 1.1 where none is written
TAKEN_OF_GLTF = ("KHR_materials_volume_scatter", "KHR_materials_volume", "KHR_materials_ior")
WEIGHED = ("base", "transmission", "coat", "fuzz", "thin_film", "emission")  # groups of inputs, each with a weight
THIN = "a thin wall has no inside, whose light a medium could be"
TO_REC709: dict[str, np.ndarray] = {  # linear, by the name of a colour space in MaterialX
    "": np.eye(3),
    "lin_rec709": np.eye(3),
    "acescg": np.array(  # AP1 with the white of ACES to Rec. 709 with D65, Bradford adaptation
        [[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]
    ),
}


def import_materials(path: str | os.PathLike, mm_per_unit: float | None = None) -> list[Material]:
    """The materials of a MaterialX file (.mtlx) with OpenPBR surfaces, or of a glTF file (.glb, .gltf) that scatter.

    Args:
        path: the file; surfaces without subsurface scattering are left out. For the others one warning names what
            changes the picture and is no part of a medium, such as roughness, coats and partial weights.
        mm_per_unit: length of a unit of the file, by default 1 mm in MaterialX and a metre in glTF.

    Raises:
        ValueError: the file cannot be read, holds no subsurface scattering, has values that no medium has, or
            scatters inside thin walls; file, material and value are named.
        BackendError: the package that reads the file is not installed.
    """
    path = Path(path)
    readers = {".mtlx": (_of_materialx, 1.0), ".glb": (_of_gltf, 1000.0), ".gltf": (_of_gltf, 1000.0)}
    check_choice("suffix of path", path.suffix.lower(), readers)
    if mm_per_unit is not None and not 0 < mm_per_unit < math.inf:
        raise ValueError(f"mm_per_unit must be finite and > 0, got {mm_per_unit!r}")
    if not path.is_file():
        raise ValueError(f"path must be a file, got {str(path)!r}")
    reader, unit = readers[path.suffix.lower()]
    results = list(reader(path, mm_per_unit or unit))
    if not results:
        raise ValueError(f"{path}: must hold a material with subsurface scattering, got none")
    return results


def _of_materialx(path: Path, unit: float) -> Iterator[Material]:
    mx = needed("MaterialX", ".mtlx needs MaterialX", "import")
    document = mx.createDocument()
    try:
        mx.readFromXmlFile(document, str(path))
    except mx.ExceptionParseError as error:
        raise ValueError(f"{path}: must be a MaterialX document, got {error}") from error
    names = {s.getNodeName(): m.getName() for m in document.getMaterialNodes() for s in m.getActiveInputs()}
    for node in document.getNodes("open_pbr_surface"):
        name = names.get(node.getName(), node.getName())
        try:
            values = {key: _value(node, key, default) for key, default in OPENPBR.items()}
            if values.pop("subsurface_weight") > 0 and _written(node).get("base_metalness") != 1:
                if node.getInputValue("geometry_thin_walled"):
                    raise ValueError(f"geometry_thin_walled must be false, got true: {THIN}")
                _warn_of(path, name, _not_taken(node))
                values["specular_ior"] = modulated(values["specular_ior"], values.pop("specular_weight"))
                medium = Medium.from_openpbr(**values, mm_per_unit=unit)
                yield Material(name, medium, CHANNELS, set="OpenPBR", source=str(path))
        except ValueError as error:
            raise ValueError(f"{path}: material {name!r}: {error}") from error


def _written(node: mx.Node) -> dict[str, object]:
    """The inputs that a node writes: numbers, tuples and texts; "a connection" where it has no value."""
    results = {}
    for each in node.getActiveInputs():
        value = "a connection" if each.getValue() is None else each.getValue()
        value = tuple(round(v, 6) for v in value.asTuple()) if hasattr(value, "asTuple") else value
        results[each.getName()] = round(value, 6) if isinstance(value, float) else value  # they are of single precision
    return results


def _not_taken(node: mx.Node) -> dict[str, object]:
    """What changes the picture of a surface and is in no medium, with its values."""
    written = {"specular_roughness": ROUGHNESS} | _written(node)
    found = {key: written[key] for key, none in NO_MEDIUM.items() if written.get(key, none) != none}
    mixed = [group for group in WEIGHED if any(key.startswith(group) for key in found)]
    if not {"subsurface_weight", "base_metalness"}.isdisjoint(found):
        mixed.append("base")
    by_others = {key: value for key, value in written.items() if key.startswith(tuple(mixed))}
    geometry = {key: value for key, value in written.items() if key.startswith("geometry_") and value == "a connection"}
    return found | by_others | geometry


def _warn_of(path: Path, name: str, not_taken: dict[str, object]) -> None:
    """One warning of all that changes the picture of a material and is in no medium."""
    if not_taken:
        told = ", ".join(f"{key} = {value}" for key, value in not_taken.items())
        warnings.warn(f"{path}: material {name!r}: its medium alone is imported, without {told}", stacklevel=4)


def _value(node: mx.Node, key: str, default: float | tuple[float, ...]) -> float | tuple[float, ...] | np.ndarray:
    """The value of an input, colours in linear Rec. 709."""
    result = node.getInput(key)
    if result is None:
        return default
    if result.getNodeName() or result.getNodeGraphString():
        raise ValueError(f"{key} must be a value, got a connection")
    value = result.getValue()
    if not hasattr(value, "asTuple"):
        return value
    space = result.getActiveColorSpace()
    check_choice(f"colour space of {key}", space, TO_REC709)
    return TO_REC709[space] @ np.array(value.asTuple())


def modulated(ior: float, weight: float) -> float:
    """The index whose normal reflectance is `weight` times that of `ior`; OpenPBR 1.1, section dielectric base."""
    amplitude = abs(ior - 1) / (ior + 1)
    amplitude = math.copysign(min(math.sqrt(max(weight, 0.0)) * amplitude, 0.999), ior - 1)
    return (1 + amplitude) / (1 - amplitude)


def read_gltf(path: Path) -> pygltflib.GLTF2:
    """A glTF file as pygltflib reads it; ValueError if it cannot, BackendError without that package."""
    pygltflib = needed("pygltflib", f"{path.suffix} needs pygltflib", "import")
    try:
        return pygltflib.GLTF2().load(str(path))
    except Exception as error:  # pygltflib raises what json, struct and dataclasses_json raise
        raise ValueError(f"{path}: must be a glTF file, got {type(error).__name__}: {error}") from error


def gltf_medium(parts: dict[str, dict[str, object]], unit: float = 1000.0) -> Medium | None:
    """The medium of a material of glTF by its extensions, None where it does not scatter.

    Args:
        parts: the extensions of the material, by name.
        unit: length of a unit of the file, mm.

    Raises:
        ValueError: it has no thickness, or values that no medium has.
    """
    scatter, volume = parts.get("KHR_materials_volume_scatter"), parts.get("KHR_materials_volume", {})
    if scatter is None:
        return None
    if volume.get("thicknessFactor", 0.0) == 0:
        raise ValueError(f"thicknessFactor must be > 0, got 0: {THIN}")
    color = scatter.get("multiscatterColor", scatter.get("multiscatterColorFactor", (0.0, 0.0, 0.0)))
    distance = volume.get("attenuationDistance", math.inf) * unit / 1000
    ior = parts.get("KHR_materials_ior", {}).get("ior", 1.5)
    tint = volume.get("attenuationColor", (1.0, 1.0, 1.0))
    return Medium.from_gltf(color, distance, tint, scatter.get("scatterAnisotropy", 0.0), ior)


def _of_gltf(path: Path, unit: float) -> Iterator[Material]:
    for k, material in enumerate(read_gltf(path).materials):
        parts, name = material.extensions or {}, material.name or f"{path.stem} {k}"
        try:
            medium = gltf_medium(parts, unit)
            if medium is not None:
                _warn_of(path, name, _not_taken_of_gltf(material, parts))
                yield Material(name, medium, CHANNELS, set="glTF", source=str(path))
        except ValueError as error:
            raise ValueError(f"{path}: material {name!r}: {error}") from error


def _not_taken_of_gltf(material: pygltflib.Material, parts: dict[str, object]) -> dict[str, object]:
    """What changes the picture of a material of glTF and is in no medium, with its values."""
    none = {"baseColorFactor": [1.0] * 4, "metallicFactor": 0.0, "roughnessFactor": 0.0, "emissiveFactor": [0.0] * 3}
    surface = material.pbrMetallicRoughness
    owners = [vars(surface) if surface else {}, vars(material), *(parts.get(name, {}) for name in TAKEN_OF_GLTF)]
    written = {key: value for owner in owners for key, value in owner.items() if value is not None}
    factors = {key: written[key] for key in none if written.get(key, none[key]) != none[key]}
    textures = {key: "a texture" for key in written if key.endswith("Texture")}
    return factors | textures | {key: value for key, value in parts.items() if key not in TAKEN_OF_GLTF}
