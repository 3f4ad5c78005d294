"""Half-space models of media by textures: models at nodes of the albedo, between which S is interpolated.

S(r; albedo, sigma_t) = sigma_t² S^(sigma_t r; albedo), so that the albedo alone needs nodes. With the medium at both
ends of a way of light,

    S = sqrt(S_o S_i),

S_o of the half-space of the medium at the exit, S_i of that at the entry: reciprocal where the model is, and S of the
medium where both are the same. Between nodes ln(S / albedo^p) is linear, p = 1 for models of all orders, else 2. Nodes
are even in v, the square root of x of `physics.reflectance`, for albedos near 1. Those of analytic models cover all
albedos, so that kernels serve textures that change.

Networks cost more than all else, and each node would be one. So `neural` has the backbone of the albedo itself, and two
networks for all nodes (`neural.reduced`), asked at the distances of the channels in mean free paths where extinction is
the same at both ends. Where it is not, they are asked at three distances, Chebyshev's in the logarithm over the range
of those of all channels and ends, and their outputs are interpolated. This changes S by 0.03, 0.2, 0.4 and 0.5 % in the
mean of its magnitude, where extinctions differ by factors of 2, 4, 8 and 12, and its integral by 0.04 %. Where they
differ by more, networks are asked for all distances.

Derivatives by the medium of each end, with ln S_o and ln S_i as they are interpolated:

    dS = S/2 Σ_ends (d ln S / dv dv + p d ln albedo + d ln S / d ln sigma_t d ln sigma_t).

Measured between nodes against models of the medium itself, sums of S over random pairs of points: 0.3 % at most for
analytic models, 0.7 % for `neural` with texels of albedo 0.3 to 0.999.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import ObjectModel, SurfacePoint, Transport, floats, opaque, plane_query
from full_geometry.geometry.shape import Geometry
from full_geometry.settings import Settings
from full_geometry.surface.spectral import MediumByWavelength
from full_geometry.surface.textured import MediumAt, Number, TexturedMedium, bend, x_of_albedo
from full_geometry.transport.half_space import HalfSpaceProposals, positions_of
from full_geometry.walk.random_walk import pick
from halfspace_sss import measure
from halfspace_sss.arrays import broadcast_query
from halfspace_sss.interface.model import BSSRDF, Query
from halfspace_sss.neural.network import SymmetricModel
from halfspace_sss.neural.reduced import MODES, ReducedNetworks, shape_over_power
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf

NODES = 32  # over all albedos
LEAST = 1e-4  # albedo that stands for less at nodes
MOST = 1 - 1e-6  # above which S has no derivative by it, as dv is infinite
SLOPED = ("albedo", "sigma_t")
STEP, V_STEP = 0.01, 2e-3  # of ln sigma_t and v, for slopes
SEEN = 0.7  # cosine at which reflectances of nodes are known
CLOSE = 12.0  # largest extinction of all places and channels over the least, up to which few distances do
DISTANCES = ((0, 9), (3, 5))  # how many where they are not close and where they are, without slopes and with; 0: all
NEAREST, NARROWEST = 1e-6, 0.05  # least distance, mean free paths, and least half of their range in the logarithm
FAINT = 1e-35  # of S, below which it is interpolated itself
Varied = TexturedMedium | MediumByWavelength
LEVELS = (0.0, 0.5, 1.0)  # quantiles of albedo and extinction in the radial density of entries


class NodeRange(NamedTuple):
    """Where the nodes of a channel are: number of the first, cells between them, v of the first, and step of v."""

    first: int
    cells: int
    low: float
    step: float


@dataclass
class Slope:
    """Half of d ln S of the half-space at one end, in one channel."""

    by_v: mi.Float  # between nodes
    by_log_sigma_t: mi.Float


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances at which functions are asked, and those for which they are interpolated, in mean free paths.
    `every`: for which they are wanted. `r`: at which they are asked: these, or places of Chebyshev in the logarithm
    over their range. `middle`, `half`: of that range of the logarithm; none where they are asked at all."""

    every: list[mi.Float]
    r: list[mi.Float]
    middle: mi.Float | None = None
    half: mi.Float | None = None

    @classmethod
    def of(cls, every: list[mi.Float], count: int) -> Distances:
        """At so many places, 0 for all of them."""
        if not count:
            return cls(every, every)
        logs = [dr.log(dr.maximum(r, NEAREST)) for r in every]
        low, high = functools.reduce(dr.minimum, logs), functools.reduce(dr.maximum, logs)
        middle, half = 0.5 * (low + high), dr.maximum(0.5 * (high - low), NARROWEST)
        return cls(every, [dr.exp(middle + half * t) for t in _places(count)], middle, half)

    def interpolated(self, values: list[list[mi.Float]], k: int, r: mi.Float) -> list[mi.Float]:
        """At the points asked, values at a distance, that of `every` by number, or close to it."""
        if self.middle is None:
            return values[k % len(values)]
        t, ts = (dr.log(dr.maximum(r, NEAREST)) - self.middle) / self.half, _places(len(self.r))
        weights = [math.prod([(t - b) / (a - b) for b in ts if b != a], start=mi.Float(1)) for a in ts]
        return [sum(w * value for w, value in zip(weights, each)) for each in zip(*values)]


def _places(n: int) -> list[float]:
    """Places of Chebyshev in [-1, 1], stretched to its ends."""
    return [-math.cos(math.pi * (k + 0.5) / n) / math.cos(0.5 * math.pi / n) for k in range(n)]


class Palette:
    """Models at nodes of the albedo, in mean free paths.

    Args:
        name: of the model.
        albedos: that nodes have to cover, shape (n, channels).
        extinctions: of all places, shape (n, channels).
        media: of each channel; their g and eta hold.

    Attributes:
        models: at the nodes of all channels.
        rows: of each channel.
        g: mean cosine of each channel.
        alike: whether extinction is the same everywhere.
        close: whether all extinctions, of all channels, are within a factor of `CLOSE`.
        networks: of the nodes of rows, by the number of their first, where the model is `neural`.

    Raises:
        ValueError: the model knows some media only.
    """

    def __init__(self, name: str, albedos: np.ndarray, extinctions: np.ndarray, media: Sequence[Medium]) -> None:
        refusal = ""  # raised outside of the handler: messages of Mitsuba's functions are those of first causes
        try:
            model = bssrdf(name, Medium.from_albedo(0.5, 1.0, media[0].g, media[0].eta))
            learnt = isinstance(model, SymmetricModel) and bool(model.calibrations)  # as `neural` has for every medium
            refusal = "its weights are those of one medium" if model.checksums and not learnt else ""
        except ValueError as error:
            refusal = str(error)
        if refusal:
            raise ValueError(f"model {name!r} must be one of any medium for media by textures: {refusal}")
        self.models: list[BSSRDF] = []
        self.rows: list[NodeRange] = []
        self.networks: dict[int, ReducedNetworks] = {}
        self.g: list[float] = [m.g for m in media]
        self.alike = bool((extinctions == extinctions[0]).all())
        self.close = bool(extinctions.max() <= CLOSE * extinctions.min())
        for c, m in enumerate(media):
            sharing = [k for k, other in enumerate(media) if other.g == m.g]  # nodes
            if sharing[0] < c:
                self.rows.append(self.rows[sharing[0]])
                continue
            covered = albedos[:, sharing]
            ends = np.clip([covered.max(), covered.min()], LEAST, 1.0) if learnt else (1.0, LEAST)
            low, high = (math.sqrt(x_of_albedo(np, a, m.g, bend(m.g))) for a in ends)
            if learnt:  # so that slopes are known at the ends
                low, high = max(low - 2 * V_STEP, 0.0), high + 2 * V_STEP
            nodes = np.clip(_albedo_of_v(np.linspace(low, high, NODES + 1), m.g, bend(m.g)), LEAST / 10, 1)
            self.rows.append(NodeRange(len(self.models), NODES, low, (high - low) / NODES))
            self.models += [bssrdf(name, Medium.from_albedo(float(a), 1.0, m.g, m.eta)) for a in nodes]
            if learnt:
                self.networks[self.rows[-1].first] = ReducedNetworks(self.models[self.rows[-1].first :])

    @property
    def power(self) -> int:
        """Least power of the albedo in S."""
        return 1 if self.models[0].orders == "total" else 2

    def S(self, ends: Sequence[MediumAt], query: tuple[mi.Float, ...], active: mi.Bool) -> mi.Spectrum:
        """sqrt(S_o S_i) of the media at both ends, or S of one, at a query in scene units, 1/((scene unit)² sr).
        With derivatives by the media where they are followed."""
        by_albedo, by_sigma_t = (any(dr.grad_enabled(getattr(end, key)) for end in ends) for key in SLOPED)
        with dr.suspend_grad():
            ask = self._of_networks if self.networks else self._at_ends
            result, slopes = ask(ends, query, by_albedo, by_sigma_t, active)
        if not (by_albedo or by_sigma_t):
            return result
        change = [mi.Float(0) for _ in self.rows]
        for k, slope in enumerate(slopes):
            end, c = ends[k // len(self.rows)], k % len(self.rows)
            albedo = dr.clip(end.albedo[c], LEAST, MOST)
            variables = (_v(albedo, opaque(self.g[c]), opaque(bend(self.g[c]))), dr.log(end.sigma_t[c]))
            factors = (slope.by_v, slope.by_log_sigma_t)
            for x, factor in ((dr.log(albedo), self.power / 2), *zip(variables, factors)):
                change[c] += (x - dr.detach(x)) * factor
        return mi.Spectrum([value * (1 + each) for value, each in zip(result, change)])

    def _at_ends(
        self, ends: Sequence[MediumAt], query: tuple[mi.Float, ...], by_albedo: bool, by_sigma_t: bool,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, list[Slope]]:  # fmt: skip
        """S, and the slopes of each end and channel, 0 where they are not asked for.
        A loop over ends and channels, so that models are recorded once."""
        n, lanes, tables = len(self.rows), dr.width(query[0]), self._tables()

        def step(k: mi.UInt32, result: mi.Spectrum, slopes: list[Slope]) -> tuple[mi.UInt32, mi.Spectrum, list[Slope]]:
            c, first = k % n, k < n
            albedo, sigma_t = (
                dr.select(first, pick(getattr(ends[0], key), c), pick(getattr(ends[-1], key), c)) for key in SLOPED
            )
            per_step, numbers = dr.gather(mi.Float, tables[3], c), [dr.gather(mi.Float, table, c) for table in tables]
            albedo = dr.clip(albedo, 0, 1)
            node, f = _node(albedo, numbers)

            def pair(factor: float) -> tuple[mi.Float, mi.Float]:
                pairs = [self._pair(*pair) for pair in zip(self.models, self.models[1:])]  # one function, other data
                return dr.switch(node, pairs, query[0] * sigma_t * factor, *query[1:], active)

            a, b = pair(1.0)
            S = _between(a, b, f)
            S = dr.square(sigma_t) * albedo**self.power * S
            root = S if len(ends) == 1 else dr.sqrt(S)
            if slopes:
                new, known = Slope(mi.Float(0), mi.Float(0)), dr.minimum(a, b) > FAINT
                if by_albedo:
                    new.by_v = dr.select(known, 0.5 * per_step * (_log(b) - _log(a)), 0)
                if by_sigma_t:
                    by_r = (_log(_between(*pair(1 + STEP), f)) - _log(_between(*pair(1 - STEP), f))) / (2 * STEP)
                    new.by_log_sigma_t = dr.select(known, 1 + 0.5 * by_r, 0)
                slopes = [dr.select(k == j, new, old) for j, old in enumerate(slopes)]
            return (
                k + 1,
                mi.Spectrum([dr.select(c == j, value * root, value) for j, value in enumerate(result)]),
                slopes,
            )

        slopes = [dr.zeros(Slope, lanes) for _ in range(2 * n)] if by_albedo or by_sigma_t else []
        start = mi.UInt32(0) + dr.zeros(mi.UInt32, lanes), dr.full(mi.Spectrum, 1, lanes), slopes
        return dr.while_loop(start, lambda k, *_: active & (k < len(ends) * n), step, label="ends and channels")[1:]

    def reflectance(self, albedo: mi.Spectrum) -> mi.Spectrum:
        """Reflectance of half-spaces of the orders of the models, at one cosine, interpolated as S is."""
        results = []
        for c, value in enumerate(albedo):
            value = dr.clip(value, 0, 1)
            k, f = _node(value, [opaque(v) for v in self._numbers(c)])
            a, b = (dr.gather(mi.Float, self._reflectances, dr.minimum(k + j, len(self.models) - 1)) for j in (0, 1))
            results.append(dr.exp(dr.lerp(a, b, f)) * value**self.power)
        return mi.Spectrum(results)

    @cached_property
    def _reflectances(self) -> mi.Float:
        """ln(R / albedo^p) of all nodes."""
        R = [measure.reflectance(m, SEEN) / float(m.medium.albedo) ** self.power for m in self.models]
        return floats(np.log(R))

    def _numbers(self, c: int) -> tuple[float, ...]:
        row, g = self.rows[c], self.g[c]
        return row.first, row.cells, row.low, 1 / row.step if row.step > 0 else 0.0, g, bend(g)

    def _tables(self) -> list[mi.Float]:
        tables = [mi.Float([float(v) for v in column]) for column in zip(*map(self._numbers, range(len(self.rows))))]
        dr.make_opaque(tables)
        return tables

    def _pair(self, first: BSSRDF, second: BSSRDF) -> Callable:
        """A function for S / albedo^p of two nodes, for sigma_t = 1."""

        def pair(*args: mi.Float | mi.Bool) -> tuple[mi.Float, mi.Float]:
            *query, active = args
            powers = (opaque(float(m.medium.albedo) ** -self.power) for m in (first, second))
            return tuple(dr.select(active, m.eval(*query) * p, 0) for m, p in zip((first, second), powers))

        return pair

    def _of_networks(
        self, ends: Sequence[MediumAt], query: tuple[mi.Float, ...], by_albedo: bool, by_sigma_t: bool,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, list[Slope]]:  # fmt: skip
        """As `_at_ends` by networks, which are asked at the distances of `_distances`."""
        lib, args = broadcast_query(*query)
        across = Query(lib, *args, opaque(float(self.models[0].medium.eta)))
        transmitted = F_t(across.mu_i, across.index) * F_t(across.mu_o, across.index)
        distances = self._distances(ends, across.r, by_sigma_t)
        phi = self._at_distances(distances, across, active)
        result, slopes = [mi.Float(1) for _ in self.rows], []
        met = dict.fromkeys(self.networks, 0)
        for end in ends:
            for c, (row, albedo, sigma_t) in enumerate(zip(self.rows, end.albedo, end.sigma_t)):
                numbers = [opaque(v) for v in self._numbers(c)]
                known = functools.partial(distances[row.first].interpolated, phi[row.first], met[row.first])
                met[row.first] += 1

                def shape(
                    albedo: mi.Float, sigma_t: mi.Float, known: Callable = known, numbers: list = numbers
                ) -> mi.Float:
                    q = replace(across, r=across.r * sigma_t)
                    return self._shape(q, known(q.r), albedo, numbers)

                S = dr.square(albedo * sigma_t) * transmitted * shape(albedo, sigma_t)
                result[c] *= S if len(ends) == 1 else dr.sqrt(S)
                if not (by_albedo or by_sigma_t):
                    continue
                v, slope = _v(dr.clip(albedo, LEAST, 1), *numbers[4:]), Slope(mi.Float(0), mi.Float(0))
                at = [shape(_albedo_of_v(v + h, *numbers[4:]), sigma_t) for h in (V_STEP, -V_STEP)]
                slope.by_v = 0.25 / V_STEP * (_log(at[0]) - _log(at[1]))
                if by_sigma_t:
                    at = [shape(albedo, sigma_t * factor) for factor in (1 + STEP, 1 - STEP)]
                    slope.by_log_sigma_t = 1 + 0.25 / STEP * (_log(at[0]) - _log(at[1]))
                slopes.append(slope)
        return mi.Spectrum(result), slopes

    def _distances(self, ends: Sequence[MediumAt], r: mi.Float, by_sigma_t: bool) -> dict[int, Distances]:
        """Where networks of each row are asked: at the distances of its channels, or at a few between all of these."""
        result = {}
        for first in self.networks:
            channels = [c for c, row in enumerate(self.rows) if row.first == first]
            every = [r * end.sigma_t[c] for end in (ends[:1] if self.alike else ends) for c in channels]
            few = len(every) <= max(len(channels), 2) and not by_sigma_t
            result[first] = Distances.of(every, 0 if few else DISTANCES[self.close][by_sigma_t])
        return result

    def _at_distances(
        self, distances: dict[int, Distances], across: Query, active: mi.Bool
    ) -> dict[int, list[list[mi.Float]]]:
        """phi of each row at its distances; a loop, so that networks are recorded once."""
        places = [(first, r) for first, each in distances.items() for r in each.r]
        firsts = mi.UInt32([first for first, _ in places])
        dr.make_opaque(firsts)

        def step(k: mi.UInt32, phi: list[list[mi.Float]]) -> tuple[mi.UInt32, list[list[mi.Float]]]:
            q = replace(across, r=pick([r for _, r in places], k))
            new = self._functions(q, dr.gather(mi.UInt32, firsts, k))
            return k + 1, [[dr.select(k == j, a, b) for a, b in zip(new, old)] for j, old in enumerate(phi)]

        lanes = dr.width(across.r)
        zeros = [[dr.zeros(mi.Float, lanes) for _ in range(MODES + 1)] for _ in places]
        start = mi.UInt32(0) + dr.zeros(mi.UInt32, lanes), zeros
        found = dr.while_loop(start, lambda k, *_: active & (k < len(places)), step, label="distances")[1]
        return {key: [phi for (first, _), phi in zip(places, found) if first == key] for key in distances}

    def _functions(self, q: Query, first: mi.UInt32) -> list[mi.Float]:
        """phi of the networks of the row that begins with a node."""
        if len(self.networks) == 1:
            return next(iter(self.networks.values())).functions(q)
        values = tuple(dr.zeros(mi.Float, dr.width(q.r)) for _ in range(MODES + 1))
        for number, networks in self.networks.items():

            def ask(*values: mi.Float, of: ReducedNetworks = networks) -> tuple:
                return tuple(of.functions(q))

            values = dr.if_stmt(values, first == number, ask, lambda *values: values, label="networks of a row")
        return list(values)

    def _shape(self, q: Query, phi: list[mi.Float], albedo: mi.Float, numbers: list[mi.Float]) -> mi.Float:
        """S / albedo² without transmittances, for sigma_t = 1."""
        node, f = _node(dr.clip(albedo, 0, 1), numbers)
        low, high = (dr.gather(mi.Vector4f, self._coefficients, node + j) for j in (0, 1))
        log_factor = phi[0] + sum(c * value for c, value in zip(dr.lerp(low, high, f), phi[1:]))
        return shape_over_power(q, albedo, numbers[4], log_factor)

    @cached_property
    def _coefficients(self) -> mi.Float:
        """Of `MODES` functions of all nodes."""
        rows = np.concatenate([networks.coefficients for networks in self.networks.values()])
        return floats(rows)


def _node(albedo: mi.Float, numbers: Sequence[mi.Float]) -> tuple[mi.UInt32, mi.Float]:
    """The node below an albedo in [0, 1], and the share of the way to the next, for `Palette._numbers`."""
    first, cells, low, per_step, g, bent = numbers
    t = dr.clip((_v(dr.maximum(albedo, LEAST), g, bent) - low) * per_step, 0, cells)
    cell = dr.minimum(dr.floor(t), cells - 1)
    return mi.UInt32(first + cell), t - cell


def _between(a: mi.Float, b: mi.Float, f: mi.Float) -> mi.Float:
    """At the share f of the way, in the logarithm."""
    return dr.select(dr.minimum(a, b) > FAINT, dr.exp((1 - f) * _log(a) + f * _log(b)), dr.lerp(a, b, f))


def _log(S: mi.Float) -> mi.Float:
    return dr.log(dr.maximum(S, FAINT))


def _v(albedo: mi.Float, g: mi.Float, bent: mi.Float) -> mi.Float:
    return dr.sqrt(x_of_albedo(dr, albedo, g, bent))


def _albedo_of_v(v: Number, g: Number, c: Number) -> Number:
    x = v * v
    s2 = (x / (c + (1 - c) * x)) ** 2
    return (1 - s2) / (1 - g * s2)


@dataclass(frozen=True, eq=False)
class PaletteTransport(Transport):
    """S = sqrt(S_o S_i) of the media at both ends, or S of that at the wavelengths of a ray.
    `palette`: the models. `medium`: what varies, 1/(scene unit)."""

    palette: Palette
    obj: Geometry
    medium: Varied

    @property
    def orders(self) -> str:
        return self.palette.models[0].orders

    @property
    def checksums(self) -> tuple[str, ...]:
        models = self.palette.models
        if self.palette.networks:  # those of all nodes are made of the same weights
            return (models[0].trained,)
        return tuple(checksum for model in models for checksum in model.checksums)

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        with dr.suspend_grad():
            query = plane_query(at, exit)
            above = active & (at.mu > 0) & (query[3] > 0)
        ends = self.medium.ends(self.obj, exit, at, above)
        return dr.select(above, self.palette.S(ends, query, above), 0)

    def paint(self, at: SurfacePoint) -> mi.Spectrum:
        return self.palette.reflectance(at.medium.albedo)


def palette_model(
    name: str, geometry: Geometry, media: tuple[Medium, ...], medium: Varied, settings: Settings
) -> ObjectModel:
    """The transport and the proposals of a half-space model on an object whose medium has textures or spectra.
    `media`: of each channel, 1/(scene unit); their g and eta hold. `medium`: what varies, 1/(scene unit). `settings`:
    share of uniform entries. ValueError if the model knows some media only."""
    palette = palette_of(name, geometry, media, medium)
    models = _spread(name, *_values_of(geometry, media, medium), media)
    positions = positions_of(models, name, geometry, settings)
    transport = PaletteTransport(palette, geometry, medium)
    known = medium if isinstance(medium, TexturedMedium) else None  # else that of the exit
    return ObjectModel(transport, HalfSpaceProposals(positions, models[0], known))


def palette_of(name: str, geometry: Geometry, media: tuple[Medium, ...], medium: Varied) -> Palette:
    """The models of all media of an object; arguments and errors as of `palette_model`."""
    return Palette(name, *_values_of(geometry, media, medium), media)


def _values_of(geometry: Geometry, media: tuple[Medium, ...], medium: Varied) -> tuple[np.ndarray, np.ndarray]:
    """Albedos and extinctions of an object, (n, channels)."""
    values = [v if len(v) else np.array([[0.0], [1.0]]) for v in medium.values_on(geometry.shape)]
    return tuple(np.broadcast_to(v, (len(v), len(media))) for v in values)


def _spread(name: str, albedos: np.ndarray, extinctions: np.ndarray, media: tuple[Medium, ...]) -> list[BSSRDF]:
    """Models of media of small and large albedo and extinction, by whose mean entries are drawn."""
    pairs = set()
    for c, m in enumerate(media):
        a, t = (np.quantile(values[:, c], LEVELS) for values in (albedos, extinctions))
        pairs |= {(float(max(x, LEAST)), float(y), m) for x in a for y in t}
    ordered = sorted(pairs, key=lambda pair: (pair[0], pair[1], pair[2].g))
    return [bssrdf(name, Medium.from_albedo(a, t, m.g, m.eta)) for a, t, m in ordered]
