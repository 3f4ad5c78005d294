"""Media that vary in space, as walks see them: coefficients at a point, majorants, transmittance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from halfspace_sss.rendering.surface.varying import VaryingMedium, eval_volume

__all__ = ["Grids", "per_channel"]


@dataclass(frozen=True, eq=False)
class Grids:
    """The media of all objects, of which at least one varies.

    Args:
        densities: volume of each object, or None, see `VaryingMedium`.
        albedos: likewise.
        factor: table with one column per channel, 1/(scene unit).
        albedo: likewise, without a unit.
        majorants: likewise, 1/(scene unit).
    """

    densities: list[Any]
    albedos: list[Any]
    factor: list[Any]
    albedo: list[Any]
    majorants: list[Any]

    @classmethod
    def of(cls, insides: list[Any], mm_per_unit: float) -> Grids:
        """Of the insides of objects."""
        media = [inside.varying or _homogeneous(inside.medium) for inside in insides]
        tables = (
            per_channel([m.factor for m in media], mm_per_unit),
            per_channel([m.albedo for m in media], 1.0),
            per_channel([m.majorant for m in media], mm_per_unit),
        )
        dr.make_opaque(tables)
        return cls([m.density for m in media], [m.albedo_volume for m in media], *tables)

    def majorant(self, k: Any) -> Any:
        """Of object k, 1/(scene unit)."""
        return _row(self.majorants, k)

    def sigma_t(self, k: Any, p: Any) -> Any:
        """Extinction of object k at the point p, 1/(scene unit)."""
        return _row(self.factor, k) * _eval(self.densities, k, p)

    def coefficients(self, k: Any, p: Any) -> tuple[Any, Any]:
        """sigma_t and sigma_s of object k at the point p, 1/(scene unit)."""
        sigma_t = self.sigma_t(k, p)
        return sigma_t, sigma_t * _row(self.albedo, k) * _eval(self.albedos, k, p)

    def transmittance(self, k: Any, ray: Any, distance: Any, rng: Any) -> Any:
        """An unbiased estimate of exp(-∫ sigma_t) over a distance along a ray inside object k: ratio tracking.

        Collisions are drawn by the largest majorant M of the channels; each is null, with the weight
        1 - sigma_t,c / M (Novak, Selle and Jarosz 2014).
        """
        M = dr.max(self.majorant(k))
        o, d = mi.Point3f(ray.o), mi.Vector3f(ray.d)
        T = dr.full(mi.Spectrum, 1, dr.width(o))
        t = -dr.log(1 - rng.next_float32()) / M

        def collide(t: Any, T: Any, rng: Any, o: Any, d: Any, k: Any, M: Any, distance: Any) -> tuple:
            T = T * dr.maximum(1 - self.sigma_t(k, dr.fma(d, t, o)) / M, 0)
            return t - dr.log(1 - rng.next_float32()) / M, T, rng, o, d, k, M, distance

        state = (t, T, rng, o, d, k, M, mi.Float(distance))
        going = lambda t, T, rng, o, d, k, M, distance: (t < distance) & (dr.max(T) > 0)  # noqa: E731
        return dr.while_loop(state, going, collide, label="ratio tracking")[1]


def per_channel(rows: list[Any], scale: float) -> list[Any]:
    """A table with one column per channel from a number, or one per channel, of each object."""
    n = len(mi.Spectrum(0))
    values = np.array([np.broadcast_to(row, n) for row in rows], dtype=float) * scale
    return [mi.Float(values[:, c].tolist()) for c in range(n)] if len(rows) else []


def _homogeneous(medium: Any) -> VaryingMedium:
    return VaryingMedium(None, np.atleast_1d(medium.sigma_t), None, np.atleast_1d(medium.albedo))


def _row(table: list[Any], k: Any) -> Any:
    return mi.Spectrum([dr.gather(mi.Float, column, k) for column in table])


def _eval(volumes: list[Any], k: Any, p: Any) -> Any:
    """The value of the volume of object k, 1 where it has none; Mitsuba's volumes cannot be called by pointers."""
    if len(volumes) == 1:
        return eval_volume(volumes[0], p)
    value = mi.Spectrum(1)
    for number, volume in enumerate(volumes):
        if volume is not None:
            here = k == number
            value = dr.select(here, eval_volume(volume, p, here), value)
    return value
