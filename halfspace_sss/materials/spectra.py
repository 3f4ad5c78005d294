"""Media given by wavelength, from files too, and the RGB media that stand for them."""

from __future__ import annotations

import csv
import functools
import io
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import NamedTuple

import numpy as np

from halfspace_sss.checks import check_choice
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import DIFFUSE, half_space_reflectance
from halfspace_sss.provenance import read_text, write_atomically

PER_MM = {"1/mm": 1.0, "1/cm": 10.0}
SHORTEST = 100.0  # nm, of a medium; less looks like µm
STRONGEST = 10.0  # mu_s' in 1/mm; tissues have at most 7 at 500 nm (skin, Jacques 2013), so more looks like 1/cm
COLUMNS = ("wavelength", "mu_a", "mu_s", "g", "n")
REDUCED = ("mu_s'", "mu_s_prime")  # columns that may stand for mu_s
VISIBLE = (400.0, 700.0)  # nm; outside, colour-matching functions are below 2 % of their maximum, 4 % for z
XYZ_TO_RGB = np.array(  # linear sRGB, IEC 61966-2-1
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)


class RGBMedium(NamedTuple):
    """An RGB medium that stands for a spectral one.

    Attributes:
        medium: three channels, R, G and B.
        reflectance: of its half-space under uniform light, shape (3,).
        spectral_reflectance: linear sRGB (white 1, 1, 1) of the spectral half-space under D65, shape (3,).
    """

    medium: Medium
    reflectance: np.ndarray
    spectral_reflectance: np.ndarray

    @property
    def difference(self) -> np.ndarray:
        """Reflectance of the RGB medium less that of the spectrum, shape (3,)."""
        return self.reflectance - self.spectral_reflectance

    def __str__(self) -> str:
        shown = (" ".join(f"{v:.4f}" for v in part) for part in (self.reflectance, self.spectral_reflectance))
        return "reflectance {}, of the spectrum under D65 {}".format(*shown)


@dataclass(frozen=True, eq=False)
class SpectralMedium:
    """A homogeneous medium by wavelength; between its wavelengths everything is linear.

    Args:
        wavelengths: nm, ascending, at least two.
        sigma_s, sigma_a: 1/mm, >= 0, one number or one per wavelength.
        g: mean cosine in (-1, 1), one number or one per wavelength.
        n: index over that of the outside, > 0, one number or one per wavelength.
        source: where the numbers are from.

    Raises:
        ValueError: a value is out of range, or the arrays do not match.
    """

    wavelengths: np.ndarray
    sigma_s: np.ndarray
    sigma_a: np.ndarray
    g: np.ndarray
    n: np.ndarray
    source: str = "not stated"

    def __post_init__(self) -> None:
        wavelengths = _numbers("wavelengths", self.wavelengths)
        if wavelengths.ndim != 1 or len(wavelengths) < 2:
            raise ValueError(f"wavelengths must be two or more numbers (nm), got shape {wavelengths.shape}")
        _check("wavelengths", wavelengths, wavelengths > 0, wavelengths, "> 0 (nm)")
        _check("wavelengths", wavelengths[1:], np.diff(wavelengths) > 0, wavelengths[1:], "ascending")
        if wavelengths[-1] < SHORTEST:
            warnings.warn(
                f"wavelengths are in nm, got {wavelengths[0]:g} to {wavelengths[-1]:g}: of values in µm give 1000 "
                "times as many",
                stacklevel=3,
            )
        object.__setattr__(self, "wavelengths", wavelengths)
        for name in ("sigma_s", "sigma_a", "g", "n"):
            value = _numbers(name, getattr(self, name))
            if value.shape not in ((), wavelengths.shape):
                raise ValueError(f"{name} must have {len(wavelengths)} values, as wavelengths, got shape {value.shape}")
            value = np.broadcast_to(value, wavelengths.shape)
            ok = {"g": np.abs(value) < 1, "n": value > 0}.get(name, value >= 0)
            bound = {"g": "in the open interval (-1, 1)", "n": "> 0"}.get(name, ">= 0 (1/mm)")
            _check(name, value, ok, wavelengths, bound)
            object.__setattr__(self, name, value)

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write the spectra in 1/mm with all their digits, as `read_spectra` reads them."""
        columns = (self.wavelengths, self.sigma_a, self.sigma_s, self.g, self.n)
        rows = [",".join(COLUMNS), *(",".join(map(repr, row)) for row in np.transpose(columns).tolist())]
        write_atomically(Path(path), f"# {self.source}\n" + "\n".join(rows) + "\n")

    def medium(self, wavelengths: float | Sequence[float]) -> Medium:
        """The medium at these wavelengths (nm), one channel each; a scalar medium at one number.

        A `Medium` has one index: the mean over the wavelengths. For the index of each ask for them one by one.

        Raises:
            ValueError: a wavelength is outside the range of the spectra.
        """
        asked = _numbers("wavelengths", wavelengths)
        self._check_covered(float(asked.min()), float(asked.max()))
        s, a, g, n = (np.interp(asked, self.wavelengths, v) for v in (self.sigma_s, self.sigma_a, self.g, self.n))
        return Medium(s, a, g, float(np.mean(n)))

    def visible(self, n: int) -> Medium:
        """The medium at n wavelengths evenly over what the spectra have of 400 to 700 nm, else over all of them."""
        low, high = np.clip(VISIBLE, self.wavelengths[0], self.wavelengths[-1])
        if low == high:
            low, high = self.wavelengths[[0, -1]]
        return self.medium(low + (high - low) * (np.arange(n) + 0.5) / n)

    def surface(self) -> dict[str, object]:
        """The medium as parameters of the surface `translucent` of a Mitsuba dictionary, under a spectral variant.

        The index is the mean over the visible range: renders have no dispersion.
        """

        def spectrum(values: np.ndarray) -> dict[str, object] | float:
            texts = (", ".join(f"{v:.9g}" for v in row) for row in (self.wavelengths, values))
            named = dict(zip(("wavelengths", "values"), texts))
            return {"type": "irregular", **named} if np.ptp(values) else float(values[0])

        values = {name: spectrum(getattr(self, name)) for name in ("sigma_s", "sigma_a", "g")}
        return {**values, "eta": self.visible(4).eta}

    def reflectance(self, wavelengths: Sequence[float], mu_i: float | str = DIFFUSE) -> np.ndarray:
        """Reflectance of the half-space at these wavelengths (nm), each with its own index; as `Medium.reflectance`."""
        media = [self.medium(float(wavelength)) for wavelength in wavelengths]
        return np.array([half_space_reflectance(m.albedo, m.g, m.eta, mu_i) for m in media])

    def to_rgb(self, wavelengths: Sequence[float] | None = None) -> RGBMedium:
        """The RGB medium that stands for the spectra, by one of two conventions.

        Three wavelengths: the medium at them, R first; nothing else of the spectra counts. None: the medium whose
        half-space reflects, under uniform light of illuminant D65, the linear sRGB colour that the spectral half-space
        does; its mean free path and g are those of the spectra averaged with the sensitivity of each channel,

            r = max(0, (M [x y z])_r) D65, with the colour-matching functions of 1931 and M from XYZ to linear sRGB.

        Beyond the spectra, but not within 400 to 700 nm, their reflectance goes on as at their ends (ASTM E308).

        Raises:
            ValueError: not three wavelengths, one outside the range of the spectra, spectra that do not cover 400 to
                700 nm, or a colour outside of what a medium can have.
        """
        target, sensitivity, visible = self._colour()
        if wavelengths is not None:
            if len(wavelengths) != 3:
                raise ValueError(f"wavelengths must be three, of R, G and B, got {list(wavelengths)!r}")
            medium = self.medium(wavelengths)
        else:
            inside = np.clip(visible, self.wavelengths[0], self.wavelengths[-1])
            spectral = [self.medium(float(wavelength)) for wavelength in inside]
            mfp, g, n = (sensitivity @ [getattr(m, name) for m in spectral] for name in ("mfp", "g", "eta"))
            medium = Medium.from_reflectance(target, mfp, g, float(np.mean(n)))
        return RGBMedium(medium, medium.reflectance(), target)

    def _colour(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Linear sRGB under D65, the sensitivity of its channels (sum 1, shape (3, wavelengths)), and wavelengths."""
        self._check_covered(*VISIBLE)
        wavelengths, matching = _observer()
        inside = np.clip(wavelengths, self.wavelengths[0], self.wavelengths[-1])
        rgb = XYZ_TO_RGB @ matching
        colour = rgb @ self.reflectance(inside) / rgb.sum(axis=1)
        sensitivity = np.maximum(rgb, 0)
        return colour, sensitivity / sensitivity.sum(axis=1, keepdims=True), wavelengths

    def _check_covered(self, low: float, high: float) -> None:
        first, last = self.wavelengths[0], self.wavelengths[-1]
        if not (first <= low and high <= last):
            wrong = low if low < first else high
            raise ValueError(f"wavelengths must be in [{first:g}, {last:g}] nm, which the spectra cover, got {wrong:g}")


def _numbers(name: str, value: object) -> np.ndarray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} must be numbers, got {value!r}") from error
    if not np.all(np.isfinite(array)) or array.size == 0:
        raise ValueError(f"{name} must be finite numbers, got {array.tolist()!r}"[:200])
    return array


def _check(name: str, value: np.ndarray, ok: np.ndarray, wavelengths: np.ndarray, bound: str) -> None:
    if not np.all(ok):
        k = int(np.argmin(ok))
        raise ValueError(f"{name} must be {bound}, got {value[k]:g} at {wavelengths[k]:g} nm")


@functools.cache
def _observer() -> tuple[np.ndarray, np.ndarray]:
    """Wavelengths (nm) and colour-matching functions times D65, shape (3, wavelengths)."""
    text = resources.files("halfspace_sss.materials").joinpath("data/cie1931_d65.csv").read_text(encoding="utf-8")
    rows = np.loadtxt(io.StringIO(text), delimiter=",", skiprows=4)
    return rows[:, 0], (rows[:, 1:4] * rows[:, 4:]).T


def read_spectra(path: str | os.PathLike[str], unit: str | None = None) -> SpectralMedium:
    """Spectra of a CSV file with the columns wavelength (nm), mu_a, mu_s, g and n; lines that begin with # are skipped.

    A column mu_s' (or mu_s_prime) in place of mu_s is reduced scattering: mu_s = mu_s' / (1 - g).

    Args:
        path: the file.
        unit: of mu_a and scattering, "1/mm" or "1/cm"; without it 1/mm, and a warning where no tissue scatters so much.

    Raises:
        ValueError: the file cannot be read, a column is missing or unknown, or a value is no number or out of range;
            file, row and column are named.
    """
    if unit is not None:
        check_choice("unit", unit, PER_MM)
    try:
        lines = read_text(Path(path)).splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: must be a readable CSV file in UTF-8, got {error}") from error
    rows = csv.DictReader([line for line in lines if line.strip() and not line.startswith("#")], skipinitialspace=True)
    names = [name.strip() for name in rows.fieldnames or ()]
    reduced = any(name in REDUCED for name in names)
    rows.fieldnames = ["mu_s" if name in REDUCED else name for name in names]
    if sorted(rows.fieldnames) != sorted(COLUMNS):
        raise ValueError(
            f"{path}: columns must be {', '.join(COLUMNS)}, or mu_s' for mu_s, got {', '.join(names) or 'none'}"
        )
    values = {name: [] for name in COLUMNS}
    for k, row in enumerate(rows, 1):
        for name in COLUMNS:
            values[name].append(_cell(row[name], f"{path}, row {k}: {name}"))
    scale, g = PER_MM[unit or "1/mm"], np.array(values["g"])
    mu_s, mu_a = np.array(values["mu_s"]) / scale, np.array(values["mu_a"]) / scale
    if reduced:
        mu_s = mu_s / np.where(np.abs(g) < 1, 1 - g, 1)
    try:
        medium = SpectralMedium(values["wavelength"], mu_s, mu_a, g, values["n"], source=str(path))
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    strength = float(np.mean(medium.sigma_s * (1 - medium.g)))
    if unit is None and strength > STRONGEST:
        warnings.warn(
            f"{path}: no tissue has mu_s' = {strength:.3g} 1/mm (mean over wavelengths), at most {STRONGEST:g}: values "
            "in 1/cm need unit '1/cm', others unit '1/mm'",
            stacklevel=2,
        )
    return medium


def _cell(text: str | None, where: str) -> float:
    try:
        return float(text)
    except (TypeError, ValueError):
        raise ValueError(f"{where} must be a number, got {text!r}") from None
