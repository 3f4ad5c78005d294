"""How wrong a model of one object is: radiance of random exits against walks, with the noise of both taken out.

With the estimates a of the model and b of the walks of `radiance` and their variances,

    error² = mean_k[(a_k - b_k)² - var a_k - var b_k] / (mean_k b_k)²,

for lobes the mean of the four; its standard error by the jackknife over exits. Under an even sky images take what a
model knows of even light, where that is trusted, and no S: the error of that is the third kind.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from full_geometry.models.half_space import HalfSpace
from full_geometry.models.storing import KIND, find_weights, load
from full_geometry.object.pairs import EntryProposals
from full_geometry.object.radiance import ExitRadiance, ExitTruth, modelled, reference
from full_geometry.object.subject import Subject
from halfspace_sss.checks import check_choice, check_count
from halfspace_sss.interface.model import bssrdf
from halfspace_sss.physics.medium import Medium
from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.object.half_space import HalfSpaceTransport
from halfspace_sss.rendering.object.points import Transport
from halfspace_sss.rendering.object.registry import lookup, model_names
from halfspace_sss.rendering.object.settings import Settings
from halfspace_sss.rendering.object.translucent import Inside

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


def compare(model: ExitRadiance, truth: ExitRadiance) -> list[RadianceError]:
    """The errors of all channels under both kinds of light."""
    kinds = tuple(zip(LIGHTS, (slice(0, 1), slice(1, None))))
    return [_error(c, light, columns, model, truth) for c in range(len(truth.mean)) for light, columns in kinds]


def of_even_light(model: ExitRadiance, truth: ExitRadiance) -> list[RadianceError]:
    """The errors of all channels under an even sky, the first of the lights of both."""
    return [_error(c, EVEN_SKY, slice(0, 1), model, truth) for c in range(len(truth.mean))]


def _error(c: int, light: str, columns: slice, model: ExitRadiance, truth: ExitRadiance) -> RadianceError:
    a, b = model.mean[c][:, columns], truth.mean[c][:, columns]
    square = (a - b) ** 2 - model.variance[c][:, columns] - truth.variance[c][:, columns]
    return RadianceError(c, light, *_jackknife(square, b), float(a.mean() / max(b.mean(), 1e-300)))


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
    proposals: EntryProposals,
    *,
    truth: ExitTruth | None = None,
    samples: int = 8192,
    seed: int = 0,
) -> list[RadianceError]:
    """The error of a transport of an object, per channel, under constant light and lobes.

    Args:
        subject: the object.
        transport: its S.
        proposals: where entries are drawn.
        truth: from `reference`, of the orders of the transport; made anew by default.
        samples: entries of each exit.
        seed: of everything.
    """
    check_count("samples", samples, 2)
    truth = truth or reference(subject, seed=seed, fewest=FEWEST[transport.orders])
    return compare(modelled(transport, proposals, truth.exits, samples, seed), truth.truth)


def _even_sky(transport: Transport, by_S: ExitRadiance, truth: ExitTruth) -> list[RadianceError]:
    """The errors of images under an even sky: those of alpha where it is trusted, elsewhere of S."""
    alpha, n = transport.alpha, len(by_S.mean)
    if alpha is None:
        return []
    known = np.array(alpha.known[1]).reshape(n, 1, 1) > 0
    mean = np.where(known, np.array(alpha(truth.exits)[1]).reshape(n, -1, 1), by_S.mean[..., :1])
    return of_even_light(ExitRadiance(mean, np.where(known, 0, by_S.variance[..., :1])), truth.truth)


def errors_of(
    subject: Subject,
    transports: Mapping[str, Transport],
    *,
    exits: int = 256,
    walks: int = 8192,
    samples: int = 8192,
    seed: int = 0,
    progress: NamedProgress | None = None,
) -> dict[str, list[RadianceError]]:
    """The errors of several transports of an object, by name; the truth is traced once for all of the same orders.

    Of those that have learnt what even light leaves also the error of images under an even sky.

    Args:
        subject: the object.
        transports: by name.
        exits, seed: number of exits; of everything.
        walks, samples: of each exit, for the truth and for the models.
        progress: called with (what, done, total).
    """
    check_count("samples", samples, 2)
    proposals = EntryProposals(subject, HalfSpace(subject, PROBES))
    truths: dict[str, ExitTruth] = {}
    rows, done = {}, 0
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
        truth = truths[model.orders]
        by_S = modelled(model, proposals, truth.exits, samples, seed)
        rows[name] = [*compare(by_S, truth.truth), *_even_sky(model, by_S, truth)]
        done += 1
    tell("models", total)
    return rows


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
        exits: number of exits.
        walks, samples: of each exit, for the truth and for the model.
        seed: of everything.

    Raises:
        ValueError: an argument is out of range, the object has not been trained, or there is no such model.
    """
    subject = Subject.given(shape, medium, mm_per_unit, object)
    transports = {model: transport_of(subject, model, folder)}
    return errors_of(subject, transports, exits=exits, walks=walks, samples=samples, seed=seed)[model]


def transport_of(subject: Subject, model: str, folder: str | os.PathLike | None = None) -> Transport:
    """The transport called `model` of an object: "full_geometry", one that a package adds, or a half-space model.

    Raises:
        ValueError: the object has not been trained, there is no such model, it refuses the object as renders would, or
            it has no S for two points of a surface.
    """
    check_choice("model", model, model_names())
    if model == KIND:
        return load(find_weights(subject, folder), subject).model
    entry = lookup(model)
    if not entry.knows_objects:
        return HalfSpaceTransport([bssrdf(model, m) for m in subject.media])
    make = entry.transport
    inside = Inside("medium", subject.media[0], model, "total", True, subject.varying)
    found = make(subject.object, inside, list(subject.media), Settings()).transport if make else None
    if found is None or found.is_delta:
        raise ValueError(f"model must be one that has S for two points of a surface, got {model!r}")
    return found
