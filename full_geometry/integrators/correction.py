"""Gathered light corrected by random walks that start on the surface, the same for all views.

Light L_g that a model and `gathering` give has a bias that no time lowers. With W the light of a random walk that goes
in at x_o against w_o, both without what the boundary reflects at x_o,

    L_o = L_g + a(w_o) C(x_o, w_o),    a C = E[W - L_g].

C, a polynomial of w_o bent by the boundary, is smooth where the model has the detail of light. It is fitted to W - L_g
at random places and directions (`precomputed.surface_regression`). It stays until light or objects change; more walks
make it finer. Walks find light precomputed where that is possible (`precomputed.unscattered_light`).

Not corrected: detail that is finer than the distance of points, and C beyond its second degree in w_o, or the third of
its cosine.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import GOLDEN, lattice, uniform_entries
from full_geometry.geometry.points import cosine_above, floats, place
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.snapshot import same_objects
from full_geometry.integrators.gathering import Gathered
from full_geometry.integrators.inner_light import cut_to_next
from full_geometry.integrators.surface_paths import exit_at, trace_paths
from full_geometry.integrators.walk_paths import PathTracer
from full_geometry.precomputed.lit_points import R_4
from full_geometry.precomputed.surface_regression import ResidualSums, directional, levels, smooth_field
from full_geometry.precomputed.transport_matrix import bent
from full_geometry.walk.random_walk import PATH_LANES
from halfspace_sss.backend import clock
from halfspace_sss.interrupts import checkpoint

if TYPE_CHECKING:
    from full_geometry.objects.objects import TranslucentObject
    from full_geometry.settings import Settings

PER_LAUNCH = 2**16  # walks
FEWEST, MOST = 2**17, 2**22  # walks of an object
SAMPLES_PER_WALK = 8  # of the image
ROOTS = (*R_4, GOLDEN)  # not the fifth power of the same root: directions would lie on a line, as 1/g⁴ + 1/g⁵ = 1
LEAST_ALBEDO = 1e-6
BRIGHTEST = 1 / 16384  # of the residuals of a launch, which are as bright as the next
SEED = 500


@dataclass(frozen=True, eq=False)
class SurfaceCorrection:
    """C of an object.

    Args:
        gathered: light that is corrected.
        halves: sums of independent residuals.
        launches: of walks that they are of.
        values: C at the points times `scale_of` the light, (points, channels, terms).
        error: RMS of the light over its mean, as far as `surface_regression` tells it.
    """

    gathered: Gathered
    halves: tuple[ResidualSums, ResidualSums]
    launches: int
    values: np.ndarray
    error: float

    @property
    def walks(self) -> int:
        """How many walks it is of, without those whose place is not on the object or has no point near it."""
        return int(sum(half.number.sum() for half in self.halves))

    @classmethod
    def of(cls, gathered: Gathered, halves: tuple[ResidualSums, ResidualSums], launches: int) -> SurfaceCorrection:
        """The regression of residuals."""
        points, geometry = gathered.points, gathered.object.geometry
        p, n, n_out = (np.array(v, dtype=float).T for v in (points.p, points.n, points.n_out))
        B = np.array(gathered.values, dtype=float).reshape(len(points), -1, gathered.terms)
        G = B[:, :, 0].mean(axis=1)
        G = (G - G.mean()) / max(float(G.std()), 1e-12 + 1e-3 * float(np.abs(G).mean()))
        found = levels(p, n, geometry.area, float(sum(half.number.sum() for half in halves)))
        C, squared = smooth_field(found, (p, n_out), G, halves)
        # RMS over points, over the mean of all light that leaves
        whole = np.square((halves[0] + halves[1]).mean).sum()
        return cls(gathered, halves, launches, C, float(np.sqrt(squared.mean() / whole)) if whole > 0 else 0.0)

    @property
    def corrected(self) -> Gathered:
        """The light with C."""
        values = self.values / scale_of(self.gathered)[:, None]
        known = np.array(self.gathered.values).reshape(*values.shape[:2], self.gathered.terms)
        values[:, :, : self.gathered.terms] += known
        return replace(self.gathered, values=floats(values))

    @property
    def told(self) -> str:
        """How many walks, and the error."""
        name = self.gathered.object.geometry.name
        return f"light of object {name} corrected by {self.walks} walks: about {self.error:.1%} off at a point"


class Corrections:
    """Corrections of objects in a scene, kept until light or objects change; more walks are added to those known.

    Args:
        part: of walks that are independent of other parts.

    Attributes:
        seconds: by `clock`, of the walks as they were last traced.
    """

    def __init__(self, part: int = 0) -> None:
        self._part = part
        self._gathered: list[Gathered] = []
        self._known: list[SurfaceCorrection | None] = []
        self._found: list[TranslucentObject] = []
        self.seconds = 0.0

    def of(
        self, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, samples: int
    ) -> list[TranslucentObject]:
        """The objects with corrected light.

        Args:
            scene: of Mitsuba.
            objects: with gathered light.
            settings: of the integrator.
            samples: of the image, which set the number of walks; 0 leaves light as it is known.

        Raises:
            ValueError: the light of an object cannot be corrected.
        """
        # ---- what is known still holds for the same gathered light, which changes with light and objects
        started, gathered = clock(), [obj.gathered for obj in objects]
        for obj in objects:
            _check(obj)
        if not same_objects(gathered, self._gathered):
            self._gathered, self._known = gathered, [None] * len(objects)
        if not samples:
            return objects if None in self._known else self._found

        # ---- walks that are missing, in two halves
        number = int(np.clip(samples // SAMPLES_PER_WALK, FEWEST, MOST))
        launches = 2 * round(number / (2 * PER_LAUNCH))
        if any(known is None or known.launches < launches for known in self._known):
            walk = mi.load_dict({"type": "translucent_walk", **settings.shared()})
            tracer = replace(walk.tracer(scene, SEED, 4 * number), begins_inside=True)
            for k, known in enumerate(self._known):
                first, halves = (known.launches, list(known.halves)) if known else (0, _nothing(gathered[k]))
                for launch in range(first, launches):
                    checkpoint()
                    seed = SEED + 10_000 * k + 1_000_000 * self._part + launch
                    halves[launch % 2] += residuals(scene, objects, settings, tracer, k, seed)
                self._known[k] = SurfaceCorrection.of(gathered[k], tuple(halves), launches)
            self._found = [replace(obj, gathered=known.corrected) for obj, known in zip(objects, self._known)]
            self.seconds = clock() - started
        return self._found

    def told(self) -> list[str]:
        """A line for each object: walks, and error."""
        return [known.told for known in self._known if known is not None]


def _check(obj: TranslucentObject) -> None:
    """ValueError if there is no light of an object to correct, or walks would not all go in where they begin."""
    reason = "it leaves the model where it has entered" if obj.gathered is None else ""
    reason = "the surface has a mask or is blended with another" if obj.wrapping.mixes else reason
    if reason:
        raise ValueError(f"light of object {obj.geometry.name} must be sampled, got corrected: {reason}")


def _nothing(gathered: Gathered) -> list[ResidualSums]:
    return [ResidualSums.zeros(len(gathered.points), dr.size_v(mi.Spectrum))] * 2


def residuals(
    scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, tracer: PathTracer, k: int, seed: int
) -> ResidualSums:
    """W - L_g of object k at `PER_LAUNCH` random places and directions, summed by points.

    Args:
        scene: of Mitsuba.
        objects: with gathered light.
        settings: of the integrator.
        tracer: of walks that go in where they begin.
        k: number of the object.
        seed: of places and walks.
    """
    # ---- places uniform over the area, directions by the cosine, of one lattice
    obj, gathered = objects[k], objects[k].gathered
    u = lattice(PER_LAUNCH, ROOTS, np.random.default_rng(seed).random(5))
    u = [floats(np.minimum(v, 1 - 2**-24)) for v in u]
    at = uniform_entries(obj.geometry, u[0], mi.Point2f(u[1], u[2]))
    w, _ = cosine_above(at.n_out, at.n, mi.Point2f(u[3], u[4]))
    ray = ray_from(place(at.p, at.n), w, obj.geometry.clearance)
    ray = mi.Ray3f(ray.o, -w)
    si = obj.instance_scene.intersect(scene, ray, mi.RayFlags.All)
    met, out = si.is_valid() & (si.shape == mi.ShapePtr(obj.geometry.shape)), exit_at(obj, si)
    dr.eval(ray, out, met)

    # ---- W of a walk, and L_g = a B with order 1; order 0, which is exact where it is traced, is in neither
    passes = 0 not in obj.low_orders
    W, _, _ = replace(tracer, passes=passes).trace(ray, PATH_LANES, (seed,))
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, PER_LAUNCH)
    parts, *_ = trace_paths(scene, objects, settings, sampler, ray, mi.Bool(True), passes=passes)
    a = gathered.factor(out, met)
    r = W - gathered.radiance(out, met) - parts[1]
    point, near = gathered.points.nearest(out.p, out.n, met)
    bent_w = bent(out.w, out.n_out, gathered.albedo.eta)
    mu = dr.dot(bent_w, out.n_out)
    lanes = dr.zeros(mi.Float, PER_LAUNCH)
    a, r, W = mi.Spectrum(a) + lanes, mi.Spectrum(r) + lanes, mi.Spectrum(W) + lanes
    dr.eval(a, r, W, point, near, bent_w, mu)

    if not dr.all(dr.isfinite(dr.sum(r)))[0]:
        raise ValueError(f"light of walks at object {obj.geometry.name} must be finite, got NaN or infinity")

    # ---- sums over the residuals of each point
    kept = np.array(near) & (np.array(a).min(axis=0) > LEAST_ALBEDO)
    a, r, W, bent_w = (np.array(v, dtype=float)[:, kept].T for v in (a, r, W, bent_w))
    a = a / scale_of(gathered)
    r = _steadied(r, a)
    Y = np.stack(directional(*bent_w.T, np.array(mu, dtype=float)[kept]), axis=1)
    return ResidualSums.of(np.array(point)[kept], Y, a, r, W, len(gathered.points))


def _steadied(r: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Residuals (n, channels) of which the brightest are as bright as the next, what they lose shared by all.

    Of a lamp that walks meet by chance one residual in thousands may hold more than all others beside it.
    """
    # the sum stays: Σ a_s times the mean of what is lost
    kept = cut_to_next(r, BRIGHTEST)
    return kept + a * ((r - kept).sum(axis=0) / a.sum(axis=0))


def scale_of(gathered: Gathered) -> np.ndarray:
    """Mean of a(w) mu of each channel over that of all, which makes residuals of all channels alike."""
    whole = np.maximum(gathered.albedo.whole, LEAST_ALBEDO)
    return whole / whole.mean()
