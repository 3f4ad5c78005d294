"""The techniques of rendering, in turn on one scene, and the job and the light of a measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mitsuba as mi

from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.integrators.gathering import Gathering
from full_geometry.objects.objects import KnowsUnit, millimetres, refuse_instances, translucent_shapes
from full_geometry.objects.small_emitters import is_delta
from full_geometry.scenes.reference import check_sensor
from full_geometry.scenes.scene_files import PATH_TRACED, load_objects
from full_geometry.settings import AUTO, GATHERED_LIGHTS, NO_OBJECT, check_variant
from full_geometry.transport.models import model_names
from halfspace_sss.checks import check_choice, check_count, check_interval

LAMBERT = "lambert"
# By one model alone: the walks take away what is wrong with it. It has the narrowest tables, gathers first, and takes
# textures and clear objects.
READY_FIRST = "better_dipole"
GATHERED, CORRECTED, PRECOMPUTED = *GATHERED_LIGHTS, "precomputed"
DENOISED = ", denoised"
# Samples of the images that light is precomputed for: the noise of the most at a point is 3 to 8 %.
FEWEST_LIT, MOST_LIT = 2**17, 2**21


@dataclass(frozen=True)
class Technique:
    """A model for all objects, or "path_traced", of the orders of the scene.

    Args:
        model: name of a model, or "path_traced": walks.
        light: "sampled"; of models "gathered" or "corrected", see `Settings`; of walks "precomputed", see
            `unscattered_light`.
        part: of gathered light, see `Gathering`, 0 for all of it; of precomputed light one independent of other parts.
        blur: of walks, see `translucent_walk`.
        denoised: whether the image of walks is denoised.
    """

    model: str
    light: str = "sampled"
    part: int = 0
    blur: float = 1.0
    denoised: bool = False

    @property
    def walks(self) -> bool:
        return self.model == PATH_TRACED

    @property
    def exact(self) -> bool:
        """Whether it is walks with sampled light, the reference of biases."""
        return self.walks and self.light == "sampled" and not self.denoised

    @property
    def gathers(self) -> bool:
        """Whether light is gathered before the first sample."""
        return self.light in GATHERED_LIGHTS

    def serves(self, light: str) -> bool:
        """Whether it is a model in such light; a diffuse surface, which gathers nothing, is the same in gathered."""
        return not self.walks and (self.light == light or (self.model == LAMBERT and light != CORRECTED))

    @property
    def halves(self) -> tuple[Technique, ...]:
        """The techniques that it is measured by: itself, or two independent parts of gathered or precomputed light.
        Corrected light is measured as images have it, so that the noise of its walks counts."""
        return (self,) if self.light in ("sampled", CORRECTED) else (replace(self, part=1), replace(self, part=2))

    @property
    def name(self) -> str:
        light = "" if self.light == "sampled" else f", {self.light}"
        return self.model + light + (DENOISED if self.denoised else "")

    @property
    def flags(self) -> str:
        """The options of the command `render` for it."""
        light = f" --light {self.light}" if self.walks or self.light != "sampled" else ""
        return f"--model {self.model}{light}" + (" --denoise" if self.denoised else "")

    @classmethod
    def of(cls, name: str) -> Technique:
        """The technique of that name; ValueError if there is none."""
        denoised = name.startswith(PATH_TRACED) and name.endswith(DENOISED)
        model, _, light = (name.removesuffix(DENOISED) if denoised else name).partition(", ")
        check_choice("way", model, (PATH_TRACED, *(m for m in model_names() if m != AUTO)))
        known = {PATH_TRACED: (PRECOMPUTED,), LAMBERT: ()}.get(model, GATHERED_LIGHTS)
        if light:
            check_choice(f"light of {model}", light, known)
        return cls(model, light or "sampled", denoised=denoised)


WALKS = Technique(PATH_TRACED)
PRECOMPUTED_WALKS = Technique(PATH_TRACED, light=PRECOMPUTED)
DENOISED_WALKS = tuple(replace(each, denoised=True) for each in (WALKS, PRECOMPUTED_WALKS))
WALKED = (WALKS, PRECOMPUTED_WALKS, *DENOISED_WALKS)


def techniques() -> list[Technique]:
    """All of them: path traced first, with light sampled and precomputed, denoised too, a diffuse surface, every model
    with light sampled and gathered, and the one that is ready first with light corrected."""
    names = [name for name in model_names() if name not in (AUTO, LAMBERT)]
    results = [*WALKED, Technique(LAMBERT), *map(Technique, names)]
    return [*results, *(Technique(name, light=GATHERED) for name in names), Technique(READY_FIRST, light=CORRECTED)]


@dataclass(eq=False)
class Stage:
    """A loaded scene, and the integrators of several techniques for it.
    `settings`: of its integrator, by parameter name. `bssrdf`: parameters that `bssrdf` alone understands. `paces`:
    first `Sampled` of earlier runs by (object, technique), so that the next run knows what a sample takes.
    `light_samples`: of the image that light is precomputed for."""

    scene: mi.Scene
    shapes: list[mi.Shape]
    settings: dict[str, Any]
    bssrdf: dict[str, Any]
    paces: dict[tuple[int, Technique], Any] = field(default_factory=dict)
    light_samples: int = MOST_LIT
    _integrators: dict[Technique, mi.Integrator] = field(default_factory=dict)

    @property
    def mm_per_unit(self) -> float:
        return float(self.settings["mm_per_unit"])

    @property
    def lit(self) -> float:
        """Samples of a pixel that light is precomputed for."""
        return self.light_samples / self.pixels

    @property
    def pixels(self) -> int:
        """The number of pixels of the picture."""
        return math.prod(int(n) for n in self.scene.sensors()[0].film().crop_size())

    @property
    def names(self) -> list[str]:
        """Ids of the objects."""
        return [shape.id() for shape in self.shapes]

    @property
    def blurs(self) -> bool:
        """Whether walks spread light of a delta light over a blur, so that they are not exact."""
        return any(map(is_delta, self.scene.emitters()))

    def integrator(self, technique: Technique) -> mi.Integrator:
        """The integrator of a technique, which keeps what it has made ready; denoised walks are walks."""
        technique = replace(technique, denoised=False)
        if technique not in self._integrators:
            if technique.walks:
                plugin = {"type": "translucent_walk", **self.settings, "blur": technique.blur, "light": technique.light}
                plugin["layers"] = True  # a denoiser leaves what they show
            else:
                plugin = {"type": "bssrdf", **self.settings, **self.bssrdf}
                plugin |= {"model": technique.model, "light": technique.light}
            self._integrators[technique] = mi.load_dict(plugin)
            if technique.part and not technique.walks:
                self._integrators[technique].gathering = Gathering(technique.part)
            sampled = self._integrators.get(replace(technique, light="sampled", part=0))
            # spectral variants refuse gathered light
            if technique.light == GATHERED and sampled is not None and not mi.is_spectral:
                self._integrators[technique].take_over(sampled)
            first = self._integrators.get(replace(technique, part=1))
            if technique.walks and technique.part > 1 and first is not None:
                self._integrators[technique].take_over(first)
        return self._integrators[technique]

    def forget(self, technique: Technique) -> None:
        """Drop what has been made ready for a technique."""
        self._integrators.pop(technique, None)


def stage(scene: mi.Scene | dict[str, Any] | str | Path, parameters: dict[str, str] | None = None) -> Stage:
    """A scene made ready to be rendered by several techniques.
    `scene`: a Mitsuba scene, a dict, or the path of an XML file. `parameters`: values of the parameters $name of an XML
    file. ValueError as of `load_objects`, or if there is no translucent object or no sensor, or it is an instance."""
    check_variant()
    loaded = scene if isinstance(scene, mi.Scene) else load_objects(scene, parameters)
    shapes = translucent_shapes(loaded)
    if not shapes:
        raise ValueError(NO_OBJECT)
    check_sensor(loaded, 0)
    refuse_instances(loaded, shapes, "the trade")
    return Stage(loaded, shapes, *_settings(loaded))


def _settings(scene: mi.Scene) -> tuple[dict[str, Any], dict[str, Any]]:
    """Settings of both integrators, and of `bssrdf` alone, from the integrator of the scene where it is one of them."""
    integrator = scene.integrator()
    if is_bssrdf(integrator):
        return integrator.settings.shared(), integrator.settings.of_models()
    common: dict[str, Any] = {"mm_per_unit": millimetres(scene), "hide_emitters": False, "max_depth": -1, "rr_depth": 5}
    if isinstance(integrator, KnowsUnit):  # `translucent_walk`
        common |= {"hide_emitters": integrator.hidden}
    return common, {}


# --------------------------------------------------------------------------------------------------
# The job of a rendering, and the effort by which techniques for it are measured.


EXITS = 480  # few: their choice makes 3 % of a bias uncertain, and each gets the more samples


@dataclass(frozen=True)
class Job:
    """A job of rendering.
    `tolerance`: relative error of radiance, bias and noise together. `images`: of the object, each as large as the
    film. `seconds`: that all of them may take; None for no limit."""

    tolerance: float = 0.05
    images: int = 1
    seconds: float | None = None

    def __post_init__(self) -> None:
        check_interval("tolerance", self.tolerance, 1e-4, 10.0)
        check_count("images", self.images, 1)
        if self.seconds is not None:
            check_interval("seconds", self.seconds, 1e-3, 1e9)


@dataclass(frozen=True)
class Effort:
    """The effort of the measurement of a scene.

    Args:
        seconds: for each object, shared by all techniques, compilation left out.
        samples: of each exit by each technique, in place of seconds; the outcome then depends on the seed alone.
        exits: points of each object.
        seed: of everything; what depends on the clock is how many samples are taken.
    """

    seconds: float = 4.0
    samples: int | None = None
    exits: int = EXITS
    sensor: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0)
        check_count("exits", self.exits, 32)
        check_count("sensor", self.sensor, 0)
