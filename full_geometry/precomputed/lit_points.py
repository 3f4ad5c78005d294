"""Points of objects with a sample of the light that arrives there: where precomputed light begins."""

from __future__ import annotations

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.instances import InstanceTransform
from full_geometry.geometry.light_points import uniform_entries
from full_geometry.geometry.points import EntrySample, cosine_above, cosine_density, lift, opaque
from full_geometry.geometry.rounding import blocked, ray_from
from full_geometry.walk.media import WalkMedia

BY_COSINE = 0.25  # of the directions to emitters
R_4 = (0.8566748838545029, 0.7338918566271260, 0.6287067210378087, 0.5385972572236101)  # Roberts 2018, four dimensions


def lit_points(
    scene: mi.Scene, media: WalkMedia, k: int, rays: int, seed: tuple[int, ...], rng: mi.PCG32
) -> tuple[mi.SurfaceInteraction3f, mi.Spectrum]:
    """Points in order along the faces of object or glass k, as a direction w to an emitter sees them, and their flux.

    Paths from the camera find the light L cos(w, n_s) f / |d.n_s| for each radiance along d; behind the boundary a ray
    has the flux

        L cos(w, n_s) (f cos / pdf)(w -> d) |d.n| / |d.n_s|,

    over the density of the point and of w, n_s the shading normal. Its first part L cos(w, n_s) over that is returned,
    `bend` is the last.
    """
    # ---- points, with a sample of the emitters each
    shift = np.random.default_rng(list(seed)).random(5)
    u = [(dr.arange(mi.Float, rays) + opaque(shift[4])) / opaque(rays), *multiples(R_4, shift, rays)]
    at = entries(media, k, [dr.minimum(u[0], 1 - 2**-24), u[1], u[2]])
    si = dr.zeros(mi.SurfaceInteraction3f, rays)
    si.p, si.n, si.sh_frame = mi.Point3f(at.p), mi.Normal3f(at.n), mi.Frame3f(at.n_out)
    w, light = _incident(scene, media, k, si, mi.Point2f(u[3], u[4]), rng)
    si.wi = si.to_local(w)
    si = lift(si, w)

    # ---- L cos(w, n_s)
    cosine = mi.Frame3f.cos_theta(si.wi)
    return si, dr.select((dr.dot(si.n, w) > 0) & (cosine > 0), light * (cosine * at.weight / opaque(rays)), 0)


def bend(si: mi.SurfaceInteraction3f, wo: mi.Vector3f, d: mi.Vector3f) -> mi.Float:
    """|d.n| / |d.n_s| of a direction d, wo in the frame of shading normals."""
    return dr.abs(dr.dot(d, si.n)) / dr.maximum(dr.abs(mi.Frame3f.cos_theta(wo)), 1e-6)


def _incident(
    scene: mi.Scene, media: WalkMedia, k: int, si: mi.SurfaceInteraction3f, u: mi.Point2f, rng: mi.PCG32
) -> tuple[mi.Vector3f, mi.Spectrum]:
    """A direction w to an emitter, and the light from there over its density.
    A share of them is drawn by the cosine, for lamps so near that those of the emitters miss them (balance heuristic
    over one sample): L / ((1 - BY_COSINE) p_emitter + BY_COSINE p_cosine)."""
    instance_scene, rounding = media.instance_scene, opaque(media.holders.rounding[k])

    # ---- by the emitters, L without its density; delta lights have no other technique
    ds, light = scene.sample_emitter_direction(si, u, False)
    shadow = instance_scene.ray_to_emitter(si, ds, rounding)
    delta, active = mi.Bool(ds.delta), (ds.pdf > 0) & (ds.pdf < dr.inf)
    light = dr.select(active & ~blocked(scene, shadow, active), light * ds.pdf, 0)

    # ---- by the cosine
    w, _ = cosine_above(si.sh_frame.n, si.n, u)
    drawn = rng.next_float32() < BY_COSINE
    met = instance_scene.intersect(scene, ray_from(si, w, rounding), mi.RayFlags.All, active=drawn)
    emitter = met.emitter(scene, drawn)
    found = drawn & (emitter != None)  # noqa: E711
    there = mi.DirectionSample3f(scene, met, si)

    # ---- balance heuristic over one sample: L / ((1 - b) p_emitter + b p_cosine), b = BY_COSINE
    p_emitter = dr.select(drawn, scene.pdf_emitter_direction(si, there, found), ds.pdf)
    w = mi.Vector3f(dr.select(drawn, w, ds.d))
    p_cosine = dr.select(delta & ~drawn, 0, cosine_density(si.sh_frame.n, si.n, w))
    light = dr.select(drawn, dr.select(found, emitter.eval(met, found), 0), light)
    density = (1 - BY_COSINE) * p_emitter + BY_COSINE * p_cosine
    return w, dr.select(density > 0, light / dr.maximum(density, 1e-30), 0)


def multiples(roots: tuple[float, ...], shift: Iterable[float], width: int, first: int = 0) -> list[mi.Float]:
    """Multiples of roots from `first` on, shifted, in [0, 1): in whole numbers, which float32 would round."""
    result = []
    for root, s in zip(roots, shift):
        step = int(root * 2**32)
        start = (int(s * 2**32) + first * step) % 2**32
        step, start = (dr.opaque(mi.UInt32, v) for v in (step, start))
        result.append(mi.Float((dr.arange(mi.UInt32, width) * step + start) >> 8) * 2**-24)
    return result


def to_world(media: WalkMedia, k: int) -> np.ndarray:
    """Where object or glass k stands: the matrix of an instance."""
    table = media.holders
    kind = int(table.kind[k])
    return table.to_world(kind)[k - int(table.first[kind])]


def entries(media: WalkMedia, k: int, u: list[mi.Float]) -> EntrySample:
    """Points uniform over the surface of object or glass k, in an instance over that in its group.
    The weight is 1 / density."""
    kind = int(media.holders.kind[k])
    found = uniform_entries(media.holder_shapes[kind], u[0], mi.Point2f(u[1], u[2]))
    if media.holders.groups[kind] is None:
        return found
    M = to_world(media, k)
    columns = [[mi.Vector3f(*(opaque(v) for v in column)) for column in m[:3].T] for m in (M, np.linalg.inv(M))]
    return InstanceTransform(*columns, mi.Float(0)).entry_to_world(found)
