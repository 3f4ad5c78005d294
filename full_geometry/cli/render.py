"""The command `halfspace-sss render`: a Mitsuba scene with translucent objects, by any model or path traced."""

from __future__ import annotations

import math
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from full_geometry.cli.variants import VARIANTS, Variant, use_mitsuba
from halfspace_sss.backend import BackendError
from halfspace_sss.cli.shared import (
    SPECTRAL,
    Bar,
    Define,
    OutFolder,
    SampleSeed,
    console,
    defined,
    numbers,
    tell,
    whole,
)
from halfspace_sss.extensions import renderer
from halfspace_sss.locks import one_writer
from halfspace_sss.provenance import check_folder, replace_together, write_atomically

if TYPE_CHECKING:
    import numpy as np

    from full_geometry.scenes.picture import Picture
    from full_geometry.scenes.reference import Limits
    from full_geometry.scenes.reference_store import Reference
    from halfspace_sss.extensions import Renderer

SPP = 64
ENDINGS = ("png", "html", "denoised.exr", "denoised.png")  # of what is drawn
PHASES = ("walks.exr", "walks.json", "model.exr", "model.json")  # of an image with walks in it


def render_command(
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML file whose objects use the BSDF `translucent`.")],
    model: Annotated[
        str | None,
        typer.Option(help="A model for all objects, auto, or path_traced.", show_default="as the scene says"),
    ] = None,
    orders: Annotated[
        str | None, typer.Option(help="total, multiple or single.", show_default="as the scene says")
    ] = None,
    spp: Annotated[
        int | None, typer.Option(help="Samples for each pixel.", parser=whole, show_default="64, or what else ends it")
    ] = None,
    target_error: Annotated[float | None, typer.Option(help="Stop at this relative error of the image.")] = None,
    seconds: Annotated[float | None, typer.Option(help="Stop after this time of rendering.")] = None,
    seed: SampleSeed = 0,
    sensor: Annotated[str, typer.Option(help="Number of the sensor, several as 0,1, or all.")] = "0",
    define: Define = None,
    train_seconds: Annotated[
        float | None,
        typer.Option(help="Time to learn an object without weights; 0 refuses it.", show_default="60, or the scene's"),
    ] = None,
    train_error: Annotated[
        float | None, typer.Option(help="Error at which it has learnt enough.", show_default="0.03, or the scene's")
    ] = None,
    light: Annotated[
        str | None,
        typer.Option(
            help="Of models sampled (no bias), gathered once (little bias, no noise of orders from two on), auto; of "
            "path_traced precomputed (bias below .3 %), sampled, or auto.",
            show_default="of models sampled, of path_traced auto, or the scene's",
        ),
    ] = None,
    denoise: Annotated[bool, typer.Option("--denoise", help="An image without noise beside the other.")] = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the unfinished or finished render of the same settings.")
    ] = False,
    variant: Variant = "llvm_ad_rgb",
    out: OutFolder = Path("render"),
) -> None:
    """Render a scene: NAME_MODEL.exr with variance, .png, and .html; error, samples and time are printed.

    Until it is done, NAME_MODEL.unfinished.exr holds it, and the files of before stay. Objects whose model has to learn
    them are learnt first, where they have no weights, from walks that join the image.
    """
    use_mitsuba(variant, VARIANTS + SPECTRAL)
    from full_geometry.integrators.bssrdf import is_bssrdf
    from full_geometry.scenes.picture import Picture
    from full_geometry.scenes.reference import Limits, chosen
    from full_geometry.scenes.scene_files import open_scene
    from halfspace_sss.checks import check_count

    limits = Limits(SPP if (spp, target_error, seconds) == (None,) * 3 else spp, None, target_error, seconds)
    check_count("seed", seed, 0)
    parameters, draw = defined(define), _renderer(denoise)
    check_folder(out)
    settings = {"train_seconds": train_seconds, "train_error": train_error, "light": light, "layers": denoise or None}
    settings = {name: value for name, value in settings.items() if value is not None}
    loaded = open_scene(scene, model, orders, parameters, settings)
    chosen_sensors = _sensors(sensor, loaded)
    for sentence in chosen(loaded, loaded.integrator()).get("choices", {}).values():
        console().print(sentence, highlight=False, markup=False, soft_wrap=True)
    cameras = [loaded.sensors()[k] for k in chosen_sensors] if denoise else []
    if any(not camera.film().rfilter().is_box_filter() for camera in cameras):
        tell("the film has no box filter: the denoiser keeps most of the noise that other filters spread over pixels")
    for k in chosen_sensors:
        name = [scene.stem, model or "scene", light or "", f"sensor{k}" if k else ""]
        file = out / f"{'_'.join(filter(None, name))}.exr"
        with one_writer(file):
            result = _rendered(loaded, file, limits, {"seed": seed, "sensor": k}, resume)
            emission = result.mean[..., -3:] if getattr(loaded.integrator(), "layers", False) else None
            numbers, error = _numbers(result), _error(result)
            picture = Picture(file.stem, _colours(result.mean), numbers, error, loaded, k, denoise, emission)
            _report(result, _publish(picture, file, draw))
    for sentence in loaded.integrator().gathered if is_bssrdf(loaded.integrator()) else ():
        console().print(sentence, highlight=False, markup=False, soft_wrap=True)


def _sensors(text: str, scene: Any) -> list[int]:
    """The numbers of the sensors that are asked for, each once; ValueError if the scene lacks one."""
    from full_geometry.scenes.reference import check_sensor

    if text == "all":
        result = list(range(len(scene.sensors())))
    else:
        found = numbers("sensor", text)
        if not all(k.is_integer() for k in found):
            raise ValueError(f"sensor must be whole numbers, several as 0,1, or all, got {text!r}")
        result = list(dict.fromkeys(int(k) for k in found))
    for k in result or [0]:
        check_sensor(scene, k)
    return result


def _renderer(denoise: bool) -> Renderer | None:
    """What draws the page and denoises, if it is there; BackendError before anything is rendered in vain."""
    result = renderer("render")
    if denoise and (result is None or find_spec("mitsuba_oidn") is None):
        raise BackendError('denoising needs mitsuba-oidn and a page: pip install "halfspace-sss[figures]"')
    return result


def _unfinished(file: Path) -> Path:
    return file.with_suffix(".unfinished.exr")


def _rendered(scene: Any, file: Path, limits: Limits, which: dict[str, int], resume: bool) -> Reference:
    """The render, in files of another name until it is done."""
    from full_geometry.scenes import online
    from full_geometry.scenes.scene_files import first_cause

    part, bars = _unfinished(file), _Bars(limits)
    begun = any(path.exists() for path in (part, *online.files(part).values()))
    start = file if resume and file.exists() and not begun else resume
    with bars:
        try:
            return online.render(scene, part, resume=start, **which, **vars(limits), **bars.callbacks())
        except RuntimeError as error:
            raise BackendError(first_cause(error)) from error
        except KeyboardInterrupt:
            raise KeyboardInterrupt(bars.kept(part)) from None


class _Bars:
    """Progress of learning and of rendering, one after the other."""

    def __init__(self, limits: Limits) -> None:
        self.limits, self.bar, self.title, self.so_far = limits, Bar(""), "", 0

    def __enter__(self) -> _Bars:
        return self

    def __exit__(self, *error: Any) -> None:
        self.bar.__exit__(*error)

    def callbacks(self) -> dict[str, Any]:
        """What `online.render` is to call."""
        return {"progress": self._rendered, "learning": self._learnt, "told": self._told}

    def kept(self, part: Path) -> str:
        """What an interrupt leaves."""
        if self.title == "learning":
            return f"what was learnt up to the last checkpoint is kept for --resume beside {part}"
        return f"{self.so_far} samples a pixel are kept for --resume in {part}" if self.so_far else ""

    def _begin(self, title: str) -> None:
        self.bar.__exit__(None, None, None)
        self.bar, self.title = Bar(title), title

    def _told(self, sentence: str) -> None:
        self._begin("learning")
        tell(sentence)

    def _learnt(self, what: str, done: int, total: int) -> None:
        self.bar.show(done, total, what)

    def _rendered(self, reference: Reference) -> None:
        if self.title != "rendering":
            self._begin("rendering")
        self.so_far = reference.spp
        error = f", error {reference.relative_error:.2%}" if math.isfinite(reference.relative_error) else ""
        self.bar.show(round(1000 * self.limits.share(reference)), 1000, f"{reference.spp} spp{error}")


def _publish(picture: Picture, file: Path, draw: Renderer | None) -> list[Path]:
    """Put the finished files in the place of those of before, all of one render at any moment; their paths."""
    part = _unfinished(file)
    drawn = {"png": picture.png(), **(draw(picture) if draw else {})}
    for ending, data in drawn.items():
        write_atomically(part.with_suffix(f".{ending}"), data)
    phases = [ending for ending in PHASES if part.with_suffix(f".{ending}").exists()]
    endings = ["exr", "json", *drawn, *phases]
    moves = {part.with_suffix(f".{ending}"): file.with_suffix(f".{ending}") for ending in endings}
    gone = [file.with_suffix(f".{ending}") for ending in (*ENDINGS, *PHASES) if ending not in endings]
    replace_together(moves, gone)
    return [path for path in moves.values() if path.suffix != ".json"]


def _colours(image: np.ndarray) -> np.ndarray:
    return image[..., :3] if image.shape[2] >= 3 else image[..., :1].repeat(3, axis=2)


def _numbers(reference: Reference) -> dict[str, str]:
    error = reference.relative_error
    told = f"{error:.2%}" if 0 < error < math.inf else "–"
    return {"samples": str(reference.spp), "time, s": f"{reference.seconds:.3g}", "relative error": told}


def _report(reference: Reference, files: list[Path]) -> None:
    screen = console()
    screen.print(f"{reference.spp} samples a pixel in {reference.seconds:.1f} s; {_error(reference)}", highlight=False)
    for path in files:
        screen.print(f"  {path}", highlight=False, markup=False, soft_wrap=True)


def _error(reference: Reference) -> str:
    """What is known of the error of an image."""
    if not reference.mean[..., :3].any():
        return "every pixel is black: no light reaches the camera"
    if reference.passes < 2:
        return "one pass has no estimate of its error"
    if reference.relative_error == 0:
        return "all passes are the same: the camera sees nothing that varies, such as the sky alone"
    told, share = f"relative standard error of the image {reference.relative_error:.2%}", reference.share_by_chance
    return f"{told}, of the variance at most {share:.0%} light that orders 0 and 1 meet by chance" if share else told
