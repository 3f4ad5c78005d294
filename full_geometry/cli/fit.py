"""The command `halfspace-sss fit`: the medium of an object from images of it."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree import ElementTree

import typer

from full_geometry.cli.variants import Variant, use_mitsuba
from halfspace_sss.cli.shared import (
    Bar,
    ObjectId,
    OutFolder,
    SampleSeed,
    console,
    tell,
    whole,
)
from halfspace_sss.extensions import renderer
from halfspace_sss.provenance import check_folder, provenance, write_together

if TYPE_CHECKING:
    from full_geometry.inverse.comparing import MaterialFit

COEFFICIENTS = ("material", "dilution", "sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "reflectance", "mfp", "g")


def fit_command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML file with the cameras, the lights and a first medium.")],
    images: Annotated[Path, typer.Option(help="JSON file of the views, see `full_geometry.inverse.read_views`.")],
    parameter: Annotated[
        str, typer.Option(help="Of albedo, reflectance, sigma_t, mfp, g; the texture, where there is one.")
    ] = "albedo,sigma_t",
    model: Annotated[
        str, typer.Option(help="translucent_walk, neural_shape, or a model of the half-space.")
    ] = "translucent_walk",
    object: ObjectId = None,  # noqa: A002
    steps: Annotated[int, typer.Option(help="How many.", parser=whole, show_default="30, or 60 with textures")] = 0,
    spp: Annotated[int, typer.Option(help="Samples a pixel of each render of a step.", parser=whole)] = 64,
    batch: Annotated[int, typer.Option(help="Views a step.", parser=whole, show_default="4, or all")] = 0,
    loss: Annotated[str, typer.Option(help="relative, l2, or robust.")] = "relative",
    exposure: Annotated[bool, typer.Option("--exposure", help="Each image has an unknown factor.")] = False,
    tv: Annotated[float, typer.Option(help="Of textures: weight of their total variation.")] = 0.02,
    seed: SampleSeed = 0,
    work: Annotated[Path | None, typer.Option(help="Folder where an interrupted fit goes on.")] = None,
    variant: Variant = "llvm_ad_rgb",
    out: OutFolder = Path("fit"),
) -> None:
    """Fit the medium of an object to images: NAME_fit.toml (material), .xml (scene with it), .json (all numbers).

    NAME_fit.html flips between each image and what was found.
    A texture is written as NAME_fit_PARAMETER.exr, its standard errors as NAME_fit_PARAMETER_error.exr; an attribute of
    a mesh with it as NAME_fit.ply, its errors as the attribute NAME_error. Errors are NaN where no view shows a texel.
    """
    use_mitsuba(variant)
    from full_geometry.inverse import FitSettings, fit, read_views

    settings = FitSettings(steps, spp, batch, loss, exposure, seed, tv)
    check_folder(out)
    names = [name.strip() for name in parameter.split(",")]
    with Bar("fit") as bar:
        found = fit(scene, read_views(images), names, model, object, settings, work, bar.show)
    screen = console()
    for line in found.lines():
        screen.print(line, highlight=False)
    for sentence in found.told:
        tell(sentence)
    for path in _write(found, scene, object, out):
        screen.print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _write(found: MaterialFit, scene: Path, name: str | None, out: Path) -> list[Path]:
    """Write the files of a fit: numbers, then textures and the scene, then the page; their paths."""
    from halfspace_sss.materials.imports import to_toml
    from halfspace_sss.materials.material import Material

    stem = f"{scene.stem}_fit"
    told = provenance(**{key: value.tolist() for key, value in found.values.items()})
    files = {out / f"{stem}.json": json.dumps({**_plain(found), "provenance": told}, indent=1)}
    if found.medium.n_channels == 3:
        material = Material(
            stem,
            found.medium,
            ("R", "G", "B"),
            set="fit",
            source=f"{'means of textures ' * bool(found.textures)}fitted to images of {scene.name}",
        )
        files[out / f"{stem}.toml"] = to_toml([material])
    write_together(files)  # before anything that may fail
    painted, textures = _with_textures(scene, name, found, out / stem)
    text, rest = _with_medium(scene, name, found, painted), dict(textures)
    if text is None:
        tell(f"{scene.name} has no single surface `translucent` to put the medium in: no scene was written")
    else:
        rest[out / f"{stem}.xml"] = text
    write_together(rest)
    pages = {out / f"{stem}.html": draw(found)} if (draw := renderer("fit")) else {}
    write_together(pages)
    return [*files, *rest, *pages]


def _plain(found: MaterialFit) -> dict[str, Any]:
    values = {"values": found.values, "errors": found.errors}
    plain = {key: {name: v.tolist() for name, v in each.items()} for key, each in values.items()}
    held = None if found.held_out is None else found.held_out._asdict()
    return {
        **plain, "correlation": found.correlation.tolist(), "misfit": found.misfit._asdict(), "held_out": held,
        "chi_square": found.chi_square._asdict(), "is_misfit": found.is_misfit,
        "exposures": found.exposures, "told": found.told, "steps": [step._asdict() for step in found.steps],
    }  # fmt: skip


def _with_textures(
    scene: Path, name: str | None, found: MaterialFit, stem: Path
) -> tuple[dict[str, Path], dict[Path, bytes]]:
    """By parameter, or `mesh`, the files of textures; and these."""
    from full_geometry.inverse.textures import painted_mesh
    from full_geometry.scenes.picture import as_exr

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


def _with_medium(scene: Path, name: str | None, found: MaterialFit, painted: dict[str, Path]) -> str | None:
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
