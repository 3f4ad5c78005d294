"""Half-space models of media by textures: models at nodes of the albedo, between which S is interpolated.

S(r; albedo, sigma_t) = sigma_t² S^(sigma_t r; albedo), so that the albedo alone needs nodes. With the medium at both
ends of a way of light,

    S = sqrt(S_o S_i),

S_o of the half-space of the medium at the exit, S_i of that at the entry: reciprocal where the model is, and S of the
medium where both are the same. Between nodes ln(S / albedo^p) is linear, p = 1 for models of all orders, else 2. Nodes
are even in v, the square root of x of `physics.reflectance`, for albedos near 1. Those of analytic models cover all
albedos, so that kernels serve textures that change.

Derivatives by the medium of each end, with ln S_o and ln S_i as they are interpolated:

    dS = S/2 Σ_ends (d ln S / dv dv + p d ln albedo + d ln S / d ln sigma_t d ln sigma_t).

Measured between nodes against models of the medium itself, sums of S over random pairs of points: 0.3 % at most for
analytic models, 1.2 % for `neural` with texels of albedo 0.3 to 0.999.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss import measure
from halfspace_sss.interface.model import BSSRDF, bssrdf
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.half_space import HalfSpaceProposals, area_share
from halfspace_sss.rendering.object.points import (
    AreaPoints,
    ObjectModel,
    PositionSampler,
    RadialTable,
    SurfacePoint,
    opaque,
    plane_query,
)
from halfspace_sss.rendering.object.settings import Settings
from halfspace_sss.rendering.object.shape import Geometry
from halfspace_sss.rendering.object.spectral import MediumByWavelength
from halfspace_sss.rendering.object.textured import SurfaceMedium, TexturedMedium, bend, x_of_albedo

NODES = 32  # over all albedos
OF_NETWORKS = 9  # nodes, whatever the albedos: each is a part of the kernel
LEAST = 1e-4  # albedo that stands for less at nodes
MOST = 1 - 1e-6  # above which S has no derivative by it, as dv is infinite
SLOPED = ("albedo", "sigma_t")
STEP = 0.01  # of ln sigma_t, for its slope
SEEN = 0.7  # cosine at which reflectances of nodes are known
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
class Palette:
    """Models at nodes of the albedo, in mean free paths.

    Args:
        models: at the nodes of all channels.
        rows: of each channel.
        g: mean cosine of each channel.
        alike: whether extinction is the same everywhere.
    """

    models: list[BSSRDF]
    rows: list[NodeRange]
    g: list[float]
    alike: bool

    @classmethod
    def of(cls, name: str, albedos: np.ndarray, media: Sequence[Medium], alike: bool = False) -> Palette:
        """Of a model.

        Args:
            name: of it.
            albedos: that nodes have to cover, shape (n, channels).
            media: of each channel, of which g and eta hold.
            alike: whether extinction is the same everywhere.

        Raises:
            ValueError: the model knows some media only.
        """
        refusal = ""  # raised outside of the handler: messages of Mitsuba's functions are those of first causes
        try:
            network = bool(bssrdf(name, Medium.from_albedo(0.5, 1.0, media[0].g, media[0].eta)).checksums)
        except ValueError as error:
            refusal = str(error)
        if refusal:
            raise ValueError(f"model {name!r} must be one of any medium for media by textures: {refusal}")
        models: list[BSSRDF] = []
        rows: list[NodeRange] = []
        for c, m in enumerate(media):
            alike = [k for k, other in enumerate(media) if other.g == m.g]
            if alike[0] < c:  # they share nodes
                rows.append(rows[alike[0]])
                continue
            ends = np.clip([albedos[:, alike].max(), albedos[:, alike].min()], LEAST, 1.0) if network else (1.0, LEAST)
            low, high = (math.sqrt(x_of_albedo(np, a, m.g, bend(m.g))) for a in ends)
            cells = OF_NETWORKS - 1 if network else NODES
            nodes = _albedo_of_v(np.linspace(low, high, cells + 1), m.g) if high > low else np.full(cells + 1, ends[0])
            rows.append(NodeRange(len(models), cells, low, (high - low) / cells))
            models += [bssrdf(name, Medium.from_albedo(float(a), 1.0, m.g, m.eta)) for a in nodes]
        return cls(models, rows, [m.g for m in media], alike)

    @property
    def power(self) -> int:
        """Least power of the albedo in S."""
        return 1 if self.models[0].orders == "total" else 2

    def S(self, ends: Sequence[SurfaceMedium], query: tuple[mi.Float, ...], active: mi.Bool) -> mi.Spectrum:
        """sqrt(S_o S_i) of the media at both ends, or S of one, at a query in scene units, 1/((scene unit)² sr).

        With derivatives by the media where they are followed; not by networks.
        """
        if self.models[0].checksums:
            with dr.suspend_grad():
                return self._of_networks(ends, query, active)
        by_albedo, by_sigma_t = (any(dr.grad_enabled(getattr(end, key)) for end in ends) for key in SLOPED)
        with dr.suspend_grad():
            result, slopes = self._at_ends(ends, query, by_albedo, by_sigma_t, active)
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
        self, ends: Sequence[SurfaceMedium], query: tuple[mi.Float, ...], by_albedo: bool, by_sigma_t: bool,
        active: mi.Bool,
    ) -> tuple[mi.Spectrum, list[Slope]]:  # fmt: skip
        """S, and the slopes of each end and channel, 0 where they are not asked for.

        A loop over ends and channels, so that models are recorded once.
        """
        n, lanes, tables = len(self.rows), dr.width(query[0]), self._tables()

        def step(k: mi.UInt32, result: mi.Spectrum, slopes: list[Slope]) -> tuple[mi.UInt32, mi.Spectrum, list[Slope]]:
            c, first = k % n, k < n
            albedo, sigma_t = (
                dr.select(first, _pick(getattr(ends[0], key), c), _pick(getattr(ends[-1], key), c)) for key in SLOPED
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
        """Of half-spaces of the orders of the models, at one cosine, interpolated as S is."""
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
        return mi.Float(np.log(R).astype(np.float32))

    def _numbers(self, c: int) -> tuple[float, ...]:
        row, g = self.rows[c], self.g[c]
        return row.first, row.cells, row.low, 1 / row.step if row.step > 0 else 0.0, g, bend(g)

    def _tables(self) -> list[mi.Float]:
        """`_numbers` by channel."""
        tables = [mi.Float([float(v) for v in column]) for column in zip(*map(self._numbers, range(len(self.rows))))]
        dr.make_opaque(tables)
        return tables

    def _pair(self, first: BSSRDF, second: BSSRDF) -> Callable:
        """A function for S / albedo^p of two nodes, for sigma_t = 1."""

        def pair(*args: Any) -> tuple[mi.Float, mi.Float]:
            *query, active = args
            return tuple(dr.select(active, self._over_power(m, query), 0) for m in (first, second))

        return pair

    def _over_power(self, model: BSSRDF, query: Sequence[mi.Float]) -> mi.Float:
        return model.eval(*query) * opaque(float(model.medium.albedo) ** -self.power)

    def _of_networks(self, ends: Sequence[SurfaceMedium], query: tuple[mi.Float, ...], active: mi.Bool) -> mi.Spectrum:
        """S by networks, in a loop over channels and, where extinctions differ, over ends.

        Of ends of the same extinction the query is the same, so that nodes of both are asked once.
        """
        n, tables = len(self.rows), self._tables()
        groups = [ends] if self.alike else [[end] for end in ends]

        def step(k: mi.UInt32, result: mi.Spectrum) -> tuple[mi.UInt32, mi.Spectrum]:
            c, first = k % n, k < n
            numbers, places, total = [dr.gather(mi.Float, table, c) for table in tables], [], mi.Float(0)
            for pair in zip(groups[0], groups[-1]):
                albedo, sigma_t = (dr.select(first, *(_pick(getattr(end, key), c) for end in pair)) for key in SLOPED)
                albedo = dr.clip(albedo, 0, 1)
                places.append(_node(albedo, numbers))
                total += 2 * dr.log(sigma_t) + self.power * dr.log(dr.maximum(albedo, FAINT))
            total += self._between_networks(places, (query[0] * sigma_t, *query[1:]), active)
            root = dr.exp(total / len(ends))
            return k + 1, mi.Spectrum([dr.select(c == j, value * root, value) for j, value in enumerate(result)])

        lanes = dr.width(query[0])
        start = mi.UInt32(0) + dr.zeros(mi.UInt32, lanes), dr.full(mi.Spectrum, 1, lanes)
        return dr.while_loop(start, lambda k, _: active & (k < len(groups) * n), step, label="ends and channels")[1]

    def _between_networks(
        self, places: list[tuple[mi.UInt32, mi.Float]], query: tuple[mi.Float, ...], active: mi.Bool
    ) -> mi.Float:
        """Sum over places, a node and the share of the way to the next, of ln(S / albedo^p) for sigma_t = 1.

        Node after node, where a neighbouring lane needs it: weights that differ by lane are slow.
        """
        total = mi.Float(0)
        for j, model in enumerate(self.models):
            weight = sum(dr.select(k == j, 1 - f, dr.select(k + 1 == j, f, 0)) for k, f in places)

            def add(total: mi.Float, weight: mi.Float, query: tuple, model: BSSRDF = model) -> tuple:
                return total + weight * dr.log(dr.maximum(self._over_power(model, query), FAINT)), weight, query

            needed = active & (weight > 0)
            total, *_ = dr.if_stmt((total, weight, query), needed, add, lambda *state: state, label="node")
        return total


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


def _pick(values: mi.Spectrum, c: mi.UInt32) -> mi.Float:
    value = values[0]
    for k in range(1, len(values)):
        value = dr.select(c == k, values[k], value)
    return value


def _albedo_of_v(v: np.ndarray, g: float) -> np.ndarray:
    x, c = v * v, bend(g)
    s2 = (x / (c + (1 - c) * x)) ** 2
    return (1 - s2) / (1 - g * s2)


@dataclass(frozen=True, eq=False)
class PaletteTransport:
    """S = sqrt(S_o S_i) of the media at both ends, or S of that at the wavelengths of a ray.

    Args:
        palette: the models.
        obj: the object.
        medium: what varies, 1/(scene unit).
        geometry: "distance" or "tangent", see `points.separation`.
    """

    palette: Palette
    obj: Geometry
    medium: Varied
    geometry: str = "distance"
    alpha = None
    is_delta = False

    @property
    def orders(self) -> str:
        return self.palette.models[0].orders

    @property
    def checksums(self) -> tuple[str, ...]:
        return tuple(checksum for model in self.palette.models for checksum in model.checksums)

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> SurfacePoint:
        """Nothing is done for the exit alone."""
        return at

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """See `Transport`."""
        with dr.suspend_grad():
            query = plane_query(at, exit, self.geometry)
            above = active & (at.mu > 0) & (query[3] > 0)
        ends = self.medium.ends(self.obj, exit, at, above)
        return dr.select(above, self.palette.S(ends, query, above), 0)

    def paint(self, at: SurfacePoint) -> mi.Spectrum:
        """See `Transport`."""
        return self.palette.reflectance(at.medium.albedo)


def palette_model(
    name: str, geometry: Geometry, media: tuple[Medium, ...], medium: Varied, settings: Settings
) -> ObjectModel:
    """The transport and the proposals of a half-space model on an object whose medium has textures or spectra.

    Args:
        name: of the model.
        geometry: the object.
        media: of each channel, of which g and eta hold, 1/(scene unit).
        medium: what varies, 1/(scene unit).
        settings: geometry and share of uniform entries.

    Raises:
        ValueError: the model knows some media only.
    """
    palette = palette_of(name, geometry, media, medium)
    models = _spread(name, *_values_of(geometry, media, medium), media)
    table = RadialTable(models, geometry.size)
    share = area_share(geometry, table.mean / geometry.size, settings.area_share)
    positions = PositionSampler(geometry, table, AreaPoints(geometry.shape), share)
    transport = PaletteTransport(palette, geometry, medium, settings.geometry)
    known = medium if isinstance(medium, TexturedMedium) else None  # else that of the exit
    return ObjectModel(transport, HalfSpaceProposals(positions, models[0], known))


def palette_of(name: str, geometry: Geometry, media: tuple[Medium, ...], medium: Varied) -> Palette:
    """The models of all media of an object; arguments and errors as of `palette_model`."""
    albedos, extinctions = _values_of(geometry, media, medium)
    return Palette.of(name, albedos, media, bool((extinctions == extinctions[0]).all()))


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
