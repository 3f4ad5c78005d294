"""Delta lights in the medium of an object, by which scattering events and surfaces there are lit.

The irradiance I / d² of a light is unbounded at events close to it. Within a radius r below a mean free path it is
even, which keeps all light and blurs it by r:

    E(d) = I / d² for d > r,    3 I / r² (1 + sigma_t r / 4) for d < r,

    ∫_0^r E(d) e^(-sigma_t d) d² dd = I ∫_0^r e^(-sigma_t d) dd    to the order (sigma_t r)³.

After reflection or refraction at a smooth boundary no event sees a light; it is spread over a cone (`light.small`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.light.small import spread
from halfspace_sss.rendering.walk.media import WalkMedia
from halfspace_sss.rendering.walk.steps import draw

__all__ = ["Lamps"]

NEAREST = 0.2  # mean free paths, r
CONE = 0.15  # radius of the cone, radians; light that a medium scatters beside it hides more


@dataclass(frozen=True, eq=False)
class Lamps:
    """The delta lights inside objects.

    Args:
        media: the objects.
        emitters: the lights.
        tables: of each, what Dr.Jit's registry calls it, `pointer`, and the object `around` it.
    """

    media: WalkMedia
    emitters: list[Any]
    tables: dict[str, Any]

    @classmethod
    def of(cls, media: WalkMedia) -> Lamps | None:
        """Those of the objects of a scene; None if there are none."""
        if media.inner is None or not media.inner.lamps:
            return None
        emitters, around = zip(*media.inner.lamps)
        pointers = [int(dr.reinterpret_array(mi.UInt32, mi.EmitterPtr(emitter))[0]) for emitter in emitters]
        tables = {"pointer": mi.UInt32(pointers), "around": mi.Int32(around)}
        dr.make_opaque(tables)
        return cls(media, list(emitters), tables)

    def _drawn(self, k: Any, rng: Any, active: Any) -> tuple[Any, Any]:
        """One of the lights, and whether it is in object k."""
        which = draw(len(self.emitters), rng)
        here = active & (dr.gather(mi.Int32, self.tables["around"], which) == k)
        if len(self.emitters) == 1:
            return self.emitters[0], here
        return dr.reinterpret_array(mi.EmitterPtr, dr.gather(mi.UInt32, self.tables["pointer"], which)), here

    def light(self, k: Any, at: Any, rng: Any, active: Any) -> tuple[Any, Any]:
        """The direction to a light from an interaction in object k, and its irradiance across, over its probability."""
        emitter, here = self._drawn(k, rng, active)
        ds, E = emitter.sample_direction(at, mi.Point2f(0.5), here)
        lit = here & (ds.pdf > 0) & (dr.max(E) > 0)
        ray = at.spawn_ray(ds.d)
        sigma_t = self.media.spectrum("sigma_t", k)
        r = NEAREST / dr.max(sigma_t)
        near = dr.select(ds.dist < r, 3 * dr.square(ds.dist / r) * (1 + 0.25 * r * sigma_t), 1)
        return ds.d, dr.select(lit, self._passed(k, ray, ds.dist, rng, lit) * E * (near * len(self.emitters)), 0)

    def spread(self, k: Any, ray: Any, rng: Any, active: Any) -> Any:
        """Radiance of a light along a ray in object k, spread over a wide cone, over its probability."""
        emitter, here = self._drawn(k, rng, active)
        L = spread(self.media.inner.scene, emitter, ray, mi.Float(CONE), here)
        at = dr.zeros(mi.Interaction3f)
        at.p = ray.o
        ds, _ = emitter.sample_direction(at, mi.Point2f(0.5), here)
        lit = here & (dr.max(L) > 0)
        T = self.media.transmittance(k, ray, dr.select(lit, ds.dist, 0), rng)
        return dr.select(lit, T * L * len(self.emitters), 0)

    def _passed(self, k: Any, ray: Any, distance: Any, rng: Any, active: Any) -> Any:
        """The transmittance of what is between: 0 behind any surface."""
        shadow = mi.Ray3f(ray)
        shadow.maxt = distance * (1 - 1e-4)
        clear = active & ~self.media.inner.scene.ray_test(shadow, False, active)
        return dr.select(clear, self.media.transmittance(k, ray, dr.select(clear, distance, 0), rng), 0)
