"""The command `halfspace-sss render`: a Mitsuba scene with translucent objects, by any model or path traced."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from halfspace_sss.backend import BackendError, prepare_llvm
from halfspace_sss.cli.shared import Bar, console
from halfspace_sss.provenance import check_folder

if TYPE_CHECKING:
    from halfspace_sss.rendering.scenes.reference_store import Reference

__all__ = ["render_command"]

PASSES = 16  # that --spp is divided into, for the progress and the estimate of the error
MOST_SPP_PER_PASS = 64
VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "cuda_ad_rgb", "cuda_ad_mono")


def render_command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML file whose objects use the BSDF `translucent`.")],
    model: Annotated[
        str | None, typer.Option(help="A model for all objects, or path_traced.", show_default="as the scene says")
    ] = None,
    orders: Annotated[
        str | None, typer.Option(help="total, multiple or single.", show_default="as the scene says")
    ] = None,
    spp: Annotated[int, typer.Option(help="Samples for each pixel.")] = 64,
    target_error: Annotated[
        float | None, typer.Option(help="Stop at this relative error of the image, instead of spp.")
    ] = None,
    seed: Annotated[int, typer.Option(help="Seed of the samples.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the render of the same settings.")] = False,
    variant: Annotated[str, typer.Option(help="Variant of Mitsuba.")] = "llvm_ad_rgb",
    out: Annotated[Path, typer.Option(help="Folder for the files; those of the same names are replaced.")] = Path(
        "render"
    ),
) -> None:
    """Render a scene: NAME_MODEL.exr with variance, and .png; orders, error, samples and time are printed."""
    from halfspace_sss.checks import check_count
    from halfspace_sss.rendering.scenes import reference

    check_count("spp", spp, 1)
    check_count("seed", seed, 0)
    check_folder(out)
    loaded = _load(scene, model, orders, variant)
    file = out / f"{scene.stem}_{model or 'scene'}.exr"
    per_pass = min(max(1, -(-spp // PASSES)), MOST_SPP_PER_PASS)
    passes = None if target_error else -(-spp // per_pass)
    if not resume:
        file.unlink(missing_ok=True)
    with Bar("rendering") as bar:

        def show(found: Reference) -> None:
            if passes:
                bar.show(found.passes, passes)
            else:
                share = min((target_error / found.relative_error) ** 2, 1.0) if found.passes > 1 else 0.0
                bar.show(round(1000 * share), 1000, f"{found.spp} spp, error {found.relative_error:.2%}")

        found = reference.render(
            loaded, file, spp_per_pass=per_pass, seed=seed, passes=passes, target_error=target_error, progress=show
        )
    _report(found, file)


def _load(scene: Path, model: str | None, orders: str | None, variant: str) -> object:
    if variant not in VARIANTS:
        raise ValueError(f"variant must be one of {', '.join(VARIANTS)}, got {variant!r}")
    if variant.startswith("llvm"):
        prepare_llvm()
    try:
        import mitsuba as mi
    except ImportError as error:
        raise BackendError('rendering needs Mitsuba 3: pip install "halfspace-sss[render]"') from error
    from halfspace_sss import rendering
    from halfspace_sss.rendering.scenes.scene_files import load_scene

    try:
        mi.set_variant(variant)
    except ImportError as error:
        raise BackendError(f"variant {variant} does not run here: {error}") from error
    rendering.register()
    return load_scene(scene, model, orders)


def _report(found: Reference, file: Path) -> None:
    import mitsuba as mi
    import numpy as np

    picture = file.with_suffix(".png")
    temporary = picture.with_name(f".{picture.name}.tmp.png")
    mi.util.write_bitmap(str(temporary), mi.TensorXf(found.mean.astype(np.float32)), write_async=False)
    temporary.replace(picture)
    screen = console()
    screen.print(
        f"{found.spp} samples a pixel in {found.seconds:.1f} s; relative standard error of the image "
        f"{found.relative_error:.2%}", highlight=False,
    )  # fmt: skip
    for path in (file, picture):
        screen.print(f"  {path}", highlight=False, markup=False, soft_wrap=True)
