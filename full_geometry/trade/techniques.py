"""The techniques of rendering, in turn on one scene, and the job and the light of a measurement."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from full_geometry.integrators.bssrdf import is_bssrdf
from full_geometry.integrators.correction import Corrections
from full_geometry.integrators.gathering import Gathering
from full_geometry.objects.objects import KnowsUnit, millimetres, refuse_instances, translucent_shapes
from full_geometry.objects.small_emitters import is_delta
from full_geometry.scenes.reference import check_sensor
from full_geometry.scenes.scene_files import PATH_TRACED, load_objects
from full_geometry.settings import AUTO, GATHERED_LIGHTS, check_variant
from full_geometry.transport.models import model_names
from halfspace_sss.checks import check_choice, check_count, check_interval

LAMBERT, READY_FIRST = "lambert", "better_dipole"
GATHERED, CORRECTED, PRECOMPUTED = *GATHERED_LIGHTS, "precomputed"
RAYS = 2**19  # of light precomputed for walks, for each object: its noise at a point is 3 to 8 %


@dataclass(frozen=True)
class Technique:
    """A model for all objects, or "path_traced", of the orders of the scene.

    Args:
        model: name of a model, or "path_traced": walks.
        light: "sampled"; of models "gathered" or "corrected", see `Settings`; of walks "precomputed", see
            `unscattered_light`.
        part: of gathered light, see `Gathering`, 0 for all of it; of precomputed light one independent of other parts.
        blur: of walks, see `translucent_walk`.
        smoothed: whether by the smoothed environment, see `SmoothedEnvironment`.
    """

    model: str
    light: str = "sampled"
    part: int = 0
    blur: float = 1.0
    smoothed: bool = False

    @property
    def walks(self) -> bool:
        return self.model == PATH_TRACED

    @property
    def exact(self) -> bool:
        """Whether it is walks with sampled light, the reference of biases."""
        return self.walks and self.light == "sampled"

    @property
    def gathers(self) -> bool:
        """Whether light is gathered before the first sample."""
        return self.light in GATHERED_LIGHTS

    @property
    def halves(self) -> tuple[Technique, ...]:
        """The techniques that it is measured by: itself, or two independent parts of gathered or precomputed light."""
        return (self,) if self.light == "sampled" else (replace(self, part=1), replace(self, part=2))

    @property
    def name(self) -> str:
        return self.model if self.light == "sampled" else f"{self.model}, {self.light}"

    @property
    def flags(self) -> str:
        """The options of the command `render` for it."""
        return f"--model {self.model}" + (f" --light {self.light}" if self.walks or self.light != "sampled" else "")

    @classmethod
    def of(cls, name: str) -> Technique:
        """The technique of that name; ValueError if there is none."""
        model, _, light = name.partition(", ")
        check_choice("way", model, (PATH_TRACED, *(m for m in model_names() if m != AUTO)))
        known = {PATH_TRACED: (PRECOMPUTED,), LAMBERT: ()}.get(model, GATHERED_LIGHTS)
        if light:
            check_choice(f"light of {model}", light, known)
        return cls(model, light or "sampled")


WALKS = Technique(PATH_TRACED)
PRECOMPUTED_WALKS = Technique(PATH_TRACED, light=PRECOMPUTED)


def techniques() -> list[Technique]:
    """All of them: path traced first, with light sampled and precomputed, a diffuse surface, every model with light
    sampled and gathered, and the one that is ready first with light corrected."""
    names = [name for name in model_names() if name not in (AUTO, LAMBERT)]
    results = [WALKS, PRECOMPUTED_WALKS, Technique(LAMBERT), *map(Technique, names)]
    return [*results, *(Technique(name, light=GATHERED) for name in names), Technique(READY_FIRST, light=CORRECTED)]


@dataclass(eq=False)
class Stage:
    """A loaded scene, and the integrators of several techniques for it.

    Args:
        scene: the Mitsuba scene.
        shapes: its translucent shapes.
        settings: of its integrator, by parameter name.
        bssrdf: parameters that `bssrdf` alone understands.
        paces: first `Sampled` of earlier runs by (object, technique), so that the next run knows what a sample takes.
        smoothed: environment that biases are measured by; None where the light of the scene does it.
    """

    scene: mi.Scene
    shapes: list[mi.Shape]
    settings: dict[str, Any]
    bssrdf: dict[str, Any]
    paces: dict[tuple[int, Technique], Any] = field(default_factory=dict)
    smoothed: SmoothedEnvironment | None = None
    _integrators: dict[Technique, mi.Integrator] = field(default_factory=dict)

    @property
    def mm_per_unit(self) -> float:
        return float(self.settings["mm_per_unit"])

    @property
    def names(self) -> list[str]:
        """Ids of the objects."""
        return [shape.id() for shape in self.shapes]

    @property
    def blurs(self) -> bool:
        """Whether walks spread light of a delta light over a blur, so that they are not exact."""
        return any(map(is_delta, self.scene.emitters()))

    @contextmanager
    def with_smoothed_environment(self) -> Iterator[Stage]:
        """The stage with its environment map smoothed too, if it has one; its own is put back at the end."""
        smoothed = SmoothedEnvironment.of(self.scene)
        try:
            yield replace(self, smoothed=smoothed)
        finally:
            if smoothed is not None:
                smoothed.show(False)

    def runs(self, technique: Technique) -> tuple[Technique, ...]:
        """The runs of a technique: its halves; smoothed for the bias, with one half unsmoothed for the cost."""
        if self.smoothed is None:
            return technique.halves
        *rest, last = (replace(half, smoothed=True) for half in technique.halves)
        return (*rest, technique.halves[-1], last)

    def lit(self, technique: Technique) -> mi.Scene:
        """The scene in the light of a run."""
        if self.smoothed is not None:
            self.smoothed.show(technique.smoothed)
        return self.scene

    def integrator(self, technique: Technique) -> mi.Integrator:
        """The integrator of a technique, which keeps what it has made ready; shapes are the same in all light."""
        technique = replace(technique, smoothed=technique.smoothed and technique.light == PRECOMPUTED)
        if technique not in self._integrators:
            if technique.walks:
                plugin = {"type": "translucent_walk", **self.settings, "blur": technique.blur, "light": technique.light}
            else:
                plugin = {"type": "bssrdf", **self.settings, **self.bssrdf}
                plugin |= {"model": technique.model, "light": technique.light}
            self._integrators[technique] = mi.load_dict(plugin)
            if technique.part and not technique.walks:
                self._integrators[technique].gathering = Gathering(technique.part)
                self._integrators[technique].corrections = Corrections(technique.part)
            sampled = self._integrators.get(replace(technique, light="sampled", part=0))
            # spectral variants refuse gathered light
            if technique.light == GATHERED and sampled is not None and not mi.is_spectral:
                self._integrators[technique].take_over(sampled)
        return self._integrators[technique]

    def forget(self, technique: Technique) -> None:
        """Drop what has been made ready for a technique."""
        self._integrators.pop(technique, None)


def stage(scene: mi.Scene | dict[str, Any] | str | Path, parameters: dict[str, str] | None = None) -> Stage:
    """A scene made ready to be rendered by several techniques.

    Args:
        scene: a Mitsuba scene, a dict, or the path of an XML file.
        parameters: values of the parameters $name of an XML file.

    Raises:
        ValueError: as `load_objects`; there is no translucent object or no sensor, or it is an instance.
    """
    check_variant()
    loaded = scene if isinstance(scene, mi.Scene) else load_objects(scene, parameters)
    shapes = translucent_shapes(loaded)
    if not shapes:
        raise ValueError("the scene must have an object with a translucent BSDF, got none")
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
TRACED_SHARE = 0.4  # of the time, for the walks that all techniques are compared with


@dataclass(frozen=True)
class Job:
    """A job of rendering.

    Args:
        tolerance: relative error of radiance, bias and noise together.
        images: of the object, each as large as the film.
        seconds: that all of them may take; None for no limit.
    """

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
        traced: share of the time for walks.
        sensor: number of the sensor.
        seed: of everything; what depends on the clock is how many samples are taken.
    """

    seconds: float = 4.0
    samples: int | None = None
    exits: int = EXITS
    traced: float = TRACED_SHARE
    sensor: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("seed", self.seed, 0)
        check_count("exits", self.exits, 32)
        check_count("sensor", self.sensor, 0)


# --------------------------------------------------------------------------------------------------
# An environment map smoothed over directions, by which few walks tell how wrong a model is.
#
# A walk through a refracting boundary meets a window by chance alone. What S makes of light after two orders and more
# varies little over direction, so that a smoothed map leaves its relative error nearly the same
# (benchmarks/notes/trade_check.md):
#
#     L'(w) = c + g [∫ K(w.w') L(w') dw' - c],  K(x) = κ exp(κ (x - 1)) / (2 pi (1 - exp(-2 κ))),  κ = 1 / WIDTH²,
#
# with c the mean of L over the sphere, which L' keeps. g = 1 / (coth κ - 1/κ) keeps its first moment too; it is less
# where L' would be below 0.


WIDTH = 0.4  # radians
ROWS = 17  # of the map of L', from pole to pole
LOOKED_AT = 64  # rows of L at most: blocks of more pixels are taken together


@dataclass(eq=False)
class SmoothedEnvironment:
    """The environment map of a scene, which shows its own or its smoothed pixels.

    Args:
        parameters: of the emitter.
        own, blurred: pixels of both.
    """

    parameters: mi.SceneParameters
    own: mi.TensorXf
    blurred: mi.TensorXf
    _is_smoothed: bool = False

    @classmethod
    def of(cls, scene: mi.Scene) -> SmoothedEnvironment | None:
        """The map of a scene; None if there is none, or one of so few pixels that it is smooth."""
        sky = scene.environment()
        if sky is None or sky.class_name() != "EnvironmentMapEmitter" or mi.is_spectral:
            return None
        parameters = mi.traverse(sky)
        own = mi.TensorXf(parameters["data"])  # a copy, as the emitter changes what it gives
        return cls(parameters, own, mi.TensorXf(smoothed(np.array(own)))) if len(own) > ROWS else None

    def show(self, smoothed: bool) -> None:
        """Let the scene have its own or the smoothed map."""
        if smoothed != self._is_smoothed:
            self.parameters["data"], self._is_smoothed = self.blurred if smoothed else self.own, smoothed
            self.parameters.update()


def smoothed(pixels: np.ndarray) -> np.ndarray:
    """L' of an environment map, (rows, columns, channels) with the first and last column twice as `envmap` has them.

    It has as many pixels, as kernels know how many there are.
    """
    L = pixels[:, 1:-1]
    theta, phi = _angles(*L.shape[:2])
    step = math.ceil(len(theta) / LOOKED_AT)
    rows, columns = (np.arange(0, len(angle), step) for angle in (theta, phi))
    flux = np.add.reduceat(L * np.sin(theta)[:, None, None], rows, axis=0)
    flux = np.add.reduceat(flux, columns, axis=1).reshape(-1, L.shape[2])
    flux *= 2 * math.pi**2 / (len(theta) - 1) / len(phi)
    means = (np.add.reduceat(angle, at) / np.diff([*at, len(angle)]) for angle, at in ((theta, rows), (phi, columns)))
    kappa, few = 1 / WIDTH**2, _angles(ROWS, 2 * ROWS - 2)
    K = np.exp(kappa * (_directions(*few) @ _directions(*means).T - 1))
    c, blurred = flux.sum(axis=0) / (4 * math.pi), K @ flux * kappa / (2 * math.pi * -math.expm1(-2 * kappa))
    g = min(1 / (1 / math.tanh(kappa) - 1 / kappa), float((c / np.maximum(c - blurred, 1e-30)).min()))
    soft = (c + g * (blurred - c)).reshape(ROWS, -1, L.shape[2])
    by_row, by_column = _weights(theta, few[0]), _weights(phi, few[1], 2 * math.pi)
    soft = np.stack([by_row @ soft[..., k] @ by_column.T for k in range(L.shape[2])], axis=-1)
    return np.concatenate([soft[:, -1:], soft, soft[:, :1]], axis=1).astype(np.float32)


def _weights(fine: np.ndarray, coarse: np.ndarray, period: float | None = None) -> np.ndarray:
    """The matrix that interpolates values at coarse angles to fine ones."""
    return np.stack([np.interp(fine, coarse, row, period=period) for row in np.eye(len(coarse))], axis=1)


def _angles(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Polar angles and azimuths of the pixels of a map, from pole to pole."""
    return np.linspace(0, np.pi, rows), (np.arange(columns) + 0.5) * 2 * np.pi / columns


def _directions(theta: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Directions of pixels at these angles, (rows columns, 3), about any axis."""
    theta, phi = theta[:, None], phi[None]
    x, y, z = np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi
    return np.stack([x, y, z], axis=-1).reshape(-1, 3)
