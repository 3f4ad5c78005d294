"""The command `halfspace-sss fit`: the medium of an object from images of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any
from xml.etree import ElementTree

import typer

from halfspace_sss.cli.shared import (
    Bar,
    ObjectId,
    OutFolder,
    SampleSeed,
    Variant,
    console,
    tell,
    use_mitsuba,
    whole,
)
from halfspace_sss.provenance import check_folder, provenance, write_together

if TYPE_CHECKING:
    from halfspace_sss.inverse.fitting import MaterialFit
    from halfspace_sss.physics.medium import Medium

COEFFICIENTS = ("material", "dilution", "sigma_s", "sigma_a", "sigma_t", "albedo", "scale", "reflectance", "mfp", "g")


def fit_command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML file with the cameras, the lights and a first medium.")],
    images: Annotated[Path, typer.Option(help="JSON file of the views, see `halfspace_sss.inverse.read_views`.")],
    parameter: Annotated[str, typer.Option(help="Of albedo, sigma_t, mfp, g.")] = "albedo,sigma_t",
    model: Annotated[str, typer.Option(help="translucent_walk, or the name of a model.")] = "translucent_walk",
    object: ObjectId = None,  # noqa: A002
    steps: Annotated[int, typer.Option(help="Gauss-Newton steps.", parser=whole)] = 30,
    spp: Annotated[int, typer.Option(help="Samples a pixel of each render of a step.", parser=whole)] = 64,
    batch: Annotated[int, typer.Option(help="Views a step.", parser=whole, show_default="4, or all")] = 0,
    loss: Annotated[str, typer.Option(help="relative or l2.")] = "relative",
    exposure: Annotated[bool, typer.Option("--exposure", help="Each image has an unknown factor.")] = False,
    seed: SampleSeed = 0,
    work: Annotated[Path | None, typer.Option(help="Folder where an interrupted fit goes on.")] = None,
    variant: Variant = "llvm_ad_rgb",
    out: OutFolder = Path("fit"),
) -> None:
    """Fit the medium of an object to images: NAME_fit.toml (material), .xml (scene with it), .json (all numbers)."""
    use_mitsuba(variant)
    from halfspace_sss.inverse import FitSettings, fit, read_views

    settings = FitSettings(steps, spp, batch, loss, exposure, seed)
    check_folder(out)
    names = [name.strip() for name in parameter.split(",")]
    with Bar("fit") as bar:
        found = fit(scene, read_views(images), names, model, object, settings, work, bar.show)
    screen = console()
    for name, value in found.values.items():
        numbers = "  ".join(f"{v:.4g} ± {e:.1g}" for v, e in zip(value, found.errors[name]))
        screen.print(f"{name}: {numbers}", highlight=False)
    held = "" if found.held_out is None else f", of views held out {found.held_out.told()} %"
    screen.print(f"root of the loss {found.misfit.told()} %{held}", highlight=False)
    for sentence in found.told:
        tell(sentence)
    for path in _write(found, scene, object, out):
        screen.print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _write(found: MaterialFit, scene: Path, name: str | None, out: Path) -> list[Path]:
    """The files of a fit; their paths."""
    from halfspace_sss.materials.imports import to_toml
    from halfspace_sss.materials.material import Material

    stem = f"{scene.stem}_fit"
    told = provenance(**{key: value.tolist() for key, value in found.values.items()})
    files = {out / f"{stem}.json": json.dumps({**_plain(found), "provenance": told}, indent=1)}
    if found.medium.n_channels == 3:
        material = Material(stem, found.medium, ("R", "G", "B"), set="fit", source=f"fitted to images of {scene.name}")
        files[out / f"{stem}.toml"] = to_toml([material])
    text = _with_medium(scene, name, found.medium)
    if text is None:
        tell(f"{scene.name} has no single surface `translucent` to put the medium in: no scene was written")
    else:
        files[out / f"{stem}.xml"] = text
    write_together(files)
    return list(files)


def _plain(found: MaterialFit) -> dict[str, Any]:
    values = {"values": found.values, "errors": found.errors}
    plain = {key: {name: v.tolist() for name, v in each.items()} for key, each in values.items()}
    held = None if found.held_out is None else found.held_out._asdict()
    return {
        **plain, "correlation": found.correlation.tolist(), "misfit": found.misfit._asdict(), "held_out": held,
        "exposures": found.exposures, "told": found.told, "steps": [step._asdict() for step in found.steps],
    }  # fmt: skip


def _with_medium(scene: Path, name: str | None, medium: Medium) -> str | None:
    """The scene with another medium in the object; None if it is not clear which surface that is."""
    root = ElementTree.parse(scene).getroot()
    shapes = [shape for shape in root.iter("shape") if name is None or shape.get("id") == name]
    surfaces = [bsdf for shape in shapes for bsdf in shape.iter("bsdf") if bsdf.get("type") == "translucent"]
    ids = {ref.get("id") for shape in shapes for ref in shape.iter("ref")}
    surfaces += [b for b in root.findall("bsdf") if b.get("type") == "translucent" and b.get("id") in ids]
    if len(surfaces) != 1:
        return None
    surface = surfaces[0]
    for child in [child for child in surface if child.get("name") in COEFFICIENTS]:
        surface.remove(child)
    for key in ("albedo", "sigma_t", "g"):
        value = getattr(medium, key)
        text = ", ".join(repr(float(v)) for v in (value if medium.n_channels else [value]))
        ElementTree.SubElement(surface, "string", name=key, value=text)
    if not any(child.get("name") == "eta" for child in surface):
        ElementTree.SubElement(surface, "float", name="eta", value=repr(float(medium.eta)))
    for node in root.iter("string"):
        if node.get("name") == "filename" and "$" not in node.get("value", "$"):
            node.set("value", str((scene.parent / node.get("value")).resolve()))
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"
