"""The reflection of a dielectric boundary, which is always seen from outside: no path of surfaces leads inside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.surface.horizon import mirrored

__all__ = ["Reflection"]


@dataclass(frozen=True, eq=False)
class Reflection:
    """The reflecting lobe of a boundary, whichever way the normals of the object point.

    Args:
        boundary: a Mitsuba BSDF.
        lobe: number of its component that reflects.
    """

    boundary: Any
    lobe: int

    @classmethod
    def of(cls, boundary: Any) -> Reflection:
        """The reflection of a boundary; ValueError if it does not reflect."""
        for k in range(boundary.component_count()):
            if boundary.flags(k) & int(mi.BSDFFlags.Reflection):
                return cls(boundary, k)
        raise ValueError(f"the boundary must reflect, got {boundary}")

    def sample(self, ctx: Any, si: Any, u: Any, v: Any, active: Any) -> tuple[Any, Any]:
        """A direction and its weight; one that a smooth boundary reflects to below the surface is reflected again."""
        seen, sign = _from_outside(si)
        bs, weight = self.boundary.sample(self._context(ctx), seen, u, v, active)
        n = si.to_local(si.n)
        n = dr.select(dr.dot(n, si.wi) < 0, -n, n)
        wo = _turned(bs.wo, sign)
        bs.wo = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), mirrored(wo, n), wo)
        bs.sampled_component = 0
        return bs, weight

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
        """Value times cosine."""
        seen, sign = _from_outside(si)
        return self.boundary.eval(self._context(ctx), seen, _turned(wo, sign), active)

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any) -> Any:
        """Density of `sample`."""
        seen, sign = _from_outside(si)
        return self.boundary.pdf(self._context(ctx), seen, _turned(wo, sign), active)

    def _context(self, ctx: Any) -> Any:
        return mi.BSDFContext(ctx.mode, ctx.type_mask, self.lobe)


def _from_outside(si: Any) -> tuple[Any, Any]:
    """The interaction with the normal on the side that is seen, and 1, or -1 where it was turned."""
    sign = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, mi.Float(-1), 1)
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = _turned(si.wi, sign)
    return seen, sign


def _turned(w: Any, sign: Any) -> Any:
    """A local direction in the frame that is turned about its first axis where the sign is -1."""
    return mi.Vector3f(w.x, w.y * sign, w.z * sign)
