"""Path-traced reflectance, transmittance and absorption of layers, with their errors.

The walk is that of the half-space but for the interfaces: where a free path meets one inside, it is reflected with the
probability F_r, or refracted; a new free path is drawn beyond it. At the outer boundaries what leaves is tallied, and
the walk goes on inside with the weight F_r. Lengths are mm, depths are measured from the top of the layer.
"""

from __future__ import annotations

import functools
import math
import time
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from halfspace_sss.arrays import aligned
from halfspace_sss.backend import array_types
from halfspace_sss.checks import check_choice
from halfspace_sss.lazy import LazyModule
from halfspace_sss.physics.fresnel import F_r, mu_internal
from halfspace_sss.physics.medium import Layers, sample_hg
from halfspace_sss.progress import Progress
from halfspace_sss.tracing.passes import BATCHES, CellSums, Estimate, estimate, find_cell, is_certain, walk_passes
from halfspace_sss.tracing.walk import Boundary, generator, in_launches, roulette, turn

dr = LazyModule("drjit")

LAYER_ORDERS = ("unscattered", "single", "multiple", "total")  # 0, 1, 2 or more events, and their sum


@dataclass(frozen=True, repr=False)
class LayerTrace:
    """What `trace` measured of layers; every method returns an `Estimate` (value, standard_error).

    `order` is "unscattered" (light that interfaces inside reflect, or that passes through), "single", "multiple" or
    "total". All numbers are fractions of incident flux; what the plane z = 0 mirrors is left out.

    Attributes:
        layers, mu_i, seed, backend: what was asked.
        n_paths, n_events: walks traced; free paths, each of them up to a scattering event or at an interface.
        seconds: wall time, compilation included.
    """

    layers: Layers
    mu_i: float | str
    seed: int
    backend: str
    n_paths: int
    n_events: int
    seconds: float
    _reflected: np.ndarray  # (samples, deepest layer, order)
    _transmitted: np.ndarray  # (samples, order)
    _absorbed: np.ndarray  # (samples, layer)
    _rings: np.ndarray | None  # (samples, deepest layer or transmitted, order, ring), per mm²

    def __repr__(self) -> str:
        R, error = self.reflectance()
        return f"<LayerTrace of {len(self.layers)} layers, {self.n_paths:,} walks: reflectance {R:.5g} ± {error:.2g}>"

    def reflectance(self, order: str = "total") -> Estimate:
        """Fraction of incident flux that leaves upwards."""
        return estimate(_of_order(order, self._reflected.sum(axis=1), 1))

    def reflectance_by_layer(self, order: str = "total") -> Estimate:
        """The reflectance as a sum over the deepest layer that its light has been in, shape (layers,)."""
        return estimate(_of_order(order, self._reflected, 2))

    def transmittance(self, order: str = "total") -> Estimate:
        """Fraction of incident flux that leaves a slab downwards.

        Raises:
            ValueError: the last layer is semi-infinite.
        """
        self._check_slab()
        return estimate(_of_order(order, self._transmitted, 1))

    def absorptance(self) -> Estimate:
        """Fraction of incident flux that each layer absorbs, shape (layers,)."""
        return estimate(self._absorbed)

    def exitance(self, order: str = "total") -> Estimate:
        """Mean exitance upwards over each ring between consecutive `radii`, 1/mm² per incident flux."""
        return estimate(_of_order(order, self._asked_rings()[:, :-1].sum(axis=1), 1))

    def exitance_by_layer(self, order: str = "total") -> Estimate:
        """The exitance as a sum over the deepest layer that its light has been in, shape (layers, rings)."""
        return estimate(_of_order(order, self._asked_rings()[:, :-1], 2))

    def transmitted_exitance(self, order: str = "total") -> Estimate:
        """Mean exitance below a slab over each ring between consecutive `radii`, 1/mm² per incident flux."""
        self._check_slab()
        return estimate(_of_order(order, self._asked_rings()[:, -1], 1))

    def _check_slab(self) -> None:
        if not self.layers.is_slab:
            raise ValueError("thickness must be given for the last layer too for a transmittance, got none")

    def _asked_rings(self) -> np.ndarray:
        if self._rings is None:
            raise ValueError("radii must be given to trace() for exitance, got None")
        return self._rings


def _of_order(order: str, samples: np.ndarray, axis: int) -> np.ndarray:
    check_choice("order", order, LAYER_ORDERS)
    if order == "total":
        return samples.sum(axis=axis)
    return samples.take(LAYER_ORDERS.index(order), axis=axis)


def trace_layers(
    layers: Layers, mu_i: float | str, n_paths: int, seed: int, edges: np.ndarray | None, backend: str,
    relative_error: float | None, progress: Progress | None,
) -> LayerTrace:  # fmt: skip
    """Trace walks of a beam in layers: `trace` for `Layers`, whose arguments it has checked."""
    types, started = array_types(backend), time.perf_counter()
    beam = types, layers, mu_i, n_paths, (seed,)
    walk = functools.partial(_walk, diffuse=mu_i == "diffuse")
    samples, rings, events, paths = [], [], 0, 0
    for done in walk_passes(*beam, lambda: [_Tally(types, layers, edges)], progress, walk):
        (tally,) = done.tallies
        scale = BATCHES / done.n_paths * (1.0 if mu_i == "diffuse" else done.T_i[0])
        samples.append(scale * tally.cells.result())
        if edges is not None:
            rings.append(scale * tally.rings.result().reshape(BATCHES, len(layers) + 1, 3, -1))
        events, paths = events + done.n_events, paths + done.n_paths
        if relative_error and is_certain(np.concatenate(samples)[:, : 3 * len(layers)], relative_error):
            break
    n, result = len(layers), np.concatenate(samples)
    areas = None if edges is None else np.pi * np.diff(edges**2)
    return LayerTrace(
        layers=layers, mu_i=mu_i, seed=seed, backend=backend, n_paths=paths, n_events=events,
        seconds=time.perf_counter() - started, _reflected=result[:, : 3 * n].reshape(-1, n, 3),
        _transmitted=result[:, 3 * n : 3 * n + 3], _absorbed=result[:, 3 * n + 3 :],
        _rings=None if edges is None else np.concatenate(rings) / areas,
    )  # fmt: skip


class _Tally:
    """Cells (deepest layer, order) of reflected light, (order) of transmitted, (layer) of absorbed, and rings."""

    def __init__(self, types: ModuleType, layers: Layers, edges: np.ndarray | None) -> None:
        self.n = len(layers)
        self.cells = CellSums(types, 4 * self.n + 3)
        self.rings = None
        if edges is not None:
            self.n_rings = len(edges) - 1
            self.edges2 = aligned(types.Float, np.asarray(edges, dtype=np.float64) ** 2)
            self.rings = CellSums(types, 3 * (self.n + 1) * self.n_rings)

    def event(self, event: Boundary, crosses, transmitted, deepest, layer, absorbed) -> None:
        """Add what leaves at an outer boundary (`event`), or what a scattering event in `layer` absorbs."""
        UInt32 = type(layer)
        leaving = dr.select(transmitted, UInt32(self.n), deepest) * 3 + dr.minimum(event.order, 2)
        cell = dr.select(crosses, leaving, layer + (3 * self.n + 3))
        value = dr.select(crosses, event.weight, absorbed)
        self.cells.add(value, cell, event.lane, value > 0)
        if self.rings is not None:
            ring, inside = find_cell(self.edges2, event.x * event.x + event.y * event.y)
            self.rings.add(event.weight, leaving * self.n_rings + ring, event.lane, inside & (event.weight > 0))


class _Constants:
    """Tables of the layers; they are gathered from, so that one kernel serves all stacks."""

    def __init__(self, types: ModuleType, layers: Layers) -> None:
        def table(values: list[float]):
            return aligned(types.Float, values)

        media, eta = layers.media, [m.eta for m in layers.media]
        self.inverse_sigma_t = table([m.mfp for m in media])
        self.albedo, self.lost = table([m.albedo for m in media]), table([1 - m.albedo for m in media])
        self.g = table([m.g for m in media])
        self.thickness = table([*layers.thickness, *[math.inf] * (not layers.is_slab)])
        self.eta_up = table([a / b for a, b in zip([1.0, *eta], eta)])
        self.eta_down = table([a / b for a, b in zip([*eta[1:], layers.eta_below], eta)])
        self.last = dr.opaque(types.UInt32, len(media) - 1)


def _walk(types, layers: Layers, mu_in, paths_per_lane: int, seed, tallies, *, diffuse: bool) -> tuple:
    """Trace walks one after another in each lane, as `walk.walk`; diffuse light begins with the weight T_12."""
    Float, UInt32 = types.Float, types.UInt32
    m, (tally,), lanes = _Constants(types, layers), tallies, dr.width(mu_in)
    mu_in = dr.clip(mu_in, 1e-6, 1.0)
    sin_in = dr.sqrt(dr.maximum((1 - mu_in) * (1 + mu_in), 0.0))
    begin = 1 - F_r(mu_in, dr.gather(Float, m.eta_up, dr.zeros(UInt32, lanes))) if diffuse else Float(1)
    lane = dr.arange(UInt32, lanes)
    dr.eval(mu_in, sin_in, begin, lane)
    last = dr.opaque(UInt32, paths_per_lane)
    zero, count = dr.zeros(Float, lanes), dr.zeros(UInt32, lanes)
    state = {
        "rng": generator(types, lanes, seed), "layer": count, "deepest": count,
        "x": zero, "y": zero, "z": zero, "dx": sin_in, "dy": zero, "dz": mu_in,
        "weight": zero + begin, "order": count, "step": count, "path": count, "events": count,
    }  # fmt: skip

    def body(given: tuple, s: dict) -> tuple[dict]:
        return (_step(s, m, *given, tally),)

    given = ((sin_in, mu_in, begin), lane)
    (s,) = in_launches((state,), given, lambda s: s["path"] < last, body, "layers")
    return ((),), s["events"]


def _step(s: dict, m: _Constants, start: tuple, lane, tally: _Tally) -> dict:
    """One free path to a scattering event or an interface, roulette; ended walks begin anew."""
    rng, layer = s["rng"], s["layer"]
    Float, UInt32 = type(s["z"]), type(layer)
    x, y, z, dx, dy, dz = (s[k] for k in ("x", "y", "z", "dx", "dy", "dz"))
    inverse, albedo, lost, g, thickness, eta_up, eta_down = (
        dr.gather(Float, table, layer)
        for table in (m.inverse_sigma_t, m.albedo, m.lost, m.g, m.thickness, m.eta_up, m.eta_down)
    )
    # draw a free path, p(s) = sigma_t exp(-sigma_t s), and end it at the interface that it meets
    mu, down = dr.abs(dz), dz > 0
    free = -dr.log(1 - rng.next_float32()) * inverse
    gap = dr.select(down, thickness - z, z) / dr.maximum(mu, 1e-12)
    crosses = free >= gap
    t = dr.minimum(free, gap)
    x, y, z = x + dx * t, y + dy * t, z + dz * t

    # tally what leaves at an outer boundary, w (1 - F_r), or what a scattering event absorbs, w (1 - albedo)
    eta = dr.select(down, eta_down, eta_up)
    F = F_r(mu, eta)
    outer = crosses & dr.select(down, layer == m.last, layer == 0)
    event = Boundary(s["order"], dr.select(outer, s["weight"] * (1 - F), 0.0), x, y, mu, None, lane)
    tally.event(event, crosses, down, s["deepest"], layer, s["weight"] * lost)

    # cross an interface inside with the probability 1 - F_r: sines over eta, by Snell
    u, azimuth = rng.next_float32(), 2 * math.pi * rng.next_float32()
    refracts = crosses & ~outer & (u >= F)
    layer = dr.select(refracts, dr.select(down, layer + 1, layer - 1), layer)
    bottom = dr.gather(Float, m.thickness, layer)  # of the layer that the path goes on in
    z = dr.select(crosses, dr.select(down ^ refracts, bottom, 0.0), dr.maximum(z, 0.0))
    # else be reflected with w F_r at an outer boundary, w at one inside; or scatter with w albedo
    tx, ty, tz = turn(dx, dy, dz, sample_hg(u, g), azimuth)
    shrink, along = dr.select(refracts, 1 / eta, 1.0), dr.select(refracts, mu_internal(mu, eta), mu)
    dx, dy = dr.select(crosses, dx * shrink, tx), dr.select(crosses, dy * shrink, ty)
    dz = dr.select(crosses, dr.select(down ^ refracts, -along, along), tz)
    weight = s["weight"] * dr.select(crosses, dr.select(outer, F, 1.0), albedo)

    # play Russian roulette; a lane whose walk ends begins the next one
    step = s["step"] + 1
    survive, weight = roulette(weight, step)
    ends = rng.next_float32() >= survive

    def renew(begin, value):
        return dr.select(ends, begin, value)

    return {
        "rng": rng, "layer": renew(UInt32(0), layer), "deepest": renew(UInt32(0), dr.maximum(s["deepest"], layer)),
        "x": renew(0.0, x), "y": renew(0.0, y), "z": renew(0.0, z),
        "dx": renew(start[0], dx), "dy": renew(0.0, dy), "dz": renew(start[1], dz), "weight": renew(start[2], weight),
        "order": renew(UInt32(0), s["order"] + dr.select(crosses, UInt32(0), UInt32(1))),
        "step": renew(UInt32(0), step), "path": s["path"] + dr.select(ends, UInt32(1), UInt32(0)),
        "events": s["events"] + 1,
    }  # fmt: skip
