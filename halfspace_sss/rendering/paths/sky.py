"""The mean light of the sky as a control variate, for transports that know what they are under even light.

With alpha = ∫ S mu_i dw_i dA_i and a constant radiance c per channel

    L_o = alpha c + ∫ S mu_i (L_i - c) dw_i dA_i,

so that where light is c there is nothing left to be random. c is the mean of the environment over directions, by the
inverse of the density that they are drawn with: the bright ones, which are drawn often, have little noise of their own.
It is left out where it is not most of the light in the square, as under a sun: there it costs time and takes no noise.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.paths.lights import Lights
from halfspace_sss.rendering.surface.derivatives import detached
from halfspace_sss.rendering.transport.body import Body

__all__ = ["Sky", "sky_of"]

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
