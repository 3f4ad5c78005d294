"""Entries drawn where light arrives: proposals that know how bright the faces of an object are.

For a model S the density of entries of least variance is proportional to S times

    e² = E[(a(w_i) mu_i L_i / pdf)²],

the mean square over directions as paths draw them. Proposals that know S of an exit alone draw by S; here e of each
part of a mesh is estimated, and they draw by S (e + `FLOOR` of its mean), as the paper's Eq. 12 has light in it.
Any e leaves the means as they are. Light by way of other surfaces is not in e: the floor is for that.

e is used where it pays: where the mean of e² over the area is `LEAST_GAIN` times the square of the mean of e.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import SurfacePoints, uniform_entries
from full_geometry.geometry.points import AreaPoints, Proposals
from full_geometry.geometry.sensors import independent
from full_geometry.geometry.shape import Geometry
from full_geometry.geometry.snapshot import Snapshot, same_objects
from full_geometry.integrators.gathering import GatheringPoint, by_emitters, light_state, met_by_cosine, spreads
from full_geometry.integrators.lighting import Primal, RenderContext
from full_geometry.objects.objects import TranslucentObject
from full_geometry.precomputed.transport_matrix import Albedo
from full_geometry.settings import Settings

CELLS = 1024  # of a mesh of many faces:
FACES = 4  # for each cell, from which on none is divided
CENTROID = 5 / 9, 0.5  # of `square_to_uniform_triangle`
LEAST, MOST = 2**14, 2**16  # points of an object at which light is looked at,
SHARE = 1 / 4  # of all samples of an image: with fewer than the least, entries are by S alone
FLOOR = 0.1  # of 0.03 the mean of the variance over pixels is larger, of 0.3 the median
LEAST_GAIN = 1.5
SEED = 33


class LitEntries:
    """Proposals of the objects of a scene by the light of it, kept until something changes."""

    def __init__(self) -> None:
        self._objects: list[TranslucentObject] = []
        self._state: tuple[Snapshot | None, int] = (None, 0)
        self._proposals: list[Proposals | None] = []

    def of(
        self, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, samples: int
    ) -> list[Proposals | None]:
        """The proposals of each object.
        `scene`, `objects`, `settings`: what is rendered. `samples`: of all pixels."""
        count = int(min(SHARE * samples, MOST))
        if count < LEAST or mi.is_spectral:
            return [obj.proposals for obj in objects]
        state = (light_state(scene), count)
        if not same_objects(objects, self._objects) or state != self._state:
            context = RenderContext.of(scene, objects, settings, Primal())
            self._proposals = [_lit(context, obj, count) for obj in objects]
            self._objects, self._state = objects, state
        return self._proposals


def _lit(context: RenderContext, obj: TranslucentObject, count: int) -> Proposals | None:
    # ---- only where there is something to draw: a closed mesh that spreads light, under light that varies
    geometry = obj.geometry
    faces = geometry.shape.face_count() if geometry.shape.is_mesh() else 1
    if faces == 1 or context.lights.nee_share == 0 or not (spreads(obj) and geometry.closed and geometry.area > 0):
        return obj.proposals

    # ---- e² = mean over the samples of a cell of (a mu L / pdf)²
    cell = _cells(geometry, faces)
    face, square = _brought(context, obj, count)
    k, n = cell[face], cell.max() + 1
    number = np.bincount(k, minlength=n)
    e = np.sqrt(np.bincount(k, square, n) / np.maximum(number, 1))
    e = np.where(number > 0, e, e[k].mean())

    # ---- it pays where E[e²] > `LEAST_GAIN` E[e]²
    mean = e[k].mean()
    if not (np.isfinite(mean) and mean > 0 and (e[k] ** 2).mean() > LEAST_GAIN * mean**2):
        return obj.proposals
    return obj.proposals.lit((e / mean + FLOOR)[cell])


def _cells(geometry: Geometry, faces: int) -> np.ndarray:
    """The cell of each face: that of the point which is nearest to its centroid, or its own where faces are few."""
    # a mesh of few faces has enough samples for each of them
    points = SurfacePoints.of(geometry, CELLS)
    if faces < FACES * len(points):
        return np.arange(faces)
    face = dr.arange(mi.UInt32, faces)
    at = AreaPoints(geometry.shape).on_face(face, mi.Point2f(*CENTROID))
    return np.array(points.nearest(mi.Point3f(at.p), mi.Normal3f(at.n) * geometry.side(face), mi.Bool(True))[0])


def _brought(context: RenderContext, obj: TranslucentObject, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces of uniform points, and the square of what a direction at them brings for a unit of S, mean of channels.
    Half of the mean square over emitter samples and directions by the cosine: a factor of all is of no account."""
    # uniform points of the surface
    sampler = independent(SEED, count)
    entry = uniform_entries(obj.geometry, sampler.next_1d(), sampler.next_2d())
    at = GatheringPoint(entry.p, entry.n, entry.n_out, obj.geometry.clearance)

    # light of a sampled emitter and along a direction of the cosine, by F_t(mu) in place of a(mu)
    albedo = Albedo(np.tile([1.0, 0.0, 0.0], (len(obj.media), 1)), float(obj.media[0].eta))
    c = context.environment_means(obj)[1] if context.uses_environment_mean(obj) else mi.Spectrum(0)
    aimed, _ = by_emitters(context.scene, context.instance_scene, albedo, at, sampler.next_2d(), c)
    met = met_by_cosine(context.scene, context.instance_scene, albedo, at, sampler.next_2d(), c)[0]
    square, face = dr.mean(aimed * aimed + met * met) + dr.zeros(mi.Float, count), entry.face
    dr.eval(square, face)
    return np.array(face), np.array(square, dtype=float)
