"""The half-space models laid onto a surface: a transport, and the proposals that follow the same models."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.interface.model import BSSRDF, bssrdf
from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.points import (
    AreaPoints,
    EntrySample,
    ObjectModel,
    PositionSampler,
    RadialTable,
    SurfacePoint,
    local_frame,
    opaque,
    opposed,
    plane_query,
)
from halfspace_sss.rendering.object.settings import AUTOMATIC, Settings
from halfspace_sss.rendering.object.shape import Geometry
from halfspace_sss.rendering.object.textured import TexturedMedium
from halfspace_sss.rendering.object.translucent import VARIABLE

POINTS_PER_RATIO, MOST_POINTS = 60.0, 9  # candidates over the area


@dataclass(frozen=True, eq=False)
class HalfSpaceTransport:
    """S of the half-space at the distance of two surface points, see `plane_query`.

    Args:
        models: one per channel, in scene units.
        geometry: "distance" or "tangent", see `points.separation`.
        variation: how they vary with the medium, where derivatives may be asked for.
    """

    models: list[BSSRDF]
    geometry: str = "distance"
    variation: Variation | None = None
    alpha = None
    is_delta = False

    @property
    def orders(self) -> str:
        return self.models[0].orders

    @property
    def checksums(self) -> tuple[str, ...]:
        return tuple(checksum for model in self.models for checksum in model.checksums)

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> SurfacePoint:
        """Nothing is done for the exit alone."""
        return at

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """See `Transport`."""
        with dr.suspend_grad():
            query = plane_query(at, exit, self.geometry)
            above = active & (at.mu > 0) & (query[3] > 0)
            values = [model.eval(*query) for model in self.models]
        values = values if self.variation is None else self.variation.S(values, query)
        return dr.select(above, mi.Spectrum(*values) if len(values) > 1 else mi.Spectrum(values[0]), 0)


@dataclass(frozen=True, eq=False)
class HalfSpaceProposals:
    """Points by probes and over the area, directions by a model.

    Args:
        positions: of entries.
        model: whose directions of incidence are drawn.
        textured: a medium that entries are to know, 1/(scene unit), or None.
    """

    positions: PositionSampler
    model: Any
    textured: TexturedMedium | None = None

    def lit(self, brightness: np.ndarray) -> HalfSpaceProposals:
        """With more points where faces are bright."""
        return replace(self, positions=replace(self.positions, points=self.positions.points.lit(brightness)))

    def prepare(self, out: SurfacePoint, prepared: Any, active: mi.Bool) -> None:
        """Nothing is done for the exit alone."""

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: None, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        entry = self.positions.sample(out, prim_index, sampler, active)
        if self.textured is None:
            return entry
        place = self.positions.geometry, entry.p, entry.n, entry.face
        return entry._replace(medium=self.textured.at_point(*place, active & (entry.weight > 0)))

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[Any, Any]:
        frame = local_frame(entry.n_out, out.p - entry.p)
        drawn = self.model.sample_direction(mi.Float(0), mi.Float(1), mi.Float(0), (u.x, u.y))
        return opposed(mi.Vector3f(frame.direction(drawn.mu_i, drawn.phi_i)), entry.n), drawn.pdf

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> Any:
        mu_i = dr.clip(entry.facing(w_i).mu, 0, 1)
        return self.model.pdf_direction(mu_i, mi.Float(0), mi.Float(0), mi.Float(1), mi.Float(0))


def half_space_model(
    name: str, geometry: Geometry, media: list[Medium], settings: Settings, variation: Variation
) -> ObjectModel:
    """The transport and the proposals of a half-space model on an object.

    Args:
        name: of the model.
        geometry: the object.
        media: of each channel, 1/(scene unit).
        settings: geometry and share of uniform entries.
        variation: for derivatives by the medium.
    """
    models = [bssrdf(name, m) for m in media]
    table = radial_table([model for model, m in zip(models, media) if float(m.sigma_s) > 0], name, geometry)
    share = area_share(geometry, table.mean / geometry.size, settings.area_share)
    positions = PositionSampler(geometry, table, AreaPoints(geometry.shape), share)
    transport = HalfSpaceTransport(models, settings.geometry, variation)
    return ObjectModel(transport, HalfSpaceProposals(positions, models[0]))


def radial_table(models: list[BSSRDF], name: str, geometry: Geometry) -> RadialTable:
    """Distances between entries and exits, in the frame of the shape: of instances of a mean size."""
    if geometry.group is not None:
        models = [bssrdf(name, model.medium.scaled(geometry.group.scale)) for model in models]
    return RadialTable(models, geometry.size)


def area_share(geometry: Geometry, ratio: float, wanted: float) -> float:
    """Share of candidates over the area, by default for a ratio of mean distance to object size.

    On a dragon of ratio 0.16 nine such points beside a probe bring variance x time to a third of that without, 15 do
    the same; at 0.05 (bunny) and 0.04 (candle) the first ones cut the tail at equal cost, kurtosis 18 to 7 and 15 to 5.
    """
    if geometry.area > 0:
        m = int(np.clip(round(POINTS_PER_RATIO * ratio), 1, MOST_POINTS))
        return wanted if wanted != AUTOMATIC else m / (1 + m)
    if wanted > 0:
        kind = geometry.shape.class_name()
        raise ValueError(
            f"area_share must be 0 for {geometry.shape.id()!r}, a {kind} without known area, got {wanted:g}"
        )
    return 0.0


# --------------------------------------------------------------------------------------------------
# How the light of an object varies with its medium: derivatives by albedo, extinction and mean cosine of a channel.
#
#     dS/dtheta = S Σ_j c_j ln S(theta + h_j),    c_j = -+1/(2h) at h_j = -+h
#
# with models of media to either side: the same for every model, whatever it is made of. ln S is close to linear over
# the step of 1 % (of 1 - albedo near 1): the error is about 1e-4 of the derivative. At the end of the range of a model,
# where one side is missing, h_j = 0, h, 2h to the other.


STEP = 0.01
Stencil = list[tuple[Any, float]]  # model, or None for the model itself, and its coefficient


class Variation:
    """Of one object.

    Args:
        surface: its `translucent` BSDF, whose parameters are differentiated by.
        mm_per_unit: length of a scene unit, mm.
        model: name of the object's model.
    """

    def __init__(self, surface: Any, mm_per_unit: float, model: str) -> None:
        self.surface, self.inside, self.mm_per_unit, self.model = surface, surface.inside, mm_per_unit, model
        self._stencils: dict[str, list[Stencil]] = {}

    def prepare(self) -> None:
        """Make the models that the derivatives need, before any loop is recorded.

        Raises:
            ValueError: the model knows no medium beside its own, or g of an object with textures is followed.
        """
        textured = self.inside.textured is not None  # which knows its derivatives but for g
        for name in VARIABLE if not textured else ("g",):
            with dr.resume_grad():
                wanted = dr.grad_enabled(getattr(self.surface, name))
            if wanted and textured:
                raise ValueError("g must not have gradients enabled under models of objects with textures, got them")
            if wanted and name not in self._stencils:
                self._stencils[name] = [self._stencil(name, m) for m in self.inside.channels()]

    def check(self, names: Iterable[str]) -> None:
        """ValueError if the model knows no medium beside its own in one of the parameters."""
        for name in names:
            for m in self.inside.channels():
                self._stencil(name, m)

    def _stencil(self, name: str, m: Medium) -> Stencil:
        value = float(getattr(m, name))
        room = {"albedo": min(value, 1 - value) or 0.1, "sigma_t": value, "g": 1 - abs(value)}[name]
        h, refusals = STEP * room, []
        for offsets, coefficients in (
            ((-h, h), (-0.5 / h, 0.5 / h)),
            ((0.0, h, 2 * h), (-1.5 / h, 2 / h, -0.5 / h)),
            ((0.0, -h, -2 * h), (1.5 / h, -2 / h, 0.5 / h)),
        ):
            try:
                models = [self._model(m, name, value + offset) if offset else None for offset in offsets]
                return list(zip(models, coefficients))
            except ValueError as error:
                refusals.append(str(error))
        raise ValueError(f"model {self.model!r} cannot be differentiated by {name}: {refusals[0]}")

    def _model(self, m: Medium, name: str, value: float) -> Any:
        ratios = {key: float(getattr(m, key)) for key in VARIABLE} | {name: value}
        return bssrdf(self.model, Medium.from_albedo(**ratios, eta=m.eta).scaled(self.mm_per_unit))

    def S(self, values: list[Any], query: tuple) -> list[Any]:
        """The S of each channel at a query in scene units, with their derivatives where they are followed."""
        for name in VARIABLE:
            theta = getattr(self.surface, name)
            if not dr.grad_enabled(theta):
                continue
            with dr.suspend_grad():
                slopes = [_slope(s, dr.detach(v), query) for s, v in zip(self._stencils[name], values)]
            values = [v + slope * (t - dr.detach(t)) for v, slope, t in zip(values, slopes, theta)]
        return values

    def coefficients(self, media: list[Medium]) -> list[tuple[Any, Any, Any]]:
        """sigma_s, sigma_t in 1/(scene unit) and g of each channel, with derivatives where they are followed."""
        results = []
        for k, m in enumerate(media):
            albedo, sigma_t, g = (getattr(self.surface, name)[k] for name in VARIABLE)
            sigma_t = sigma_t * opaque(self.mm_per_unit)
            exact = tuple(opaque(v) for v in (m.sigma_s, m.sigma_t, m.g))
            results.append(tuple(dr.replace_grad(a, b) for a, b in zip(exact, (albedo * sigma_t, sigma_t, g))))
        return results


def _slope(stencil: Stencil, S: Any, query: tuple) -> Any:
    precise = _precise(query)
    sides = [(S if model is None else type(S)(model.eval(*precise)), opaque(c)) for model, c in stencil]
    least = sides[0][0]
    for value, _ in sides[1:]:
        least = dr.minimum(least, value)
    by_logarithm = S * sum(c * dr.log(dr.maximum(value, 1e-37)) for value, c in sides)
    return dr.select((least > 1e-35) & (S > 0), by_logarithm, sum(c * value for value, c in sides))


def _precise(query: tuple) -> tuple:
    """In double precision on CUDA: to single, networks answer there in half, which a difference would enlarge."""
    kind = dr.expr_t(*query)
    if dr.backend_v(kind) != dr.JitBackend.CUDA:
        return query
    return tuple(dr.float64_array_t(kind)(v) for v in query)
