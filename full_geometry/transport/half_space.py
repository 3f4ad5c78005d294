"""The half-space models laid onto a surface: a transport, and the proposals that follow the same models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import (
    AreaPoints,
    EntrySample,
    ObjectModel,
    PositionSampler,
    Proposals,
    RadialTable,
    SurfacePoint,
    Transport,
    local_frame,
    opaque,
    opposed,
    plane_query,
    refract_in,
    surface_point,
)
from full_geometry.geometry.rounding import ray_from
from full_geometry.geometry.shape import Geometry, lines_through, meet_alone
from full_geometry.settings import AUTOMATIC, Settings
from full_geometry.surface.textured import TexturedMedium
from halfspace_sss.interface.model import BSSRDF
from halfspace_sss.physics.medium import Medium
from halfspace_sss.registry import bssrdf

POINTS_PER_RATIO, MOST_POINTS = 60.0, 9  # candidates over the area


@dataclass(frozen=True, eq=False)
class HalfSpaceTransport(Transport):
    """S of the half-space at the distance of two surface points, see `plane_query`.
    `models`: one per channel, in scene units. `precise`: asked `in_double`, for differences."""

    models: list[BSSRDF]
    precise: bool = False

    @property
    def orders(self) -> str:
        return self.models[0].orders

    @property
    def checksums(self) -> tuple[str, ...]:
        return tuple(checksum for model in self.models for checksum in model.checksums)

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        query = plane_query(at, exit)
        above = active & (at.mu > 0) & (query[3] > 0)
        asked = in_double(query) if self.precise else query
        return dr.select(above, mi.Spectrum([mi.Float(model.eval(*asked)) for model in self.models]), 0)

    def perturbed(self, media: Sequence[Medium]) -> HalfSpaceTransport:
        """See `medium_derivatives.PerturbableTransport`."""
        models = [bssrdf(model.name, m) for model, m in zip(self.models, media)]
        return HalfSpaceTransport(models, True)


def in_double(query: tuple[mi.Float, ...]) -> tuple[mi.Float, ...]:
    """A query in double precision on CUDA: single ones networks answer there in half, which differences enlarge."""
    kind = dr.expr_t(*query)
    if dr.backend_v(kind) != dr.JitBackend.CUDA:
        return query
    return tuple(dr.float64_array_t(kind)(v) for v in query)


@dataclass(frozen=True, eq=False)
class HalfSpaceProposals(Proposals):
    """Points by probes and over the area, directions by a model.
    `model`: whose directions of incidence are drawn. `textured`: a medium that entries are to know, 1/(scene unit), or
    None."""

    positions: PositionSampler
    model: BSSRDF
    textured: TexturedMedium | None = None

    def lit(self, brightness: np.ndarray) -> HalfSpaceProposals:
        return replace(self, positions=replace(self.positions, points=self.positions.points.lit(brightness)))

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: None, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        entry = self.positions.sample(out, prim_index, sampler, active)
        if self.textured is None:
            return entry
        place = self.positions.geometry, entry.p, entry.n, entry.face
        return entry._replace(medium=self.textured.at_point(*place, active & (entry.weight > 0)))

    def sample_direction(self, entry: EntrySample, out: SurfacePoint, u: mi.Point2f) -> tuple[mi.Vector3f, mi.Float]:
        frame = local_frame(entry.n_out, out.p - entry.p)
        drawn = self.model.sample_direction(mi.Float(0), mi.Float(1), mi.Float(0), (u.x, u.y))
        return opposed(mi.Vector3f(frame.direction(drawn.mu_i, drawn.phi_i)), entry.n), drawn.pdf

    def pdf_direction(self, entry: EntrySample, out: SurfacePoint, w_i: mi.Vector3f) -> mi.Float:
        mu_i = dr.clip(entry.facing(w_i).mu, 0, 1)
        return self.model.pdf_direction(mu_i, mi.Float(0), mi.Float(0), mi.Float(1), mi.Float(0))


def half_space_model(name: str, geometry: Geometry, media: Sequence[Medium], settings: Settings) -> ObjectModel:
    """The transport and the proposals of a half-space model on an object.
    `media`: of each channel, 1/(scene unit). `settings`: share of uniform entries."""
    models = [bssrdf(name, m) for m in media]
    positions = positions_of([each for each, m in zip(models, media) if float(m.sigma_s) > 0], name, geometry, settings)
    return ObjectModel(HalfSpaceTransport(models), HalfSpaceProposals(positions, models[0]))


def positions_of(models: list[BSSRDF], name: str, geometry: Geometry, settings: Settings) -> PositionSampler:
    """Entries of an object by the mean of models of a name, and over the area."""
    if geometry.group is not None:  # distances are in the frame of the shape, of instances of a mean size
        models = [bssrdf(name, model.medium.scaled(geometry.group.scale)) for model in models]
    table = RadialTable(models, geometry.size)
    share = area_share(geometry, table.mean / geometry.size, settings.area_share)
    return PositionSampler(geometry, table, AreaPoints(geometry.shape), share)


def area_share(geometry: Geometry, ratio: float, wanted: float) -> float:
    """Share of candidates over the area, by default for a ratio of mean distance to object size. On a dragon of ratio
    0.16 nine such points beside a probe bring variance x time to a third of that without, 15 do the same; at 0.05
    (bunny) and 0.04 (candle) the first ones cut the tail at equal cost, kurtosis 18 to 7 and 15 to 5."""
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
# Light that passes an object without being turned, of which a half-space knows nothing.


MOST_STRAIGHT = 0.25  # of what enters: balls that let it pass are half as bright by these models as by walks, or darker
LINES = 2**14


def check_turns(geometry: Geometry, media: Sequence[Medium], model: str) -> None:
    """ValueError if more than `MOST_STRAIGHT` of the light passes straight through an object, which `model` lacks.
    `media`: of each channel, 1/(scene unit)."""
    share = float(straight_share(geometry, media).max())
    if share > MOST_STRAIGHT:
        raise ValueError(
            f"object {geometry.name} must let at most {100 * MOST_STRAIGHT:g} % of the light pass unscattered under "
            f"the model {model!r}, got {100 * share:.3g} %, with light that is turned little: the model neural_shape "
            "and the integrator translucent_walk trace it"
        )


def straight_share(geometry: Geometry, media: Sequence[Medium]) -> np.ndarray:
    """Share of even light that passes an object on its first way inside, for the medium of each channel.
    The mean of exp(-sigma_t' s) over ways s of light from everywhere, refracted where it enters. The reduced extinction
    sigma_t' = sigma_t - max(g, 0) sigma_s counts forward scattering as none. It is 0 where nothing ends a way, as in a
    plane. `geometry`, `media`: as of `check_turns`."""
    entered = lines_through(geometry.scene.bbox(), LINES)
    flags = mi.RayFlags.Minimal
    met = meet_alone(geometry.scene, entered, flags)
    n = dr.select(dr.dot(met.n, entered.d) > 0, -met.n, met.n)
    d, _, valid = refract_in(surface_point(met.p, n, n, -entered.d), opaque(media[0].eta))
    valid &= met.is_valid()
    left = meet_alone(geometry.scene, ray_from(met, d, geometry.clearance), flags, valid)
    ways = np.array(left.t)[np.array(valid)] * (1 if geometry.group is None else geometry.group.scale)
    reduced = [float(m.sigma_t - max(m.g, 0.0) * m.sigma_s) for m in media]
    return np.array([np.exp(-k * ways).mean() if len(ways) else 0.0 for k in reduced])
