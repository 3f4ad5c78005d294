"""What the knobs of a way bring: entries for an exit, channels of one walk, nodes of photon beam diffusion, precision.

Costs are variance of a sample times seconds, in time to equal noise; 1 is that of the setting everything else uses.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.scenes.scene_files import PATH_TRACED
from full_geometry.trade.assessing import assess_stage
from full_geometry.trade.results import ObjectTrade
from full_geometry.trade.techniques import Effort, Stage, Technique
from halfspace_sss.arrays import Lanes
from halfspace_sss.backend import clock
from halfspace_sss.comparison.model_errors import model_error, references
from halfspace_sss.neural.network import Network
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import model_class

ENTRIES, NODES = (1, 2, 4, 8), (4, 8, 16, 32, 64)
BEAMS, USUAL_NODES, QUERIES = "photon_beam_diffusion", 16, 2**14
PRECISIONS, LANES, REPEATS = ("float32", "float16"), 2**18, 3


@dataclass(frozen=True)
class Setting:
    """A setting of a knob: its cost over that of the usual setting, and the error that it has."""

    knob: str
    value: str
    way: str
    cost: float
    error: float


def entry_settings(
    on: Stage, names: Sequence[str], seconds: float, seed: int = 0, entries: Sequence[int] = ENTRIES
) -> list[Setting]:
    """How many points of entry an exit draws, for models on the first object of a scene."""
    results = []
    for n in entries:
        stage = replace(on, bssrdf={**on.bssrdf, "entries": n}, paces={}, _integrators={})
        chosen = [Technique(PATH_TRACED), *map(Technique, names)]
        seen = assess_stage(stage, chosen, Effort(seconds, seed=seed)).objects[0]
        results += [("entries", str(n), name, _cost(seen, name), seen.way(name).bias) for name in names]
    usual = {way: cost for _, value, way, cost, _ in results if value == str(entries[0])}
    return [Setting(knob, value, way, cost / usual[way], error) for knob, value, way, cost, error in results]


def _cost(assessed: ObjectTrade, way: str) -> float:
    row = assessed.way(way)
    return row.time_to(1.0)


def channel_settings(on: Stage, alone: Sequence[Stage], seconds: float, seed: int = 0) -> list[Setting]:
    """All channels in one walk against walks for each, at equal mean variance over the channels.

    With time t_c and variance V_c of channel c alone the least is (Σ sqrt(V_c t_c))².

    Args:
        on: the scene.
        alone: for each channel the scene in which all channels have its medium.
        seconds: of measuring, each.
        seed: of the samples.
    """
    together = assess_stage(on, [Technique(PATH_TRACED)], Effort(seconds, seed=seed)).objects[0]
    n, least = len(together.radiance), 0.0
    variance = n * together.traced.variance * np.mean(together.radiance) ** 2
    for stage in alone:
        one = assess_stage(stage, [Technique(PATH_TRACED)], Effort(seconds, seed=seed)).objects[0]
        least += math.sqrt(one.traced.variance * one.traced.seconds) * one.radiance[0]
    ratio = least**2 / (variance * together.traced.seconds)
    knob = "channels in one walk"
    return [Setting(knob, str(n), PATH_TRACED, 1.0, 0.0), Setting(knob, "1", PATH_TRACED, ratio, 0.0)]


def node_settings(medium: Medium, events: float = 4e6, seed: int = 0) -> list[Setting]:
    """Nodes of the quadrature of photon beam diffusion on a scalar medium: error against walks, time of S in NumPy."""
    (traced,) = references([medium.in_mfp()], events, seed, 4)
    rng = np.random.default_rng(0)
    r, mu = 10 ** rng.uniform(-2, 1, QUERIES), rng.uniform(0.05, 1, (2, QUERIES))
    results = []
    for n in NODES:
        model = model_class(BEAMS)(medium.in_mfp(), n_samples=n)
        started = time.perf_counter()
        model.eval(r, mu[0], 0.3, mu[1], 1.0)
        results.append((n, time.perf_counter() - started, model_error(model, traced).error))
    usual = next(took for n, took, _ in results if n == USUAL_NODES)
    return [Setting("nodes", str(n), BEAMS, took / usual, error) for n, took, error in results]


def precision_settings(medium: Medium, events: float = 4e6, seed: int = 0) -> list[Setting]:
    """Single against half precision of the network of `neural` on a scalar medium: error, time in Dr.Jit alone."""
    (traced,) = references([medium.in_mfp()], events, seed, 4)
    results = []
    for precision in PRECISIONS:
        model = model_class("neural")(medium.in_mfp())
        (network,) = model.networks
        took = _network_seconds(network, precision)
        model.networks = [partial(_rounded, network, precision)]
        results.append((precision, took, model_error(model, traced).error))
    return [Setting("precision", name, "neural", took / results[0][1], error) for name, took, error in results]


def _rounded(network: Network, precision: str, features: Sequence[Lanes]) -> Lanes:
    """The network in a precision, for Dr.Jit arrays of single or double precision."""
    kind = type(sum(features[1:], features[0]))
    inner = _lanes(kind, precision)
    return kind(network([inner(f) for f in features]))


def _lanes(kind: type, precision: str) -> type:
    return dr.float16_array_t(kind) if precision == "float16" else dr.float32_array_t(kind)


def _network_seconds(network: Network, precision: str) -> float:
    """Least of some runs over as many lanes as a launch has, compilation left out."""
    rng, n_in = np.random.default_rng(0), len(network.matrices[0])
    features = [_lanes(mi.Float, precision)(mi.Float(row)) for row in rng.random((n_in, LANES)).astype(np.float32)]
    dr.eval(features)
    took = []
    for _ in range(REPEATS + 1):
        started = clock()
        dr.eval(network(features))
        dr.sync_thread()
        took.append(clock() - started)
    return min(took[1:])
