"""Light that leaves where it entered: a diffuse surface with the reflectance of the medium, as a transport."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.rendering.object.objects import TranslucentObject
from halfspace_sss.rendering.object.points import CosineProposals, EntrySample, ObjectModel, SurfacePoint, opaque
from halfspace_sss.rendering.object.settings import Settings


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
    return ObjectModel(LambertTransport([float(m.reflectance()) for m in obj.media]), LambertProposals())
