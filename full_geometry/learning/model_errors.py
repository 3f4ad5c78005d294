"""Errors of a model of one object: radiance of random exits against walks, with the noise of both taken out.

Exits are uniform over the area with w_o by the cosine. Light is 1 from everywhere, or one of four lobes
max(0, w . l)^16; nothing blocks it.

With the estimates a of the model and b of the walks and their variances,

    error² = mean_k[(a_k - b_k)² - var a_k - var b_k] / (mean_k b_k)²,

for lobes the mean of the four; its standard error by the jackknife over exits. Under an even sky images take what a
model knows of uniform light, where that is trusted, and no S: the error of that is the third kind.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import SurfacePoint, Transport, evaluate
from full_geometry.geometry.sensors import independent
from full_geometry.objects.objects import TranslucentObject, object_of, refuse, refuse_textures, translucent_shapes
from full_geometry.settings import Settings
from full_geometry.transport.exit_pairs import EntryProposals, trace_exits
from full_geometry.transport.half_space import HalfSpaceTransport
from full_geometry.transport.models import lookup
from full_geometry.transport.one_object import HalfSpace
from full_geometry.transport.patches import WeightTable
from full_geometry.transport.storing import KIND, find_weights, load
from halfspace_sss.checks import check_count
from halfspace_sss.noise_free import NoiseFree
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.registry import bssrdf
from halfspace_sss.tracing.walk import generator, pass_seed

LOBES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
POWER = 16
LANES = 2**20  # of one pass


@dataclass(frozen=True, eq=False)
class ExitRadiance:
    """Radiance of exits under all lights and its variance, (channels, exits, lights)."""

    mean: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True, eq=False)
class ExitTruth:
    """Exits and what walks say of them."""

    exits: SurfacePoint
    truth: ExitRadiance


class _Sums:
    """Sums of value and square over the samples of each exit."""

    def __init__(self, n_exits: int) -> None:
        self.n_exits, self.n, self.sums = n_exits, 0, 0.0

    def add(self, value: mi.Spectrum, w: mi.Vector3f, per_exit: int) -> None:
        """Samples of all exits, `per_exit` neighbouring lanes for each: value per channel of unit light from w."""
        lights = [mi.Float(1)] + [dr.maximum(dr.dot(w, mi.Vector3f(*axis.tolist())), 0) ** POWER for axis in LOBES]
        products = [[v * light + 0 * v for light in lights] for v in value]
        products = [[*row, *(p * p for p in row)] for row in products]
        dr.eval(products)  # at once: a sum evaluates what it is of, each with a kernel of its own
        rows = [np.stack([dr.block_sum(p, per_exit).numpy() for p in row], axis=-1) for row in products]
        self.sums = self.sums + np.stack(rows).astype(float)
        self.n += per_exit

    def estimate(self) -> ExitRadiance:
        first, second = np.split(self.sums / self.n, 2, axis=-1)
        return ExitRadiance(first, (second - first**2) / (self.n - 1))


def _passes(n_exits: int, per_exit: int) -> list[int]:
    most = max(LANES // n_exits, 1)
    return [min(most, per_exit - done) for done in range(0, per_exit, most)]


def reference(obj: TranslucentObject, exits: int = 256, walks: int = 8192, seed: int = 0, fewest: int = 2) -> ExitTruth:
    """Exits and their radiance by walks.
    `exits`, `walks`: number of exits, and of walks of each; seed: of both. `fewest`: scattering events that count."""
    for name, value, least in (("exits", exits, 2), ("walks", walks, 2), ("seed", seed, 0)):
        check_count(name, value, least)
    points = obj.random_points(generator(mi, exits, pass_seed(seed, 17)))
    evaluate(points)
    return ExitTruth(points, traced(obj, points, walks, (seed, 18), fewest=fewest))


def traced(
    obj: TranslucentObject, exits: SurfacePoint, walks: int, seed: tuple[int, ...], **orders: int
) -> ExitRadiance:
    """Radiance of exits by so many walks of each; `orders` as for `trace_exits`."""
    sums = _Sums(dr.width(exits.p))
    for k, per_exit in enumerate(_passes(sums.n_exits, walks)):
        ends = trace_exits(obj, _repeated(exits, per_exit), (*seed, k), **orders)
        sums.add(ends.T, ends.at.w, per_exit)
    return sums.estimate()


def _repeated(points: SurfacePoint, times: int) -> SurfacePoint:
    return points.gather(dr.arange(mi.UInt32, dr.width(points.p) * times) // dr.opaque(mi.UInt32, times))


def modelled(
    transport: Transport, proposals: EntryProposals, exits: SurfacePoint, samples: int, seed: int = 0
) -> ExitRadiance:
    """Radiance of exits by a model.
    `proposals`: where its entries are drawn. `samples`, `seed`: entries of each exit; of the entries."""
    n = dr.width(exits.p)
    sums = _Sums(n)
    table = WeightTable.of(proposals.patches, exits) if proposals.patches else None
    for k, per_exit in enumerate(_passes(n, samples)):
        points, lanes = _repeated(exits, per_exit), dr.arange(mi.UInt32, n * per_exit)
        rng = generator(mi, n * per_exit, pass_seed(seed, 19, k))
        entries, weight = proposals.sample(points, rng, table, lanes // dr.opaque(mi.UInt32, per_exit))
        value = transport.S(transport.prepare(points), entries, weight > 0) * weight
        evaluate(value, entries)
        sums.add(value, entries.w, per_exit)
    return sums.estimate()


LIGHTS = ("constant", "lobes")
EVEN_SKY = "even sky"  # as images show it
FEWEST = {"multiple": 2, "total": 1}  # scattering events of what a model contains
PROBES = "better_dipole"  # whose radial density entries follow


class RadianceError(NamedTuple):
    """Relative RMSE of one channel under one kind of light, its standard error, and the ratio of the means."""

    channel: int
    light: str
    error: float
    standard_error: float
    ratio: float


def compare(model: ExitRadiance, truth: ExitRadiance, lights: Sequence[str] = LIGHTS) -> list[RadianceError]:
    """The errors of all channels under kinds of light; an even sky is the first of the lights of both, as constant."""
    rows = []
    for c, light in itertools.product(range(len(truth.mean)), lights):
        columns = slice(1, None) if light == "lobes" else slice(0, 1)
        a, b = model.mean[c][:, columns], truth.mean[c][:, columns]
        square = (a - b) ** 2 - model.variance[c][:, columns] - truth.variance[c][:, columns]
        off = _jackknife(square, b)
        rows.append(RadianceError(c, light, off.value, off.standard_error, float(a.mean() / max(b.mean(), 1e-300))))
    return rows


def _jackknife(square: np.ndarray, truth: np.ndarray) -> NoiseFree:
    """The error from the squared errors (exits, lights) and the truth."""
    n = len(square)

    def ratio(sums: np.ndarray, means: np.ndarray) -> np.ndarray:
        return np.mean(sums / np.maximum(means, 1e-150) ** 2, axis=-1)

    whole = float(ratio(square.mean(0), truth.mean(0)))
    parts = ratio((square.sum(0) - square) / (n - 1), (truth.sum(0) - truth) / (n - 1))
    return NoiseFree(whole, float(np.sqrt((n - 1) * np.mean((parts - parts.mean()) ** 2))))


def _even_sky(transport: Transport, by_S: ExitRadiance, truth: ExitTruth) -> list[RadianceError]:
    """The errors of images under an even sky: those of alpha where it is trusted, elsewhere of S."""
    alpha, n = transport.alpha, len(by_S.mean)
    if alpha is None:
        return []
    known = np.array(alpha.known[1]).reshape(n, 1, 1) > 0
    mean = np.where(known, np.array(alpha(truth.exits)[1]).reshape(n, -1, 1), by_S.mean[..., :1])
    return compare(ExitRadiance(mean, np.where(known, 0, by_S.variance[..., :1])), truth.truth, [EVEN_SKY])


def errors_of(
    obj: TranslucentObject,
    transports: Mapping[str, Transport],
    *,
    exits: int = 256,
    walks: int = 8192,
    samples: int = 8192,
    seed: int = 0,
    progress: NamedProgress | None = None,
) -> dict[str, list[RadianceError]]:
    """The errors of several transports of an object, by name; the truth is traced once for all of the same orders.
    Those that have learnt what uniform light leaves have the error of images under an even sky too. `transports`: by
    name. `exits`, `seed`: number of exits; of everything. `walks`, `samples`: of each exit, for the truth and for the
    models. `progress`: called with (what, done, total)."""
    check_count("samples", samples, 2)
    proposals = EntryProposals(obj, HalfSpace(obj, PROBES))
    truths: dict[str, ExitTruth] = {}
    rows, done = {}, 0
    total = len(transports) + len({t.orders for t in transports.values()})

    def tell(what: str, steps: int) -> None:
        if progress:
            progress(what, steps, total)

    for name, model in transports.items():
        if model.orders not in truths:
            tell("truth", done)
            truths[model.orders] = reference(obj, exits, walks, seed, FEWEST[model.orders])
            done += 1
        tell(name, done)
        truth = truths[model.orders]
        by_S = modelled(model, proposals, truth.exits, samples, seed)
        rows[name] = [*compare(by_S, truth.truth), *_even_sky(model, by_S, truth)]
        done += 1
    tell("models", total)
    return rows


def errors(
    shape: mi.Shape | mi.Scene,
    medium: Medium | None = None,
    model: str = "full_geometry",
    *,
    mm_per_unit: float | None = None,
    object: str | None = None,
    folder: str | os.PathLike[str] | None = None,
    **sampling: int,
) -> list[RadianceError]:
    """The error of a model of an object, by name: what a user is to expect of images before the first one.

    The truth has the orders of the model: two and more, or for a model that says "total" one and more.

    Args:
        shape: a Mitsuba shape, or a scene.
        medium: 1/mm; of a scene it is that of the object's `translucent` surface.
        model: "full_geometry", whose weights must have been trained, or the name of a half-space model.
        mm_per_unit: length of a scene unit, mm; by default what the integrator of a scene says, and 1 for a shape.
        object: id of the object in a scene; may be left out where there is one.
        folder: of weights.
        sampling: `exits`, `walks`, `samples` and `seed` as of `errors_of`.

    Raises:
        ValueError: an argument is out of range, the object has not been trained, or there is no such model.
    """
    obj = object_of(shape, medium, mm_per_unit, object)
    transports = {model: transport_of(obj, model, folder)}
    return errors_of(obj, transports, **sampling)[model]


def transport_of(obj: TranslucentObject, model: str, folder: str | os.PathLike[str] | None = None) -> Transport:
    """The transport called `model` of an object: "full_geometry", one that a package adds, or a half-space model.

    Raises:
        ValueError: the object has not been trained, there is no such model, it refuses the object as renders would, or
            it has no S for two points of a surface.
    """
    inclusions, entry = obj.geometry.inclusions, lookup(model)
    if inclusions is not None and not entry.capabilities.inclusions:
        refuse(inclusions.found[0], obj.geometry, f"the model {model!r}")
    if model == KIND:
        return load(find_weights(obj, folder), obj).model
    if obj.textured is not None:
        refuse_textures(obj.geometry.name, f"errors of {model!r}")
    if entry.capabilities.of_half_space:
        return HalfSpaceTransport([bssrdf(model, m) for m in obj.media])
    transport = entry.transport(obj, Settings()).transport
    if transport.is_delta:
        raise ValueError(f"model must be one that has S for two points of a surface, got {model!r}")
    return transport


# --------------------------------------------------------------------------------------------------
# How far an image by a model is off: its mean on each object over that of a few random walks.
#
# At random places of the film where an object is seen, one walk each estimates the radiance L without bias of a model.
# With I the image there, the ratio of means is R = sum I / sum L, of standard error sqrt(sum (I - R L)²) / sum L.


WALKS = 4096
SHOWN = 64  # places on an object, fewer of which tell nothing
LEAST = 0.03  # off, below which there is nothing to tell


class MeanRatio(NamedTuple):
    """The mean of an object in an image over that of walks, with its standard error."""

    object: str
    value: float
    error: float


def mean_ratios(scene: mi.Scene, image: np.ndarray, sensor: int = 0) -> list[MeanRatio]:
    """The ratio of each translucent object that enough places of the film show.
    `scene`: whose integrator tells mm_per_unit and max_depth. `image`: (height, width, channels) radiance by a model,
    of the whole crop. ValueError if the scene cannot be walked."""
    # ---- rays through random places of the film, and the objects they meet
    camera, numbers = scene.sensors()[sensor], np.random.default_rng(0)
    place = numbers.random((2, WALKS), dtype=np.float32)
    ray, weight = camera.sample_ray(camera.shutter_open(), 0.5, mi.Point2f(*map(mi.Float, place)), mi.Point2f(0.5))
    si = scene.ray_intersect(ray)
    dr.eval(ray, weight, si)

    # ---- a walk each
    settings = scene.integrator().settings.shared()
    walks = mi.load_dict({"type": "translucent_walk", **settings})
    L = weight * walks.sample(scene, independent(0, WALKS), mi.Ray3f(ray))[0]
    walked = np.array(L).reshape(-1, WALKS)

    # ---- the image at these places
    height, width = image.shape[:2]
    x, y = (np.minimum((u * n).astype(int), n - 1) for u, n in zip(place, (width, height)))
    shown = image[y, x, : len(walked)].T
    results = []
    for shape in translucent_shapes(scene):
        on = np.array(si.shape == mi.ShapePtr(shape))
        image_there, W = shown[:, on].mean(axis=0), walked[:, on].mean(axis=0)
        if on.sum() < SHOWN or not W.sum() > 0:
            continue
        ratio = image_there.sum() / W.sum()
        results.append(
            MeanRatio(shape.id(), float(ratio), float(np.sqrt(np.square(image_there - ratio * W).sum()) / W.sum()))
        )
    return results


def told(ratios: list[MeanRatio], model: str) -> list[str]:
    """A sentence for each object that is off by more than LEAST and three standard errors."""
    return [
        f"{model} makes {f'object {r.object!r}' if r.object else 'the object'} {r.value:.2f} ± {r.error:.2f} times as "
        f"bright as {WALKS} random walks do; --model path_traced has no such error"
        for r in ratios
        if abs(r.value - 1) > max(LEAST, 3 * r.error)
    ]
