"""Light that leaves where it entered: a diffuse surface with the reflectance of the medium, as a transport."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import CosineProposals, EntrySample, ObjectModel, SurfacePoint, opaque
from full_geometry.objects.objects import TranslucentObject
from full_geometry.settings import Settings
from full_geometry.surface.textured import bend, x_of_albedo
from halfspace_sss.physics.reflectance import albedo_of_reflectance, half_space_reflectance


@dataclass(frozen=True, eq=False)
class LambertTransport:
    """S = R delta(x_i - x_o) / pi, R the exact reflectance of the half-space under light from everywhere.

    Args:
        reflectance: R of each channel.
    """

    reflectance: list[float]
    orders = "total"
    checksums = ()
    alpha = None
    is_delta = True

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> SurfacePoint:
        """Nothing is done for the exit alone."""
        return at

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """Over the density of `LambertProposals.sample`, whose point is the only one."""
        R = [opaque(value) for value in self.reflectance]
        above = active & (dr.dot(exit.w, exit.n_out) > 0)
        return dr.select(above, (mi.Spectrum(*R) if len(R) > 1 else mi.Spectrum(R[0])) * dr.inv_pi, 0)


NODES = 1025  # of the table of R by x


@dataclass(frozen=True, eq=False)
class TexturedLambertTransport:
    """The same with the reflectance of the medium at the point, by a table of ln(R / albedo) over x.

    Args:
        g: mean cosine of each channel.
        tables: by mean cosine.
    """

    g: list[float]
    tables: dict[float, mi.Texture1f]
    orders = "total"
    checksums = ()
    alpha = None
    is_delta = True

    @classmethod
    def of(cls, g: list[float], eta: float) -> TexturedLambertTransport:
        """For a mean cosine of each channel and a relative index."""
        tables = {}
        for each in set(g):
            R = half_space_reflectance(1.0, each, eta) * np.linspace(0, 1, NODES)[1:] ** 2
            albedo = albedo_of_reflectance(R, each, eta)
            x = x_of_albedo(np, albedo, each, bend(each))[::-1]
            ratio = np.interp(np.linspace(0, 1, NODES), x, np.log(R / albedo)[::-1])
            tensor = mi.TensorXf(ratio.astype(np.float32)[:, None])
            tables[each] = mi.Texture1f(tensor, use_accel=False, wrap_mode=dr.WrapMode.Clamp)
        return cls(g, tables)

    def prepare(self, at: SurfacePoint, active: mi.Bool = True) -> SurfacePoint:
        """Nothing is done for the exit alone."""
        return at

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """As of `LambertTransport`."""
        R = []
        for g, albedo in zip(self.g, exit.medium.albedo):
            x = x_of_albedo(dr, dr.clip(albedo, 0, 1), opaque(g), opaque(bend(g)))
            R.append(albedo * dr.exp(self.tables[g].eval(mi.Point1f((x * (NODES - 1) + 0.5) / NODES))[0]))
        above = active & (dr.dot(exit.w, exit.n_out) > 0)
        return dr.select(above, (mi.Spectrum(*R) if len(R) > 1 else mi.Spectrum(R[0])) * dr.inv_pi, 0)


@dataclass(frozen=True, eq=False)
class LambertProposals(CosineProposals):
    """The exit itself, directions by the cosine."""

    def prepare(self, out: SurfacePoint, prepared: Any, active: mi.Bool) -> None:
        """Nothing is done for the exit alone."""

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: None, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        return EntrySample(
            mi.Point3f(out.p), mi.Normal3f(out.n), mi.Normal3f(out.n_out), dr.select(active, mi.Float(1), 0), prim_index
        )


def lambert_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """The transport of a diffuse surface: what a half-space tends to as its mean free path goes to 0."""
    if obj.textured is not None:
        transport = TexturedLambertTransport.of([m.g for m in obj.media], obj.media[0].eta)
        return ObjectModel(transport, LambertProposals())
    return ObjectModel(LambertTransport([float(m.reflectance()) for m in obj.media]), LambertProposals())
