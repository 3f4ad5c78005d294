"""The commands `render`, a scene with translucent objects by any model or path traced, and `view`, in the browser."""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from full_geometry.cli.variants import Drawers, SceneOptions, use_mitsuba
from halfspace_sss.backend import BackendError
from halfspace_sss.cli import shared
from halfspace_sss.interrupts import interrupts
from halfspace_sss.provenance import check_folder, one_writer, replace_together, write_atomically

if TYPE_CHECKING:
    import mitsuba as mi
    import numpy as np

    from full_geometry.learning.online import Listeners
    from full_geometry.scenes.reference import Limits
    from full_geometry.scenes.reference_store import Reference
    from full_geometry.viewing.frames import Animation, Rows

SPP, ASKED = 64, 0.02  # samples of a pixel of what is named, relative error of what is not
ENDINGS = ("png", "html", "denoised.exr", "denoised.png")  # of what is drawn
PHASES = ("walks.exr", "walks.json", "model.exr", "model.json")  # of an image with walks in it
RenderVariant = Annotated[
    Literal["llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral", "cuda_ad_rgb", "cuda_ad_mono", "cuda_ad_spectral"],
    typer.Option(help="Variant of Mitsuba."),
]


@dataclass(frozen=True)
class UntilOptions:
    """What ends a render: whichever comes first."""

    spp: Annotated[
        int | None, typer.Option(help="Samples for each pixel.", parser=shared.whole, show_default="64, or another end")
    ] = None
    target_error: Annotated[
        float | None,
        typer.Option(help="Stop at this relative error; 0.02 is 2 %.", show_default="0.02 where nothing names a model"),
    ] = None
    seconds: Annotated[float | None, typer.Option(help="Stop after this time of rendering.")] = None

    def limits(self) -> Limits:
        from full_geometry.scenes.reference import Limits

        spp = SPP if (self.spp, self.target_error, self.seconds) == (None,) * 3 else self.spp
        return Limits(spp, None, self.target_error, self.seconds)


@dataclass(frozen=True)
class TransportOptions:
    """The model of the objects, in place of what the scene says."""

    model: Annotated[
        str | None,
        typer.Option(
            help="A model for all objects, auto, or path_traced.",
            show_default="as the scene says, or the cheaper of walks and corrected light",
        ),
    ] = None
    orders: Annotated[
        Literal["total", "multiple", "single"] | None,
        typer.Option(help="Orders of scattering.", show_default="as the scene says"),
    ] = None
    light: Annotated[
        str | None,
        typer.Option(
            help="Models: sampled (adds no bias), gathered (little bias, no noise of orders from two on), corrected "
            "(gathered; walks take most of the model's bias away) or auto. "
            "path_traced: precomputed (bias below .3 %), sampled or auto.",
            show_default="models: sampled; path_traced: auto; or the scene's",
        ),
    ] = None
    train_seconds: Annotated[
        float, typer.Option(help="Seconds to train each object without weights first; 0 refuses such objects.")
    ] = 0.0
    train_error: Annotated[float, typer.Option(help="Error at which an object is trained enough.")] = 0.03

    def settings(self, denoise: bool) -> dict[str, Any]:
        """Settings of the integrator that are given."""
        given = {"light": self.light, "layers": denoise or None}
        return {name: value for name, value in given.items() if value is not None}

    def training(self) -> dict[str, float]:
        return {"train_seconds": self.train_seconds, "train_error": self.train_error}


@dataclass(frozen=True)
class ImageOptions:
    """Which image, and what is made of it."""

    seed: shared.Seed = 0
    sensor: Annotated[str, typer.Option(help="Number of the sensor, several as 0,1, or all.")] = "0"
    denoise: Annotated[
        bool, typer.Option("--denoise", help="Also write a denoised image; --target-error then applies to it.")
    ] = False
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on with the unfinished or finished render of the same settings.")
    ] = False
    frames: Annotated[
        Path | None, typer.Option(help="JSON or CSV file with a row of edits for each frame: NAME_MODEL_0001.exr.")
    ] = None


def render(
    context: typer.Context,
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML or glTF file whose objects use the BSDF `translucent`.")],
    transport: TransportOptions,
    until: UntilOptions,
    images: ImageOptions,
    define: shared.Define = None,
    variant: RenderVariant = "llvm_ad_rgb",
    out: shared.OutFolder = Path("render"),
) -> None:
    """Render a scene: NAME_MODEL.exr with variance, .png, and .html; error, samples and time are printed.

    NAME_MODEL.unfinished.exr holds an unfinished render; earlier files stay until the new one is done. --train-seconds
    trains objects without weights first, by walks that join the image.
    """
    use_mitsuba(variant)
    from full_geometry.integrators.bssrdf import is_bssrdf
    from full_geometry.scenes.reference import LARGEST_PASS, chosen
    from full_geometry.viewing.frames import read_rows

    until.limits()  # refuses what is out of range, before any work
    drawers, rows = _drawers(context, images.denoise), read_rows(images.frames) if images.frames else None
    check_folder(out)
    way = _way(scene, transport, until, shared.defined(define), (images.denoise, drawers is not None), rows)
    if way.animation:  # passes of one size, by which each frame has as many walks that correct its light
        even = min(max((way.limits.spp or 32) // 8, 1), LARGEST_PASS)
        way = replace(way, limits=replace(way.limits, spp_per_pass=2 ** (even.bit_length() - 1)))
    loaded, animation = way.scene, way.animation
    sensors = _sensors(images.sensor, loaded)
    shared.say(*chosen(loaded, loaded.integrator()).get("choices", {}).values())
    if way.denoise and any(not loaded.sensors()[k].film().rfilter().is_box_filter() for k in sensors):
        shared.tell(
            "the film has no box filter: the denoiser keeps most of the noise that other filters spread over pixels"
        )
    for frame in range(len(animation) if animation else 1):
        if animation:
            animation.show(frame)
        for k in sensors:
            name = [scene.stem, transport.model or "scene", transport.light or "", f"sensor{k}" if k else ""]
            name += [f"{frame + 1:04}"] if animation else []
            file = out / f"{'_'.join(filter(None, name))}.exr"
            mean = _image(way, file, images, {"seed": images.seed, "sensor": k, **transport.training()}, drawers)
            if is_bssrdf(loaded.integrator()) and not animation:
                shared.say(*_off(loaded, mean, k, transport.model))
    shared.say(*(loaded.integrator().gathered if is_bssrdf(loaded.integrator()) else ()))


def _image(
    way: _Render, file: Path, images: ImageOptions, which: dict[str, Any], drawers: Drawers | None
) -> np.ndarray | None:
    """Render an image and write its files; None for a frame that is finished and gone on with."""
    from full_geometry.scenes.reference import cross_denoised
    from full_geometry.scenes.reference_store import Picture, as_png
    from full_geometry.trade.denoising import Denoiser

    with one_writer(file):
        if images.frames and images.resume and _is_finished(way, file, which):
            shared.say(f"{file} is finished")
            return None
        denoise = Denoiser(way.scene, which["sensor"]) if way.denoise else None
        result = _rendered(way.scene, file, way.limits, {**which, "denoise": denoise}, images.resume)
        clean = cross_denoised(result, denoise) if denoise else None
        relative = math.hypot(result.relative_error, result.light_error)
        error = _error(result, way.limits.target_error or SMALL_ERROR)
        told = {"samples": str(result.spp), "time, s": f"{result.seconds:.3g}"}
        told["relative error"] = f"{relative:.2%}" if 0 < relative < math.inf else "–"
        off = (clean.image, {"error": clean.told}) if clean else None
        colours = result.mean[..., :3] if result.mean.shape[2] >= 3 else result.mean[..., :1].repeat(3, axis=2)
        picture = Picture(file.stem, colours, told, error, off)
        drawn = drawers.render(picture) if drawers and (off or not images.frames) else {}
        drawn = {end: drawn[end] for end in drawn if not (images.frames and end == "html")}
        files = _publish(file, {"png": as_png(colours), **drawn})
        shared.say(f"{result.spp} samples a pixel in {result.seconds:.1f} s; {error}")
        shared.say(*([clean.told] if clean else []))
        shared.say_files(files)
    return result.mean


def _is_finished(way: _Render, file: Path, which: dict[str, Any]) -> bool:
    """Whether the file of a frame has the samples that are asked for; ValueError if it is of another render."""
    from full_geometry.scenes import reference

    if not file.exists():
        return False
    found = reference.load(file)
    here = reference.about_render(way.scene, way.scene.integrator(), which["sensor"], which["seed"])
    reference.check_same(found, file, found.about | here)  # weights and choices would have to be made anew
    return way.limits.reached(found)


def _off(scene: mi.Scene, image: np.ndarray, sensor: int, model: str | None) -> list[str]:
    """How far off models are on each object of an image, where walks can tell."""
    import mitsuba as mi

    from full_geometry.learning.model_errors import mean_ratios, told
    from full_geometry.scenes.scene_files import first_cause

    if mi.is_spectral or scene.integrator().settings.orders:
        return []
    try:
        return told(mean_ratios(scene, image, sensor), model or "the model of the scene")
    except (ValueError, RuntimeError) as error:
        return [f"the error of models is unknown, as random walks refuse the scene: {first_cause(error)}"]


@dataclass(frozen=True)
class _Render:
    """A scene as it is rendered, what ends that, whether it is denoised, and its frames."""

    scene: mi.Scene
    limits: Limits
    denoise: bool
    animation: Animation | None


def _way(
    scene: Path, transport: TransportOptions, until: UntilOptions, parameters: dict[str, str],
    denoising: tuple[bool, bool], rows: Rows | None,
) -> _Render:  # fmt: skip
    """The scene by what is named, or by the cheapest way that keeps the asked error: of all for the model "auto".

    Where neither scene nor options name anything, and an error or no end at all is asked for, it is the cheapest of
    walks and light that is corrected by them.

    Args:
        denoising: whether it is asked for, and whether it can be.
        rows: of an animation, which are refused here where they do not fit the scene.
    """
    import mitsuba as mi

    from full_geometry.integrators.bssrdf import is_bssrdf
    from full_geometry.objects.objects import translucent_shapes
    from full_geometry.scenes.scene_files import names_nothing, open_scene
    from full_geometry.settings import AUTO, PATH_TRACED, Settings
    from full_geometry.trade.automatic import UNNAMED, decided, models_of, ways_of
    from full_geometry.trade.techniques import READY_FIRST, Technique
    from full_geometry.viewing.frames import Animation

    # ---- what is asked for, and whether it is left to us
    denoise, error, ended = denoising[0], until.target_error, (until.spp, until.seconds) != (None, None)
    settings = {**({"light": AUTO} if transport.model == AUTO else {}), **transport.settings(denoise)}
    if transport.model == AUTO and error:
        settings["tolerance"] = error
    loaded = open_scene(scene, transport.model, transport.orders, parameters, settings)
    animation = None if rows is None else Animation(loaded, rows)
    integrator, named = loaded.integrator(), (transport.model, transport.orders, transport.light)
    by_models = is_bssrdf(integrator) and set(models_of(loaded, integrator.settings)) == {AUTO}
    unnamed = named == (None, None, None) and (error or not ended) and names_nothing(scene, parameters)
    unnamed &= all(any(shape is each for each in loaded.shapes()) for shape in translucent_shapes(loaded))
    if mi.is_spectral or not (by_models or unnamed):
        return _Render(loaded, until.limits(), denoise, animation)

    # ---- the way, and what ends it
    how = integrator.settings if by_models else Settings(mm_per_unit=integrator.mm_per_unit, tolerance=error or ASKED)
    ways = ways_of([AUTO], how.light) if by_models else UNNAMED
    ways = [way for way in ways if denoising[1] or not Technique.of(way).denoised]
    found = decided(loaded, how, ways)
    shared.say(found.why)
    limits = until.limits()
    if not ended and found.walks:  # their error is measured while they go on
        limits = replace(limits, spp=None, target_error=how.tolerance)
    elif not ended:
        limits = replace(limits, spp=found.spp, target_error=None)
    if by_models and found.walks is None:  # the integrator finds again which models these are
        return _Render(loaded, limits, denoise, animation)
    denoise |= found.walks is not None and found.walks.denoised
    settings = {**transport.settings(denoise), "light": found.light}
    model = PATH_TRACED if found.walks else READY_FIRST
    loaded = open_scene(scene, model, transport.orders, parameters, settings)
    return _Render(loaded, limits, denoise, None if rows is None else Animation(loaded, rows))


def _sensors(text: str, scene: mi.Scene) -> list[int]:
    """The numbers of the sensors that are asked for, each once; ValueError if the scene lacks one."""
    from full_geometry.scenes.reference import check_sensor

    if text == "all":
        result = list(range(len(scene.sensors())))
    else:
        found = shared.numbers("sensor", text)
        if not all(k.is_integer() for k in found):
            raise ValueError(f"sensor must be whole numbers, several as 0,1, or all, got {text!r}")
        result = list(dict.fromkeys(int(k) for k in found))
    for k in result or [0]:
        check_sensor(scene, k)
    return result


def _drawers(context: typer.Context, denoise: bool) -> Drawers | None:
    """What draws the page and denoises, if it is there; BackendError before anything is rendered in vain."""
    drawers = context.find_object(Drawers)
    if denoise and (drawers is None or find_spec("mitsuba_oidn") is None):
        raise BackendError('denoising needs mitsuba-oidn and a page: pip install "halfspace-sss[figures]"')
    return drawers


def _unfinished(file: Path) -> Path:
    return file.with_suffix(".unfinished.exr")


def _rendered(scene: mi.Scene, file: Path, limits: Limits, which: dict[str, Any], resume: bool) -> Reference:
    """The render, in files of another name until it is done."""
    from full_geometry.learning import online
    from full_geometry.scenes.scene_files import first_cause

    part, bars = _unfinished(file), _Bars(limits)
    begun = any(path.exists() for path in (part, *online.files(part).values()))
    start = file if resume and file.exists() and not begun else resume
    with bars:
        try:
            return online.render(scene, part, resume=start, **which, **vars(limits), listeners=bars.listeners())
        except ValueError:  # a refusal, which may be a RuntimeError too
            raise
        except RuntimeError as error:
            raise BackendError(first_cause(error)) from error
        except KeyboardInterrupt:
            raise KeyboardInterrupt(bars.kept(part)) from None


class _Bars:
    """Progress of learning and of rendering, one after the other."""

    def __init__(self, limits: Limits) -> None:
        self.limits, self.bar, self.title, self.so_far = limits, shared.Bar(""), "", 0

    def __enter__(self) -> _Bars:
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.__exit__(*error)

    def listeners(self) -> Listeners:
        """What `online.render` is to call."""
        from full_geometry.learning.online import Listeners

        return Listeners(self._rendered, None, self._learnt, self._told)

    def kept(self, part: Path) -> str:
        """What an interrupt leaves."""
        if self.title == "learning":
            return f"the training up to the last checkpoint is kept for --resume beside {part}"
        return f"{self.so_far} samples a pixel are kept for --resume in {part}" if self.so_far else ""

    def _begin(self, title: str) -> None:
        self.bar.__exit__(None, None, None)
        self.bar, self.title = shared.Bar(title), title

    def _told(self, sentence: str) -> None:
        self._begin("learning")
        shared.tell(sentence)

    def _learnt(self, what: str, done: int, total: int) -> None:
        self.bar.show(done, total, what)

    def _rendered(self, reference: Reference) -> None:
        if self.title != "rendering":
            self._begin("rendering")
        self.so_far = reference.spp
        error = f", error {reference.error:.2%}" if math.isfinite(reference.error) else ""
        self.bar.show(round(1000 * self.limits.share(reference)), 1000, f"{reference.spp} spp{error}")


def _publish(file: Path, drawn: dict[str, bytes]) -> list[Path]:
    """Put the finished files in the place of those of before, all of one render at any moment; their paths."""
    part = _unfinished(file)
    for ending, data in drawn.items():
        write_atomically(part.with_suffix(f".{ending}"), data)
    phases = [ending for ending in PHASES if part.with_suffix(f".{ending}").exists()]
    endings = ["exr", "json", *drawn, *phases]
    moves = {part.with_suffix(f".{ending}"): file.with_suffix(f".{ending}") for ending in endings}
    gone = [file.with_suffix(f".{ending}") for ending in (*ENDINGS, *PHASES) if ending not in endings]
    replace_together(moves, gone)
    return [path for path in moves.values() if path.suffix != ".json"]


SMALL_ERROR = 0.01  # below which nobody has to know where the noise of an image is from


def _error(reference: Reference, wanted: float = SMALL_ERROR) -> str:
    """What an image says of its noise; where from only if there is more of it than was wanted."""
    if not reference.mean[..., :3].any():
        return "every pixel is black: no light reaches the camera"
    if reference.passes < 2:
        return "one pass has no estimate of its error"
    if reference.relative_error == 0:
        return "all passes are the same: the camera sees nothing that varies, such as the sky alone"
    told, share = f"relative standard error of the image {reference.relative_error:.2%}", reference.share_by_chance
    if not share or share < 0.005 or reference.relative_error <= wanted:
        return told
    return (
        f"{told}; up to {share:.0%} of the variance is from light that scattered at most once inside and then hit an "
        "emitter by chance"
    )


PORT = 8080


def view(
    scene: Annotated[Path, typer.Argument(help="Mitsuba XML or glTF file whose objects use the BSDF `translucent`.")],
    options: SceneOptions,
    host: Annotated[str, typer.Option(help="Address; another than a loopback one asks for a token.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port.")] = PORT,
    side: Annotated[int, typer.Option(help="Side of a square image of as many pixels.")] = 256,
) -> None:
    """Look at a scene in the browser: turn it, move its light, change media and models, until Ctrl-C.

    The address is printed. Scenes are saved beside the file, and no file of another folder is read.
    """
    use_mitsuba(options.variant)
    from full_geometry.viewing.page import Page

    page = Page(scene, host, port, side**2, options.parameters())
    try:
        shared.say(f"{page.url}  (Ctrl-C ends)")
        while not threading.Event().wait(0.2):
            interrupts.check()
            page.check()
    finally:
        page.close()
