"""One network for every shape and medium: S = S_0 P_o P_i exp f, held to the light that leaves by walks.

The base model S_0 (half-space, floor, light scattered twice, light that is mixed), the network f of `descriptors`, the
calibration of the whole, and the weights that come with the package.
"""

from __future__ import annotations

import functools
import math
import os
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from types import ModuleType

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import (
    ObjectModel,
    PositionSampler,
    RadialTable,
    SurfacePoint,
    Transport,
    evaluate,
    opaque,
    refract_in,
)
from full_geometry.geometry.shape import Geometry
from full_geometry.objects.objects import TranslucentObject, check_geometry
from full_geometry.settings import Settings
from full_geometry.transport.descriptors import (
    CURVED_OWN,
    CURVED_SHARED,
    N_MEDIUM,
    N_OWN,
    N_SHARED,
    End,
    Mixed,
    Pair,
    Segment,
    describe,
    end,
    mean_chord,
    medium,
    mixed,
    on_a_plane,
    phases,
)
from full_geometry.transport.exit_pairs import EntryProposals, trace_exits, trace_scores
from full_geometry.transport.features import Lanes, Side
from full_geometry.transport.half_space import HalfSpaceProposals, area_share
from full_geometry.transport.one_object import HalfSpace
from halfspace_sss.lazy import once
from halfspace_sss.neural.perceptron import Perceptron
from halfspace_sss.neural.store import checksum_of, load_weights
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf
from halfspace_sss.tracing.walk import generator, pass_seed

# ---- What the network of all shapes is trained on, and warns outside of ----------------------------

SIZE = (1.0, 3000.0)  # sigma_t sqrt(area)
CLEAR = 3.0  # mean chord in transport mean free paths, below which single objects are up to 20 % off under a lamp
ALBEDO, G, ETA = (0.02, 1.0), (-0.3, 0.95), (1.0, 1.7)  # the albedo reduced


# ----------------------------------------------------------------------------------------------------
# S_0 of the network of all shapes: the half-space, a floor, and what the object as a whole brings where it is thin.
# Of light that is scattered twice, between the mean places y of both first events at a distance d,
#
#     S_twice = F_t(w_o) P_o F_t(w_i) P_i m_2 max(v - v', 0),    v = (4 pi)² p_o p_i exp(-sigma_t d)/(d² + e²),
#
# v' the same of a plane, whose light of two events the half-space has; e² a twelfth of the squared ways to both y, as
# these are places in the mean; p of |g| <= 0.6, as so are directions. Light of more events: `Mixed`.


MODEL = "neural"
FLOOR = 2e-3  # reflectance of what S_0 has everywhere, over that of the half-space
LEAST_LENGTH2 = 1e-6  # squared mean free paths
MOST_G = 0.6
LEAST_S = 1e-30


class Backbone(HalfSpace):
    """S_0 P_o P_i per channel.
    `mixtures`: what each of its channels mixes. `precise`: as of `HalfSpace`."""

    def __init__(self, obj: TranslucentObject, mixtures: Sequence[Mixed], precise: bool = False) -> None:
        super().__init__(obj, MODEL, FLOOR, precise)
        self.mixtures = mixtures

    def added(self, exit: Side, entry: Side) -> list[mi.Float]:
        """Per channel the floor, what is mixed and what is scattered twice, over F_t(w_o) P_o F_t(w_i) P_i."""
        everywhere = [opaque(floor + mixture.M) for floor, mixture in zip(self.floors, self.mixtures)]
        return [G + S for G, S in zip(everywhere, self.twice(exit, entry))]

    def shares(self, S_0: mi.Spectrum, exit: Side, entry: Side) -> list[tuple[mi.Float, mi.Float]]:
        """Per channel the parts of S_0, of this pair, that are mixed and that are scattered twice; 0 on a plane."""
        F_t = self.query(exit.at, entry.at)[1]
        parts = []
        for c, (mixture, twice) in enumerate(zip(self.mixtures, self.twice(exit, entry))):
            over = dr.select(
                S_0[c] > LEAST_S, F_t * exit.event.P[c] * entry.event.P[c] / dr.maximum(S_0[c], LEAST_S), 0
            )
            parts.append((opaque(mixture.M) * over, twice * over))
        return parts

    def twice(self, exit: Side, entry: Side) -> mi.Spectrum:
        """S_twice/(F_t(w_o) P_o F_t(w_i) P_i) per channel, that of a plane taken off."""
        eta = self.object.eta
        o, i = (refract_in(side.at, eta)[0] for side in (exit, entry))
        line = Segment.between(exit.at.p, entry.at.p)
        d_o, d_i = on_a_plane(exit.at.n_out, o, entry.at.n_out, i, line)
        channels = []
        for c, (m, mixture) in enumerate(zip(self.object.media, self.mixtures)):
            t = opaque(max(float(m.sigma_t), 1e-20))
            ys = exit.event.ys[c], entry.event.ys[c]
            spread = dr.square(exit.event.lengths[c]) + dr.square(entry.event.lengths[c])
            flat = Segment.between(d_o / t, mi.Vector3f(line.length, 0, 0) + d_i / t)
            here = _twice(m, o, i, Segment.between(*ys), spread)
            plane = _twice(m, d_o, d_i, flat, 2 / dr.square(t))
            channels.append(opaque(mixture.m_2) * dr.maximum(here - plane, 0))
        return mi.Spectrum(channels)


def _twice(m: Medium, d_o: mi.Vector3f, d_i: mi.Vector3f, line: Segment, spread: mi.Float) -> mi.Float:
    """Both phase functions and the attenuation along a line over its squared length, times (4 pi)²."""
    t = opaque(float(m.sigma_t))
    apart = dr.square(line.length) + spread / 12 + LEAST_LENGTH2 / dr.square(dr.maximum(t, 1e-20))
    return phases(min(max(float(m.g), -MOST_G), MOST_G), d_o, d_i, line.d) * dr.exp(-t * line.length) / apart


# ----------------------------------------------------------------------------------------------------
# S of any object: the half-space times what one network says of the shape around two points, evaluated in Dr.Jit.

LEAST, MOST, MOST_FORWARD = -6.0, 3.0, 1.5  # of f: what is too bright costs more than what is too dark
FORWARD = 0.5  # g from which on the most is that of forward scattering
PLACE_OF_G = 2  # among the numbers of a medium


@dataclass(frozen=True, eq=False)
class NeuralShape(Transport):
    """S = s S_0 P_o P_i exp f, f = b tanh(h . tanh(u) / b), b = 1.5 to 3 above 0, see `most`, and 6 below.

    u = (c_o + c_i, c_oi) is what is 0 on a plane, h a perceptron whose first layer is asked for both ends in turn and
    summed, so that S is reciprocal as far as S_0 is; on a plane f = 0. Orders two and more;
    positive; 0 below the horizons.

    Args:
        half_space: S_0 P_o P_i.
        weights: W_k (outputs, inputs) and b_k of the layers.
        media: numbers of each channel.
        scales: s of each channel, see `calibrated`; 1 if there are none.
        checksums: of the weights, and of those of the half-space models that they correct.
        precise: on CUDA without half precision, for differences.
    """

    object: TranslucentObject
    half_space: Backbone
    weights: Mapping[str, np.ndarray]
    media: Sequence[np.ndarray]
    scales: Sequence[float] = ()
    checksums: tuple[str, ...] = ()
    precise: bool = False
    orders = "multiple"

    @classmethod
    def of(cls, obj: TranslucentObject, weights: Mapping[str, np.ndarray], precise: bool = False) -> NeuralShape:
        """The model of an object from the arrays of a file, not held to walks."""
        mixtures = mixed(obj)
        numbers = [medium(obj, c, mixture) for c, mixture in enumerate(mixtures)]
        return cls(obj, Backbone(obj, mixtures, precise), weights, numbers, precise=precise)

    def perturbed(self, media: Sequence[Medium]) -> NeuralShape:
        """See `surface.medium_derivatives.PerturbableTransport`; s by the walks and pairs that this one was held to."""
        near = NeuralShape.of(replace(self.object, media=tuple(media)), self.weights, True)
        return replace(near, scales=self.held.scales(near) if self.scales else ())

    @functools.cached_property
    def held(self) -> HeldLight:
        """How much light leaves it, as its medium changes."""
        return HeldLight(self)

    @functools.cached_property
    def _network(self) -> Perceptron:
        """The first layer in two parts, own and the rest."""
        return Perceptron.named(self.weights, "W", "b", splits=[N_OWN], looped=self.precise)

    @functools.cached_property
    def _media(self) -> list[list[mi.Float]]:
        return [[opaque(v) for v in numbers] for numbers in self.media]

    @functools.cached_property
    def _scale(self) -> mi.Spectrum:
        return mi.Spectrum([opaque(s) for s in self.scales or [1.0] * len(self.media)])

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> End:
        """The exit's side, for as many entries as are asked for."""
        return end(self.object, at, active)

    def S(self, exit: End, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """S(x_i, w_i; x_o, w_o) per channel, 1/((scene unit)² sr); 0 below the horizons.
        `exit`: from `prepare`. `at`: entry, with w_i."""
        entry = end(self.object, at, active)
        S_0 = self.half_space(exit, entry)
        pairs = describe(self.object, exit, entry, self.half_space.shares(S_0, exit, entry), active)
        f = mi.Spectrum([self._f(pair, numbers) for pair, numbers in zip(pairs, self._media)])
        return dr.select(active, S_0 * dr.exp(f) * self._scale, 0)

    def _f(self, pair: Pair, numbers: list[mi.Float]) -> mi.Float:
        net = self._network
        rest = net.first(1, [*pair.shared, *numbers], biased=True)
        ends = [net.activation(net.first(0, own) + rest) for own in (pair.exit, pair.entry)]
        x = net.rest(ends[0] + ends[1])
        u = [a + b for a, b in zip(pair.exit[CURVED_OWN], pair.entry[CURVED_OWN])] + pair.shared[CURVED_SHARED]
        g = sum(h * dr.tanh(v) for h, v in zip(x, u))
        g = dr.select(dr.isfinite(g), g, 0)  # S_0 alone rather than a hole in the picture
        bound = dr.select(g > 0, most(dr, numbers[PLACE_OF_G]), -LEAST)
        return bound * dr.tanh(g / bound)


def most(lib: ModuleType, g: Lanes) -> Lanes:
    """The bound of f above: 3 for g <= 0, falling to 1.5 at g = 0.5.
    Light that is scattered forwards comes from few pairs, which too large an f makes far too bright in what is thin."""
    return MOST - (MOST - MOST_FORWARD) * lib.clip(g / FORWARD, 0, 1)


# ---- The light that leaves an object on the mean, by walks, to which S as a whole is held ----------
# Where light is 1 from everywhere, the radiance of two events and more, over exits uniform over the area and by the
# cosine, is the mean throughput B of walks. With <S> the mean of S mu_i over the density of entries of such exits,
#
#     scale = (B/<S>)^w,    w = max(1 - sigma_t' c/1000, 0),
#
# one number for a channel, c the mean chord: what is as good as flat stays the half-space. Seeds are fixed, so an
# object has the same scale wherever it is asked.

SEED = 37
FLAT = 1000.0  # mean chord in transport mean free paths
WALKS, PAIRS = (2**15, 2**18), (2**17, 2**18)  # fewest, most: few pairs miss what is rare and bright
ENOUGH = 5e-3  # relative standard error
SCORED, COMPARED = 2**16, 2**15  # walks and pairs by which s of neighbouring media is known
COEFFICIENTS = ("sigma_s", "sigma_t", "g")  # of the scores of walks
MOST_SCALE = 4.0


def calibrated(model: NeuralShape) -> NeuralShape:
    """The same S with such scales that as much light leaves as by walks; of what is flat or does not scatter as it is.
    `model`: of an object, any weights."""
    weights = np.array([calibration_weight(mixture) for mixture in model.half_space.mixtures])
    if not weights.any():
        return model
    proposals = EntryProposals(model.object, model.half_space)

    def walks(n: int, k: int) -> np.ndarray:
        starts = model.object.random_points(generator(mi, n, pass_seed(SEED, 0, k)))
        return _rows(trace_exits(model.object, starts, (SEED, 1, k)).T)

    B = _mean(walks, *WALKS)
    S = _mean(lambda n, k: _values(model, *_drawn(model, proposals, n, k)), *PAIRS)
    known = (B > 0) & (S > 0)
    ratio = np.clip(np.where(known, B, 1) / np.where(known, S, 1), 1 / MOST_SCALE, MOST_SCALE)
    return replace(model, scales=tuple((np.array(model.scales or 1.0) * ratio**weights).tolist()))


class HeldLight:
    """How B and <S> of a calibrated model change with its medium: B by the scores of walks, <S> by the same pairs.
    `scores`: d ln B by sigma_s, sigma_t (scene units) and g, (3, channels). `pairs`: as of `_drawn`."""

    def __init__(self, model: NeuralShape) -> None:
        obj = model.object
        starts = obj.random_points(generator(mi, SCORED, pass_seed(SEED, 4)))
        throughput, score = trace_scores(obj, starts, (SEED, 5))
        T, n, d, g = _rows(throughput), score.n.numpy(), score.d.numpy(), _rows(score.g)
        sigma_s = np.maximum([float(m.sigma_s) for m in obj.media], 1e-30)
        parts = (T * n).mean(axis=1) / sigma_s, -(T * d).mean(axis=1), (T * g).mean(axis=1)
        self.model, self.scores = model, np.array(parts) / np.maximum(T.mean(axis=1), 1e-30)
        self.pairs = _drawn(model, EntryProposals(obj, model.half_space), COMPARED, 0)

    def spread(self, model: NeuralShape) -> np.ndarray:
        """<S> of each channel of a model of this object, by these pairs."""
        return _values(model, *self.pairs).mean(axis=1)

    @functools.cached_property
    def _bare(self) -> np.ndarray:
        """<S> of the model without s."""
        return self.spread(replace(self.model, scales=()))

    def scales(self, near: NeuralShape) -> tuple[float, ...]:
        """s of the same object with a medium a little beside."""
        media = zip(self.model.object.media, near.object.media)
        moved = [[float(getattr(b, key)) - float(getattr(a, key)) for key in COEFFICIENTS] for a, b in media]
        brighter = (self.scores * np.transpose(moved)).sum(axis=0)
        ratio = self.spread(near) / np.maximum(self._bare, 1e-30)
        weights, others = (np.array([calibration_weight(mixture) for mixture in m.half_space.mixtures])
                           for m in (self.model, near))  # fmt: skip
        whole = np.log(self.model.scales) / np.where(weights > 0, weights, 1)
        whole += np.where((weights > 0) & (ratio > 0), brighter - np.log(np.maximum(ratio, 1e-30)), 0)
        return tuple(np.exp(others * whole).tolist())


def calibration_weight(mixture: Mixed) -> float:
    """w of a channel; 0 where there is no scattering or no volume."""
    return max(1 - mixture.chord / FLAT, 0.0) if mixture.m_2 > 0 else 0.0


def _mean(sample: Callable[[int, int], np.ndarray], fewest: int, most: int) -> np.ndarray:
    """Mean of each channel of samples (channels, n), n doubled until it is known well enough."""
    samples, k = sample(fewest, 0), 0
    while True:
        mean, n = samples.mean(axis=1), samples.shape[1]
        error = samples.std(axis=1) / np.maximum(mean, 1e-30) / np.sqrt(n)
        if n >= most or not (error > ENOUGH).any():
            return mean
        k += 1
        samples = np.concatenate([samples, sample(n, k)], axis=1)


def _drawn(
    model: NeuralShape, proposals: EntryProposals, n: int, k: int
) -> tuple[SurfacePoint, SurfacePoint, mi.Float]:
    """n random exits, their entries, and mu_i over the density of these."""
    exits = model.object.random_points(generator(mi, n, pass_seed(SEED, 2, k)))
    entries, over = proposals.sample(exits, generator(mi, n, pass_seed(SEED, 3, k)))
    evaluate(exits, entries, over)
    return exits, entries, over


def _values(model: NeuralShape, exits: SurfacePoint, entries: SurfacePoint, over: mi.Float) -> np.ndarray:
    return _rows(dr.select(over > 0, model.S(model.prepare(exits), entries) * over, 0))


def _rows(spectrum: object) -> np.ndarray:
    return np.array(spectrum, dtype=float).reshape(len(spectrum), -1)


# ---- The weights that come with the package --------------------------------------------------------

KIND = "neural_shape"
WEIGHTS = f"{KIND}.safetensors"


def shipped_weights() -> Path:
    """The file of weights that comes with the package."""
    return Path(str(resources.files("full_geometry.transport").joinpath("data", WEIGHTS)))


@once
def load(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file of weights.
    ValueError if it is damaged, of another kind, or of a network of other descriptors; the message names the file."""
    arrays, _ = load_weights(path, KIND)
    depth, inputs = len(arrays) // 2, N_OWN + N_SHARED + N_MEDIUM
    outputs = len(range(N_OWN)[CURVED_OWN]) + len(range(N_SHARED)[CURVED_SHARED])
    names = {f"{letter}_{k}" for letter in "Wb" for k in range(depth)}
    if set(arrays) != names or depth < 2:
        raise ValueError(f"{path}: arrays must be W_k and b_k of two layers or more, got {sorted(arrays)}")
    widths = [inputs, *(arrays[f"b_{k}"].size for k in range(depth))]
    for k in range(depth):
        shapes, wanted = (arrays[f"W_{k}"].shape, arrays[f"b_{k}"].shape), (widths[k + 1], widths[k])
        if shapes != (wanted, wanted[:1]) or widths[-1] != outputs:
            raise ValueError(f"{path}: layer {k} must go from {widths[k]} to {widths[k + 1]} numbers, got {shapes}")
    return {name: value.astype(np.float32) for name, value in arrays.items()}


def checksums(obj: TranslucentObject, path: str | os.PathLike[str] | None = None) -> tuple[str, ...]:
    """Checksums of the shipped weights or others, and of those of the half-space models that they correct."""
    models = [bssrdf(MODEL, m) for m in obj.media]
    own = checksum_of(Path(path) if path is not None else shipped_weights(), KIND)
    return (own, *(checksum for m in models for checksum in m.checksums))


def transport(obj: TranslucentObject, path: str | os.PathLike[str] | None = None) -> NeuralShape:
    """The model of an object, by the shipped weights or others, held to the light that leaves by walks.
    ValueError if the file cannot be used, or the medium varies or is out of the range of `neural`."""
    if obj.varying is not None:
        name = obj.geometry.shape.id()
        raise ValueError(f"the medium of {name!r} must be the same everywhere for {KIND}, got one that varies")
    model = NeuralShape.of(obj, load(Path(path) if path is not None else shipped_weights()))
    return replace(calibrated(model), checksums=checksums(obj, path))


# ---- Its binding to an object: entries by probes and over the area, and warnings out of range -------

SLACK = 1e-3  # of the bounds, for rounding


def warn_out_of_range(geometry: Geometry, media: tuple[Medium, ...]) -> None:
    """Warn, by name and number, of what the network was not trained on: size, medium, or an object that is open."""
    name, reasons = geometry.shape.id(), []
    scattering = [m for m in media if float(m.sigma_s) > 0]
    numbers = {
        "sigma_t sqrt(area)": (SIZE, [float(m.sigma_t) * math.sqrt(geometry.area) for m in scattering]),
        "reduced albedo": (ALBEDO, [float(m.albedo_prime) for m in scattering]),
        "g": (G, [float(m.g) for m in scattering]),
        "eta": (ETA, [float(m.eta) for m in scattering]),
    }
    for what, ((low, high), values) in numbers.items():
        outside = [v for v in values if not low - SLACK * abs(low) <= v <= high + SLACK * abs(high)]
        if outside:
            reasons.append(f"{what} {', '.join(f'{v:.4g}' for v in outside)} is not in [{low:g}, {high:g}]")
    if not geometry.closed:
        reasons.append("it is not closed")
    if reasons:
        warnings.warn(
            f"object {name!r} is out of the range that neural_shape was trained on: {'; '.join(reasons)}", stacklevel=2
        )


def warn_of_clear(obj: TranslucentObject) -> None:
    """Warn, by name and number, of an object so clear that the calibration by its mean light does not hold it.
    A ball of grapefruit juice with a mean chord of 2.6 is 13 % too bright under a lamp, with 5.2 it is 4 %."""
    chord = max(mean_chord(obj), 0.0)
    clear = [c for m in obj.media if 0 < (c := chord * float(m.sigma_t_prime)) < CLEAR]
    if clear:
        warnings.warn(
            f"object {obj.geometry.name} is clear for neural_shape, which may be 5 to 20 % off: its mean chord is "
            f"{', '.join(f'{c:.2g}' for c in clear)} transport mean free paths, below {CLEAR:g}; translucent_walk is "
            "right",
            stacklevel=2,
        )


def shape_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """Transport and proposals of any object with a homogeneous medium and a smooth boundary.
    ValueError if the medium varies or is out of the range of `neural`, or normals of pieces of the object disagree."""
    geometry = obj.geometry
    check_geometry(geometry)
    warn_out_of_range(geometry, obj.media)
    warn_of_clear(obj)
    model = transport(obj)
    live = [m for m in model.half_space.models if float(m.medium.sigma_s) > 0]
    table = RadialTable(live, geometry.size)
    share = area_share(geometry, table.mean / geometry.size, settings.area_share)
    # light may leave by another piece of the surface than it entered by
    positions = PositionSampler(replace(geometry, pieces=None), table, obj.points, share)
    return ObjectModel(model, HalfSpaceProposals(positions, live[0]))
