"""The path loop of the integrator `bssrdf`: a path tracer whose paths enter translucent objects through their BSSRDF.

At every vertex, as in Mitsuba's `prb_volpath`: emission with its MIS weight, choice of an event, next-event estimation,
throughput, Russian roulette. At a translucent object the events are reflection, ballistic and single scattering
(`ballistic_and_single`), and all other orders by the BSSRDF of the object. In a replay (`lighting.Replay`) what decides
where the path goes is `detached` from what its light is multiplied with.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from full_geometry.geometry.points import EntrySample, SurfacePoint, lifted, opaque, place, turned
from full_geometry.geometry.rounding import before, blocked, ray_from, ray_to
from full_geometry.integrators.ballistic_and_single import RefractedRay, sample_one_event
from full_geometry.integrators.lighting import PathRadiance, Primal, RenderContext, Replay, delta_light
from full_geometry.integrators.specular_connections import outward_sign
from full_geometry.objects.objects import TranslucentObject
from full_geometry.settings import Settings
from full_geometry.walk.emission import (
    emission,
    emitter_pdf,
    mis_weight,
    next_event,
    sample_emitter,
    survival,
    unmasked_surface,
)

LEAST_REFLECTION = 0.05  # probability of reflection where there is light to come; Fresnel's is 0.04 face on
LEAST_ONE_EVENT, MOST_ONE_EVENT = 0.03, 0.95  # probability of ballistic and single scattering
ONE_EVENT_BOOST = 2.0  # as its light varies more from one sample to the next
DIRECTIONS = 8  # of the environment at an entry, of which one is kept
LEAST_PASSING = 0.3  # of T, where order 0 does not count: reflected back, a walk may be scattered yet


# ---- Loop state ------------------------------------------------------------------------------------------------------


@dataclass
class PreviousVertex:
    """The vertex before a ray, as the MIS weight of emission needs it."""

    p: mi.Point3f
    n: mi.Normal3f  # geometric
    e: mi.Float  # how far rounding puts p from the surface, at most
    pdf: mi.Float  # density of the sampled direction, 1/sr; 1 for the only one, 0 if no emission counts
    emitter_share: mi.Float  # share of directions that next-event estimation drew, 1 for a second sample, 0 for none
    environment_only: mi.Bool  # connections have counted all emission but that of the environment less its suns
    emitter_distance: mi.Float  # of the emitter that the direction was drawn for, alone counted; < 0: any direction
    mirrored: mi.Bool  # the direction was the only one, so that next-event estimation had none
    one_event: mi.Bool  # it is the end of a walk of one scattering event or none

    @property
    def unconnected(self) -> mi.Bool:
        """Whether phase sampling of such a walk hits emission there that no connection finds."""
        return self.one_event & (self.emitter_share == 0)


@dataclass
class NextVertex:
    """The ray of a path from a vertex to the next, and what it is worth."""

    previous: PreviousVertex  # the origin of the ray
    d: mi.Vector3f  # direction of the ray
    weight: mi.Spectrum  # factor of the throughput: value * cosine / density
    scattered: mi.Bool  # the direction was one of many


@dataclass
class PathState:
    """Loop variables of a path from the camera."""

    ray: mi.Ray3f  # from the previous vertex
    radiance: PathRadiance  # radiance so far and its derivative; in a replay radiance still to come
    throughput: mi.Spectrum  # product of the weights of all vertices
    previous: PreviousVertex
    depth: mi.UInt32  # vertices so far
    scattered: mi.Bool  # whether a vertex had more than one direction
    second_pass: mi.Bool  # traces orders 0 and 1 of the first object, from the camera again
    needs_second: mi.Bool  # whether the first vertex is on an object that has these and others
    L_first: mi.Spectrum  # radiance at the end of the first pass
    hit: mi.Bool  # whether the camera ray meets anything
    active: mi.Bool


def trace_paths(
    scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, sampler: mi.Sampler, ray: mi.Ray3f,
    active: mi.Bool, scattered: bool = False,
) -> tuple[tuple[mi.Spectrum, mi.Spectrum], mi.Bool, mi.Spectrum]:  # fmt: skip
    """Radiance along a camera ray in two parts for a replay, whether the ray hits anything, and unconnected light.
    The second part is light of orders 0 and 1 of the object that the ray meets first. What phase sampling alone has hit
    is in both. `scattered` says whether the ray is one of many that a vertex may have sent, as for one that goes on."""
    # the first pass adds up; L of both its parts begins at 0
    context = RenderContext.of(scene, objects, settings, Primal())
    L, radiance, hit = _loop(context, sampler, ray, (mi.Spectrum(0), mi.Spectrum(0)), (), active, scattered)
    return L, hit, radiance.unconnected


def replay_paths(
    scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, sampler: mi.Sampler, ray: mi.Ray3f,
    L: tuple[mi.Spectrum, mi.Spectrum], d: mi.Spectrum | None, backward: bool,
) -> mi.Spectrum:  # fmt: skip
    """The derivative of the radiance of traced paths.

    Args:
        sampler: as it was before the paths were traced.
        L: radiance of the paths, in two parts.
        d: backward: adjoint of the radiance, which is handed on to the parameters of the scene.
        backward: otherwise the derivative of the radiance is returned, for the derivatives that the parameters carry.
    """
    # the second pass begins with L and takes from it what each vertex had added
    context = RenderContext.of(scene, objects, settings, Replay(backward))
    return _loop(context, sampler, ray, L, mi.Spectrum(0 if d is None else d), mi.Bool(True))[1].derivative


# ---- The loop --------------------------------------------------------------------------------------------------------


def _loop(
    context: RenderContext, sampler: mi.Sampler, camera_ray: mi.Ray3f, L: tuple[mi.Spectrum, mi.Spectrum],
    derivative: mi.Spectrum | tuple[()], active: mi.Bool, scattered: bool = False,
) -> tuple[tuple[mi.Spectrum, mi.Spectrum], PathRadiance, mi.Bool]:  # fmt: skip
    """All vertices of a path, in one or two passes: L, what is summed, and whether the camera ray hits anything.
    Where the first vertex is on an object with orders 0 and 1 and others, the path begins there a second time for
    orders 0 and 1: the choice between both was most of the variance under an environment."""
    settings, mode = context.settings, context.mode
    camera_ray = mi.Ray3f(camera_ray)
    max_depth = 0xFFFFFFFF if settings.max_depth < 0 else settings.max_depth

    def step(sampler: mi.Sampler, path: PathState) -> tuple[mi.Sampler, PathState]:
        # ---- intersection: the surface that the ray from the last vertex meets
        first, active = path.depth == 0, path.active
        si = context.ray_intersect(path.ray, first, active)

        # ---- emission: L += throughput L_e p_f / (p_f + p_e), against next-event estimation at the last vertex
        with dr.resume_grad(when=mode.tracks):
            shown = ~first if settings.hide_emitters else mi.Bool(True)
            counts, previous = active & ~(first & path.second_pass), path.previous
            L_e = weighted_emission(context, sampler, path.ray, si, previous, shown, path.scattered, active=counts)
            radiance = mode.add(path.radiance, path.throughput * L_e)
            radiance = mode.add_unconnected(radiance, dr.select(previous.unconnected, path.throughput * L_e, 0))
        hit = path.hit | (first & si.is_valid())
        active = active & si.is_valid() & (previous.emitter_distance < 0) & (path.depth + 1 < max_depth)
        needs_second = path.needs_second | (active & first & _on_splitting(context, si))

        # ---- event: L += throughput f L_e / p_e w_e, its next-event estimation; throughput *= f cos / p_f, its ray
        vertex = Vertex(*met_surface(context, sampler, path.ray, si, active), path.ray, path.throughput,
                        first & path.second_pass, first & ~path.second_pass, path.scattered, active)  # fmt: skip
        following, radiance = sample_event(context, sampler, vertex, radiance)
        throughput = dr.select(active, path.throughput * following.weight, path.throughput)

        # ---- Russian roulette: survive with q = min(throughput, 0.95), throughput /= q
        largest = dr.max(throughput)
        active = active & (largest > 0)
        depth = dr.select(active, path.depth + 1, path.depth)
        survives = survival(largest, depth, settings.rr_depth)
        active = active & (sampler.next_1d() < survives)
        throughput = throughput / survives
        ray = dr.select(active, _ray_from(following.previous, following.d, path.ray), path.ray)

        # ---- second pass: from the camera again, where the first pass has ended; L of the first is kept
        again = ~active & needs_second & ~path.second_pass
        return sampler, PathState(
            ray=dr.select(again, camera_ray, ray),
            radiance=replace(radiance, L=dr.select(again, L[1], radiance.L)),
            throughput=dr.select(again, mi.Spectrum(1), throughput),
            previous=dr.select(again, _camera_vertex(), following.previous),
            depth=dr.select(again, mi.UInt32(0), depth),
            scattered=((path.scattered | following.scattered) & ~again) | scattered,
            second_pass=path.second_pass | again,
            needs_second=needs_second,
            L_first=dr.select(again, radiance.L, path.L_first),
            hit=hit,
            active=active | again,
        )

    start = _path_start(camera_ray, PathRadiance(L[0], derivative, mi.Spectrum(0)), scattered, active)
    with dr.suspend_grad():
        _, path = dr.while_loop((sampler, start), lambda sampler, path: path.active, step, label="bssrdf")

    # ---- L of the first pass, and of the second where there was one
    two = path.second_pass
    parts = dr.select(two, path.L_first, path.radiance.L), dr.select(two, path.radiance.L, 0)
    return parts, path.radiance, path.hit


def _path_start(ray: mi.Ray3f, radiance: PathRadiance, scattered: bool, active: mi.Bool) -> PathState:
    """A path at the camera, of throughput 1."""
    return PathState(
        ray=ray, radiance=radiance, throughput=mi.Spectrum(1), previous=_camera_vertex(), depth=mi.UInt32(0),
        scattered=mi.Bool(scattered), second_pass=mi.Bool(False), needs_second=mi.Bool(False), L_first=mi.Spectrum(0),
        hit=mi.Bool(False), active=mi.Bool(active),
    )  # fmt: skip


def _ray_from(origin: PreviousVertex, d: mi.Vector3f, before: mi.Ray3f) -> mi.Ray3f:
    """A ray along d from a vertex, clear of its surface, with the wavelengths of the one before."""
    ray = ray_from(place(origin.p, origin.n), d, origin.e)
    ray.wavelengths = before.wavelengths
    return ray


def _camera_vertex() -> PreviousVertex:
    """The camera: all emission counts."""
    return replace(_path_end().previous, pdf=mi.Float(1))


def _path_end() -> NextVertex:
    """No next vertex."""
    previous = PreviousVertex(
        p=mi.Point3f(0), n=mi.Normal3f(0), e=mi.Float(0), pdf=mi.Float(0), emitter_share=mi.Float(0),
        environment_only=mi.Bool(False), emitter_distance=mi.Float(-1), mirrored=mi.Bool(False),
        one_event=mi.Bool(False),
    )  # fmt: skip
    return NextVertex(previous, mi.Vector3f(0), mi.Spectrum(0), mi.Bool(False))


def _on_splitting(context: RenderContext, si: mi.SurfaceInteraction3f) -> mi.Bool:
    """Whether a point is on an object with orders 0 and 1 and others."""
    # objects of which the first pass and the second have orders each
    on_one = mi.Bool(False)
    for obj in context.objects:
        if obj.splits:
            on_one |= si.shape == mi.ShapePtr(obj.geometry.shape)
    return on_one


# ---- Emission --------------------------------------------------------------------------------------------------------


def weighted_emission(
    context: RenderContext, sampler: mi.Sampler, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, previous: PreviousVertex,
    shown: mi.Bool, scattered: mi.Bool, active: mi.Bool,
) -> mi.Spectrum:  # fmt: skip
    """Emitted light where a ray arrives, with its MIS weight against next-event estimation at the previous vertex.
    Emitters count where they are `shown`; delta lights behind a mirror if the path has `scattered` before."""
    with dr.suspend_grad():
        # emitters that next-event estimation or connections at the last vertex have not counted
        emitter, mirrored = si.emitter(context.scene, active), active & previous.mirrored & scattered
        active = active & shown & (emitter != None)  # noqa: E711
        active &= ~(previous.environment_only & context.sampled_by_nee(emitter, ray.d))
        # a direction drawn for one emitter counts that emitter only: at its distance, but for rounding of its surface
        distance = previous.emitter_distance
        off, along = dr.abs(si.t - distance), dr.abs(dr.dot(si.n, ray.d))
        e = before(si.p, distance, previous.e + context.instance_scene.rounding(si))
        near = (off < 1e-3 * distance) | (off * along < e)
        there = dr.select(si.is_valid(), near, distance == dr.inf)
        active &= (distance < 0) | there
        # p_f / (p_f + share p_e)
        origin, share = place(previous.p, previous.n), previous.emitter_share
        p_e, _ = emitter_pdf(context.scene, origin, si, active & (share > 0))
        weight = mis_weight(previous.pdf, share * p_e)
    light = emission(emitter, si, weight, active)
    return light + delta_light(context, sampler, ray, mirrored)[1] if context.lights.some_delta else light


# ---- Events at a vertex ----------------------------------------------------------------------------------------------


class Vertex(NamedTuple):
    """A surface point of a path, and what it has brought there."""

    si: mi.SurfaceInteraction3f  # as normal maps around translucent surfaces bend it
    bsdf: mi.BSDFPtr  # that is met there, inside of masks and blends
    ray: mi.Ray3f
    throughput: mi.Spectrum
    one_event_only: mi.Bool  # first vertex of the second pass: orders 0 and 1 only
    others_only: mi.Bool  # first vertex of the first pass: not orders 0 and 1, where the object has a second pass
    scattered: mi.Bool
    active: mi.Bool


class EventChoice(NamedTuple):
    """Probabilities of the events at a point of an object."""

    reflection: mi.Float
    one_event: mi.Float  # of ballistic and single scattering, among the events inside
    refracted: RefractedRay


class Taken(NamedTuple):
    """Whether a path goes on outside, the probability of that, and a uniform number for the events inside."""

    outside: mi.Bool
    probability: mi.Float
    u: mi.Float


def met_surface(
    context: RenderContext, sampler: mi.Sampler, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, active: mi.Bool
) -> tuple[mi.SurfaceInteraction3f, mi.BSDFPtr]:
    """What a ray meets: the interaction as normal maps bend it, and the BSDF that masks and blends leave."""
    # of each object with a mask, a blend or a map around its surface
    bsdf = si.bsdf(ray)
    for obj in context.objects:
        around = obj.wrapping
        if around.surface is obj.geometry.shape.bsdf():
            continue
        # one of the surfaces by its opacity, then the normal of the map where the translucent one is met
        with dr.suspend_grad():
            here = active & (si.shape == mi.ShapePtr(obj.geometry.shape))
            own = mi.BSDFPtr(around.surface)
            if around.mixes:
                own = unmasked_surface(around, obj.geometry, si, ray.d, sampler.next_1d(), here)
            bsdf = dr.select(here, own, bsdf)
            si = around.bent(si, here & (bsdf == mi.BSDFPtr(around.surface)))
    return si, bsdf


def _met(obj: TranslucentObject, at: Vertex) -> mi.Bool:
    """Whether the translucent surface of an object is met."""
    here = at.active & (at.si.shape == mi.ShapePtr(obj.geometry.shape))
    return here & (at.bsdf == mi.BSDFPtr(obj.surface)) if obj.wrapping.mixes else here


def sample_event(
    context: RenderContext, sampler: mi.Sampler, at: Vertex, radiance: PathRadiance
) -> tuple[NextVertex, PathRadiance]:
    """One event: the BSDF of a surface, or at an object reflection, ballistic and single scattering, or the BSSRDF."""
    # ---- probabilities of the events; a pass that has one kind of them chooses that
    choices = []
    with dr.suspend_grad():
        for known in context.objects:
            here, obj = _met(known, at), known.at(context.instance_transform(at.si))
            choice = choose_event(obj, at.si, here)
            if obj.splits:
                once = dr.select(at.one_event_only, mi.Float(1), dr.select(at.others_only, 0, choice.one_event))
                # where the others are gathered, there is nothing to choose against reflection
                others = choice.reflection if obj.gathered is None else dr.select(at.others_only, 1, choice.reflection)
                choice = choice._replace(one_event=once, reflection=dr.select(at.one_event_only, 0, others))
            choices.append((obj, here, choice))

    # ---- light that is known without sampling, alpha c and a(w_o) B, then BSDF or reflection
    radiance = _add_environment_means(context, sampler, at, radiance, choices)
    radiance = _add_gathered(context, sampler, at, radiance, choices)
    following, radiance, taken = _scatter_outside(context, sampler, at, radiance, choices)

    # ---- events inside each object: `one_event` with its probability, else the BSSRDF
    probability, events = taken.probability, []
    for obj, here, choice in choices:
        inside = here & ~taken.outside
        once = inside & (taken.u < choice.one_event)
        probability = dr.select(
            inside, probability * dr.select(once, choice.one_event, 1 - choice.one_event), probability
        )
        if obj.transport is not None:
            more = inside & ~once
            out, face = choice.refracted.out, at.si.prim_index
            events.append((more, partial(bssrdf_event, context, obj, out, face, sampler, more)))
        if obj.low_orders:
            events.append((once, partial(one_event, context, obj, choice.refracted, sampler, at.scattered, once)))

    # ---- the event taken: L += throughput direct / probability, and the PRB update of its weight
    for mask, event in events:

        def below(
            _: NextVertex, radiance: PathRadiance, mask: mi.Bool = mask, event: Callable = event
        ) -> tuple[NextVertex, PathRadiance]:
            new, direct, unconnected = event()
            light = at.throughput / probability * direct
            radiance = context.mode.add_unconnected(radiance, at.throughput / probability * unconnected)
            return new, context.mode.update(radiance, light, new.weight, mask, mi.Spectrum(0))

        following, radiance = _where(context, sampler, mask, (following, radiance), below)
    return replace(following, weight=following.weight / probability), radiance


def choose_event(obj: TranslucentObject, si: mi.SurfaceInteraction3f, active: mi.Bool) -> EventChoice:
    """Probabilities of the events by the light that is expected of each. With T the mean transmittance along the
    refracted ray to the other side, R_1 and R_2 the reflectances of the half-space by single scattering and more, and
    albedo a, the expected light is T of order 0, (1 - T) (R_1 + (a - R_1) T) of order 1 and (1 - T) R_2 of the rest."""
    # ---- the ray refracted into the object: d = -w / eta + n (mu / eta - mu')
    out = exit_at(obj, si)
    mu = dr.dot(out.w, out.n_out)
    F, mu_in, _, into = mi.fresnel(dr.maximum(mu, 0), obj.eta)
    d = mi.Vector3f(dr.normalize(-into * out.w + out.n_out * (into * mu - dr.abs(mu_in))))
    valid = active & (mu > 0) & (dr.dot(d, out.n) < 0)

    # ---- reflection, by Fresnel
    reflection = dr.clip(F, LEAST_REFLECTION, 0.95) if obj.surface.spec.reflection else mi.Float(0)
    if not obj.low_orders:
        return EventChoice(reflection, mi.Float(0), RefractedRay(out, d, 1 - F, valid, mi.Float(0)))

    # ---- orders 0 and 1 against the rest, in proportion to the light that is expected of each
    T = _transmittance(obj, out, d, valid)
    passing = T if 0 in obj.low_orders else LEAST_PASSING * T
    albedo, single, multiple = (opaque(v) for v in (obj.expected.albedo, obj.expected.single, obj.expected.multiple))
    scattered = ONE_EVENT_BOOST * (1 - T) * (single + (albedo - single) * T)
    both = passing + scattered
    once = mi.Float(1)
    if obj.transport is not None:
        once = dr.clip(both / dr.maximum(both + (1 - T) * multiple, 1e-20), LEAST_ONE_EVENT, MOST_ONE_EVENT)
    passing = dr.select(both > 0, passing / dr.maximum(both, 1e-20), 1)
    return EventChoice(reflection, once, RefractedRay(out, d, 1 - F, valid, passing))


def _transmittance(obj: TranslucentObject, out: SurfacePoint, d: mi.Vector3f, active: mi.Bool) -> mi.Float:
    """Transmittance to the other side, mean over channels; not by the light so far, as choices hold in derivatives."""
    # Σ_c exp(-sigma_t,c t) / n to the boundary opposite
    ray = ray_from(place(out.p, out.n), d, obj.geometry.clearance)
    wall = obj.geometry.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
    T, each = mi.Float(0), out.medium.sigma_t if out.medium else [opaque(m.sigma_t) for m in obj.media]
    for sigma_t in each:
        T = T + dr.exp(-sigma_t * wall.t) / len(obj.media)
    return dr.select(active & wall.is_valid(), T, 0)


def exit_at(obj: TranslucentObject, si: mi.SurfaceInteraction3f) -> SurfacePoint:
    """The exit of light towards `si.wi`, with the normal that points outwards, as `si.wi` sees it."""
    w, n_face = si.to_world(si.wi), mi.Normal3f(si.n)
    sign = outward_sign(obj, si, w)
    n = lifted(turned(si.sh_frame.n, n_face), n_face, w)
    return SurfacePoint(mi.Point3f(si.p), n_face * sign, n * sign, w, sign, obj.medium_at(si))


def _where(context: RenderContext, sampler: mi.Sampler, mask: mi.Bool, otherwise: tuple, event: Callable) -> tuple:
    """`event(*otherwise)` where the mask holds, elsewhere `otherwise`.
    An event that no neighbouring lane asks for is not computed. Derivatives do not leave the event."""

    # a branch of the kernel; derivatives are followed inside and end there
    def happens(sampler: mi.Sampler, otherwise: tuple) -> tuple:
        with dr.resume_grad(when=context.mode.tracks):
            return sampler, dr.detach(tuple(event(*otherwise)))

    with dr.suspend_grad():
        return dr.if_stmt((sampler, otherwise), mask, happens, lambda s, other: (s, other))[1]


# ---- Light known without sampling: alpha c of the environment, gathered light ----------------------------------------


def _add_environment_means(
    context: RenderContext, sampler: mi.Sampler, at: Vertex, radiance: PathRadiance, choices: list
) -> PathRadiance:
    """Add alpha c of each object, which the events inside leave out, see `lighting.EnvironmentMean`."""
    for obj, here, choice in choices:
        if not context.uses_environment_mean(obj):
            continue

        def known(
            radiance: PathRadiance,
            obj: TranslucentObject = obj,
            here: mi.Bool = here,
            out: SurfacePoint = choice.refracted.out,
        ) -> tuple[PathRadiance]:
            # (alpha_1 of orders 0 and 1 + alpha of the others) c, each in the pass that has those orders
            once, others = obj.alpha(out, here)
            once = dr.select(at.others_only, 0, once) if obj.low_orders else mi.Spectrum(0)
            light = (once + dr.select(at.one_event_only, 0, others)) * context.environment_mean.mean
            return (context.mode.add(radiance, at.throughput * light),)

        (radiance,) = _where(context, sampler, here, (radiance,), known)
    return radiance


def _add_gathered(
    context: RenderContext, sampler: mi.Sampler, at: Vertex, radiance: PathRadiance, choices: list
) -> PathRadiance:
    """Add what leaves each object by light that was gathered, see `gathering`."""
    for obj, here, choice in choices:
        out = choice.refracted.out
        if obj.gathered is None:
            continue

        def known(
            radiance: PathRadiance, obj: TranslucentObject = obj, here: mi.Bool = here, out: SurfacePoint = out
        ) -> tuple[PathRadiance]:
            return (context.mode.add(radiance, at.throughput * obj.gathered.radiance(out, here)),)

        (radiance,) = _where(context, sampler, here & ~at.one_event_only, (radiance,), known)
    return radiance


# ---- BSDFs, and reflection at the boundary of an object --------------------------------------------------------------


def _scatter_outside(
    context: RenderContext, sampler: mi.Sampler, at: Vertex, radiance: PathRadiance, choices: list
) -> tuple[NextVertex, PathRadiance, Taken]:
    """The BSDF. At an object, emission that it mirrors is added whatever is chosen, as highlights are bright.
    The path goes on from there if the mirrored ray meets a surface and reflection is chosen."""
    # ---- where there is an object, its probability of reflection, and where it may reflect in this pass
    u_event = sampler.next_1d()
    inside, glossy, reflection = mi.Bool(False), mi.Bool(False), mi.Float(0)
    for obj, here, choice in choices:
        inside |= here
        reflection = dr.select(here, choice.reflection, reflection)
        if obj.surface.spec.reflection:
            glossy |= here & ~at.one_event_only
    plain = at.active & ~inside
    if any(obj.wrapping.mixes for obj in context.objects):
        plain &= ~at.one_event_only  # what masks and blends leave of an object is of the first pass

    def scatter(_: NextVertex, __: mi.Bool, radiance: PathRadiance) -> tuple:
        # L += throughput f L_e / p_e w_e, and at objects throughput F L_e of what they mirror
        u = sampler.next_2d(), sampler.next_1d(), sampler.next_2d()
        with dr.suspend_grad():
            following, direct = bsdf_event(context, u, at.bsdf, at.si, plain | glossy)
        shown, meets, radiance = _add_mirrored(context, sampler, following, at, radiance, glossy)
        reflects = glossy & meets & (u_event < reflection)
        if context.mode.tracks:  # again: no derivatives may be pending while others are passed on
            following, direct = bsdf_event(context, u, at.bsdf, at.si, plain | glossy)
        radiance = context.mode.update(radiance, at.throughput * direct, following.weight, plain | reflects, shown)
        return following, meets, radiance

    nothing = (_path_end(), mi.Bool(False), radiance)
    following, meets, radiance = _where(context, sampler, plain | glossy, nothing, scatter)

    # ---- reflection only where the mirrored ray meets a surface; emission there has been added
    reflection = dr.select(glossy & meets, reflection, 0)
    unlit = replace(following.previous, pdf=mi.Float(0), emitter_share=mi.Float(0), mirrored=mi.Bool(False))
    outside = plain | (u_event < reflection)
    following = replace(following, previous=dr.select(glossy, unlit, following.previous),
                        weight=dr.select(outside, following.weight, 0))  # fmt: skip

    # ---- the probability of the choice, and u again uniform for the events inside: (u - R) / (1 - R)
    probability = dr.select(plain, 1, dr.select(outside, reflection, 1 - reflection))
    u = dr.select(outside, 0, (u_event - reflection) / dr.maximum(1 - reflection, 1e-6))
    return following, radiance, Taken(outside, probability, u)


def _add_mirrored(
    context: RenderContext,
    sampler: mi.Sampler,
    reflected: NextVertex,
    at: Vertex,
    radiance: PathRadiance,
    active: mi.Bool,
) -> tuple[mi.Spectrum, mi.Bool, PathRadiance]:
    """Add emission that an object mirrors.
    Returns emission over the weight of the reflection, whether the ray meets a surface, and the radiance of the
    path."""

    def look(_: mi.Spectrum, __: mi.Bool, radiance: PathRadiance) -> tuple[mi.Spectrum, mi.Bool, PathRadiance]:
        # L += throughput F L_e along the mirrored ray
        origin = reflected.previous
        ray = _ray_from(origin, reflected.d, at.ray)
        si = context.ray_intersect(ray, False, active)
        L_e = weighted_emission(
            context, sampler, ray, si, origin, shown=mi.Bool(True), scattered=at.scattered, active=active
        )
        light = at.throughput * L_e
        return light, active & si.is_valid(), context.mode.add(radiance, reflected.weight * light)

    return _where(context, sampler, active, (mi.Spectrum(0), mi.Bool(False), radiance), look)


def bsdf_event(
    context: RenderContext, u: tuple[mi.Point2f, mi.Float, mi.Point2f], bsdf: mi.BSDFPtr,
    si: mi.SurfaceInteraction3f, active: mi.Bool,
) -> tuple[NextVertex, mi.Spectrum]:  # fmt: skip
    """BSDF sampling and next-event estimation, weighted against each other by the balance heuristic."""
    # ---- next-event estimation: f cos L_e / p_e  p_e / (p_e + p_f)
    ctx, tracks = mi.BSDFContext(), context.mode.tracks
    direct = next_event(context.scene, context.instance_scene, (si, bsdf), u[0], active, False, tracks)

    # ---- BSDF sampling: f cos / p_f; emission that the ray meets has the weight p_f / (p_e + p_f)
    bs, weight = bsdf.sample(ctx, si, u[1], u[2], active)
    if tracks:
        weight = _differentiable(bsdf, ctx, si, bs, weight, active)
    bs = dr.detach(bs)
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    # next-event estimation has drawn other directions of the lobe, where it is not delta: share 1, else 0
    previous = PreviousVertex(
        p=mi.Point3f(si.p), n=mi.Normal3f(si.n), e=context.instance_scene.rounding(si), pdf=dr.select(delta, 1, bs.pdf),
        emitter_share=dr.select(delta, mi.Float(0), 1), environment_only=mi.Bool(False), emitter_distance=mi.Float(-1),
        mirrored=delta, one_event=mi.Bool(False),
    )  # fmt: skip
    return NextVertex(previous, si.to_world(bs.wo), weight, ~delta), direct


def _differentiable(
    bsdf: mi.BSDFPtr, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, bs: mi.BSDFSample3f, weight: mi.Spectrum,
    active: mi.Bool,
) -> mi.Spectrum:  # fmt: skip
    """The weight of a sampled direction with the derivative of the BSDF there, the density held.
    A delta lobe has no value to ask for: its weight times the probability of the lobe has the derivative."""
    # delta lobes: weight P(lobe) / detached P(lobe); others: f(w) cos / p(w), w and p held
    pdf = dr.detach(bs.pdf)
    inverse = dr.select(pdf > 0, dr.rcp(pdf), 0)
    lobe = weight * (bs.pdf * inverse)
    value = bsdf.eval(ctx, si, dr.detach(bs.wo), active) * inverse
    delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    return dr.replace_grad(dr.detach(weight), dr.select(delta, lobe, value))


# ---- Ballistic and single scattering ---------------------------------------------------------------------------------


def one_event(
    context: RenderContext,
    obj: TranslucentObject,
    refracted: RefractedRay,
    sampler: mi.Sampler,
    scattered: mi.Bool,
    active: mi.Bool,
) -> tuple[NextVertex, mi.Spectrum, mi.Spectrum]:
    """Light that was scattered at most once inside, and emitter connections of that event.
    c of `lighting.EnvironmentMean` is taken off the former where `_add_environment_means` has added alpha c. Last comes
    what of the light phase sampling alone has hit."""
    # the way out of the walk is the next vertex; light of connections is added at this one
    sample = sample_one_event(context, obj, refracted, sampler, scattered, active)
    previous = PreviousVertex(
        p=sample.p, n=sample.n, e=mi.Float(obj.geometry.clearance), pdf=sample.pdf, emitter_share=sample.emitter_share,
        environment_only=sample.connected, emitter_distance=mi.Float(-1), mirrored=mi.Bool(False),
        one_event=mi.Bool(True),
    )  # fmt: skip
    direct = sample.direct
    if context.uses_environment_mean(obj):
        direct = direct - sample.weight * context.environment_means(obj)[0]
    return NextVertex(previous, sample.d, sample.weight, mi.Bool(sample.once)), direct, sample.unconnected


# ---- BSSRDF: light that entered the object elsewhere -----------------------------------------------------------------


def bssrdf_event(
    context: RenderContext,
    obj: TranslucentObject,
    out: SurfacePoint,
    face: mi.UInt32,
    sampler: mi.Sampler,
    active: mi.Bool,
) -> tuple[NextVertex, mi.Spectrum, mi.Spectrum]:
    """Light that entered elsewhere and leaves at `out` by the transport of the object.
    Delta lights are its next-event estimation. c of `lighting.EnvironmentMean` is taken off where
    `_add_environment_means` has added alpha c."""
    # ---- an entry x_i and a direction w_i, of weight S mu_i / p
    entry = resample_entry(context, obj, out, face, sampler, active)
    # ---- control variate: -S mu_i c / p, of the share that directions of the environment have
    direct = mi.Spectrum(0)
    if context.uses_environment_mean(obj):
        direct = -entry.weight * entry.environment_weight * context.environment_means(obj)[1]

    # ---- delta lights: S mu_i E V(x_i, y) / p
    if context.lights.some_delta:
        shadow = ray_to(place(entry.p, entry.n), entry.emitter_point, obj.geometry.clearance)
        lit = entry.delta & ~blocked(context.scene, shadow, entry.delta)
        direct = direct + dr.select(lit, entry.weight * entry.light, 0)

    # ---- the ray that goes on along w_i; drawn by an emitter it counts that alone, for the density has both techniques
    anywhere = entry.emitter_distance < 0
    previous = PreviousVertex(
        p=entry.p, n=entry.n, e=mi.Float(obj.geometry.clearance), pdf=dr.select(anywhere, entry.pdf, 1),
        emitter_share=dr.select(anywhere, mi.Float(context.lights.entry_share), 0), environment_only=mi.Bool(False),
        emitter_distance=entry.emitter_distance, mirrored=mi.Bool(False), one_event=mi.Bool(False),
    )  # fmt: skip
    return NextVertex(previous, entry.d, dr.select(entry.delta, 0, entry.weight), mi.Bool(True)), direct, mi.Spectrum(0)


@dataclass
class Candidate:
    """A candidate of resampling: a point of entry with a direction of incidence."""

    p: mi.Point3f
    n: mi.Normal3f  # geometric
    d: mi.Vector3f
    weight: mi.Spectrum  # S mu_i / density
    pdf: mi.Float  # of d, 1/sr
    emitter_distance: mi.Float  # of the emitter that d was drawn for; < 0: drawn by the proposals
    delta: mi.Bool  # whether no ray can hit that emitter
    emitter_point: mi.Point3f
    light: mi.Spectrum  # light of the emitter, where delta
    target: mi.Float  # resampling target
    by_emitter: mi.Bool  # whether d is drawn by next-event estimation, where there is an entry
    environment_weight: mi.Float  # MIS weight of d among the techniques that draw directions of the environment


class _Entry(NamedTuple):
    """An entry for an exit, and as a point from which rays start."""

    entry: EntrySample
    out: SurfacePoint
    at: mi.Interaction3f


class _ExitPoint(NamedTuple):
    """An exit, its face, and what transport and proposals have made of it."""

    out: SurfacePoint
    face: mi.UInt32
    transport: object
    proposals: object


def resample_entry(
    context: RenderContext,
    obj: TranslucentObject,
    out: SurfacePoint,
    face: mi.UInt32,
    sampler: mi.Sampler,
    active: mi.Bool,
) -> Candidate:
    """One entry for light that leaves at `out`, by resampled importance sampling (Talbot, Cline and Egbert 2005).
    One of N candidates with weights W_k = S mu_i / density is kept with the probability w_k / Σ w, with w_k the
    resampling target: the largest channel of W_k times the light of a sampled emitter. Its weight is W_k Σ w / (N w_k),
    the mean of all candidates. The ray that goes on tests the visibility of the one kept."""
    # ---- what transport and proposals make of the exit once, for all candidates
    with dr.suspend_grad():
        prepared = obj.transport.prepare(out, active)
        exit_point = _ExitPoint(out, face, prepared, obj.proposals.prepare(out, prepared, active))

    def draw(by_emitter: mi.Bool | None = None) -> Candidate:
        return _draw_candidate(context, obj, exit_point, by_emitter, sampler, active)

    # ---- the first candidate; all others take their directions by the same technique
    n, kept = context.entries(obj), draw()
    if n == 1:
        return kept

    # ---- reservoir: candidate k replaces the one kept with the probability w_k / Σ_{j <= k} w_j
    total = dr.detach(kept.target)
    for _ in range(n - 1):
        other = draw(kept.by_emitter)
        total = total + dr.detach(other.target)
        take = sampler.next_1d() * total < dr.detach(other.target)
        kept = dr.select(take, other, kept)

    # ---- weight W Σ w / (N w)
    target = dr.detach(kept.target)
    return replace(kept, weight=kept.weight * dr.select(target > 0, total / (n * dr.maximum(target, 1e-30)), 0))


def _draw_candidate(
    context: RenderContext, obj: TranslucentObject, exit_point: _ExitPoint, by_emitter: mi.Bool | None,
    sampler: mi.Sampler, active: mi.Bool,
) -> Candidate:  # fmt: skip
    """A point of entry by the proposals, and a direction by emitters or by the proposals (one-sample MIS).
    The choice between both is the same for all candidates of an exit: `by_emitter`, drawn where it is None. Under an
    environment alone the direction is one of several, see `_towards_environment`."""
    share, proposals, out = context.lights.entry_share, obj.proposals, exit_point.out

    # ---- x_i and a direction that may meet anything, of density (1 - share) p_i
    with dr.suspend_grad():
        entry = proposals.sample(out, exit_point.face, exit_point.proposals, sampler, active)
        active = active & (entry.weight > 0)
        entry = obj.wrapping.bent_entry(obj.geometry, entry, active)
        at, distance, brightness = place(entry.p, entry.n, out.medium), mi.Float(-1), mi.Float(1)
        if context.lights.environment_alone:
            d, pdf, brightness = _towards_environment(context, obj, _Entry(entry, out, at), sampler, active)
            active = active & (pdf > 0)
        else:
            d, pdf = proposals.sample_direction(entry, out, sampler.next_2d())
            pdf = (1 - share) * pdf
    delta, emitter_point, light = mi.Bool(False), mi.Point3f(0), mi.Spectrum(0)
    environment_weight = mi.Float(1) if context.uses_environment_mean(obj) else mi.Float(0)
    if share == 0:
        by_emitter = mi.Bool(False)
    elif by_emitter is None:
        by_emitter = sampler.next_1d() < share

    # ---- or a direction by next-event estimation; density share p_e + (1 - share) p_i, one-sample MIS
    if share > 0:
        nee = active & by_emitter
        ds, light = sample_emitter(context.scene, at, sampler.next_2d(), nee, context.mode.tracks)
        light = light * dr.detach(ds.pdf)  # the weight has the density, of delta lights the probability of the choice
        with dr.suspend_grad():
            delta, emitter_point = nee & ds.delta, mi.Point3f(ds.p)
            if context.uses_environment_mean(obj):
                pdf_environment = share * context.pdf_environment(at, d, active & ~by_emitter)
                by_environment = dr.select(ds.emitter.is_environment(), 1, 0)
                environment_weight = dr.select(nee, by_environment, mis_weight(pdf, pdf_environment))
            pdf_proposal = proposals.pdf_direction(entry, out, ds.d)
            d = dr.select(nee, ds.d, d)
            pdf = dr.select(nee, share * ds.pdf + dr.select(ds.delta, 0, (1 - share) * pdf_proposal), pdf)
            distance = dr.select(nee, dr.select(ds.emitter.is_environment(), dr.inf, ds.dist), distance)
            active = active & (pdf > 0)
            brightness = dr.select(nee, dr.max(light), 1)

    # ---- W = S mu_i / (density of x_i and w_i), and the resampling target w = max_c W_c times brightness
    with dr.suspend_grad():
        at_entry = entry.facing(d)
        mu_i = at_entry.mu
    S_mu = obj.transport.S(exit_point.transport, at_entry, active) * mu_i
    weight = dr.select(active, S_mu * (entry.weight / dr.maximum(pdf, 1e-8)), 0)
    target = dr.detach(dr.max(weight)) * brightness
    return Candidate(
        p=mi.Point3f(entry.p), n=mi.Normal3f(entry.n), d=d, weight=weight, pdf=pdf, emitter_distance=distance,
        delta=delta, emitter_point=emitter_point, light=light, target=target, by_emitter=by_emitter,
        environment_weight=environment_weight,
    )  # fmt: skip


def _towards_environment(
    context: RenderContext, obj: TranslucentObject, where: _Entry, sampler: mi.Sampler, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float, mi.Float]:
    """A direction at an entry where the environment is the only emitter, by resampled importance sampling.

    Half of `DIRECTIONS` are drawn by the environment, half by the proposals. With p_e and p_i the densities of both,
    one is kept with the probability t_k / p_k over the sum of all, p = (p_e + p_i) / 2, t = p_i (abs(L - c) + dim): the
    light that it brings if nothing is in the way. What is in the way may shine too, so that no direction is left out;
    dim is a share of the mean of abs(L - c), see `RenderContext.dim`. An evaluation of S is worth many of the
    environment.

    Returns:
        Direction; its density, the number of directions times t over the sum of t_k / p_k; and abs(L - c) + dim.
    """
    # ---- directions with p_i, |L - c| and 2 p_i / (p_i + p_e), the share of t_k / p_k without the brightness
    c = context.environment_means(obj)[1] if context.uses_environment_mean(obj) else mi.Spectrum(0)
    directions = []
    for k in range(DIRECTIONS):
        if k % 2:
            w, p_e, L = context.sample_environment(where.at, sampler.next_2d(), active)
            p_i = obj.proposals.pdf_direction(where.entry, where.out, w)
        else:
            w, p_i = obj.proposals.sample_direction(where.entry, where.out, sampler.next_2d())
            p_e, L = context.eval_environment(where.at, w, active)
        over = dr.select(active & (p_i > 0), 2 * p_i / dr.maximum(p_i + p_e, 1e-30), 0)
        directions.append((w, p_i, dr.max(dr.abs(L - c)), over))

    # ---- Σ t_k / p_k = Σ (|L_k - c| + dim) over_k, with dim from the mean of |L - c|
    number, light = sum(over for *_, over in directions), sum(L * over for *_, L, over in directions)
    dim = dr.select(light > 0, context.dim * light / dr.maximum(number, 1e-30), 1)
    total = light + dim * number

    # ---- one of them, where the cumulative sum passes u Σ
    left, kept = sampler.next_1d() * total, (mi.Vector3f(0, 0, 1), mi.Float(0), mi.Float(0))
    for w, p_i, L, over in directions:
        kept = dr.select((over > 0) & (left >= 0), (w, p_i, L + dim), kept)
        left = left - (L + dim) * over
    d, p_i, brightness = kept
    return d, dr.select(total > 0, DIRECTIONS * p_i * brightness / dr.maximum(total, 1e-30), 0), brightness
