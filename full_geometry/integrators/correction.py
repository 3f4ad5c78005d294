"""Light that leaves objects, by random walks that start on their surfaces: the same for all views.

Deep light is that of paths which are scattered twice at least once they have gone in, before they meet anything but the
boundary. With W that of a random walk that goes in at x_o against w_o, without what the boundary reflects at x_o, and
L_g what a model and `gathering` give for it, which has a bias that no time lowers,

    L_o = L_g + a(w_o) C(x_o, w_o),    a C = E[W - L_g].

C, a polynomial of w_o bent by the boundary and of what is painted there, is smooth where the model has the detail of
light; where a boundary is rough, a has the share of light that it lets in instead of F_t, which is 0 along the surface.
It is fitted to W - L_g at random places and directions (`precomputed.surface_regression`). It stays until light or
objects change; more walks make it finer. Walks find light precomputed where that is possible
(`precomputed.unscattered_light`). All other light is traced by the walks of the image, which end at their second event
(`walk_paths`). Where phase functions are narrow, light that has turned forwards alone is as narrow, and no deep light:
paths go on by the share Π (1 - q) of their turns (`precomputed.forward_scattering`), and walks have the rest of it.

No model knows what lies inside an object, what overlaps it, or where its instances stand: L_g is then 0 and a that of
the reflectance of the medium, so that C is all deep light.

Not corrected: detail that is finer than the distance of points, as webs between fingers that are half a mean free path
thin, and C beyond its second degree in w_o, or the third of its cosine.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.light_points import GOLDEN, SurfacePoints, lattice
from full_geometry.geometry.points import cosine_above, floats, place, surface_point
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.shape import is_inside
from full_geometry.geometry.snapshot import same_objects
from full_geometry.integrators.gathering import Gathered, OutgoingLight, light_state, way_in_is_clear
from full_geometry.integrators.inner_light import cut_to_next
from full_geometry.integrators.walk_paths import PathTracer
from full_geometry.objects.objects import TranslucentObject
from full_geometry.precomputed.lit_points import R_4, entries, to_world
from full_geometry.precomputed.surface_regression import (
    TERMS,
    ResidualSums,
    directional,
    levels,
    painted,
    smooth_field,
)
from full_geometry.precomputed.transport_matrix import FEWEST as FEWEST_POINTS
from full_geometry.precomputed.transport_matrix import Albedo, bent, count_of
from full_geometry.precomputed.unscattered_light import ImageSamples
from full_geometry.settings import Settings
from full_geometry.surface.varying import equivalent
from full_geometry.surface.wrapped import surface_of
from full_geometry.transport.models import lookup
from full_geometry.walk.media import WalkMedia, is_rough, sent_back
from full_geometry.walk.random_walk import PATH_LANES
from halfspace_sss.backend import clock
from halfspace_sss.interrupts import checkpoint

PER_LAUNCH = 2**16  # walks
FEWEST, MOST = 2**17, 2**22  # walks of an object
SAMPLES_PER_WALK = 8  # of the image
MOST_PLACES = 64  # of objects and their instances
ROOTS = (*R_4, GOLDEN)  # not the fifth power of the same root: directions would lie on a line, as 1/g⁴ + 1/g⁵ = 1
LEAST_ALBEDO = 1e-6
SAMPLES_OF_LIGHT, FEWEST_OF_LIGHT = 4, 2**20  # of the image that light inside is precomputed for: of a walk, of all
BRIGHTEST = 1 / 16384  # of the residuals of a launch, which are as bright as the next
COSINES, OF_COSINE = 32, 4096  # of what a rough boundary lets in
SEED = 500


@dataclass(frozen=True, eq=False)
class SurfaceCorrection:
    """C of an object.

    Args:
        gathered: light that is corrected.
        area: of the object.
        halves: sums of independent residuals, of all channels together, or of each where textures part their factors.
        launches: of walks that they are of.
        values: C at the points times `scale_of` the light, (points, channels, terms).
        lost: mean squared error of the light over points, as far as `surface_regression` tells it.
        whole: mean square of the light.
    """

    gathered: Gathered
    area: float
    halves: tuple[list[ResidualSums], list[ResidualSums]]
    launches: int
    values: np.ndarray
    lost: float
    whole: float

    @property
    def error(self) -> float:
        """sqrt(sum e² / sum L²) over points."""
        return math.sqrt(self.lost / self.whole) if self.whole > 0 else 0.0

    @property
    def finest(self) -> bool:
        """Whether no image has more walks."""
        return self.launches >= MOST // PER_LAUNCH

    @property
    def walks(self) -> int:
        """How many walks it is of, without those whose place is not on the object or has no point near it."""
        return int(_number(self.halves))

    @classmethod
    def of(
        cls, gathered: Gathered, area: float, halves: tuple[list[ResidualSums], list[ResidualSums]], launches: int
    ) -> SurfaceCorrection:
        """The regression of residuals."""
        points = gathered.points
        p, n = (np.array(v, dtype=float).T for v in (points.p, points.n))
        B = np.array(gathered.values, dtype=float).reshape(len(points), -1, gathered.terms)[:, :, 0]
        found = levels(p, n, area, _number(halves))
        C, lost, whole = [], 0.0, 0.0
        for parts, c in zip(zip(*halves), _channels_together(gathered)):
            known = B[:, c]
            G = known.mean(axis=1)
            G = (G - G.mean()) / max(float(G.std()), 1e-12 + 1e-3 * float(np.abs(G).mean()))
            field, mean, e2 = smooth_field(found, p, G, parts)
            C.append(field)
            # what is found has the square of its error beside that of the light
            light2 = np.square(scale_of(gathered)[c] * known + mean).sum(axis=1)
            lost, whole = lost + e2.mean(), whole + max(light2.mean() - e2.mean(), 0.0)
        return cls(gathered, area, halves, launches, np.concatenate(C, axis=1), float(lost), float(whole))

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
        most = ", the most that images have" if self.finest else ""
        return f"light of object {name} corrected by {self.walks} walks{most}: about {self.error:.1%} off at a point"


class Corrections:
    """Corrections of objects in a scene, kept until light or objects change; more walks are added to those known.

    Args:
        part: of walks that are independent of other parts.

    Attributes:
        seconds: by `clock`, of the walks as they were last traced.
    """

    def __init__(self, part: int = 0) -> None:
        self._part = part
        self._walk: mi.Integrator | None = None
        self._alone: tuple = (None, None, [])
        self._gathered: list[Gathered | None] = []
        self._lights: list[Gathered | None] = []
        self._known: list[SurfaceCorrection | None] = []
        self.seconds = 0.0

    def walk(self, settings: Settings) -> mi.Integrator:
        if self._walk is None:
            self._walk = mi.load_dict({"type": "translucent_walk", **settings.shared(), "layers": settings.layers})
            self._walk.ends = True
        return self._walk

    def without_model(self, scene: mi.Scene, settings: Settings) -> list[TranslucentObject] | None:
        """The objects of a scene, each at one place, where no model has light of them; None where models have it.

        Raises:
            ValueError: they are at too many places, one is open, or none is outside of others.
        """
        if mi.is_spectral:  # refused with models
            return None
        media = self.walk(settings).media(scene)
        if not _exceeds_models(media, settings):
            return None
        state = light_state(scene)
        if self._alone[0] is not media or self._alone[1] != state:
            places = len(media.instance_table)
            if places > MOST_PLACES:
                raise ValueError(
                    f"objects and their instances must be at {MOST_PLACES} places at most for corrected light, which "
                    f"is kept by place, got {places}: translucent_walk takes more"
                )
            for obj in media.objects:
                if not obj.closed:
                    raise ValueError(f"light must be sampled for object {obj.name}, which is not closed, got corrected")
            objects = [_without_light(media, k, scene) for k in range(places)]
            if objects and all(obj.gathered is None for obj in objects):
                raise ValueError(
                    f"light must be sampled for object {objects[0].geometry.name}, of which nothing is outside of "
                    "other objects and of what overlaps it, got corrected: translucent_walk takes it"
                )
            self._alone = media, state, objects
        return self._alone[2]

    def of(
        self, scene: mi.Scene, objects: list[TranslucentObject], settings: Settings, samples: int
    ) -> mi.Integrator | None:
        """The integrator of walks that end by corrected light; None where that is not known.

        Args:
            scene: of Mitsuba.
            objects: with gathered light, or of `without_model`, whose light is never left unknown.
            settings: of the integrator.
            samples: of the image, which set the number of walks; 0 leaves light as it is known.

        Raises:
            ValueError: the light of an object cannot be corrected.
        """
        # ---- what is known still holds for the same gathered light, which changes with light and objects
        started, walk, alone = clock(), self.walk(settings), objects is self._alone[2]
        media = walk.media(scene)
        for obj in objects:
            _check(obj, settings, alone)
        gathered = [obj.gathered for obj in objects]
        if not alone:  # by the numbers of walks, which know what lies inside too
            by_shape = {id(obj.geometry.shape): obj.gathered for obj in objects}
            gathered = [by_shape.get(id(each.shape)) for each in media.objects]
        if not same_objects(gathered, self._gathered):
            self._gathered, self._known, walk.outgoing = gathered, [None] * len(gathered), None
            rough = [let_in(boundary, spec.medium.eta) for boundary, spec in zip(media.boundaries, media.specs)]
            kinds = media.instance_table.kind
            self._lights = [g and replace(g, rough=rough[kind]) for g, kind in zip(gathered, kinds)]
        if not samples and not alone:
            return walk if walk.outgoing is not None else None

        # ---- walks that are missing, in two halves
        number = int(np.clip(samples // SAMPLES_PER_WALK, FEWEST, MOST))
        launches = 2 * round(number / (2 * PER_LAUNCH))
        missing = [k for k, g in enumerate(gathered) if g and self._launches(k) < launches]
        if missing or walk.outgoing is None:
            walk.outgoing = None
            # light that leaves into glass or what overlaps is traced, and needs the cells of all samples
            samples = max((SAMPLES_PER_WALK if alone else SAMPLES_OF_LIGHT) * number, FEWEST_OF_LIGHT)
            tracer = walk.tracer(scene, SEED, ImageSamples(samples, FEWEST_POINTS))
            tracer = replace(tracer, visitor=replace(tracer.visitor, deep=True), layers=False)
            for k in missing:
                known, light = self._known[k], self._lights[k]
                first, halves = (known.launches, list(known.halves)) if known else (0, _nothing(light))
                for launch in range(first, launches):
                    checkpoint()
                    seed = SEED + 10_000 * k + 1_000_000 * self._part + launch
                    found = residuals(tracer, k, light, seed)
                    halves[launch % 2] = [a + b for a, b in zip(halves[launch % 2], found)]
                area = known.area if known else area_of(media, k)
                self._known[k] = SurfaceCorrection.of(light, area, tuple(halves), launches)
            outgoing = OutgoingLight.of(media, [known and known.corrected for known in self._known])
            walk.take(scene, outgoing, tracer.visitor.unscattered)
            self.seconds = clock() - started
        return walk

    def _launches(self, k: int) -> int:
        return self._known[k].launches if self._known[k] else 0

    @property
    def error(self) -> float | None:
        """sqrt(sum e² / sum L²) over the surfaces of all objects; None before light is known."""
        known = [each for each in self._known if each is not None]
        lost, whole = (sum(each.area * getattr(each, name) for each in known) for name in ("lost", "whole"))
        return (math.sqrt(lost / whole) if whole > 0 else 0.0) if known else None

    @property
    def samples(self) -> int:
        """Samples of an image that has so many walks."""
        return SAMPLES_PER_WALK * PER_LAUNCH * max((each.launches for each in self._known if each), default=0)

    @property
    def finest(self) -> bool:
        """Whether no image has more walks."""
        return all(each is None or each.finest for each in self._known)

    def told(self) -> list[str]:
        """A line for each object: walks, and error."""
        return [known.told for known in self._known if known is not None]


def _exceeds_models(media: WalkMedia, settings: Settings) -> bool:
    """Whether instances show objects, they overlap, or their models do not take what lies inside."""
    models = {settings.model or spec.model for spec in media.specs}
    taken = media.inner is None or all(lookup(model).capabilities.inclusions for model in models)
    return media.instance_table.repeated or media.overlaps or not taken


def area_of(media: WalkMedia, k: int) -> float:
    """The area of object k where it stands: the mean of the inverse density of its points."""
    return float(dr.mean(entries(media, k, [floats(v) for v in lattice(2**14)]).weight)[0])


def _without_light(media: WalkMedia, k: int, scene: mi.Scene) -> TranslucentObject:
    """Object k with points and a factor by its reflectance in place of gathered light; without, inside another.
    Glass may be around the whole of it."""
    # ---- the object, with a medium of each channel, 1/(scene unit)
    kind = int(media.instance_table.kind[k])
    geometry, spec = media.objects[kind], media.specs[kind]
    channels = equivalent(spec, geometry).channels()
    textured = None if spec.textured is None else spec.textured.scaled(media.mm_per_unit)
    obj = TranslucentObject(geometry, tuple(m.scaled(media.mm_per_unit) for m in channels), textured=textured)

    # ---- points, none of them inside of others but of glass around all
    area = area_of(media, k)
    points = SurfacePoints.drawn(lambda u: entries(media, k, u), area, count_of(obj, area))
    p, hidden, within = np.array(points.p, dtype=float), np.zeros(len(points), dtype=bool), 0
    bits = np.array(media.inner.priorities.tables["bit"]) if media.overlaps else None
    for j, other in _around(media):
        if j == k:
            continue
        inside = is_inside(other[0], np.linalg.inv(other[1])[:3] @ np.vstack([p, np.ones(p.shape[1])]))
        if inside.all() and j >= len(media.instance_table) and bits[j] < bits[k]:
            within |= int(bits[j])
        else:
            hidden |= inside
    if hidden.all():
        return obj
    points = points.some(np.flatnonzero(~hidden))

    # ---- a = F_t times the reflectance, which textures give at each exit
    R = [1.0] * len(channels) if textured else [float(sent_back(np, m.albedo, m.g)) for m in channels]
    eta = media.inner.priorities.index_within(k, within) if within else float(channels[0].eta)
    albedo = Albedo(np.outer(R, [1.0, 0.0, 0.0]), eta)
    values = floats(np.zeros(len(points) * len(channels)))
    return replace(obj, gathered=Gathered(obj, points, albedo, values, None, within=within))


def _around(media: WalkMedia) -> list[tuple[int, tuple]]:
    """The objects, and glass that overlaps them, by number, each with its geometry and the place where it stands."""
    members = media.inner.priorities.members().tolist() if media.overlaps else []
    numbers = {*range(len(media.instance_table)), *members}
    return [(k, (media.holder_shapes[int(media.holders.kind[k])], to_world(media, k))) for k in sorted(numbers)]


def _check(obj: TranslucentObject, settings: Settings, alone: bool) -> None:
    """ValueError if there is no light of an object to correct, or other orders are asked for than its surface has."""
    reason = "it leaves the model where it has entered" if obj.gathered is None and not alone else ""
    orders = surface_of(obj.geometry.shape).spec.orders
    if settings.orders not in ("", orders):
        reason = f"walks take the orders of the surface, {orders!r}"
    if reason:
        raise ValueError(f"light of object {obj.geometry.name} must be sampled, got corrected: {reason}")


def let_in(boundary: mi.BSDF, eta: float) -> mi.Texture1f | None:
    """The share of light that a boundary of this index lets in, by the cosine of its direction, if it is rough."""
    if not is_rough(boundary):
        return None
    # eta² times the mean weight of refracted directions
    mu = np.repeat((np.arange(COSINES) + 0.5) / COSINES, OF_COSINE)
    u = [floats(np.tile(v, COSINES)) for v in lattice(OF_COSINE)]
    si = dr.zeros(mi.SurfaceInteraction3f, len(mu))
    si.wi, si.t = mi.Vector3f(floats(np.sqrt(1 - mu**2)), 0, floats(mu)), mi.Float(1)
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.Transmission
    _, value = boundary.sample(ctx, si, u[2], mi.Point2f(u[0], u[1]))
    share = eta**2 * np.array(value, dtype=float).mean(axis=0).reshape(COSINES, OF_COSINE).mean(axis=1)
    return mi.Texture1f(mi.TensorXf(share.astype(np.float32)[:, None]), use_accel=False, wrap_mode=dr.WrapMode.Clamp)


def _number(halves: tuple[list[ResidualSums], list[ResidualSums]]) -> float:
    """Residuals of the channels that have most."""
    return float(sum(max(part.number.sum() for part in half) for half in halves))


def _nothing(gathered: Gathered) -> list[list[ResidualSums]]:
    terms = TERMS if gathered.object.textured is None else TERMS + len(painted(0))
    parts = [ResidualSums.zeros(len(gathered.points), len(part), terms) for part in _channels_together(gathered)]
    return [parts, parts]


def _channels_together(gathered: Gathered) -> list[np.ndarray]:
    """Channels that are fitted together, as their factors are alike: all, but each alone where textures part them, or
    one sends no light back."""
    channels, alike = np.arange(dr.size_v(mi.Spectrum)), gathered.object.textured is None
    return [channels] if alike and (gathered.albedo.whole > LEAST_ALBEDO).all() else list(channels[:, None])


def residuals(tracer: PathTracer, k: int, gathered: Gathered, seed: int) -> list[ResidualSums]:
    """W - L_g of object k at `PER_LAUNCH` random places and directions, summed by points, of all channels or of each.

    Args:
        tracer: of deep light.
        k: number of the object.
        gathered: its light.
        seed: of places and walks.
    """
    # ---- places uniform over the area, directions by the cosine, of one lattice
    media, scene = tracer.visitor.media, tracer.visitor.scene
    u = lattice(PER_LAUNCH, ROOTS, np.random.default_rng(seed).random(5))
    u = [floats(np.minimum(v, 1 - 2**-24)) for v in u]
    at = entries(media, k, u[:3])
    w, _ = cosine_above(at.n_out, at.n, mi.Point2f(u[3], u[4]))
    number = dr.opaque(mi.Int32, k)
    ray = ray_from(place(at.p, at.n), w, media.row("rounding", number))
    ray = mi.Ray3f(ray.o, -w)
    si = media.instance_scene.intersect(scene, ray, mi.RayFlags.All)
    met = si.is_valid() & (media.index_of(si, si.is_valid()) == number)
    if media.overlaps:
        beyond = media.instance_scene.intersect(scene, mi.Ray3f(ray.o, w), mi.RayFlags.All)
        met &= _bare(media, beyond, w, dr.opaque(mi.UInt32, gathered.within))
    si = media.seen(si, number, -w)
    out = surface_point(si.p, si.n, si.sh_frame.n, w)._replace(medium=gathered.object.medium_at(si))
    dr.eval(ray, out, met)

    # ---- W of a walk, and L_g = a B
    W, _, _ = replace(tracer, within=gathered.within).trace(ray, PATH_LANES, (seed,))
    a, R = gathered.factor(out, met), gathered.reflectance(out)
    r = W - gathered.radiance(out, met)
    eta = dr.opaque(mi.Float, gathered.albedo.eta)
    point, near = gathered.points.nearest(out.p, out.n, way_in_is_clear(media, si, number, w, eta, met))
    bent_w = bent(out.w, out.n_out, eta)
    mu = dr.dot(bent_w, out.n_out)
    lanes = dr.zeros(mi.Float, PER_LAUNCH)
    a, r, R = (mi.Spectrum(v) + lanes for v in (a, r, R))
    dr.eval(a, r, R, point, near, bent_w, mu)

    if not dr.all(dr.isfinite(dr.sum(r)))[0]:
        raise ValueError(
            f"light of walks at object {gathered.object.geometry.name} must be finite, got NaN or infinity"
        )

    # ---- sums over the residuals of each point, of channels that send any light back there
    kept = np.array(near)
    a, r, R, bent_w = (np.array(v, dtype=float)[:, kept].T for v in (a, r, R, bent_w))
    a = a / scale_of(gathered)
    r = _steadied(r, a)
    Y = np.stack(directional(*bent_w.T, np.array(mu, dtype=float)[kept]), axis=1)
    point, found = np.array(point)[kept], []
    for c in _channels_together(gathered):
        some = a[:, c].min(axis=1) > LEAST_ALBEDO
        terms = Y if gathered.object.textured is None else np.column_stack([Y, *painted(R[:, c])])
        values = (v[some] for v in (terms, a[:, c], r[:, c]))
        found.append(ResidualSums.of(point[some], *values, len(gathered.points)))
    return found


def _bare(media: WalkMedia, beyond: mi.SurfaceInteraction3f, w: mi.Vector3f, within: mi.UInt32) -> mi.Bool:
    """Whether a ray along w that meets `beyond` began outside of all that overlaps but glass around the object."""
    number = media.inner.priorities.instance_table.number(beyond, beyond.is_valid())
    beyond = media.seen(beyond, media.index_of(beyond, beyond.is_valid()), w)
    around = (media.inner.priorities.bit_of(number) & within) != 0
    return (number < 0) | (dr.dot(beyond.n, w) < 0) | around


def _steadied(r: np.ndarray, a: np.ndarray) -> np.ndarray:
    """Residuals (n, channels) of which the brightest are as bright as the next, what they lose shared by all.

    Of a lamp that walks meet by chance one residual in thousands may hold more than all others beside it.
    """
    # the sum stays: Σ a_s times the mean of what is lost
    kept = cut_to_next(r, BRIGHTEST)
    return kept + a * ((r - kept).sum(axis=0) / np.maximum(a.sum(axis=0), 1e-30))


def scale_of(gathered: Gathered) -> np.ndarray:
    """Mean of a(w) mu of each channel over that of all, which makes residuals of all channels alike."""
    whole = np.maximum(gathered.albedo.whole, LEAST_ALBEDO)
    return whole / whole.mean()
