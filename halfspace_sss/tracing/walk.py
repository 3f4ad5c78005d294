"""The random walk in a half-space, as one symbolic Dr.Jit loop in mean free paths.

Weights stand in for absorption (times albedo at each event) and for internal reflection (times F_r at the
boundary), so a walk never leaves; what leaves is handed to tallies. Depth z grows downwards from the plane,
light enters at the origin and travels towards +x ("forward").
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any, TypeVar

import numpy as np

from halfspace_sss.arrays import Lanes
from halfspace_sss.lazy import LazyModule
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.physics.medium import Medium, check_ratios, sample_hg

dr = LazyModule("drjit")

# least variance x time over the media (albedo, g, eta) = (0.75, 0, 1.3), (0.99, 0, 1.5), (0.999, 0.9, 1.3)
ROULETTE_WEIGHT, ROULETTE_BOOST = 0.3, 3.0
# Albedo 1 never absorbs: roulette at each doubling of the number of events from LONG_PATH on. As P(order > N) ~ N^-1/2,
# survival s per doubling costs a sum over k of (sqrt(2) s)^k events and has a variance of a sum of (1 / (sqrt(2) s))^k;
# no s keeps both finite. sqrt(1/2), at which both grow with k only, goes on until VERY_LONG_PATH, then 1/2, which
# spares the one lane that goes on and on. z of R at albedo 1 (60 runs of 8192 walks): rms 1.3, worst -4.4;
# with 1/2 from the start 1.7, -7.2; with sqrt(1/2) to the end 1.2, -2.6 in up to ten times the wall time.
LONG_PATH, VERY_LONG_PATH = 4096, 2**18
LONG_SURVIVAL, VERY_LONG_SURVIVAL = math.sqrt(0.5), 0.5
LAUNCH_SECONDS = 0.7  # of a kernel, in which Python hears no interrupt
FIRST_TURNS, FEWEST_TURNS = 64, 16  # of the loop in a launch
CUDA_FIRST_TURNS = 2048  # a few ms on a GPU, less than Python takes to record the loop
FEW, ONE_PACKET = 0.5, 32  # share of lanes at which those that go on are put together; not below so many
State = TypeVar("State", bound="tuple[object, ...]")  # of a loop


@dataclass
class Boundary:
    """A walk that meets the surface from below: what leaves there."""

    order: Lanes  # scattering events so far; 0 cannot occur
    weight: Lanes  # leaving weight w (1 - F_r), 0 where nothing leaves
    x: Lanes
    y: Lanes
    mu: Lanes  # internal cosine
    length: Lanes  # path length inside, mean free paths
    lane: Lanes


@dataclass
class Scatter:
    """A scattering event, before the new direction is drawn."""

    order: Lanes  # this event's number, from 1
    weight: Lanes  # weight after the event (albedo included)
    x: Lanes
    y: Lanes
    z: Lanes
    dx: Lanes  # direction of arrival; dz > 0 points down
    dy: Lanes
    dz: Lanes
    lane: Lanes
    first: Lanes  # cosine of the first scattering angle; 1 before it is drawn
    random: Callable[[], Lanes]  # further uniform numbers


class Tally:
    """What is recorded. Per-lane sums live in `start`'s tuple of arrays; anything else is scattered to memory."""

    def start(self, lanes: int) -> tuple[Lanes, ...]:
        """Per-lane sums at zero; by default none."""
        return ()

    def at(self, lanes: Lanes) -> Tally:
        """The tally of some of the lanes; by default it knows nothing of lanes but by events."""
        return self

    def boundary(self, sums: tuple[Lanes, ...], event: Boundary) -> tuple[Lanes, ...]:
        """Sums after a meeting with the surface; by default as they were."""
        return sums

    def scatter(self, sums: tuple[Lanes, ...], event: Scatter) -> tuple[Lanes, ...]:
        """Sums after a scattering event; by default as they were."""
        return sums


@dataclass(frozen=True)
class WalkConstants:
    """What the walk knows of a medium: Dr.Jit numbers, or one value per lane.

    Numbers are opaque, so that one kernel serves all media; isotropic and matched media have kernels of their own.
    """

    albedo: Lanes
    g: Lanes
    inverse_eta: Lanes
    isotropic: bool  # g = 0 in every lane
    matched: bool  # eta = 1 in every lane

    @classmethod
    def uniform(cls, types: ModuleType, medium: Medium) -> WalkConstants:
        """One scalar medium for all lanes."""
        opaque = (dr.opaque(types.Float, v) for v in (medium.albedo, medium.g, 1 / medium.eta))
        return cls(*opaque, medium.g == 0, medium.eta == 1)

    @classmethod
    def per_lane(cls, types: ModuleType, albedo: np.ndarray, g: np.ndarray, eta: np.ndarray) -> WalkConstants:
        """A medium of its own for each lane.

        Args:
            types: Dr.Jit array module, from `backend.array_types`.
            albedo, g, eta: arrays of shape (lanes,), in the ranges of `Medium`.

        Raises:
            ValueError: the shapes differ or a value is out of range.
        """
        albedo, g, eta = (np.asarray(v, dtype=np.float64) for v in (albedo, g, eta))
        if albedo.ndim != 1 or not albedo.shape == g.shape == eta.shape:
            shapes = ", ".join(str(v.shape) for v in (albedo, g, eta))
            raise ValueError(f"albedo, g and eta must be arrays of one shape (lanes,), got {shapes}")
        check_ratios(albedo, g, eta)
        lanes = (types.Float(types.Float64(v)) for v in (albedo, g, 1 / eta))  # rounded by Dr.Jit: aligned memory
        return cls(*lanes, bool(np.all(g == 0)), bool(np.all(eta == 1)))

    def at(self, lanes: Lanes) -> WalkConstants:
        """Those of some of the lanes."""
        return replace(self, **{name: at_lanes(getattr(self, name), lanes) for name in ("albedo", "g", "inverse_eta")})


def pass_seed(seed: int, *indices: int) -> tuple[int, int]:
    """State and stream of the generator of one pass; distinct indices give independent streams."""
    state, stream = np.random.SeedSequence([seed, *indices]).generate_state(2, np.uint64)
    return int(state), int(stream >> np.uint64(1))


def generator(types: ModuleType, lanes: int, seed: tuple[int, int]) -> Lanes:
    """A generator whose lanes are independent: state and stream of each are hashed (SplitMix64).

    Lanes of PCG32 whose states and streams differ in a few low bits only are correlated: the variance of the mean of
    16384 first numbers was 0.07 to 4.2 times that of independent ones, and standard errors were wrong by as much.

    Args:
        types: a module of Dr.Jit array types, or Mitsuba.
        seed: from `pass_seed`.
    """
    UInt64 = types.UInt64
    lane = dr.arange(UInt64, lanes)

    def hashed(start: int) -> Lanes:
        z = dr.opaque(UInt64, start) + lane * UInt64(0x9E3779B97F4A7C15)
        z = (z ^ (z >> 30)) * UInt64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> 27)) * UInt64(0x94D049BB133111EB)
        return z ^ (z >> 31)

    return types.PCG32(lanes, *map(hashed, seed))


def turn(dx: Lanes, dy: Lanes, dz: Lanes, cosine: Lanes, azimuth: Lanes) -> tuple[Lanes, Lanes, Lanes]:
    """Direction at the given polar cosine and azimuth about (dx, dy, dz); frame of Duff et al. 2017."""
    sin_a, cos_a = dr.sincos(azimuth)
    sine = dr.sqrt(dr.maximum((1 - cosine) * (1 + cosine), 0.0))
    sign = dr.select(dz < 0, type(dz)(-1), type(dz)(1))
    a = -1 / (sign + dz)
    b = dx * dy * a
    u, v = sine * cos_a, sine * sin_a
    nx = u * (1 + sign * dx * dx * a) + v * b + cosine * dx
    ny = u * sign * b + v * (sign + dy * dy * a) + cosine * dy
    nz = -u * sign * dx - v * dy + cosine * dz
    shrink = 1.5 - 0.5 * (nx * nx + ny * ny + nz * nz)  # one Newton step: float32 drifts over thousands of turns
    return nx * shrink, ny * shrink, nz * shrink


def at_lanes(value: Any, lanes: Lanes) -> Any:
    """Arrays, or trees of them, at some of the lanes, scheduled to be evaluated; numbers stay."""
    if isinstance(value, dict):
        return {key: at_lanes(v, lanes) for key, v in value.items()}
    if isinstance(value, (tuple, list)):
        return type(value)(at_lanes(v, lanes) for v in value)
    if hasattr(value, "at"):
        return value.at(lanes)
    if dr.width(value) > 1:
        value = dr.gather(type(value), value, lanes)
        dr.schedule(value)
    return value


def _put_back(whole: Any, part: Any, lanes: Lanes) -> None:
    """Write what `at_lanes` took to where it was."""
    if isinstance(part, (tuple, dict)):
        for key in part if isinstance(part, dict) else range(len(part)):
            _put_back(whole[key], part[key], lanes)
    else:
        dr.scatter(whole, part, lanes)


def in_launches(
    state: State, given: tuple[object, ...], going: Callable[..., Lanes], body: Callable[..., State], label: str
) -> State:
    """A symbolic loop in launches of about `LAUNCH_SECONDS`; lanes go on where they were, to the last bit.

    A lane that has ended waits for the last one of its packet. `LAUNCH_SECONDS` after the first launch, those that go
    on are put together whenever half of them have ended.

    Args:
        state: of the loop, arrays or trees of them.
        given: what does not change: numbers, arrays of a value per lane, or what has `at` of lanes.
        going: of the state, which lanes go on.
        body: of `given` and the state, the next state.
        label: of the kernel.
    """
    UInt32 = dr.uint32_array_t(type(going(*state)))

    def launch(state: State, given: tuple[object, ...], most: Lanes) -> State:
        loop = (UInt32(0), *state)
        loop = dr.while_loop(
            loop, lambda k, *s: going(*s) & (k < most), lambda k, *s: (k + 1, *body(given, *s)), mode="symbolic",
            label=label,
        )  # fmt: skip
        dr.eval(loop[1:])
        return loop[1:]

    dr.make_opaque(state)  # as they are in later launches: one kernel
    turns = CUDA_FIRST_TURNS if dr.backend_v(UInt32) == dr.JitBackend.CUDA else FIRST_TURNS
    first_ended, whole, lanes = math.inf, None, None
    while True:
        started = time.perf_counter()
        state = launch(state, given, dr.opaque(UInt32, turns))
        left = going(*state)
        width, n = dr.width(left), dr.count(left)[0]
        ended = time.perf_counter()
        first_ended = min(first_ended, ended)
        long = ended - first_ended > LAUNCH_SECONDS
        if n == 0 or (long and ONE_PACKET < width and n <= FEW * width):
            if lanes is None:
                whole, lanes = state, dr.arange(UInt32, width)
            else:
                _put_back(whole, state, lanes)
            if n == 0:
                return whole
            kept = dr.compress(left)
            state, given, lanes = at_lanes((state, given, lanes), kept)
            dr.eval()  # what was gathered
        turns = int(max(turns * min(LAUNCH_SECONDS / (ended - started), 16), FEWEST_TURNS))


def walk(
    types: ModuleType,
    medium: Medium | WalkConstants,
    mu_in: Lanes,
    paths_per_lane: int,
    seed: tuple[int, int],
    tallies: Sequence[Tally],
    weight: Lanes = 1.0,
    spot: tuple[float, float] | None = None,
) -> tuple[tuple[tuple[Lanes, ...], ...], Lanes]:
    """Trace `paths_per_lane` walks one after another in each lane and return the tallies' sums and event counts.

    A lane that ends a walk starts the next at once, so that lanes stay busy although walks differ in length.

    Args:
        types: Dr.Jit array module, from `backend.array_types`.
        medium: scalar medium, or the constants of one or of a medium per lane; only albedo, g and eta matter
            (lengths are mean free paths).
        mu_in: internal cosine of the beam in each lane, taken as at least 1e-6; T_12 is left to the caller.
        paths_per_lane: number of walks per lane.
        seed: from `pass_seed`.
        tallies: what to record.
        weight: of a walk at its start, a number or one per lane. Above one it keeps roulette away for longer: with
            albedo^-n all walks get to order n.
        spot: standard deviations in x and y of where walks begin, normally distributed; None is the origin.

    Returns:
        The sums of each tally, one entry per lane and summed over its walks, and scattering events per lane.

    Raises:
        ValueError: the constants are of another number of lanes.
    """
    Float, UInt32 = types.Float, types.UInt32
    lanes = dr.width(mu_in)
    constants = medium if isinstance(medium, WalkConstants) else WalkConstants.uniform(types, medium)
    if dr.width(constants.albedo) not in (1, lanes):
        raise ValueError(f"medium must have one value or {lanes} (one per lane), got {dr.width(constants.albedo)}")
    mu_in = dr.clip(mu_in, 1e-6, 1.0)
    sin_in = dr.sqrt(dr.maximum((1 - mu_in) * (1 + mu_in), 0.0))
    lane = dr.arange(UInt32, lanes)
    dr.eval(mu_in, sin_in, lane, constants.albedo, constants.g, constants.inverse_eta)
    last = dr.opaque(UInt32, paths_per_lane)
    zero = dr.zeros(Float, lanes)
    count = dr.zeros(UInt32, lanes)
    begin = dr.opaque(Float, weight) if isinstance(weight, float) else weight
    rng, spread = generator(types, lanes, seed), tuple(dr.opaque(Float, s) for s in spot or ())
    x, y = (zero + v for v in _entry(rng, spread))
    state = {
        "rng": rng,
        "x": x, "y": y, "z": zero, "dx": sin_in, "dy": zero, "dz": mu_in, "length": zero,
        "weight": zero + begin, "first": zero + 1, "order": count, "path": count, "events": count,
    }  # fmt: skip

    given = (constants, (sin_in, mu_in, begin, spread), lane, tuple(tallies))
    sums = tuple(t.start(lanes) for t in tallies)
    s, sums = in_launches(
        (state, sums), given, lambda s, sums: s["path"] < last, lambda given, *state: _step(*state, *given), "walk"
    )
    return sums, s["events"]


def roulette(weight: Lanes, order: Lanes) -> tuple[Lanes, Lanes]:
    """Probability that a walk goes on, and its weight if it does."""
    Float = type(weight)
    low = weight < ROULETTE_WEIGHT
    survivor = ROULETTE_WEIGHT * ROULETTE_BOOST
    survive = dr.minimum(weight / survivor, 1.0)
    long = (order >= LONG_PATH) & ((order & (order - 1)) == 0)
    long_survival = dr.select(order <= VERY_LONG_PATH, Float(LONG_SURVIVAL), Float(VERY_LONG_SURVIVAL))
    survive = dr.select(low, survive, dr.select(long, long_survival, 1.0))
    weight = dr.select(low, survivor, dr.select(long, weight / long_survival, weight))
    return survive, weight


def _entry(rng: Lanes, spread: tuple) -> tuple:
    """Where a walk begins, by Box and Muller; the origin draws no numbers."""
    if not spread:
        return 0.0, 0.0
    r = dr.sqrt(-2 * dr.log(1 - rng.next_float32()))
    sine, cosine = dr.sincos(2 * math.pi * rng.next_float32())
    return spread[0] * r * cosine, spread[1] * r * sine


def _step(s: dict, sums: tuple, m: WalkConstants, start: tuple, lane: Lanes, tallies: Sequence[Tally]) -> tuple:
    """One free path, the boundary if it is met, one scattering event, roulette; ended walks begin anew."""
    rng = s["rng"]
    Float, UInt32 = type(s["z"]), type(s["order"])
    x, y, z, dx, dy, dz = (s[k] for k in ("x", "y", "z", "dx", "dy", "dz"))
    # draw a free path, p(s) = exp(-s)
    path = -dr.log(1 - rng.next_float32())
    # where it meets the boundary, w (1 - F_r) leaves at the distance t = z/mu, and w F_r is reflected
    below = z + dz * path
    crosses = below < 0
    mu = dr.abs(dz)
    F = Float(0) if m.matched else F_r(mu, m.inverse_eta)
    leaving = dr.select(crosses, s["weight"] * (1 - F), 0.0)
    t = z / dr.maximum(mu, 1e-12)
    event = Boundary(s["order"], leaving, x + dx * t, y + dy * t, mu, s["length"] + t, lane)
    sums = tuple(tally.boundary(state, event) for tally, state in zip(tallies, sums))

    # a reflected free path goes on downwards by what is left of it: the mirror image of the straight one
    x, y, z, dz = x + dx * path, y + dy * path, dr.abs(below), dr.select(crosses, -dz, dz)
    # scatter: w <- w albedo
    weight = dr.select(crosses, s["weight"] * F, s["weight"]) * m.albedo
    order = s["order"] + 1
    event = Scatter(
        order=order, weight=weight, x=x, y=y, z=z, dx=dx, dy=dy, dz=dz, lane=lane, first=s["first"],
        random=rng.next_float32,
    )  # fmt: skip
    sums = tuple(tally.scatter(state, event) for tally, state in zip(tallies, sums))

    # turn by Henyey and Greenstein's phase function, the azimuth uniform
    u, azimuth = rng.next_float32(), 2 * math.pi * rng.next_float32()
    cosine = 2 * u - 1 if m.isotropic else sample_hg(u, m.g)
    first = dr.select(order == 1, cosine, s["first"])
    dx, dy, dz = turn(dx, dy, dz, cosine, azimuth)

    # play Russian roulette, w <- w / P(survive); a lane whose walk ends begins the next one
    survive, weight = roulette(weight, order)
    ends = rng.next_float32() >= survive
    entry = _entry(rng, start[3])

    def renew(begin: Lanes, value: Lanes) -> Lanes:
        return dr.select(ends, begin, value)

    return {
        "rng": rng, "x": renew(entry[0], x), "y": renew(entry[1], y), "z": renew(0.0, z),
        "dx": renew(start[0], dx), "dy": renew(0.0, dy), "dz": renew(start[1], dz),
        "length": renew(0.0, s["length"] + path), "weight": renew(start[2], weight), "first": renew(1.0, first),
        "order": renew(UInt32(0), order), "path": s["path"] + dr.select(ends, UInt32(1), UInt32(0)),
        "events": s["events"] + 1,
    }, sums  # fmt: skip
