"""Media by wavelength, under spectral variants of Mitsuba, where a ray has four wavelengths and each is a channel.

The coefficients are those at the wavelengths of the ray, sigma_t(l), sigma_s(l) and g(l). The relative index is one
number, the mean over the visible range: dispersion is left out. Models of the half-space know one g, the visible mean
g_0, and take the similar medium

    sigma_s* = sigma_s (1 - g) / (1 - g_0),    sigma_t* = sigma_s* + sigma_a.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from full_geometry.geometry.points import MediumAt, SurfacePoint, opaque
from full_geometry.geometry.shape import Geometry
from halfspace_sss.materials.spectra import SpectralMedium, read_spectra
from halfspace_sss.physics.medium import Medium

STEP = 1.0  # nm, of tables
CHANNELS = 4  # wavelengths of a ray
EVERYWHERE = np.array([1.0, 1e6])  # nm, of media given by numbers
IN_UNITS = ("sigma_s", "sigma_a", "sigma_t", "mfp")  # no colours: rgb is a reflectance in [0, 1]
LOOKS = 256  # wavelengths that a sensor is asked for
Values = "mi.Spectrum | np.ndarray"


@dataclass(frozen=True, eq=False)
class MediumByWavelength:
    """The medium of an object at the wavelengths of rays.
    `spectra`: the medium. `tables`: sigma_t, sigma_s (1/mm) and g at every `STEP` from the first wavelength to the
    last, or at these two. `scale`: factor of sigma_t and sigma_s."""

    spectra: SpectralMedium
    tables: list[mi.Float]
    scale: float = 1.0

    @classmethod
    def of(cls, spectra: SpectralMedium) -> MediumByWavelength:
        """Tabulate spectra at every `STEP`."""
        even = all(np.ptp(getattr(spectra, key)) == 0 for key in ("sigma_s", "sigma_a", "g"))
        ends = spectra.wavelengths[[0, -1]]
        m = spectra.medium(ends if even else _grid(*ends))
        tables = [mi.Float(np.broadcast_to(v, m.sigma_t.shape).tolist()) for v in (m.sigma_t, m.sigma_s, m.g)]
        dr.make_opaque(tables)
        return cls(spectra, tables)

    @property
    def g(self) -> np.ndarray:
        """Mean cosine by wavelength."""
        return self.spectra.g

    def scaled(self, factor: float) -> MediumByWavelength:
        """The same in other units of length: sigma_t and sigma_s times a factor."""
        return replace(self, scale=self.scale * factor)

    def at(self, wavelengths: mi.Spectrum) -> tuple[mi.Spectrum, mi.Spectrum, mi.Spectrum]:
        """sigma_t, sigma_s and g at wavelengths in nm; beyond the spectra as at their ends."""
        (first, last), n = self.spectra.wavelengths[[0, -1]], dr.width(self.tables[0])
        results = [[], [], []]
        for wavelength in wavelengths:
            t = dr.clip((wavelength - opaque(first)) * opaque((n - 1) / (last - first)), 0, n - 1)
            k = mi.UInt32(dr.minimum(t, n - 2))
            for table, values in zip(self.tables, results):
                values.append(dr.lerp(dr.gather(mi.Float, table, k), dr.gather(mi.Float, table, k + 1), t - k))
        sigma_t, sigma_s, g = (mi.Spectrum(values) for values in results)
        return sigma_t * opaque(self.scale), sigma_s * opaque(self.scale), g

    def at_exit(self, si: mi.SurfaceInteraction3f) -> MediumAt:
        """The medium where light leaves, for its whole way."""
        sigma_t, sigma_s, g = self.at(si.wavelengths)
        return MediumAt(sigma_s / dr.maximum(sigma_t, 1e-30), sigma_t, si.prim_index, g, si.wavelengths)

    def ends(self, obj: Geometry, exit: SurfacePoint, at: SurfacePoint, active: mi.Bool) -> list[MediumAt]:
        """The medium by whose half-space light goes to an exit: the similar one of the mean g."""
        m = exit.medium
        albedo, sigma_t = self._similar(m.albedo, m.sigma_t, m.g)
        return [MediumAt(albedo, sigma_t, m.face)]

    def values_on(self, shape: mi.Shape) -> tuple[np.ndarray, np.ndarray]:
        """Albedo and sigma_t of that medium at the wavelengths of the tables, shapes (n, 1)."""
        sigma_t, sigma_s, g = (np.array(table, dtype=float)[:, None] for table in self.tables)
        albedo, sigma_t = self._similar(sigma_s / np.maximum(sigma_t, 1e-30), sigma_t, g)
        return albedo, self.scale * sigma_t

    def _similar(self, albedo: Values, sigma_t: Values, g: Values) -> tuple[Values, Values]:
        factor = (1 - g) / (1 - self.mean().g.mean())
        extinction = sigma_t * (albedo * factor + 1 - albedo)
        return albedo * factor * sigma_t / (extinction + 1e-30), extinction

    def mean(self) -> Medium:
        """The medium at four visible wavelengths, with their mean index, see `SpectralMedium.visible`."""
        return self.spectra.visible(CHANNELS)

    def check_covers(self, name: str, sensor: mi.Sensor) -> None:
        """ValueError if a sensor sees wavelengths that the spectra of the object called `name` do not have."""
        u = (np.arange(LOOKS) / LOOKS).tolist()
        drawn, _ = sensor.sample_wavelengths(dr.zeros(mi.SurfaceInteraction3f, LOOKS), mi.Float(u))
        low, high = float(np.min(np.array(drawn))), float(np.max(np.array(drawn)))
        first, last = self.spectra.wavelengths[[0, -1]]
        if low < first - 1e-3 or high > last + 1e-3:
            raise ValueError(
                f"spectra of object {name} must cover {low:.4g} to {high:.4g} nm, which the film sees, got those of "
                f"{first:g} to {last:g} nm"
            )


def _grid(first: float, last: float) -> np.ndarray:
    return np.linspace(first, last, max(math.ceil((last - first) / STEP), 1) + 1)


def spectral_medium(props: mi.Properties, keys: tuple[str, ...]) -> tuple[dict[str, Any], np.ndarray | None]:
    """Coefficients of the parameters of a surface by wavelength; numbers, if all of them are.
    `props`: the parameters; numbers, spectra of Mitsuba, and rgb where that is an albedo or a reflectance. `keys`:
    their names. Returns the values, arrays where wavelengths are given, and these in nm, which all the spectra cover.
    ValueError if a parameter is neither, or spectra do not overlap."""
    given = {key: _number_or_texture(props, key) for key in keys if key in props}
    textures = {key: value for key, value in given.items() if isinstance(value, mi.Texture)}
    if not textures:
        return given, None
    ranges = np.array([value.wavelength_range() for value in textures.values()], dtype=float).reshape(-1, 2)
    first, last = ranges[:, 0].max(), ranges[:, 1].min()
    if not first < last:
        raise ValueError(f"spectra must share wavelengths, got none between those of {' and '.join(textures)}")
    wavelengths = _grid(first, last)
    si = dr.zeros(mi.SurfaceInteraction3f, len(wavelengths))
    si.wavelengths = mi.Spectrum(mi.Float(wavelengths.tolist()))
    values = {key: np.array(value.eval(si)[0], dtype=float) for key, value in textures.items()}
    return {**given, **{key: np.broadcast_to(value, wavelengths.shape) for key, value in values.items()}}, wavelengths


def _number_or_texture(props: mi.Properties, key: str) -> float | mi.Texture:
    kind, types = props.type(key), mi.Properties.Type
    value = props[key]
    if kind == types.String:
        try:
            return float(value)
        except ValueError:
            pass
    elif kind in (types.Float, types.Integer):
        return float(value)
    elif kind == types.Spectrum or (kind == types.Color and key not in IN_UNITS):
        return props.get_unbounded_texture(key) if kind == types.Spectrum else props.get_texture(key)
    elif isinstance(value, mi.Texture) and not value.is_spatially_varying():
        if "MeshAttribute" not in value.class_name():
            return value
    got = value.class_name().partition("Impl")[0] if isinstance(value, mi.Object) else repr(value)
    raise ValueError(
        f"{key} must be a number or a spectrum, the same over all of the object, under a spectral variant, got {got}"
    )


def read_file(props: mi.Properties) -> SpectralMedium:
    """The medium of the file `spectra`, see `materials.read_spectra`, with mu_a and mu_s in `unit`; errors as there."""
    path = mi.file_resolver().resolve(str(props["spectra"]))
    return read_spectra(str(path), str(props["unit"]) if "unit" in props else None)
