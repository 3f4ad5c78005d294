"""Absorption and scattering of samples from integrating-sphere measurements, by the exact slab solver.

Reads `.rxt` files (format IAD1): index, slides, thickness, then rows of M_R, M_T and M_U by wavelength. They are
the total reflectance, the total transmittance and its unscattered part, corrected for the spheres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from halfspace_sss.checks import check_interval
from halfspace_sss.materials.spectra import SpectralMedium
from halfspace_sss.physics.reflectance import slab_fluxes
from halfspace_sss.provenance import read_text

NODES = 32  # of the solver: reflectance of a slab to 1e-5 for g up to 0.9
HEADER = 17  # numbers before the kind of rows
KINDS: dict[int, tuple[str, ...]] = {
    1: ("M_R",),
    2: ("M_R", "M_T"),
    3: ("M_R", "M_T", "M_U"),
    5: ("M_R", "M_T", "M_U", "r_w", "t_w"),
}
LARGEST = 1e3  # optical thickness, absorbed or reduced scattered, of a fit


@dataclass(frozen=True)
class SphereFile:
    """What an `.rxt` file holds.

    Attributes:
        eta, eta_slide: index of the sample, and of its slides, 1 for none.
        thickness: of the sample, mm.
        wavelengths: nm, or the numbers of the rows where the file has none.
        rows: readings by name, M_R, M_T, M_U and others, each of shape (rows,).
    """

    eta: float
    eta_slide: float
    thickness: float
    wavelengths: np.ndarray
    rows: dict[str, np.ndarray]


@dataclass(frozen=True, repr=False)
class SphereSample:
    """Coefficients of a sample by wavelength, with standard errors; all arrays have a value for each row.

    Attributes:
        wavelengths: nm, or the numbers of the rows where the file has none.
        sigma_a, sigma_s_prime, g: 1/mm and the mean cosine, which is that asked for unless M_U told it.
        sigma_a_error, sigma_s_prime_error: of the stated uncertainty of the readings.
        residual: root mean square distance of the fitted readings from those given, in units of that uncertainty.
        eta, source: index of the sample; file.
    """

    wavelengths: np.ndarray
    sigma_a: np.ndarray
    sigma_s_prime: np.ndarray
    g: np.ndarray
    sigma_a_error: np.ndarray
    sigma_s_prime_error: np.ndarray
    residual: np.ndarray
    eta: float
    source: str

    def __repr__(self) -> str:
        return f"<SphereSample of {len(self.wavelengths)} rows of {self.source}>"

    @property
    def spectra(self) -> SpectralMedium:
        """The sample as a medium by wavelength."""
        sigma_s = self.sigma_s_prime / (1 - self.g)
        return SpectralMedium(self.wavelengths, sigma_s, self.sigma_a, self.g, np.array(self.eta), self.source)


def from_spheres(
    file: Path | str, uncertainty: float, *, g: float = 0.0, sigma_s_prime: float | None = None
) -> SphereSample:
    """Absorption and reduced scattering of a sample from a file of sphere measurements, with errors.

    M_R and M_T give sigma_a and sigma_s' for a stated g; M_U > 0, the unscattered part, gives g too. M_R alone tells
    the reduced albedo of a thick sample, and the coefficients only with `sigma_s_prime`.

    Args:
        file: an `.rxt` file.
        uncertainty: standard deviation of M_R and M_T, in units of 1, which the files do not state.
        g: mean cosine where the file does not tell it, (-1, 1).
        sigma_s_prime: reduced scattering where only M_R is given, 1/mm.

    Raises:
        ValueError: the file cannot be read (names it and the line), its readings are not corrected for spheres, or a
            value is out of range.
    """
    check_interval("uncertainty", uncertainty, 1e-9, 1.0)
    check_interval("g", g, -0.99, 0.99)
    data = read_spheres(file)
    if "M_T" not in data.rows and sigma_s_prime is None:
        raise ValueError(f"{Path(file).name}: sigma_s_prime must be given where M_R alone is measured, got None")
    start, found = None, []
    for k in range(len(data.wavelengths)):
        row = {name: float(values[k]) for name, values in data.rows.items()}
        found.append(_fit(_Wavelength(data, row, g, sigma_s_prime), uncertainty, start))
        start = found[-1][:2]
    columns = np.array(found).T
    return SphereSample(data.wavelengths, *columns, data.eta, Path(file).name)


class _Wavelength:
    """The readings of a wavelength, and what a medium would give for them."""

    def __init__(self, data: SphereFile, row: dict[str, float], g: float, sigma_s_prime: float | None) -> None:
        self.data, self.row, self.g, self.sigma_s_prime = data, row, g, sigma_s_prime
        self.given = np.array([row[name] for name in ("M_R", "M_T") if name in row])
        self.sigma_t = self._extinction() if row.get("M_U", 0.0) > 0 else None

    def _extinction(self) -> float:
        """Of M_U = T² x / (1 - F² x²), x = exp(-tau), the root in x."""
        clear = slab_fluxes(0.0, 0.0, 1e-9, self.data.eta, self.data.eta_slide, NODES)
        # of a clear slab R + T = 1 and T = (1 - F) / (1 + F)
        F = (1 - clear.unscattered) / (1 + clear.unscattered)
        T2, U = (1 - F) ** 2, self.row["M_U"]
        x = 2 * U / (T2 + math.sqrt(T2 * T2 + 4 * (U * F) ** 2))
        return max(-math.log(min(x, 1.0)), 1e-9) / self.data.thickness

    def coefficients(self, x: np.ndarray) -> tuple[float, float, float]:
        """sigma_a, sigma_s' and g of the free variables, which are roots of coefficient times thickness."""
        d = self.data.thickness
        sigma_a = x[0] ** 2 / d
        sigma_s_prime = self.sigma_s_prime if len(x) == 1 else x[1] ** 2 / d
        if self.sigma_t is None:
            return sigma_a, sigma_s_prime, self.g
        g = 1 - sigma_s_prime / max(self.sigma_t - sigma_a, 1e-12)
        return sigma_a, sigma_s_prime, min(max(g, -0.95), 0.95)

    def readings(self, x: np.ndarray) -> np.ndarray:
        """M_R and M_T as far as they are given."""
        sigma_a, sigma_s_prime, g = self.coefficients(x)
        sigma_s = sigma_s_prime / (1 - g)
        sigma_t, data = max(sigma_a + sigma_s, 1e-9), self.data
        thickness = data.thickness if "M_T" in self.row else 1e3 / sigma_t  # without M_T the sample counts as thick
        slab = slab_fluxes(min(sigma_s / sigma_t, 1.0), g, sigma_t * thickness, data.eta, data.eta_slide, NODES)
        return np.array([slab.reflectance, slab.transmittance])[: len(self.given)]


def _fit(row: _Wavelength, uncertainty: float, start: tuple[float, float] | None) -> tuple[float, ...]:
    """sigma_a, sigma_s', g, both errors and the residual."""
    from scipy.optimize import least_squares

    d, n = row.data.thickness, 1 if row.sigma_s_prime is not None and "M_T" not in row.row else 2
    guesses = [(0.1, 1.0), (1.0, 4.0), (0.05, 10.0), (2.0, 0.5)]
    if row.sigma_t is not None:
        guesses = [(0.1, 0.02 * row.sigma_t * d), *guesses]
    if start is not None:
        guesses = [(start[0] * d, start[1] * d), *guesses]

    def residual(x: np.ndarray) -> np.ndarray:
        return (row.readings(x) - row.given) / uncertainty

    fit = None
    for guess in guesses:
        x = np.sqrt(np.clip(guess[:n], 1e-4, LARGEST))
        trial = least_squares(residual, x, bounds=(0.0, math.sqrt(LARGEST)), diff_step=1e-4)
        fit = trial if fit is None or trial.cost < fit.cost else fit
        if fit.cost < 1e-4:
            break
    sigma_a, sigma_s_prime, g = row.coefficients(fit.x)
    # errors by derivatives of the coefficients themselves, for roots have none at 0
    steps = np.maximum(1e-3 * fit.x**2, 1e-5)
    J = np.stack([residual(np.sqrt(fit.x**2 + step)) - fit.fun for step in np.diag(steps)], axis=1) / steps
    errors = np.zeros(2)
    errors[:n] = np.sqrt(np.diag(np.linalg.pinv(J.T @ J))) / d
    return sigma_a, sigma_s_prime, g, *errors, float(np.sqrt(np.mean(fit.fun**2)))


def read_spheres(file: Path | str) -> SphereFile:
    """Read an `.rxt` file of the format IAD1; what follows # is a comment.

    Raises:
        ValueError: names the file and the line that cannot be read.
    """
    path = Path(file)
    lines = _lines(read_text(path))
    if next(lines, (0, ""))[1] != "IAD1":
        raise ValueError(f"{path.name}: the first line must be IAD1")
    head, kind, table = [], None, []
    for number, line in lines:
        try:
            values = [float(v) for v in line.split()]
        except ValueError as error:
            raise ValueError(f"{path.name}, line {number}: must be numbers, got {line!r}") from error
        if len(head) < HEADER + 1:
            head += values
            continue
        kind = KINDS.get(int(head[HEADER]))
        if kind is None or len(values) - len(kind) not in (0, 1):
            raise ValueError(f"{path.name}, line {number}: must have the readings of one of {KINDS}, got {line!r}")
        table.append(values if len(values) > len(kind) else [len(table) + 1.0, *values])
    if not table:
        raise ValueError(f"{path.name}: rows of readings must follow {HEADER + 1} numbers, got {len(head)}")
    columns = np.array(table).T
    for name, value in (("index", head[0]), ("thickness", head[2])):
        check_interval(f"{path.name}: {name}", value, 1e-6 if name == "thickness" else 1.0, 1e6)
    if head[6] != 0:
        raise ValueError(f"{path.name}: number of spheres must be 0, of corrected readings, got {head[6]:g}")
    slide = head[1] if head[3] > 0 else 1.0
    return SphereFile(head[0], slide, head[2], columns[0], dict(zip(kind, columns[1:])))


def _lines(text: str) -> Iterator[tuple[int, str]]:
    """Lines that hold more than a comment, with their numbers."""
    for number, line in enumerate(text.splitlines(), 1):
        if content := line.partition("#")[0].strip():
            yield number, content
