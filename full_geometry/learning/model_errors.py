"""How wrong a model of one object is: radiance of random exits against walks, with the noise of both taken out.

Exits are uniform over the area with w_o by the cosine. Light is 1 from everywhere, or one of four lobes
max(0, w . l)^16; nothing blocks it. With the estimates a of the model and b of the walks and their variances,

    error² = mean_k[(a_k - b_k)² - var a_k - var b_k] / (mean_k b_k)²,

for lobes the mean of the four; its standard error by the jackknife over exits.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from full_geometry.half_space import HalfSpace
from full_geometry.learning.exits import trace_exits
from full_geometry.learning.pairs import Proposals
from full_geometry.patch_table import ExitTable
from full_geometry.subject import Subject, SurfacePoint
from halfspace_sss.checks import check_count
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.tracing.walk import generator, pass_seed

__all__ = [
    "LIGHTS", "ModelError", "Reference", "Transport", "compare", "errors", "errors_of", "measure",
    "reference", "traced",
]  # fmt: skip

LIGHTS = ("constant", "lobes")
LOBES = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3.0)
POWER = 16
LANES = 2**20  # of one pass
FEWEST = {"multiple": 2, "total": 1}  # scattering events of what a model contains
PROBES = "better_dipole"  # whose radial density entries follow


class Transport(Protocol):
    """A model of what light that enters an object is worth where it leaves.

    Attributes:
        orders: "multiple" (two or more scattering events) or "total" (one or more).
    """

    orders: str

    def prepare(self, at: SurfacePoint, active: Any = True) -> Any: ...

    def S(self, exit: Any, at: SurfacePoint, active: Any = True) -> Any: ...


class ModelError(NamedTuple):
    """Relative RMSE of one channel under one kind of light, its standard error, and the ratio of the means."""

    channel: int
    light: str
    error: float
    standard_error: float
    ratio: float


@dataclass(frozen=True, eq=False)
class Estimate:
    """Radiance of exits under all lights and its variance, (channels, exits, lights)."""

    mean: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True, eq=False)
class Reference:
    """Exits and what walks say of them."""

    exits: SurfacePoint
    truth: Estimate


class _Sums:
    """Sums of value and square over the samples of each exit."""

    def __init__(self, n_exits: int) -> None:
        self.n_exits, self.n, self.sums = n_exits, 0, 0.0

    def add(self, value: Any, w: Any, per_exit: int) -> None:
        """Samples of all exits, `per_exit` neighbouring lanes for each: value per channel of unit light from w."""
        import drjit as dr
        import mitsuba as mi

        lights = [mi.Float(1)] + [dr.maximum(dr.dot(w, mi.Vector3f(*axis.tolist())), 0) ** POWER for axis in LOBES]
        rows = []
        for v in value:
            products = [v * light for light in lights]
            parts = [dr.block_sum(p + 0 * v, per_exit) for p in (*products, *(p * p for p in products))]
            dr.eval(parts)
            rows.append(np.stack([p.numpy() for p in parts], axis=-1).astype(float))
        self.sums = self.sums + np.stack(rows)
        self.n += per_exit

    def estimate(self) -> Estimate:
        first, second = np.split(self.sums / self.n, 2, axis=-1)
        return Estimate(first, (second - first**2) / (self.n - 1))


def _passes(n_exits: int, per_exit: int) -> list[int]:
    """Samples of each exit in each pass."""
    most = max(LANES // n_exits, 1)
    return [min(most, per_exit - done) for done in range(0, per_exit, most)]


def reference(subject: Subject, exits: int = 256, walks: int = 8192, seed: int = 0, fewest: int = 2) -> Reference:
    """Exits and their radiance by walks.

    Args:
        exits, walks: number of exits, and of walks of each; seed: of both.
        fewest: scattering events that count.
    """
    import drjit as dr
    import mitsuba as mi

    for name, value, least in (("exits", exits, 2), ("walks", walks, 2), ("seed", seed, 0)):
        check_count(name, value, least)
    points = subject.random_points(generator(mi, exits, pass_seed(seed, 17)))
    dr.eval(points)
    return Reference(points, traced(subject, points, walks, (seed, 18), fewest=fewest))


def traced(subject: Subject, exits: SurfacePoint, walks: int, seed: tuple[int, ...], **orders: int) -> Estimate:
    """Radiance of exits by so many walks of each; `orders` as for `trace_exits`."""
    import drjit as dr

    sums = _Sums(dr.width(exits.p))
    for k, per_exit in enumerate(_passes(sums.n_exits, walks)):
        found = trace_exits(subject, _repeated(exits, per_exit), (*seed, k), **orders)
        sums.add(found.T, found.at.w, per_exit)
    return sums.estimate()


def _repeated(points: SurfacePoint, times: int) -> SurfacePoint:
    import drjit as dr
    import mitsuba as mi

    return points.gather(dr.arange(mi.UInt32, dr.width(points.p) * times) // times)


def modelled(transport: Transport, proposals: Proposals, exits: SurfacePoint, samples: int, seed: int = 0) -> Estimate:
    """Radiance of exits by a model.

    Args:
        transport: the model.
        proposals: where its entries are drawn.
        exits: from a reference.
        samples, seed: entries of each exit; of the entries.
    """
    import drjit as dr
    import mitsuba as mi

    n = dr.width(exits.p)
    sums = _Sums(n)
    table = ExitTable(proposals.patches, exits) if proposals.patches else None
    for k, per_exit in enumerate(_passes(n, samples)):
        points, lanes = _repeated(exits, per_exit), dr.arange(mi.UInt32, n * per_exit)
        rng = generator(mi, n * per_exit, pass_seed(seed, 19, k))
        entries, weight = proposals.sample(points, rng, table, lanes // per_exit)
        value = transport.S(transport.prepare(points), entries, weight > 0) * weight
        dr.eval(value, entries)
        sums.add(value, entries.w, per_exit)
    return sums.estimate()


def compare(model: Estimate, truth: Estimate) -> list[ModelError]:
    """The errors of all channels under both kinds of light."""
    found = []
    for c in range(len(truth.mean)):
        for light, columns in zip(LIGHTS, (slice(0, 1), slice(1, None))):
            a, b = model.mean[c][:, columns], truth.mean[c][:, columns]
            square = (a - b) ** 2 - model.variance[c][:, columns] - truth.variance[c][:, columns]
            found.append(ModelError(c, light, *_jackknife(square, b), float(a.mean() / max(b.mean(), 1e-300))))
    return found


def _jackknife(square: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Error and standard error from the squared errors (exits, lights) and the truth."""
    n = len(square)

    def ratio(sums: np.ndarray, means: np.ndarray) -> np.ndarray:
        return np.mean(sums / np.maximum(means, 1e-150) ** 2, axis=-1)

    whole = float(ratio(square.mean(0), truth.mean(0)))
    parts = ratio((square.sum(0) - square) / (n - 1), (truth.sum(0) - truth) / (n - 1))
    spread = float(np.sqrt((n - 1) * np.mean((parts - parts.mean()) ** 2)))
    error = float(np.sqrt(max(whole, 0.0)))
    return error, spread / (2 * max(error, np.sqrt(spread), 1e-12))


def measure(
    subject: Subject,
    transport: Transport,
    proposals: Proposals,
    *,
    truth: Reference | None = None,
    samples: int = 8192,
    seed: int = 0,
) -> list[ModelError]:
    """The error of a transport of an object, per channel, under constant light and lobes.

    Args:
        subject: the object.
        transport: `FullGeometry` or `HalfSpaceTransport`.
        proposals: where entries are drawn.
        truth: from `reference`, of the orders of the transport; made anew by default.
        samples: entries of each exit.
        seed: of everything.
    """
    check_count("samples", samples, 2)
    truth = truth or reference(subject, seed=seed, fewest=FEWEST[transport.orders])
    return compare(modelled(transport, proposals, truth.exits, samples, seed), truth.truth)


def errors_of(
    subject: Subject,
    transports: Mapping[str, Transport],
    *,
    exits: int = 256,
    walks: int = 8192,
    samples: int = 8192,
    seed: int = 0,
    progress: NamedProgress | None = None,
) -> dict[str, list[ModelError]]:
    """The errors of several transports of an object, by name; the truth is traced once for all of the same orders.

    Args:
        subject: the object.
        transports: by name.
        exits, seed: number of exits; of everything.
        walks, samples: of each exit, for the truth and for the models.
        progress: called with (what, done, total).
    """
    check_count("samples", samples, 2)
    proposals = Proposals(subject, HalfSpace(subject, PROBES))
    truths: dict[str, Reference] = {}
    found, done = {}, 0
    total = len(transports) + len({t.orders for t in transports.values()})

    def tell(what: str, steps: int) -> None:
        if progress:
            progress(what, steps, total)

    for name, model in transports.items():
        if model.orders not in truths:
            tell("truth", done)
            truths[model.orders] = reference(subject, exits, walks, seed, FEWEST[model.orders])
            done += 1
        tell(name, done)
        found[name] = measure(subject, model, proposals, truth=truths[model.orders], samples=samples, seed=seed)
        done += 1
    tell("models", total)
    return found


def errors(
    shape: Any,
    medium: Medium | None = None,
    model: str = "full_geometry",
    *,
    mm_per_unit: float | None = None,
    object: str | None = None,
    folder: str | os.PathLike | None = None,
    exits: int = 256,
    walks: int = 8192,
    samples: int = 8192,
    seed: int = 0,
) -> list[ModelError]:
    """The error of a model of an object, by name: what a user is to expect of images before the first one.

    The truth has the orders of the model: two and more, or for a model that says "total" one and more.

    Args:
        shape: a Mitsuba shape, or a scene.
        medium: 1/mm; of a scene it is that of the object's `translucent` surface.
        model: "full_geometry", whose weights must have been trained, or the name of a half-space model.
        mm_per_unit: length of a scene unit, mm; by default what the integrator of a scene says, and 1 for a shape.
        object: id of the object in a scene; may be left out where there is one.
        folder: of weights.
        exits: number of exits.
        walks, samples: of each exit, for the truth and for the model.
        seed: of everything.

    Raises:
        ValueError: an argument is out of range, the object has not been trained, or there is no such model.
    """
    from full_geometry.storing import transport

    subject = Subject.given(shape, medium, mm_per_unit, object)
    found = {model: transport(subject, model, folder)}
    return errors_of(subject, found, exits=exits, walks=walks, samples=samples, seed=seed)[model]
