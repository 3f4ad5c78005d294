"""The command `halfspace-sss fit`: the medium of an object from images of it."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal
from xml.etree import ElementTree

import typer

from full_geometry.cli.variants import Drawers, Variant, use_mitsuba
from halfspace_sss.cli import shared
from halfspace_sss.provenance import check_folder, provenance, write_together

if TYPE_CHECKING:
    from full_geometry.inverse.comparing import MaterialFit


@dataclass(frozen=True)
class DescentOptions:
    """How images are compared, and the steps."""

    steps: Annotated[
        int, typer.Option(help="Number of steps.", parser=shared.whole, show_default="30; 60: textures")
    ] = 0
    spp: Annotated[int, typer.Option(help="Samples a pixel of each render of a step.", parser=shared.whole)] = 64
    batch: Annotated[int, typer.Option(help="Views in each step.", parser=shared.whole, show_default="4, or all")] = 0
    loss: Annotated[Literal["relative", "l2", "robust"], typer.Option(help="Loss of the pixels.")] = "relative"
    exposure: Annotated[bool, typer.Option("--exposure", help="Fit a factor of brightness for each image.")] = False
    tv: Annotated[float, typer.Option(help="Weight of the total variation of textures.")] = 0.02
    light: Annotated[
        Literal["sampled", "precomputed"],
        typer.Option(help="Light of translucent_walk; precomputed below rough boundaries."),
    ] = "sampled"
    test_spp: Annotated[
        int, typer.Option(help="Samples a pixel of views held out.", parser=shared.whole, show_default="spp")
    ] = 0
    seed: shared.Seed = 0


@dataclass(frozen=True)
class FittedOptions:
    """What is fitted."""

    parameter: Annotated[
        str,
        typer.Option(help="Any of albedo, reflectance, sigma_t, mfp, g, alpha; texels where these are textures."),
    ] = "albedo,sigma_t"
    model: Annotated[str, typer.Option(help="translucent_walk, neural_shape, or a model of the half-space.")] = (
        "translucent_walk"
    )
    object: shared.ObjectId = None


def fit(
    context: typer.Context,
    scene: Annotated[
        Path, typer.Argument(help="Mitsuba XML or glTF file with the cameras, the lights and a first medium.")
    ],
    images: Annotated[Path, typer.Option(help="JSON file of the views: image, sensor or camera, mask.")],
    fitted: FittedOptions,
    descent: DescentOptions,
    work: Annotated[Path | None, typer.Option(help="Folder where an interrupted fit goes on.")] = None,
    variant: Variant = "llvm_ad_rgb",
    out: shared.OutFolder = Path("fit"),
) -> None:
    """Fit the medium of an object to images: NAME_fit.toml (material), .xml (scene with it), .json (all numbers).

    NAME_fit.html flips between each image and its fit.
    Textures are NAME_fit_PARAMETER.exr and their standard errors NAME_fit_PARAMETER_error.exr. Attributes of a mesh and
    their errors (NAME_error) are in NAME_fit.ply. Errors are NaN where no view shows a texel.
    """
    use_mitsuba(variant)
    from full_geometry import inverse

    settings = inverse.FitSettings(**vars(descent))
    check_folder(out)
    names = [name.strip() for name in fitted.parameter.split(",")]
    with shared.Bar("fit") as bar:
        views = inverse.read_views(images)
        found = inverse.fit(
            scene, views, names, fitted.model, object=fitted.object, settings=settings, work=work, progress=bar.show
        )
    shared.say(*found.lines())
    for sentence in found.told:
        shared.tell(sentence)
    shared.say_files(_write(found, scene, fitted.object, out, context.find_object(Drawers)))


def _write(found: MaterialFit, scene: Path, name: str | None, out: Path, drawers: Drawers | None) -> list[Path]:
    """Write the files of a fit: numbers, then textures and the scene, then the page; their paths."""
    from halfspace_sss.materials.catalogue import to_toml
    from halfspace_sss.materials.material import Material

    stem = f"{scene.stem}_fit"
    told = provenance(**{key: value.tolist() for key, value in found.values.items()})
    files = {out / f"{stem}.json": json.dumps({**as_json(found), "provenance": told}, indent=1)}
    if found.medium.n_channels == 3:
        source = f"{'means of textures ' * bool(found.textures)}fitted to images of {scene.name}"
        material = Material(stem, found.medium, ("R", "G", "B"), set="fit", source=source)
        files[out / f"{stem}.toml"] = to_toml([material])
    write_together(files)  # before anything that may fail
    painted, textures = texture_files(scene, name, found, out / stem)
    text, rest = scene_with_medium(scene, name, found, painted), dict(textures)
    if text is None:
        shared.tell(f"{scene.name} has no single surface `translucent` to put the medium in: no scene was written")
    else:
        rest[out / f"{stem}.xml"] = text
    write_together(rest)
    pages = drawers.fit(found) if drawers else {}
    drawn = {out / f"{stem}.{ending}": data for ending, data in pages.items()}
    write_together(drawn)
    return [*files, *rest, *drawn]


# --------------------------------------------------------------------------------------------------
# A fit as files: its numbers, its textures, and the scene with the medium that was found.


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
    """The files of textures by parameter, or `mesh`; and these."""
    from full_geometry.inverse.textures import painted_mesh
    from full_geometry.scenes.reference_store import as_exr

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
    from full_geometry.scenes.gltf import is_gltf

    if is_gltf(scene):
        return None
    root = ElementTree.parse(scene).getroot()
    shared, surfaces = {bsdf.get("id"): bsdf for bsdf in root.findall("bsdf")}, {}
    for shape in (shape for shape in root.iter("shape") if name is None or shape.get("id") == name):
        below = [*shape.iter("bsdf"), *(shared.get(ref.get("id")) for ref in shape.iter("ref"))]
        surfaces |= {bsdf: shape for bsdf in below if bsdf is not None and bsdf.get("type") == "translucent"}
    if len(surfaces) != 1:
        return None
    ((surface, shape),), medium = surfaces.items(), found.medium
    for node in root.iter("string"):
        if node.get("name") == "filename" and "$" not in node.get("value", "$"):
            node.set("value", str((scene.parent / node.get("value")).resolve()))
    if found.textures:
        _paint(root, surface, shape, found, painted)
    else:
        _remove(surface, *COEFFICIENTS)
        for key in ("albedo", "sigma_t", "g"):
            _add_numbers(surface, key, getattr(medium, key) if medium.n_channels else [getattr(medium, key)])
    if "alpha" in found.values:
        if (boundary := surface.find("bsdf")) is None:  # a reference, which other surfaces may share
            return None
        _remove(boundary, "alpha")
        ElementTree.SubElement(boundary, "float", name="alpha", value=repr(float(found.values["alpha"][0])))
    if not any(child.get("name") == "eta" for child in surface):
        ElementTree.SubElement(surface, "float", name="eta", value=repr(float(medium.eta)))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_numbers(surface: ElementTree.Element, key: str, values: Iterable[float]) -> None:
    ElementTree.SubElement(surface, "string", name=key, value=", ".join(repr(float(v)) for v in values))


def _paint(
    root: ElementTree.Element, surface: ElementTree.Element, shape: ElementTree.Element, found: MaterialFit,
    files: dict[str, Path],
) -> None:  # fmt: skip
    """Put textures and the constants beside them into a scene: bitmaps by their files, attributes with their mesh."""
    if {"sigma_t", "mfp"} & (found.values.keys() | found.textures.keys()):
        _remove(surface, "scale")
    for key, value in found.values.items():
        if key == "alpha":
            continue
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
