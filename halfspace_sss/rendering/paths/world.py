"""What every path needs to know: the scene, its lights and bodies, the settings, and how its light is written down."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.light.small import WIDE, SmallEmitters
from halfspace_sss.rendering.paths.books import Replay, Tally
from halfspace_sss.rendering.paths.lights import Lights
from halfspace_sss.rendering.paths.sky import Sky, sky_of
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.transport.body import Body
from halfspace_sss.rendering.transport.settings import AUTOMATIC, Settings

__all__ = ["World", "delta_light", "sampled_light"]


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
