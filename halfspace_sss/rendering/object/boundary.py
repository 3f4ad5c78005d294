"""The smooth dielectric boundary of an object; its index is data of kernels, which then serve media of any index."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.object.points import mirrored

__all__ = ["Reflection", "boundary_of", "check_eta", "is_smooth_boundary", "smooth_boundary"]

REFLECTED, REFRACTED = 0, 1  # components


def smooth_boundary(eta: float) -> mi.BSDF:
    """The plain dielectric of a relative index under the current variant of Mitsuba.

    The same events, weights and densities as Mitsuba's `dielectric` without tints, whose index is part of the code of
    every kernel: each other index would compile them all anew.

    Args:
        eta: index inside over index outside.
    """
    props = mi.Properties("smooth_boundary")
    props["eta"] = float(eta)
    return _class(mi.variant())(props)


def is_smooth_boundary(boundary: mi.BSDF) -> bool:
    """Whether a boundary is one of `smooth_boundary`."""
    return isinstance(boundary, _class(mi.variant()))


@functools.cache
def _class(variant: str) -> type:
    """The class of a variant, which must be the current one."""

    class SmoothBoundary(mi.BSDF):
        """Reflection by Fresnel's equations, and refraction into the cone by Snell's law."""

        def __init__(self, props: mi.Properties) -> None:
            mi.BSDF.__init__(self, props)
            self.eta = dr.opaque(mi.Float, float(props["eta"]))
            faces = int(mi.BSDFFlags.FrontSide) | int(mi.BSDFFlags.BackSide)
            reflects = int(mi.BSDFFlags.DeltaReflection) | faces
            refracts = int(mi.BSDFFlags.DeltaTransmission) | int(mi.BSDFFlags.NonSymmetric) | faces
            self.m_components = [reflects, refracts]
            self.m_flags = reflects | refracts

        def traverse(self, callback: mi.TraversalCallback) -> None:
            callback.put("eta", self.eta, mi.ParamFlags.NonDifferentiable)

        def sample(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool = True
        ) -> tuple[Any, Any]:
            reflects = ctx.is_enabled(mi.BSDFFlags.DeltaReflection, REFLECTED)
            refracts = ctx.is_enabled(mi.BSDFFlags.DeltaTransmission, REFRACTED)
            bs, both = dr.zeros(mi.BSDFSample3f), reflects and refracts
            if not (reflects or refracts):
                return bs, mi.Spectrum(0)
            F, cos_t, eta_it, eta_ti = mi.fresnel(mi.Frame3f.cos_theta(si.wi), self.eta)
            chosen = u <= F if both else mi.Bool(reflects)
            share = dr.select(chosen, F, 1 - F)
            bs.pdf, weight = (share, mi.Float(1)) if both else (mi.Float(1), share)
            bs.sampled_component = dr.select(chosen, mi.UInt32(REFLECTED), REFRACTED)
            kinds = (mi.UInt32(int(f)) for f in (mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission))
            bs.sampled_type = dr.select(chosen, *kinds)
            bs.wo = dr.select(chosen, mi.reflect(si.wi), mi.refract(si.wi, cos_t, eta_ti))
            bs.eta = dr.select(chosen, 1, eta_it)
            if ctx.mode == mi.TransportMode.Radiance:  # radiance, unlike importance, grows with the index
                weight = weight * dr.select(chosen, 1, dr.square(eta_ti))
            return bs, mi.Spectrum(dr.select(active, weight, 0))

        def eval(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> Any:
            return mi.Spectrum(0)

        def pdf(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True) -> Any:
            return mi.Float(0)

        def eval_pdf(
            self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool = True
        ) -> tuple[Any, Any]:
            return mi.Spectrum(0), mi.Float(0)

        def to_string(self) -> str:
            return f"SmoothBoundary[eta = {float(np.max(np.array(self.eta))):.7g}]"

    return SmoothBoundary


def boundary_of(surfaces: list[Any], eta: float) -> Any:
    """The boundary of a medium from the BSDFs inside a surface: at most one, a dielectric of the same index.

    Raises:
        ValueError: there are several, or it is of another index.
    """
    if len(surfaces) > 1:
        raise ValueError(f"a translucent surface must have at most one BSDF inside, got {len(surfaces)}")
    for boundary in surfaces:
        check_eta(boundary, eta)
        if boundary.class_name() != "SmoothDielectric" or mi.traverse(boundary).keys() != {"eta"}:  # rough, or tinted
            return boundary
    return smooth_boundary(eta)


def check_eta(boundary: mi.BSDF, eta: float) -> None:
    """Refuse a boundary of another index than the medium's."""
    found = mi.traverse(boundary).get("eta")
    found = None if found is None else float(np.max(np.array(found)))
    if found is None or abs(found - eta) > 2e-3 * eta:
        raise ValueError(
            f"the boundary must be a dielectric with eta {eta:g} of the medium (int_ior/ext_ior), got {found}"
        )


# --------------------------------------------------------------------------------------------------
# The reflection of a dielectric boundary, which is always seen from outside: no path of surfaces leads inside.


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
    def of(cls, boundary: mi.BSDF) -> Reflection:
        """The reflection of a boundary; ValueError if it does not reflect."""
        for k in range(boundary.component_count()):
            if boundary.flags(k) & int(mi.BSDFFlags.Reflection):
                return cls(boundary, k)
        raise ValueError(f"the boundary must reflect, got {boundary}")

    def sample(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, u: mi.Float, v: mi.Point2f, active: mi.Bool
    ) -> tuple[Any, Any]:
        """A direction and its weight; one that a smooth boundary reflects to below the surface is reflected again."""
        seen, sign = _from_outside(si)
        bs, weight = self.boundary.sample(self._context(ctx), seen, u, v, active)
        n = si.to_local(si.n)
        n = dr.select(dr.dot(n, si.wi) < 0, -n, n)
        wo = _turned(bs.wo, sign)
        bs.wo = dr.select(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta), mirrored(wo, n), wo)
        bs.sampled_component = 0
        return bs, weight

    def eval(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> Any:
        """Value times cosine."""
        seen, sign = _from_outside(si)
        return self.boundary.eval(self._context(ctx), seen, _turned(wo, sign), active)

    def pdf(self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool) -> Any:
        """Density of `sample`."""
        seen, sign = _from_outside(si)
        return self.boundary.pdf(self._context(ctx), seen, _turned(wo, sign), active)

    def _context(self, ctx: mi.BSDFContext) -> Any:
        return mi.BSDFContext(ctx.mode, ctx.type_mask, self.lobe)


def _from_outside(si: mi.SurfaceInteraction3f) -> tuple[Any, Any]:
    """The interaction with the normal on the side that is seen, and 1, or -1 where it was turned."""
    sign = dr.select(mi.Frame3f.cos_theta(si.wi) < 0, mi.Float(-1), 1)
    seen = mi.SurfaceInteraction3f(si)
    seen.wi = _turned(si.wi, sign)
    return seen, sign


def _turned(w: mi.Vector3f, sign: mi.Float) -> Any:
    """A local direction in the frame that is turned about its first axis where the sign is -1."""
    return mi.Vector3f(w.x, w.y * sign, w.z * sign)
