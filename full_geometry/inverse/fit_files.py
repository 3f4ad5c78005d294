"""A fit as files: its numbers, its textures, and the scene with the medium that was found."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from full_geometry.inverse.textures import painted_mesh
from full_geometry.scenes.picture import as_exr

if TYPE_CHECKING:
    from full_geometry.inverse.comparing import MaterialFit

COEFFICIENTS = ("material", "dilution", "sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "reflectance", "mfp", "g")


def as_json(found: MaterialFit) -> dict[str, Any]:
    """All numbers of a fit, ready for JSON."""
    values = {"values": found.values, "errors": found.errors}
    plain = {key: {name: v.tolist() for name, v in each.items()} for key, each in values.items()}
    held = None if found.held_out is None else found.held_out._asdict()
    return {
        **plain, "correlation": found.correlation.tolist(), "misfit": found.misfit._asdict(), "held_out": held,
        "chi_square": found.chi_square._asdict(), "is_misfit": found.is_misfit,
        "exposures": found.exposures, "told": found.told, "steps": [step._asdict() for step in found.steps],
    }  # fmt: skip


def texture_files(
    scene: Path, name: str | None, found: MaterialFit, stem: Path
) -> tuple[dict[str, Path], dict[Path, bytes]]:
    """By parameter, or `mesh`, the files of textures; and these."""
    ways, files = {}, {}
    for key, values in found.textures.items():
        if values.ndim == 3:
            ways[key] = stem.with_name(f"{stem.name}_{key}.exr")
            files[ways[key]] = as_exr(values)
            files[stem.with_name(f"{stem.name}_{key}_error.exr")] = as_exr(found.texture_errors[key])
    attributes = {k: (v, found.texture_errors[k]) for k, v in found.textures.items() if v.ndim == 2}
    if attributes:
        ways["mesh"] = stem.with_name(f"{stem.name}.ply")
        files[ways["mesh"]] = painted_mesh(scene, name, attributes)
    return ways, files


def scene_with_medium(scene: Path, name: str | None, found: MaterialFit, painted: dict[str, Path]) -> str | None:
    """The scene with another medium in the object; None if it is not clear which surface that is."""
    root = ElementTree.parse(scene).getroot()
    shapes = [shape for shape in root.iter("shape") if name is None or shape.get("id") == name]
    own = {id(bsdf): shape for shape in shapes for bsdf in shape.iter("bsdf") if bsdf.get("type") == "translucent"}
    surfaces = [bsdf for shape in shapes for bsdf in shape.iter("bsdf") if bsdf.get("type") == "translucent"]
    ids = {ref.get("id"): shape for shape in shapes for ref in shape.iter("ref")}
    surfaces += [b for b in root.findall("bsdf") if b.get("type") == "translucent" and b.get("id") in ids]
    if len(surfaces) != 1:
        return None
    surface, medium = surfaces[0], found.medium
    for node in root.iter("string"):
        if node.get("name") == "filename" and "$" not in node.get("value", "$"):
            node.set("value", str((scene.parent / node.get("value")).resolve()))
    if found.textures:
        shape = own.get(id(surface), ids.get(surface.get("id")))
        _paint(root, surface, shape, found, painted)
    else:
        _remove(surface, *COEFFICIENTS)
        for key in ("albedo", "sigma_t", "g"):
            _add_numbers(surface, key, getattr(medium, key) if medium.n_channels else [getattr(medium, key)])
    if not any(child.get("name") == "eta" for child in surface):
        ElementTree.SubElement(surface, "float", name="eta", value=repr(float(medium.eta)))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_numbers(surface: ElementTree.Element, key: str, values: Any) -> None:
    ElementTree.SubElement(surface, "string", name=key, value=", ".join(repr(float(v)) for v in values))


def _paint(
    root: ElementTree.Element, surface: ElementTree.Element, shape: ElementTree.Element, found: MaterialFit,
    files: dict[str, Path],
) -> None:  # fmt: skip
    """Put textures and the constants beside them into a scene: bitmaps by their files, attributes with their mesh."""
    if {"sigma_t", "mfp"} & (found.values.keys() | found.textures.keys()):
        _remove(surface, "scale")
    for key, value in found.values.items():
        other = {"mfp": "sigma_t", "sigma_t": "mfp"}.get(key, key)
        named = key if any(child.get("name") == key for child in surface) else other
        _remove(surface, named)
        _add_numbers(surface, named, value if named == key else 1 / value)
    for key in found.textures:
        (texture,) = [child for child in surface if child.get("name") == key]
        if texture.tag == "ref":
            source = next(each for each in root.iter("texture") if each.get("id") == texture.get("id"))
            surface.remove(texture)
            texture = ElementTree.SubElement(surface, "texture", name=key, type=source.get("type"))
            texture.extend(copy.deepcopy(child) for child in source)
        _remove(texture, "scale")
        if key in files:
            _remove(texture, "filename", "raw", "format")
            ElementTree.SubElement(texture, "string", name="filename", value=str(files[key].resolve()))
            ElementTree.SubElement(texture, "boolean", name="raw", value="true")
    if "mesh" in files:  # in the space of the scene
        _remove(shape, "filename", "to_world", "flip_normals")
        shape.set("type", "ply")
        ElementTree.SubElement(shape, "string", name="filename", value=str(files["mesh"].resolve()))


def _remove(node: ElementTree.Element, *names: str) -> None:
    for child in [child for child in node if child.get("name") in names]:
        node.remove(child)
