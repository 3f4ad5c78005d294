"""All ways of rendering on all objects of a scene that is made ready."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from halfspace_sss.progress import NamedProgress
from halfspace_sss.rendering.object.shape import survey
from halfspace_sss.rendering.scenes.causes import first_cause
from halfspace_sss.rendering.scenes.scene_files import PATH_TRACED
from halfspace_sss.trade.measuring.exits import Exits, visible_exits
from halfspace_sss.trade.measuring.results import Assessment, ObjectTrade, WayTrade
from halfspace_sss.trade.measuring.sampling import Sampled, clock, first_sample, sample_more, warm_up
from halfspace_sss.trade.measuring.seeds import seeded
from halfspace_sss.trade.measuring.statistics import mean_square, ratio_of_means, relative_variance
from halfspace_sss.trade.measuring.training import training_seconds
from halfspace_sss.trade.measuring.ways import Stage, Way

__all__ = ["EXITS", "assess_stage"]

EXITS = 160  # few: their choice makes 6 % of a bias uncertain, and each gets the more samples
TRACED_SHARE = 0.4  # of the time, for the walks that all ways are compared with


def assess_stage(
    on: Stage,
    chosen: Sequence[Way],
    *,
    seconds: float = 4.0,
    samples: int | None = None,
    sensor: int = 0,
    seed: int = 0,
    exits: int = EXITS,
    traced: float = TRACED_SHARE,
    progress: NamedProgress | None = None,
) -> Assessment:
    """As `assessing.assess`, of a scene that is made ready.

    With `samples` of each exit instead of seconds; `traced` is the share of the time for walks.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are heard when the ways are made ready again
        for walks in (True, False):
            warm_up(on, [way for way in chosen if (way.model == PATH_TRACED) == walks])
    started = clock()
    seen = visible_exits(on.scene, on.shapes, sensor, exits, seeded(seed, 41))
    objects, compiled, compiling = [], 0.0, 0.0
    for k, points in enumerate(seen):
        if points is None:
            objects.append(_unseen(on, k))
            continue

        def tell(way: str, done: int, k: int = k) -> None:
            if progress:
                progress(f"{on.names[k]}, {way}", k * len(chosen) + done, len(seen) * len(chosen))

        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            sampled = _object(on, k, points, chosen, (seconds, samples, traced), seeded(seed, 42, k), tell)
            heard = [" ".join(str(w.message).split()) for w in caught]
        walks = sampled[chosen[0]]
        rows = tuple(_row(on, k, way, found, walks) for way, found in sampled.items())
        compiled += sum(row.compilation for row in rows)
        compiling += sum(found.compiling for found in sampled.values() if isinstance(found, Sampled))
        radiance = tuple(float(v) for v in walks.estimate.mean.mean(axis=1))
        notes = tuple(dict.fromkeys(heard))
        objects.append(ObjectTrade(on.names[k], _mfp(on, k), points.share, points.pixels, radiance, rows, notes))
    return Assessment(tuple(objects), clock() - started - compiling, compiled, seed)


def _unseen(on: Stage, k: int) -> ObjectTrade:
    note = f"object {on.names[k]!r} is hardly seen by the camera, if at all: nothing can be told of it"
    return ObjectTrade(on.names[k], _mfp(on, k), 0.0, 0.0, (), (), (note,))


def _mfp(on: Stage, k: int) -> tuple[float, float]:
    """Mean free paths across an object."""
    size = survey(on.shapes[k]).size * on.mm_per_unit
    thickness = [size * float(m.sigma_t) for m in on.shapes[k].bsdf().inside.channels()]
    return min(thickness), max(thickness)


def _object(
    on: Stage,
    k: int,
    points: Exits,
    chosen: Sequence[Way],
    budget: tuple[float, int | None, float],
    seed: int,
    tell: Any,
) -> dict[Way, Sampled | str]:
    """What all ways say of an object, or why they refuse it."""
    seconds, samples, traced = budget
    sampled: dict[Way, Sampled | str] = {}
    end = clock() + seconds
    for done, way in enumerate(chosen):
        tell(way.name, done)
        started = clock()
        share = traced if way.model == PATH_TRACED and len(chosen) > 1 else 1 / (len(chosen) - done)
        try:
            found = first_sample(on, way, points, seeded(seed, done), k)
            end, started = end + found.compiling, started + found.compiling
            left = share * (end - started) - (clock() - started)
            sample_more(on, way, points, found, seeded(seed, done), seconds=left, samples=samples)
            sampled[way] = found
        except (ValueError, RuntimeError) as error:
            if way.model == PATH_TRACED:
                raise ValueError(first_cause(error)) from error
            sampled[way] = first_cause(error)
    return sampled


def _row(on: Stage, k: int, way: Way, found: Sampled | str, traced: Sampled) -> WayTrade:
    if isinstance(found, str):
        return WayTrade(way.name, refusal=found)
    a, b = found.estimate, traced.estimate
    exact = way.model == PATH_TRACED
    bias2 = (0.0, 0.0) if exact else mean_square(a, b)
    ratios = [(1.0, 0.0) if exact else ratio_of_means(a, b, c) for c in range(len(b.mean))]
    variance = relative_variance(a, b)
    row = WayTrade(
        way.name, *bias2, tuple(r[0] for r in ratios), tuple(r[1] for r in ratios), *variance, found.seconds,
        a.samples * a.mean.shape[1], found.preparation, found.compilation, 0.0, found.memory,
    )  # fmt: skip
    return replace(row, training=training_seconds(on.scene, on.shapes[k].id(), way.model))
