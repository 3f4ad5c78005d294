"""The command `halfspace-sss fit`: the medium of an object from images of it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from full_geometry.cli.variants import Drawers, Variant, use_mitsuba
from halfspace_sss.cli import shared

if TYPE_CHECKING:
    from full_geometry.inverse.comparing import MaterialFit


@dataclass(frozen=True)
class DescentOptions:
    """How images are compared, and the steps."""

    steps: Annotated[
        int, typer.Option(help="Number of steps.", parser=shared.whole, show_default="30; 60: textures")
    ] = 0
    spp: Annotated[int, typer.Option(help="Samples a pixel of each render of a step.", parser=shared.whole)] = 64
    batch: Annotated[int, typer.Option(help="Views a step.", parser=shared.whole, show_default="4, or all")] = 0
    loss: Annotated[Literal["relative", "l2", "robust"], typer.Option(help="Loss of the pixels.")] = "relative"
    exposure: Annotated[bool, typer.Option("--exposure", help="Fit a factor of brightness for each image.")] = False
    tv: Annotated[float, typer.Option(help="Weight of the total variation of textures.")] = 0.02
    seed: shared.Seed = 0


@dataclass(frozen=True)
class FittedOptions:
    """What is fitted."""

    parameter: Annotated[
        str, typer.Option(help="Any of albedo, reflectance, sigma_t, mfp and g; textures where it has them.")
    ] = "albedo,sigma_t"
    model: Annotated[str, typer.Option(help="translucent_walk, neural_shape, or a model of the half-space.")] = (
        "translucent_walk"
    )
    object: shared.ObjectId = None


def fit(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML file with the cameras, the lights and a first medium.")],
    images: Annotated[Path, typer.Option(help="JSON file of the views, see `full_geometry.inverse.read_views`.")],
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
    from halfspace_sss.provenance import check_folder

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
    from full_geometry.inverse.fit_files import as_json, scene_with_medium, texture_files
    from halfspace_sss.materials.imports import to_toml
    from halfspace_sss.materials.material import Material
    from halfspace_sss.provenance import provenance, write_together

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
