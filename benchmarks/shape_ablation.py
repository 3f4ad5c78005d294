"""Which descriptors are worth what: short fits without some of them, on the same objects, at equal time."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.held_out import HELD_OUT
from benchmarks.shape_training import (
    STANDARD,
    PairData,
    ShapeFit,
    draw_object,
    grouped,
    make_data,
    mean_events,
)
from full_geometry.transport.descriptors import N_LENGTHS, N_OWN
from halfspace_sss.progress import NamedProgress

OBJECTS, HELD_OUT_OBJECTS, SEED = 300, 28, 79
K = N_LENGTHS
OWN = {  # columns of an end
    "log P, way to y": (6, 7), "n.d, n.e": (8, 9), "L_k": tuple(range(10, 10 + K)),
    "V_k": tuple(range(10 + K, 10 + 3 * K)),
}  # fmt: skip
SHARED = {
    "refracted w_o.w_i": (4, 5), "n_o.n_i": (6,), "gap of the y": (7,), "line y_o y_i": (8, 9),
    "phase functions": (10, 11), "shares of S_0": (12, 13),
}  # fmt: skip
WITHOUT: dict[str, tuple[str, ...]] = {
    "all": (), "without log P, way to y": ("log P, way to y",), "without L_k": ("L_k",), "without V_k": ("V_k",),
    "without L_k and V_k": ("L_k", "V_k"), "without the line y_o y_i": ("line y_o y_i",),
    "without phase functions and attenuation": ("phase functions",),
    "without n.d, n.e, n_o.n_i, gap of the y": ("n.d, n.e", "n_o.n_i", "gap of the y"),
    "without shares of S_0": ("shares of S_0",), "without refracted w_o.w_i and its phase": ("refracted w_o.w_i",),
}  # fmt: skip


def ablation_table(work: Path, seconds: float, progress: NamedProgress | None = None) -> str:
    """A row for each set: steps, likelihood left on held-out objects, and how far their mean radiance is off.

    Args:
        work: folder of a training, whose first 300 objects are taken.
        seconds: processor time of each fit.
        progress: called with (what, done, total).

    Raises:
        ValueError: the folder has no objects.
    """
    pool = _objects(work)
    families = tuple(HELD_OUT)
    held = []
    for k in range(HELD_OUT_OBJECTS):
        family = families[k % len(families)]
        obj = draw_object((SEED, k), {family: HELD_OUT[family]}).object
        held.append(make_data(obj, mean_events(obj), (SEED, k)))
    held = [data for data in held if data is not None]
    lines = ["| descriptors | steps | likelihood left | mean radiance off: median | 90th percentile |",
             "| --- | --- | --- | --- | --- |"]  # fmt: skip
    best = None
    for k, (name, missing) in enumerate(WITHOUT.items()):
        if progress:
            progress(f"ablation: {name}", k, len(WITHOUT))
        objects = ([_without(data, missing) for data in some] for some in (pool, held))
        steps, losses, ratios = _fit(*objects, seconds)
        best = losses.mean() if best is None else best
        off = np.quantile(np.abs(ratios - 1), [0.5, 0.9])
        left = f"{losses.mean() - best:+.4f}"
        lines.append(f"| {name} | {steps} | {left} | {100 * off[0]:.1f} % | {100 * off[1]:.1f} % |")
    return "\n".join(lines) + "\n"


def _objects(work: Path) -> list[PairData]:
    objects = []
    for path in sorted(work.glob("object-*.npz"))[:OBJECTS]:
        with np.load(path) as stored:
            if "walks" in stored:
                objects.append(PairData.from_arrays(stored))
    if not objects:
        raise ValueError(f"work must hold objects of `train-shapes`, got none in {work}")
    return objects


def _without(data: PairData, missing: Sequence[str]) -> PairData:
    """The data with some descriptors set to what they are on a plane."""
    if not missing:
        return data
    columns = [c + side * N_OWN for name in missing for c in OWN.get(name, ()) for side in (0, 1)]
    columns += [2 * N_OWN + c for name in missing for c in SHARED.get(name, ())]
    walks, proposals = data.walks.copy(), data.proposals.copy()
    walks[:, columns] = proposals[:, columns] = 0
    return replace(data, walks=walks, proposals=proposals)


def _fit(pool: list[PairData], held: list[PairData], seconds: float) -> tuple[int, np.ndarray, np.ndarray]:
    """Steps, and on every held-out object the likelihood and the ratio of the mean radiances."""
    groups = [grouped(data) for data in pool]
    fitting, rng, at = ShapeFit(STANDARD, 0), np.random.default_rng(0), time.process_time()
    while (part := (time.process_time() - at) / seconds) < 1:
        fitting.advance(groups, rng, part)
    losses, ratios = [], []
    with torch.no_grad():
        for data in held:
            numbers = torch.from_numpy(data.medium)[None]
            f_x, f_y = (
                fitting.average(torch.from_numpy(v).float(), numbers.expand(len(v), -1))
                for v in (data.walks, data.proposals)
            )
            ratios.append(float((torch.from_numpy(data.W) * torch.exp(f_y)).mean()))
            losses.append(ratios[-1] - data.share * float((torch.from_numpy(data.T) * f_x).mean()))
    return fitting.step, np.array(losses), np.array(ratios)
