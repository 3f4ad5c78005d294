"""What kinds of emitters a scene has, and so how directions of incidence are sampled."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.light.small_emitters import WIDE, SmallEmitters, is_delta
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.settings import AUTOMATIC, Settings

__all__ = ["Books", "Lights", "Replay", "Sky", "Tally", "World", "balance", "delta_light", "sampled_light", "sky_of"]


EMITTER_SHARE = 0.5


@dataclass(frozen=True)
class Lights:
    """Kinds of emitters.

    Args:
        share: share of the directions into an object that are sampled by emitters; 0 where all light is the same from
            everywhere, which the model's own directions find better.
        some_local: whether there is an emitter beside the environment.
        some_shaped: whether there is one with a shape, which rays can hit.
        some_delta: whether there is one that no ray can hit (point, spot, directional).
    """

    share: float
    some_local: bool
    some_shaped: bool
    some_delta: bool

    @classmethod
    def of(cls, scene: Any) -> Lights:
        """The lights of a scene."""
        emitters = scene.emitters()
        even = all("Constant" in emitter.class_name() for emitter in emitters)
        delta = any(map(is_delta, emitters))
        local = any(not emitter.is_environment() for emitter in emitters)
        shaped = any(emitter.get_shape() is not None for emitter in emitters)
        return cls(0.0 if even else EMITTER_SHARE, local, shaped, delta)


def balance(pdf: Any, other: Any) -> Any:
    """The balance heuristic."""
    total = pdf + other
    return dr.select(total > 0, pdf / dr.maximum(total, 1e-30), 0)


# ---- Mean radiance of the sky as a control variate -----------------------------------------------------------------

DIRECTIONS = 128  # squared
MOST_LEFT = 0.5  # of the mean square of the radiance, once c is taken from it


class Sky(NamedTuple):
    """The environment of a scene, and its mean radiance c, a spectrum."""

    emitter: Any
    mean: Any

    def density(self, scene: Any, at: Any, d: Any, active: Any) -> Any:
        """Of a direction, when emitters are sampled, 1/sr."""
        return scene.pdf_emitter_direction(at, _towards(self.emitter, d), active)


def sky_of(scene: Any, lights: Lights, bodies: list[Body]) -> Sky | None:
    """The sky of a scene; None where there is none, it is uneven, or no body knows what it is under even light."""
    emitter = scene.environment()
    if emitter is None or not any(hasattr(body.transport, "alpha") for body in bodies):
        return None
    with detached():
        k = dr.arange(mi.UInt32, DIRECTIONS**2)
        u = mi.Point2f(k % DIRECTIONS + 0.5, k // DIRECTIONS + 0.5) / DIRECTIONS
        si = dr.zeros(mi.SurfaceInteraction3f, DIRECTIONS**2)
        si.wi = -mi.warp.square_to_uniform_sphere(u)
        density = (1 - lights.share) * mi.warp.square_to_uniform_sphere_pdf(si.wi)
        if lights.share > 0:
            density += lights.share * scene.pdf_emitter_direction(si, _towards(emitter, -si.wi))
        L, weight = np.array(mi.Spectrum(emitter.eval(si)) + 0 * density), 1 / np.array(density)
        c = np.average(L, axis=1, weights=weight)
        left = np.average((L - c[:, None]) ** 2, axis=1, weights=weight).sum()
        if left > MOST_LEFT * np.average(L**2, axis=1, weights=weight).sum():
            return None
        return Sky(emitter, dr.opaque(mi.Spectrum, c.tolist()))


def _towards(emitter: Any, d: Any) -> Any:
    """A direction of the environment."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d, ds.emitter = d, mi.EmitterPtr(emitter)
    return ds


# ---- Path tally, and its replay for derivatives --------------------------------------------------------------------

Books = tuple[Any, Any]  # radiance so far, or in a replay still to come; its derivative, or adjoint; spectra


@dataclass(frozen=True)
class Tally:
    """Adds up the light of a path."""

    tracks = False

    def add(self, books: Books, light: Any) -> Books:
        """Light that the path brings."""
        return books[0] + light, books[1]

    def settle(self, books: Books, light: Any, weight: Any, goes_on: Any, shown: Any) -> Books:
        """A vertex: its light, and the weight of what comes after it where the path goes on.

        Args:
            light: spectrum, to be added.
            weight: spectrum that scales all light after the vertex.
            goes_on: where it does.
            shown: light that the weight scales too, over the weight, and that is in the books already.
        """
        return self.add(books, light)


@dataclass(frozen=True)
class Replay:
    """Takes the light of a path away again, and differentiates it.

    Args:
        backward: whether derivatives of light are handed to the parameters, or those of the parameters to the light.
    """

    backward: bool
    tracks = True

    def add(self, books: Books, light: Any) -> Books:
        """Light that the path brings."""
        L, d = self._vary(books, light)
        return L - dr.detach(light), d

    def settle(self, books: Books, light: Any, weight: Any, goes_on: Any, shown: Any) -> Books:
        """As in `Tally`."""
        L = books[0] - dr.detach(light)
        fixed = dr.detach(weight)
        after = dr.select(goes_on & (fixed != 0), L / dr.select(fixed != 0, fixed, 1), 0)
        return self._vary((L, books[1]), light + weight * (after + shown))

    def _vary(self, books: Books, value: Any) -> Books:
        L, d = books
        if not dr.grad_enabled(value):
            return books
        if self.backward:
            dr.backward_from(d * value)
            return books
        return L, d + dr.forward_to(value)


# ---- What every path needs -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class World:
    """What every path needs.

    Args:
        scene: the Mitsuba scene.
        lights: its kinds of emitters.
        bodies: its translucent objects.
        settings: those of the integrator.
        books: what is written down.
        sky: its mean light, where it serves.
        small: its emitters that look small, if there are any.
    """

    scene: Any
    lights: Lights
    bodies: list[Body]
    settings: Settings
    books: Tally | Replay
    sky: Sky | None = None
    small: SmallEmitters | None = None

    @classmethod
    def of(cls, scene: Any, bodies: list[Body], settings: Settings, books: Tally | Replay) -> World:
        """That of a scene and its bodies."""
        lights = Lights.of(scene)
        with detached():
            small = SmallEmitters.of(scene)
        return cls(scene, lights, bodies, settings, books, sky_of(scene, lights, bodies), small)

    @property
    def suns(self) -> bool:
        """Whether the environment has suns, which are aimed at."""
        return self.small is not None and len(self.small.suns) > 0

    def evens(self, body: Body) -> bool:
        """Whether the mean light of the sky serves a body."""
        return self.sky is not None and hasattr(body.transport, "alpha")

    def even(self, body: Body) -> tuple[Any, Any]:
        """The mean light of the sky in the channels where it serves, for orders below two and for the others."""
        few, others = body.transport.evened
        return few * self.sky.mean, others * self.sky.mean

    def entries(self, body: Body) -> int:
        """How many an exit draws: one where the mean light of the sky is nearly all, and the settings do not say."""
        alone = self.evens(body) and not self.lights.some_local
        return 1 if alone and self.settings.entries == AUTOMATIC else body.entries


def sampled_light(world: World, ref: Any, u: Any, test_visibility: bool, active: Any) -> tuple[Any, Any]:
    """A direction sampled by the emitters, and their light over its density; derivatives are those of the light."""
    with detached():
        ds, light = world.scene.sample_emitter_direction(ref, u, test_visibility, active)
        inverse = dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
    if not world.books.tracks:
        return ds, light
    shines = active & (ds.pdf > 0)
    return ds, dr.replace_grad(light, world.scene.eval_emitter_direction(ref, ds, shines) * inverse)


def delta_light(world: World, sampler: Any, ray: Any, active: Any) -> Any:
    """Light of the delta lights along a ray, spread over a wide cone, by one of them."""
    n = world.small.n_delta
    which = mi.UInt32(dr.minimum(sampler.next_1d() * n, n - 1)) if n > 1 else mi.UInt32(0)
    return n * world.small.spread(which, ray, mi.Float(WIDE), active)
