"""Optical properties of tissue from what it is made of, after Jacques.

    sigma_s' = a' [f (l / 500 nm)^-4 + (1 - f) (l / 500 nm)^-b],
    sigma_a = B (S mu_oxy + (1 - S) mu_deoxy) + W mu_water + F mu_fat + M mu_melanosome + (1 - M) mu_baseline,

with the volume fractions of blood B, water W, fat F and melanosomes M, and the oxygenation S. Haemoglobin: 150 g/l of
64500 g/mol in whole blood, mu = ln(10) extinction concentration. In mm and nm, mu_melanosome = 6.6e10 l^-3.33 and
mu_baseline = 0.0244 + 8.53 exp(-(l - 154) / 66.2) (bloodless skin; only where asked for).

Source: S. L. Jacques, Optical properties of biological tissues: a review, Phys. Med. Biol. 58 (2013) R37-R61;
melanosomes, baseline and fractions of melanosomes: S. L. Jacques, Skin optics, Oregon Medical Laser Center News (1998).
Tables: `data/hemoglobin.csv`, `data/water.csv` and `data/fat.csv`, each with its source and licence.
"""

from __future__ import annotations

import functools
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import resources

import numpy as np

from halfspace_sss.checks import check_choice, check_interval
from halfspace_sss.materials.spectra import SpectralMedium
from halfspace_sss.physics.medium import Layers

HAEMOGLOBIN = 150 / 64500  # mol/l in whole blood
EPIDERMIS_MM = 0.06
RANGE, FAT_RANGE = (250.0, 1000.0), (450.0, 1000.0)  # nm, of the tables
STEP = 2.0  # nm, of the table of haemoglobin


@functools.cache
def _table(name: str) -> np.ndarray:
    text = resources.files("halfspace_sss.materials").joinpath(f"data/{name}.csv").read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.startswith("#")][1:]
    return np.loadtxt(io.StringIO("\n".join(lines)), delimiter=",").T


def tissue(
    a_prime: float,
    f_rayleigh: float,
    b_mie: float,
    *,
    blood: float = 0.0,
    oxygenation: float = 0.75,
    water: float = 0.0,
    fat: float = 0.0,
    melanosomes: float = 0.0,
    baseline: bool = False,
    g: float | Callable[[np.ndarray], np.ndarray] = 0.9,
    n: float = 1.4,
    wavelengths: Sequence[float] | None = None,
) -> SpectralMedium:
    """The spectra of a tissue by the formulas of this module.

    Args:
        a_prime: sigma_s' at 500 nm, 1/mm (tables of Jacques are in 1/cm).
        f_rayleigh: share of Rayleigh scattering at 500 nm, [0, 1].
        b_mie: power of Mie scattering, [0, 4].
        blood, water, fat, melanosomes: volume fractions, [0, 1].
        oxygenation: of the blood, [0, 1].
        baseline: whether to add the absorption of bloodless skin.
        g: mean cosine, a number or a function of wavelengths in nm.
        n: index over that of the outside.
        wavelengths: nm; every 2 nm of the covered range if None.

    The tables cover 250 to 1000 nm, that of fat 450 to 1000 nm.

    Raises:
        ValueError: a number is out of range, or a wavelength is outside the tables of what the tissue has.
    """
    check_interval("a_prime", a_prime, 0.0, 1e6)
    check_interval("b_mie", b_mie, 0.0, 4.0)
    fractions = {"f_rayleigh": f_rayleigh, "blood": blood, "oxygenation": oxygenation, "water": water, "fat": fat}
    for name, value in {**fractions, "melanosomes": melanosomes}.items():
        check_interval(name, value, 0.0, 1.0)
    low, high = FAT_RANGE if fat else RANGE
    given = None if wavelengths is None else np.atleast_1d(np.asarray(wavelengths, dtype=np.float64))
    nm = np.arange(low, high + STEP / 2, STEP) if given is None else given
    outside = nm[~((nm >= low) & (nm <= high))]
    if len(outside):
        what = "which the table of fat covers" if fat else "which the tables cover"
        raise ValueError(f"wavelengths must be in [{low:g}, {high:g}] nm, {what}, got {outside[0]:g}")
    scattering = a_prime * (f_rayleigh * (nm / 500) ** -4 + (1 - f_rayleigh) * (nm / 500) ** -b_mie)
    known, oxy, deoxy = _table("hemoglobin")
    mixed = np.interp(nm, known, oxygenation * oxy + (1 - oxygenation) * deoxy)
    absorption = blood * (math.log(10) * HAEMOGLOBIN / 10 * mixed)
    absorption = absorption + water * (4 * np.pi * np.interp(nm, *_table("water")) / (nm * 1e-6))
    absorption = absorption + melanosomes * (6.6e10 * nm**-3.33)
    skin = (1 - melanosomes) * (0.0244 + 8.53 * np.exp(-(nm - 154) / 66.2)) if baseline else 0.0
    absorption += (fat * (np.interp(nm, *_table("fat")) / 10) if fat else 0.0) + skin
    cosine = np.broadcast_to(g(nm) if callable(g) else g, nm.shape)
    return SpectralMedium(nm, scattering / (1 - cosine), absorption, cosine, n, source="Jacques 2013")


@dataclass(frozen=True)
class Tissue:
    """A published tissue.

    Attributes:
        spectra: by wavelength, from `tissue` where nothing else is said.
        ranges: published ranges of its parameters, by name.
        source: of the numbers.
        assumptions: what was not published and which value was taken.
    """

    spectra: SpectralMedium
    ranges: dict[str, tuple[float, float]]
    source: str
    assumptions: tuple[str, ...] = ()


def _skin_g(wavelengths: np.ndarray) -> np.ndarray:
    """Mean cosine of skin, 0.62 + 0.29e-3 l / nm (van Gemert et al. 1989)."""
    return 0.62 + 0.29e-3 * wavelengths


_MAKERS: dict[str, Callable[[], Tissue]] = {
    "blood": lambda: Tissue(
        tissue(2.2, 0.0, 0.66, blood=1.0, oxygenation=0.98, water=0.55, g=0.98, n=1.4),
        {"oxygenation": (0.6, 1.0)},
        "Jacques 2013, table 1 (Alexandrakis et al. 2005)",
        ("g: 0.98", "water: plasma, 55 %", "n: 1.4"),
    ),
    "fat": lambda: Tissue(
        tissue(1.93, 0.174, 0.447, fat=1.0, g=0.9, n=1.44),
        {},
        "Jacques 2013, table 2 (fatty tissue)",
        ("pure fat without blood", "n: 1.44"),
    ),
    "soft tissue": lambda: Tissue(
        tissue(1.91, 0.153, 1.091, blood=0.01, water=0.68, g=0.9),
        {},
        "Jacques 2013, table 2 (other soft tissue)",
        ("blood: 1 %", "oxygenation: 0.75", "water: 68 % (Forbes et al. 1953)"),
    ),
    "brain": lambda: Tissue(
        tissue(2.42, 0.0, 1.611, blood=0.027, oxygenation=0.75, water=0.75, g=0.9),
        {"blood": (0.0117, 0.0375)},
        "Jacques 2013, table 2 (brain: a = 24.2 / cm, b = 1.611) and table 3 (blood)",
        ("oxygenation: 0.75", "water: 75 %"),
    ),
    "breast": lambda: Tissue(
        tissue(1.68, 0.0, 1.055, blood=0.0146, oxygenation=0.68, water=0.35, fat=0.37, g=0.9),
        {"blood": (0.0107, 0.0185), "oxygenation": (0.60, 0.76), "water": (0.3, 0.4)},
        "Jacques 2013, table 2 (breast: a = 16.8 / cm, b = 1.055); blood: Durduran et al. 2002 (34 ± 9 uM, 68 ± 8 %); "
        "water and fat: Shah et al. 2004, premenopausal",
        (),
    ),
    "dentine": lambda: Tissue(
        SpectralMedium([543, 632, 1053], [28.0, 28.0, 26.0], 0.35, 0.93, 1.54, source="Fried et al. 1995"),
        {"sigma_a": (0.3, 0.4)},
        "D. Fried, R. E. Glena, J. D. B. Featherstone and W. Seka, Appl. Opt. 34, 1278-1285 (1995), 543 to 1053 nm",
        ("sigma_a: middle of the range", "n: 1.54"),
    ),
}
TISSUES = tuple(_MAKERS)
# of the epidermis (Jacques 1998): light skin 1.3 to 6.3 %, moderately pigmented 11 to 16 %, dark 18 to 43 %
MELANOSOMES = {"I": 0.013, "II": 0.038, "III": 0.063, "IV": 0.135, "V": 0.18, "VI": 0.43}


def published_tissue(name: str) -> Tissue:
    """A published tissue: blood, fat, soft tissue, brain, breast or dentine. Skin has layers: `skin`.

    Raises:
        ValueError: no such tissue; the message names those there are.
    """
    check_choice("tissue", name, TISSUES)
    return _MAKERS[name]()


@dataclass(frozen=True)
class Skin:
    """Epidermis on dermis.

    Attributes:
        epidermis, dermis: their spectra.
        thickness: of the epidermis, mm.
        assumptions: what was not published and which value was taken.
    """

    epidermis: SpectralMedium
    dermis: SpectralMedium
    thickness: float
    assumptions: tuple[str, ...]

    def layers(self, wavelength: float) -> Layers:
        """Both at one wavelength (nm), the dermis semi-infinite; for `trace`."""
        if np.ndim(wavelength):
            raise ValueError(f"wavelength must be one number (nm), as layers have no channels, got {wavelength!r}")
        media = [spectra.medium(float(wavelength)) for spectra in (self.epidermis, self.dermis)]
        return Layers(media, [self.thickness])


def skin(kind: str, *, blood: float = 0.002, oxygenation: float = 0.75, thickness: float = EPIDERMIS_MM) -> Skin:
    """Skin of one of the six types of Fitzpatrick, I to VI.

    Scattering of epidermis (6.67 / mm, f 0.29, b 0.689) and dermis (4.36 / mm, f 0.41, b 0.562): Salomatina et al. 2006
    in table 1 of Jacques 2013; g: van Gemert et al. 1989; blood of the dermis (0.2 %) and baseline: Jacques 1998.
    Melanosomes of the epidermis: ends and middles of the ranges of Jacques 1998, spread over the types. At 694 nm types
    I and II absorb the 0.3 to 1.2 / mm that was measured in light skin; V and VI have 4 and 10 / mm, while 2.5 was
    measured in dark skin.

    Args:
        kind: "I" to "VI".
        blood, oxygenation: of the dermis, [0, 1].
        thickness: of the epidermis, mm.

    Raises:
        ValueError: no such type, or a number is out of range.
    """
    check_choice("kind", kind, MELANOSOMES)
    check_interval("thickness", thickness, 1e-6, 1e3)
    M = MELANOSOMES[kind]
    return Skin(
        tissue(6.67, 0.29, 0.689, melanosomes=M, baseline=True, water=0.65 * (1 - M), g=_skin_g),
        tissue(4.36, 0.41, 0.562, blood=blood, oxygenation=oxygenation, baseline=True, water=0.65, g=_skin_g),
        thickness,
        (f"melanosomes: {100 * M:g} %", "water: 65 %", f"oxygenation: {oxygenation:g}", "n: 1.4, no step between both"),
    )
