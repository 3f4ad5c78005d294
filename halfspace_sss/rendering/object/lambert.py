"""Light that leaves where it entered: a diffuse surface with the reflectance of the medium, as a transport."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from halfspace_sss.physics.medium import Medium
from halfspace_sss.rendering.object.points import CosineProposals, Entry, Exit, Means, number
from halfspace_sss.rendering.object.settings import Settings
from halfspace_sss.rendering.object.shape import Object
from halfspace_sss.rendering.object.translucent import Inside

__all__ = ["LambertProposals", "LambertTransport", "lambert_means"]


@dataclass(frozen=True, eq=False)
class LambertTransport:
    """S = R delta(x_i - x_o) / pi, R the exact reflectance of the half-space under light from everywhere.

    Args:
        reflectance: R of each channel.
    """

    reflectance: list[float]
    orders = "total"
    is_delta = True

    def prepare(self, out: Exit, active: Any) -> Exit:
        """Nothing is done for the exit alone."""
        return out

    def S_mu(self, prepared: Exit, entry: Entry, w_i: Any, active: Any) -> Any:
        """Over the density of `LambertProposals.sample`, whose point is the only one."""
        R = [number(value) for value in self.reflectance]
        _, mu_i = entry.seen(w_i)
        lit = active & (dr.dot(prepared.w, prepared.n) > 0)
        return dr.select(lit, (mi.Spectrum(*R) if len(R) > 1 else mi.Spectrum(R[0])) * (mu_i * dr.inv_pi), 0)


@dataclass(frozen=True, eq=False)
class LambertProposals(CosineProposals):
    """The exit itself, directions by the cosine."""

    def prepare(self, out: Exit, prepared: Any, active: Any) -> None:
        """Nothing is done for the exit alone."""

    def sample(self, out: Exit, prim_index: Any, prepared: None, sampler: Any, active: Any) -> Entry:
        n = mi.Normal3f(out.n_face * out.sign)
        return Entry(mi.Point3f(out.p), n, mi.Normal3f(out.n), dr.select(active, mi.Float(1), 0), prim_index)


def lambert_means(found: Object, inside: Inside, media: list[Medium], settings: Settings) -> Means:
    """The transport of a diffuse surface: what a half-space tends to as its mean free path goes to 0."""
    return Means(LambertTransport([float(m.reflectance()) for m in media]), LambertProposals())
