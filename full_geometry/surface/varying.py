"""Media that vary in space: extinction and albedo from Mitsuba's grid volumes.

    sigma_t(x) = factor D(x),  sigma_s(x) = albedo A(x) sigma_t(x)

D and A are grids, interpolated and placed by Mitsuba's `gridvolume`; factor and albedo are numbers, one per channel.
The mean cosine and the relative index are constant.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.rounding import box_ends
from full_geometry.geometry.shape import Geometry, crossings
from halfspace_sss.physics.medium import Medium

POINTS = 2**15  # at which a medium is averaged over an object
Coefficient = "mi.Volume | np.ndarray | float"


@dataclass(frozen=True, eq=False)
class VaryingMedium:
    """Extinction and albedo of a medium that varies in space.
    `density`: the volume D >= 0, with one channel or one per channel of the variant; None for one everywhere. `factor`:
    1/mm, one value per channel, >= 0. `albedo_volume`: the volume A, likewise. `albedo`: one value per channel; albedo
    A is in [0, 1]."""

    density: mi.Volume | None
    factor: np.ndarray
    albedo_volume: mi.Volume | None
    albedo: np.ndarray

    by_depth = False  # whether the surface of an object decides, and `placed` asks for it

    def scaled(self, factor: float) -> VaryingMedium:
        """The same in other units of length: sigma_t times a factor."""
        return replace(self, factor=self.factor * factor)

    def placed(self, obj: Geometry, mm_per_unit: float) -> VaryingMedium:
        """The medium of an object, 1/(scene unit)."""
        return self.scaled(mm_per_unit)

    @property
    def majorant(self) -> np.ndarray:
        """The largest sigma_t of each channel, 1/mm: interpolation exceeds no voxel."""
        if self.density is None:
            return self.factor
        values = grid_values(self.density)  # Mitsuba's own maxima do not follow changes of the voxels
        return self.factor * values.reshape(-1, values.shape[-1]).max(axis=0)

    def coefficients(self, p: mi.Point3f) -> tuple[np.ndarray, np.ndarray]:
        """sigma_t and sigma_s at points, arrays of shape (channels, n), 1/mm."""
        sigma_t = self.factor[:, None] * np.array(eval_volume(self.density, p))
        return sigma_t, self.albedo[:, None] * np.array(eval_volume(self.albedo_volume, p)) * sigma_t

    def albedo_at(self, p: mi.Point3f, active: mi.Bool = True) -> mi.Spectrum:
        return mi.Spectrum(self.albedo.tolist()) * eval_volume(self.albedo_volume, p, active)


def eval_volume(volume: mi.Volume | None, p: mi.Point3f, active: mi.Bool = True) -> mi.Spectrum:
    """The value of a volume at points, one per channel of the variant."""
    n = dr.width(p)
    if volume is None:
        return dr.full(mi.Spectrum, 1, n)
    it = dr.zeros(mi.Interaction3f, n)
    it.p = p
    return mi.Spectrum(volume.eval(it, active))


def grid_values(volume: Any) -> np.ndarray:
    """All values of a volume, shape (z, y, x, channels): the voxels of a grid, those of layers one behind the other."""
    if not isinstance(volume, mi.Volume):
        return volume.values[None, None]
    return np.array(mi.traverse(volume)["data"])


def constant_value(value: Any) -> Any:
    """A parameter as it is, but a `constvolume` by its value."""
    if isinstance(value, mi.Volume) and value.class_name() == "ConstVolume":
        return np.ravel(np.array(value.eval(dr.zeros(mi.Interaction3f, 1))))
    return value


def varying_medium(sigma_t: Coefficient, albedo: Coefficient, scale: Coefficient, channels: int) -> VaryingMedium:
    """The medium of parameters with at least one grid volume.

    Args:
        sigma_t: 1/mm, a grid volume, a number or one per channel.
        albedo: likewise, in [0, 1].
        scale: a number, or a grid volume of one channel if sigma_t is none.
        channels: of the variant.

    Raises:
        ValueError: sigma_t and scale are both volumes, a volume is no grid, has another number of channels, or has
            values that are not finite, negative or, of the albedo, above one; or a channel has no extinction.
    """
    if isinstance(sigma_t, mi.Volume) and isinstance(scale, mi.Volume):
        raise ValueError("scale must be a number where sigma_t is a volume, got two volumes")
    density, factor = (scale, sigma_t) if isinstance(scale, mi.Volume) else (sigma_t, scale)
    name = "scale" if density is scale else "sigma_t"
    factor = _per_channel("sigma_t" if name == "scale" else "scale", factor, channels)
    if isinstance(density, mi.Volume):
        _check_grid(name, density, channels, np.inf)
    else:
        density, factor = None, factor * _per_channel("sigma_t", density, channels)
    if isinstance(albedo, mi.Volume):
        _check_grid("albedo", albedo, channels, 1.0)
        medium = VaryingMedium(density, factor, albedo, np.ones(channels))
    else:
        medium = VaryingMedium(density, factor, None, _per_channel("albedo", albedo, channels, 1.0))
    if not np.all(medium.majorant > 0):
        raise ValueError(f"sigma_t must be > 0 somewhere in each channel, got at most {medium.majorant.tolist()}")
    return medium


def _per_channel(name: str, value: np.ndarray | float, channels: int, most: float = np.inf) -> np.ndarray:
    values = np.atleast_1d(np.asarray(value, dtype=float))
    if values.shape not in ((1,), (channels,)):
        raise ValueError(f"{name} must be a number or one per channel ({channels}), got {values.tolist()}")
    _check_range(name, values, most)
    return np.broadcast_to(values, (channels,)).copy()


def _check_range(name: str, values: np.ndarray, most: float) -> None:
    ok = np.isfinite(values) & (values >= 0) & (values <= most)
    if not ok.all():
        bound = "finite and >= 0" if most == np.inf else f"in [0, {most:g}]"
        raise ValueError(f"{name} must be {bound}, got {values[~ok].flat[0].item()!r}")


def _check_grid(name: str, volume: mi.Volume, channels: int, most: float) -> None:
    if volume.class_name() != "GridVolume":
        raise ValueError(f"{name} must be a number, a constvolume or a gridvolume, got a {volume.class_name()}")
    values = grid_values(volume)
    if values.shape[-1] not in {1, channels if name != "scale" else 1}:
        wanted = "1 channel" if name == "scale" or channels == 1 else f"1 or {channels} channels"
        raise ValueError(f"{name} must be a grid of {wanted}, got {values.shape[-1]}")
    _check_range(name, values, most)


def mean_of_grids(medium: VaryingMedium, g: np.ndarray | float, eta: float) -> Medium:
    """The homogeneous medium with the mean extinction and the mean albedo of the grids, before an object is known."""
    sigma_t, albedo = (
        factor * (1.0 if volume is None else grid_values(volume).mean(axis=(0, 1, 2)))
        for factor, volume in ((medium.factor, medium.density), (medium.albedo, medium.albedo_volume))
    )
    albedo = np.minimum(albedo, 1)
    return Medium.from_albedo(*(v if len(v) > 1 else float(v[0]) for v in (albedo, sigma_t)), g, eta)


def equivalent(spec: Any, obj: Geometry) -> Any:
    """The spec with a homogeneous medium, which models of the half-space take.
    Its sigma_s and sigma_a are the means over the volume of the object, its albedo and sigma_t those over textures.
    Layers have theirs already, see `layered.LayeredMedium.mean`."""
    if spec.textured is not None:
        return replace(spec, medium=spec.textured.mean(spec.medium.g, spec.medium.eta, obj.shape))
    if spec.varying is None or spec.varying.by_depth:
        return spec
    p = _points(obj.scene.bbox())
    if obj.closed:
        ray = mi.Ray3f(p, dr.normalize(mi.Vector3f(0.31, 0.87, 0.39)))
        within = np.array(crossings(obj.scene, ray)[1]) % 2 == 1
        if within.any():
            p = mi.Point3f(np.array(p)[:, within])
    sigma_t, sigma_s = (values.astype(float).mean(axis=1) for values in spec.varying.coefficients(p))
    sigma_a = np.maximum(sigma_t - sigma_s, 0)
    pair = (v if len(v) > 1 else float(v[0]) for v in (sigma_s, sigma_a))
    return replace(spec, medium=Medium(*pair, spec.medium.g, spec.medium.eta))


def warn_of_means(spec: Any, obj: Geometry) -> None:
    """Warn that models of the half-space take the medium of `equivalent`, if it stands for one that varies."""
    if spec.varying is not None:
        warnings.warn(
            f"object {obj.name} varies in space: the model {spec.model!r} takes its mean sigma_s "
            f"{spec.medium.sigma_s} and sigma_a {spec.medium.sigma_a} 1/mm",
            stacklevel=2,
        )


def _points(box: mi.ScalarBoundingBox3f) -> mi.Point3f:
    u = np.random.default_rng(5).random((3, POINTS))
    low, high = box_ends(box)[..., None]
    return mi.Point3f(low + u * (high - low))
