"""Half-space models of media by textures: models at nodes of the albedo, between which S is interpolated.

S(r; albedo, sigma_t) = sigma_t² S^(sigma_t r; albedo), so that the albedo alone needs nodes. With the medium at both
ends of a way of light,

    S = sqrt(S_o S_i),

S_o of the half-space of the medium at the exit, S_i of that at the entry: reciprocal where the model is, and S of the
medium where both are the same. Between nodes ln(S / albedo^p) is linear, p = 1 for models of all orders, else 2. Nodes
are even in the square root of x of `physics.reflectance`, for albedos near 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.interface.model import BSSRDF, bssrdf
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.half_space import HalfSpaceProposals, area_share
from halfspace_sss.rendering.object.points import (
    AreaPoints,
    EntrySample,
    ObjectModel,
    PositionSampler,
    RadialTable,
    SurfacePoint,
    opaque,
    plane_query,
)
from halfspace_sss.rendering.object.settings import Settings
from halfspace_sss.rendering.object.shape import Geometry
from halfspace_sss.rendering.object.textured import TexturedMedium, bend, x_of_albedo

NODES = 32  # over all albedos
LEAST = 1e-4  # albedo that stands for less, and for more than 1 minus it, at nodes
FAINT = 1e-35  # of S, below which it is interpolated itself
LEVELS = (0.0, 0.5, 1.0)  # quantiles of albedo and extinction in the radial density of entries


@dataclass(frozen=True, eq=False)
class Palette:
    """One model for a range of albedos, in mean free paths.

    Args:
        models: at the nodes, even in v.
        g: mean cosine.
        low, step: v of the first node and between nodes.
    """

    models: list[BSSRDF]
    g: float
    low: float
    step: float

    @classmethod
    def of(cls, name: str, albedos: np.ndarray, g: float, eta: float) -> Palette:
        """Of a model, for a range that covers some albedos.

        Raises:
            ValueError: the model is a network.
        """
        ends = np.clip([albedos.max(), albedos.min()], LEAST, 1.0)
        low, high = (math.sqrt(x_of_albedo(np, a, g, bend(g))) for a in ends)
        cells = math.ceil((high - low) * NODES)
        v = np.linspace(low, high, cells + 1)
        nodes = [float(a) for a in (ends[:1] if cells == 0 else _albedo_of_v(v, g))]
        models = [bssrdf(name, Medium.from_albedo(albedo, 1.0, g, eta)) for albedo in nodes[:1]]
        if models[0].checksums:  # weights cannot differ from lane to lane
            raise ValueError(f"model must be analytic for media by textures, got {name!r}, which is a network")
        models += [bssrdf(name, Medium.from_albedo(albedo, 1.0, g, eta)) for albedo in nodes[1:]]
        return cls(models, g, low, (high - low) / max(cells, 1))

    @property
    def power(self) -> int:
        """Least power of the albedo in S."""
        return 1 if self.models[0].orders == "total" else 2

    def S(self, albedo: mi.Float, sigma_t: mi.Float, query: tuple[mi.Float, ...], active: mi.Bool) -> mi.Float:
        """S of the half-space of the medium in each lane, at a query in scene units, 1/((scene unit)² sr)."""
        query = (query[0] * sigma_t, *query[1:])
        if len(self.models) == 1:
            return dr.square(sigma_t) * self.models[0].eval(*query)
        cells = len(self.models) - 1
        g, c = (opaque(value) for value in (self.g, bend(self.g)))
        v = dr.sqrt(x_of_albedo(dr, dr.clip(albedo, LEAST, 1), g, c))
        t = dr.clip((v - opaque(self.low)) * opaque(1 / self.step), 0, cells)
        k = dr.minimum(mi.UInt32(t), cells - 1)
        a, b = dr.switch(k, self._pairs, *query, active)
        f = t - k
        between = dr.exp((1 - f) * dr.log(dr.maximum(a, FAINT)) + f * dr.log(dr.maximum(b, FAINT)))
        value = dr.select(dr.minimum(a, b) > FAINT, between, dr.lerp(a, b, f))
        return dr.square(sigma_t) * albedo**self.power * value

    @property
    def _pairs(self) -> list[Callable]:
        """S / albedo^p of the nodes at both ends of each cell; all are one function with other data."""
        return [self._pair(*pair) for pair in zip(self.models, self.models[1:])]

    def _pair(self, first: BSSRDF, second: BSSRDF) -> Callable:
        def pair(*args: Any) -> tuple[mi.Float, mi.Float]:
            *query, active = args
            values = (m.eval(*query) * opaque(float(m.medium.albedo) ** -self.power) for m in (first, second))
            return tuple(dr.select(active, value, 0) for value in values)

        return pair


def _albedo_of_v(v: np.ndarray, g: float) -> np.ndarray:
    x, c = v * v, bend(g)
    s2 = (x / (c + (1 - c) * x)) ** 2
    return (1 - s2) / (1 - g * s2)


@dataclass(frozen=True, eq=False)
class TexturedTransport:
    """S = sqrt(S_o S_i) of the media at both ends.

    Args:
        palettes: of each channel.
        geometry: "distance" or "tangent", see `points.separation`.
    """

    palettes: list[Palette]
    geometry: str = "distance"
    alpha = None
    is_delta = False

    @property
    def orders(self) -> str:
        return self.palettes[0].models[0].orders

    @property
    def checksums(self) -> tuple[str, ...]:
        return tuple(checksum for palette in self.palettes for m in palette.models for checksum in m.checksums)

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> SurfacePoint:
        """Nothing is done for the exit alone."""
        return at

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """See `Transport`."""
        query = plane_query(at, exit, self.geometry)
        above = active & (at.mu > 0) & (query[3] > 0)
        values = []
        for c, palette in enumerate(self.palettes):
            ends = (palette.S(end.medium.albedo[c], end.medium.sigma_t[c], query, above) for end in (exit, at))
            S_o, S_i = ends
            values.append(dr.sqrt(S_o) * dr.sqrt(S_i))  # their product may leave the range of single precision
        return dr.select(above, mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0]), 0)


@dataclass(frozen=True, eq=False)
class TexturedProposals:
    """Proposals of a half-space model, whose entries know the medium there.

    Args:
        plain: those proposals.
        textured: the medium, 1/(scene unit).
    """

    plain: HalfSpaceProposals
    textured: TexturedMedium

    def prepare(self, out: SurfacePoint, prepared: Any, active: mi.Bool) -> None:
        """Nothing is done for the exit alone."""

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: None, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        entry = self.plain.sample(out, prim_index, prepared, sampler, active)
        obj = self.plain.positions.geometry
        medium = self.textured.at_point(obj, entry.p, entry.n, entry.face, active & (entry.weight > 0))
        return entry._replace(medium=medium)

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[Any, Any]:
        return self.plain.sample_direction(entry, out, u)

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> Any:
        return self.plain.pdf_direction(entry, out, w_i)


def textured_model(
    name: str, geometry: Geometry, media: tuple[Medium, ...], textured: TexturedMedium, settings: Settings
) -> ObjectModel:
    """The transport and the proposals of a half-space model on an object whose medium has textures.

    Args:
        name: of the model.
        geometry: the object.
        media: of each channel, of which g and eta hold, 1/(scene unit).
        textured: the medium, 1/(scene unit).
        settings: geometry and share of uniform entries.

    Raises:
        ValueError: the model is a network.
    """
    values = [v if len(v) else np.array([[0.0], [1.0]]) for v in textured.values_on(geometry.shape)]
    albedos, extinctions = (np.broadcast_to(v, (len(v), len(media))) for v in values)
    palettes = [Palette.of(name, albedos[:, c], m.g, m.eta) for c, m in enumerate(media)]
    models = _spread(name, albedos, extinctions, media)
    table = RadialTable(models, geometry.size)
    share = area_share(geometry, table.mean / geometry.size, settings.area_share)
    positions = PositionSampler(geometry, table, AreaPoints(geometry.shape), share)
    transport = TexturedTransport(palettes, settings.geometry)
    return ObjectModel(transport, TexturedProposals(HalfSpaceProposals(positions, models[0]), textured))


def _spread(name: str, albedos: np.ndarray, extinctions: np.ndarray, media: tuple[Medium, ...]) -> list[BSSRDF]:
    """Models of media of small and large albedo and extinction, by whose mean entries are drawn."""
    pairs = set()
    for c, m in enumerate(media):
        a, t = (np.quantile(values[:, c], LEVELS) for values in (albedos, extinctions))
        pairs |= {(float(max(x, LEAST)), float(y), m) for x in a for y in t}
    ordered = sorted(pairs, key=lambda pair: (pair[0], pair[1], pair[2].g))
    return [bssrdf(name, Medium.from_albedo(a, t, m.g, m.eta)) for a, t, m in ordered]
