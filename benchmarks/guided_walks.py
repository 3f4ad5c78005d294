"""Walks guided towards the surface (Dwivedi 1982; Křivánek and d'Eon 2014) against plain ones, in the half-space.

The asymptotic diffusion mode of a medium of albedo a, which scatters evenly, decays as exp(-z / nu), z the depth in
mean free paths and nu > 1 the root of

    1 = a nu / 2 ln((nu + 1) / (nu - 1)).

A guided walk takes directions and distances from that mode, mu the cosine towards the surface:

    p(mu) = 1 / (ln((nu + 1) / (nu - 1)) (nu - mu)),    p(t | mu) = (1 - mu / nu) exp(-(1 - mu / nu) t).

Without internal reflection their weights hardly vary. A share of the flights is guided, and the balance heuristic over
both kinds weighs them. Both walks here are one loop, and both add what leaves where they meet the surface. The table
has variance x time of the reflectance at normal incidence of plain walks over that of guided ones.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Iterator, Sequence
from types import ModuleType

import numpy as np
from scipy.optimize import brentq

from benchmarks.bench import Row
from halfspace_sss.arrays import Lanes
from halfspace_sss.backend import array_types
from halfspace_sss.physics.fresnel import F_r, F_t
from halfspace_sss.tracing.walk import generator, pass_seed, roulette

ALBEDOS, INDICES, SHARES = (0.75, 0.95, 0.99, 0.999), (1.0, 1.3), (0.5, 0.75, 0.9)
LANES, WALKS, REPEATS = 2**15, 64, 3


def decay_length(albedo: float) -> float:
    """nu, mean free paths."""
    return brentq(lambda k: albedo * math.atanh(k) / k - 1, 1e-6, 1 - 1e-12) ** -1


def reflectances(
    types: ModuleType, albedo: float, eta: float, share: float, lanes: int, walks: int, seed: int
) -> np.ndarray:
    """Reflectance at normal incidence by each lane of so many walks.

    Args:
        types: Dr.Jit array module.
        albedo, eta: of the medium, which scatters evenly.
        share: of the flights that are guided; 0 traces plain walks.
        lanes, walks, seed: of the run.
    """
    import drjit as dr

    Float, UInt32 = types.Float, types.UInt32
    nu, a, inverse_eta, s, last = (
        dr.opaque(kind, v)
        for kind, v in (
            (Float, decay_length(albedo)), (Float, albedo), (Float, 1 / eta), (Float, share), (UInt32, walks),
        )
    )  # fmt: skip
    span = dr.log((nu + 1) / (nu - 1))
    zero = dr.zeros(Float, lanes)
    state = {
        "rng": generator(types, lanes, pass_seed(seed)), "z": zero, "mu": zero - 1, "weight": zero + 1,
        "turns": dr.full(types.Bool, False, lanes), "order": dr.zeros(UInt32, lanes), "walk": dr.zeros(UInt32, lanes),
        "sum": zero,
    }  # fmt: skip

    def body(q: dict[str, Lanes]) -> dict[str, Lanes]:
        rng, z = q["rng"], q["z"]
        # ---- a direction after an event, guided or even, and a distance by the same technique
        guided = (rng.next_float32() < s) if share else types.Bool(False)
        u = rng.next_float32()
        mode = nu - (nu + 1) * dr.exp(-u * span) if share else 2 * u - 1
        mu = dr.select(q["turns"], dr.clip(dr.select(guided, mode, 2 * u - 1), -1, 1), q["mu"])
        rate = 1 - mu / nu
        t = -dr.log(1 - rng.next_float32()) / dr.select(guided, rate, 1)

        # ---- where it meets the surface, and w = f / ((1 - s) p + s p_guided)
        edge = z / dr.maximum(mu, 1e-6)
        meets = (mu > 0) & (t > edge)
        t = dr.select(meets, edge, t)
        weight = dr.select(q["turns"], q["weight"] * a, q["weight"])
        if share:
            towards = dr.select(q["turns"], 2 / (span * (nu - mu)), 1)  # over that of even directions
            ahead = dr.exp(t * mu / nu) * dr.select(meets, 1, rate)  # over exp(-t)
            weight /= (1 - s) + s * towards * ahead

        # ---- w (1 - F) leaves, w F goes back down; an event scatters
        F = F_r(dr.abs(mu), inverse_eta) if eta != 1 else Float(0)
        leaves = dr.select(meets, weight * (1 - F), 0)
        weight = dr.select(meets, weight * F, weight)
        order = q["order"] + dr.select(meets, UInt32(0), UInt32(1))

        # ---- Russian roulette at events by the weight that the mode expects; a walk that ends begins anew
        z = dr.select(meets, 0.0, dr.maximum(z - t * mu, 0))
        size = weight * dr.exp(-z / nu) if share else weight
        survive, kept = roulette(dr.maximum(size, 1e-30), order)
        weight = dr.select(meets, weight, weight * kept / dr.maximum(size, 1e-30))
        ends = dr.select(meets, weight <= 0, rng.next_float32() >= survive)
        return {
            "rng": rng, "z": dr.select(ends, 0.0, z), "mu": dr.select(ends, -1.0, dr.select(meets, -mu, mu)),
            "weight": dr.select(ends, 1.0, weight), "turns": ~meets & ~ends,
            "order": dr.select(ends, UInt32(0), order), "walk": q["walk"] + dr.select(ends, UInt32(1), UInt32(0)),
            "sum": q["sum"] + leaves,
        }  # fmt: skip

    (found,) = dr.while_loop((state,), lambda q: q["walk"] < last, lambda q: (body(q),), mode="symbolic")
    return found["sum"].numpy().astype(float) * (F_t(1.0, eta) / walks)


def bench_guided(lanes: int = LANES, walks: int = WALKS, albedos: Sequence[float] = ALBEDOS) -> Iterator[Row]:
    """A row for each medium and share of guided flights: reflectance, its error, and how much less its cost is."""
    types = array_types()
    for albedo in albedos:
        for eta in INDICES:
            plain = None
            for share in (0.0, *SHARES):
                reflectances(types, albedo, eta, share, 1024, 1, 0)
                seconds, runs = [], []
                for seed in range(1, REPEATS + 1):
                    started = time.process_time()
                    runs.append(reflectances(types, albedo, eta, share, lanes, walks, seed))
                    seconds.append(time.process_time() - started)
                values = np.concatenate(runs)
                cost = values.var(ddof=1) * statistics.median(seconds)
                plain = plain or cost
                yield {
                    "albedo": albedo, "eta": eta, "guided": share, "mean": float(values.mean()),
                    "standard_error": float(values.std(ddof=1)) / math.sqrt(len(values)), "over_plain": plain / cost,
                }  # fmt: skip
