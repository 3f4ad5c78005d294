"""Light that leaves where it entered: a diffuse surface with the reflectance of the medium, as a transport."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import CosineProposals, EntrySample, ObjectModel, SurfacePoint, Transport, opaque
from full_geometry.objects.objects import TranslucentObject
from full_geometry.settings import Settings
from full_geometry.surface.textured import bend, x_of_albedo
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import albedo_of_reflectance, half_space_reflectance

NODES = 1025  # of the table of R by x


@dataclass(frozen=True, eq=False)
class LambertTransport(Transport):
    """S = R delta(x_i - x_o) / pi, R the exact reflectance of the half-space under light from everywhere.
    `reflectance`: R of each channel at an exit."""

    reflectance: Callable[[SurfacePoint], list[mi.Float]]
    orders = "total"
    is_delta = True

    def S(self, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool = True) -> mi.Spectrum:
        """Over the density of `LambertProposals.sample`, whose point is the only one."""
        above = active & (dr.dot(exit.w, exit.n_out) > 0)
        return dr.select(above, mi.Spectrum(self.reflectance(exit)) * dr.inv_pi, 0)


class ReflectanceTable:
    """R of the medium at an exit whose object has textures, by a table of ln(R / albedo) over x.
    `media`: of each channel; their g and eta hold."""

    def __init__(self, media: Sequence[Medium]) -> None:
        self.g, self.tables = [m.g for m in media], {}
        for each in set(self.g):
            R = half_space_reflectance(1.0, each, media[0].eta) * np.linspace(0, 1, NODES)[1:] ** 2
            albedo = albedo_of_reflectance(R, each, media[0].eta)
            x = x_of_albedo(np, albedo, each, bend(each))[::-1]
            ratio = np.interp(np.linspace(0, 1, NODES), x, np.log(R / albedo)[::-1])
            tensor = mi.TensorXf(ratio.astype(np.float32)[:, None])
            self.tables[each] = mi.Texture1f(tensor, use_accel=False, wrap_mode=dr.WrapMode.Clamp)

    def __call__(self, exit: SurfacePoint) -> list[mi.Float]:
        R = []
        for g, albedo in zip(self.g, exit.medium.albedo):
            x = x_of_albedo(dr, dr.clip(albedo, 0, 1), opaque(g), opaque(bend(g)))
            R.append(albedo * dr.exp(self.tables[g].eval(mi.Point1f((x * (NODES - 1) + 0.5) / NODES))[0]))
        return R


@dataclass(frozen=True, eq=False)
class LambertProposals(CosineProposals):
    """The exit itself, directions by the cosine."""

    def sample(
        self, out: SurfacePoint, prim_index: mi.UInt32, prepared: None, sampler: mi.Sampler, active: mi.Bool
    ) -> EntrySample:
        return EntrySample(
            mi.Point3f(out.p), mi.Normal3f(out.n), mi.Normal3f(out.n_out), dr.select(active, mi.Float(1), 0), prim_index
        )


def lambert_model(obj: TranslucentObject, settings: Settings) -> ObjectModel:
    """The transport of a diffuse surface: what a half-space tends to as its mean free path goes to 0."""
    R = [float(m.reflectance()) for m in obj.media]

    def constant(exit: SurfacePoint) -> list[mi.Float]:
        return [opaque(value) for value in R]

    reflectance = constant if obj.textured is None else ReflectanceTable(obj.media)
    return ObjectModel(LambertTransport(reflectance), LambertProposals())
