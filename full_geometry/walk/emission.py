"""Emission, next-event estimation and their MIS weights: the same for every path, whatever it walks through.

At a vertex with the value f(w) of a BSDF or of a phase function times the cosine, light L_e(w) of emitters is estimated
by two techniques. The first draws w by emitters, of density p_e, the second by f, of density p_f. With the balance
heuristic (Veach and Guibas 1995) both together are

    f L_e / p_e  p_e / (p_e + p_f)    +    f L_e / p_f  p_f / (p_e + p_f),

the first at the vertex, by `next_event`, the second where the ray along w meets an emitter, by `emission`. Delta lights
have the first alone, directions of delta lobes the second. The weight of a path that is one of a mixture, as of entries
that are drawn by emitters or by a proposal, must be that of this heuristic; so it is that of all.
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.instances import InstanceScene
from full_geometry.geometry.rounding import blocked
from full_geometry.geometry.shape import Geometry
from full_geometry.surface.wrapped import Wrapping

MOST_SURVIVAL = 0.99  # of Russian roulette; of 0.95, what glass reflects a hundred times was a firefly


def mis_weight(pdf: mi.Float, other: mi.Float) -> mi.Float:
    """The balance heuristic, pdf / (pdf + other): weight of a sample of one density against a technique of another.
    It is 1 where the first density overflows, as of a bulb that is seen from the horizon."""
    total = pdf + other
    return dr.select(pdf == dr.inf, 1, dr.select(total > 0, pdf / dr.maximum(total, 1e-30), 0))


def survival(size: mi.Float, depth: mi.UInt32, rr_depth: int) -> mi.Float:
    """The probability min(size, 0.99) to survive Russian roulette; 1 before `rr_depth` vertices."""
    return dr.select(depth >= rr_depth, dr.minimum(size, MOST_SURVIVAL), 1.0)


# ---- First technique: directions drawn by emitters ------------------------------------------------------------------


def sample_emitter(
    scene: mi.Scene, at: mi.Interaction3f, u: mi.Point2f, active: mi.Bool, differentiable: bool = False
) -> tuple[mi.DirectionSample3f, mi.Spectrum]:
    """A direction to an emitter with its density p_e, and L_e / p_e, whatever lies between.
    `differentiable`: whether the light carries derivatives by parameters of emitters, with the direction held."""
    # w and p_e are held in derivatives, L_e is not
    with dr.suspend_grad():
        ds, light = scene.sample_emitter_direction(at, u, False, active)
        inverse = dr.select(ds.pdf > 0, dr.rcp(ds.pdf), 0)
    if not differentiable:
        return ds, light
    return ds, dr.replace_grad(light, scene.eval_emitter_direction(at, ds, active & (ds.pdf > 0)) * inverse)


def next_event(
    scene: mi.Scene, instance_scene: InstanceScene, surface: tuple[mi.SurfaceInteraction3f, mi.BSDFPtr], u: mi.Point2f,
    active: mi.Bool, outwards: mi.Bool | bool = False, differentiable: bool = False,
    share: Callable[[mi.DirectionSample3f, mi.Bool], mi.Float] | None = None,
) -> mi.Spectrum:  # fmt: skip
    """Next-event estimation at a surface: f(w) |cos| L_e(w) / p_e with its MIS weight against BSDF sampling.

    Args:
        scene, u, active, differentiable: as of `sample_emitter`.
        instance_scene: what rays meet in the scene.
        surface: a point of a surface and its BSDF.
        outwards: whether light arrives at its outer side alone, as at a translucent boundary.
        share: of the light along a sampled direction that counts here, where another technique finds it too.
    """
    # w by the emitters of the scene, p_e; delta BSDFs have no value for it
    si, bsdf = surface
    active = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    ds, light = sample_emitter(scene, si, u, active, differentiable)
    with dr.suspend_grad():
        active &= (ds.pdf > 0) & (~mi.Bool(outwards) | (dr.dot(ds.d, si.n) > 0))
        # V(x, y): nothing between the surface and the emitter
        active &= ~blocked(scene, instance_scene.ray_to_emitter(si, ds, instance_scene.rounding(si)), active)
    # f |cos| L_e / p_e  p_e / (p_e + p_f); the densities are held in derivatives
    value, pdf = towards(si, bsdf, ds.d, active, outwards)
    weight = dr.select(ds.delta, 1, mis_weight(ds.pdf, dr.detach(pdf)))
    if share is not None:
        weight *= share(ds, active & (dr.max(value * light) > 0))
    return dr.select(active, value * light * weight, 0)


def towards(
    si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, w: mi.Vector3f, active: mi.Bool, outwards: mi.Bool | bool
) -> tuple[mi.Spectrum, mi.Float]:
    """f(w) |cos| of a BSDF and its density p_f for light that arrives from w; `outwards` as of `next_event`.
    At a rough boundary w may be below the shading normal; then it is refracted from inside, by the opposite direction.
    """
    with dr.suspend_grad():
        wo = si.to_local(w)
        below = outwards & (wo.z < 0)
        active = active & (~below | (mi.Frame3f.cos_theta(si.wi) < 0))
    value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, dr.select(below, -wo, wo), active)
    return dr.select(active, value, 0), pdf


# ---- Second technique: emitters that a ray meets --------------------------------------------------------------------


def emitter_pdf(
    scene: mi.Scene, origin: mi.Interaction3f, si: mi.SurfaceInteraction3f, active: mi.Bool
) -> tuple[mi.Float, mi.DirectionSample3f]:
    """The density p_e, 1/sr, of `sample_emitter` for the emitter that a ray meets and the direction to it."""
    ds = mi.DirectionSample3f(scene, si, origin)
    return scene.pdf_emitter_direction(origin, ds, active), ds


def emission(emitter: mi.EmitterPtr, si: mi.SurfaceInteraction3f, weight: mi.Float, active: mi.Bool) -> mi.Spectrum:
    """Radiance L_e of an emitter that a ray meets, times the MIS weight of having met it."""
    return dr.select(active, weight * emitter.eval(si, active), 0)


# ---- Masks -----------------------------------------------------------------------------------------------------------


def unmasked_surface(
    wrapping: Wrapping, obj: Geometry, si: mi.SurfaceInteraction3f, d: mi.Vector3f, u: mi.Float, here: mi.Bool
) -> mi.BSDFPtr:
    """The BSDF that masks and blends around the surface of an object leave for a ray along d, by a uniform number."""
    # a ray that a mask has let in arrives at a closed object from inside, where there is nothing
    behind = (dr.dot(si.n, d) * obj.side(si.prim_index, here) > 0) & obj.closed
    return wrapping.draw(si, behind, u, here)
