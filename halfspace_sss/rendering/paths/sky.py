"""The mean light of the sky as a control variate, for transports that know what they are under even light.

With alpha = ∫ S mu_i dw_i dA_i and a constant radiance c per channel

    L_o = alpha c + ∫ S mu_i (L_i - c) dw_i dA_i,

so that where light is c there is nothing left to be random. c is the mean of the environment over directions, by the
inverse of the density that they are drawn with: the bright ones, which are drawn often, have little noise of their own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.paths.lights import Lights
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.transport.body import Body

__all__ = ["Sky", "sky_of"]

DIRECTIONS = 128  # squared


class Sky(NamedTuple):
    """The environment of a scene, and its mean radiance c, a spectrum."""

    emitter: Any
    mean: Any

    def density(self, scene: Any, at: Any, d: Any, active: Any) -> Any:
        """Of a direction, when emitters are sampled, 1/sr."""
        return scene.pdf_emitter_direction(at, _towards(self.emitter, d), active)


def sky_of(scene: Any, lights: Lights, bodies: list[Body]) -> Sky | None:
    """The sky of a scene; None where there is none, or no body knows what it is under even light."""
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
        weight = dr.rcp(density)
        found = mi.Spectrum(emitter.eval(si))
        mean = dr.opaque(mi.Spectrum, [(dr.sum(v * weight) / dr.sum(weight))[0] for v in found])
    return Sky(emitter, mean)


def _towards(emitter: Any, d: Any) -> Any:
    """A direction of the environment."""
    ds = dr.zeros(mi.DirectionSample3f)
    ds.d, ds.emitter = d, mi.EmitterPtr(emitter)
    return ds
