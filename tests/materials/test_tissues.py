"""Tissue after Jacques: chromophores against SIMPA, the scattering formula, published tissues, skin in layers."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import trace
from halfspace_sss.materials import published_tissue, skin, tissue
from halfspace_sss.materials.tissues import MELANOSOMES, TISSUES

# 1/cm by SIMPA 1.0.0 (MIT), rounded there to three digits or fewer
SIMPA = [
    ({"blood": 1.0, "oxygenation": 1.0}, [(450, 336), (500, 112), (700, 1.55), (800, 4.37), (1000, 5.48)], 0.01),
    ({"blood": 1.0, "oxygenation": 0.0}, [(450, 553), (500, 112), (700, 9.61), (800, 4.08), (1000, 1.11)], 0.01),
    ({"melanosomes": 1.0}, [(450, 965), (500, 679), (700, 221), (800, 142), (1000, 67.5)], 0.01),
    ({"baseline": True}, [(450, 1.21919), (500, 0.702217), (700, 0.266336), (1000, 0.24424)], 1e-4),
    ({"fat": 1.0}, [(450, 0.06375), (500, 0.01906), (700, 0.00323), (1000, 0.02654)], 1e-3),
    ({"water": 1.0}, [(700, 0.006), (800, 0.02), (1000, 0.36)], 0.05),
]


@pytest.mark.parametrize(("parts", "values", "tolerance"), SIMPA)
def test_what_tissue_is_made_of_absorbs_as_in_simpa(parts: dict, values: list, tolerance: float) -> None:
    nm, per_cm = np.array(values).T
    found = tissue(1.0, 0.0, 1.0, **parts, wavelengths=nm)
    np.testing.assert_allclose(10 * found.sigma_a, per_cm, rtol=tolerance)


def test_parts_add_up_by_their_volume() -> None:
    nm = [500.0, 600.0, 900.0]
    fractions = {"blood": 0.02, "water": 0.6, "fat": 0.1, "melanosomes": 0.03}
    whole = tissue(1.0, 0.0, 1.0, **fractions, oxygenation=0.6, wavelengths=nm).sigma_a
    parts = [tissue(1.0, 0.0, 1.0, **{k: v}, oxygenation=0.6, wavelengths=nm).sigma_a for k, v in fractions.items()]
    np.testing.assert_allclose(whole, np.sum(parts, axis=0), rtol=1e-12)


def test_reduced_scattering_is_the_sum_of_both_powers() -> None:
    spectra = tissue(2.0, 0.3, 1.2, g=0.8, wavelengths=[500.0, 1000.0])
    np.testing.assert_allclose(spectra.sigma_s * (1 - spectra.g), [2.0, 2.0 * (0.3 / 16 + 0.7 * 2**-1.2)], rtol=1e-12)


@pytest.mark.parametrize("kind", TISSUES)
def test_published_tissues_say_where_they_come_from_and_scatter(kind: str) -> None:
    found = published_tissue(kind)
    assert found.source and np.all(found.spectra.sigma_s > 0) and np.all(found.spectra.sigma_a >= 0)
    low, high = found.spectra.wavelengths[[0, -1]]
    medium = found.spectra.medium([max(low, 550.0), min(high, 800.0)])
    assert np.all((medium.reflectance() > 0) & (medium.reflectance() < 1))


def test_blood_is_red() -> None:
    R = published_tissue("blood").spectra.medium([470, 540, 650]).reflectance()
    assert R[2] > 5 * R[0] and R[2] > 5 * R[1]


@pytest.mark.slow
def test_skin_gets_darker_from_type_to_type_most_in_the_blue() -> None:
    nm = (450.0, 550.0, 650.0)
    R = np.array(
        [[trace(skin(k).layers(w), "diffuse", 20_000, 1).reflectance().value for w in nm] for k in MELANOSOMES]
    )
    assert np.all(np.diff(R, axis=0) < 0) and np.all(np.diff(R, axis=1) > 0)
    assert R[0, 2] > 0.4 and R[5, 2] < 0.2


@pytest.mark.parametrize("kind", ["I", "II"])
def test_melanin_of_light_skin_absorbs_at_694_nm_as_was_measured(kind: str) -> None:
    """300 to 1200 / m (to one digit) in the epidermis of Caucasian and Asian skin.

    Source: Skin pigmentation characterized by visible reflectance measurements, UC Irvine.
    """
    found = tissue(1.0, 0.0, 1.0, melanosomes=MELANOSOMES[kind], wavelengths=[694.0, 700.0]).sigma_a[0]
    assert 0.29 < found < 1.2


@pytest.mark.slow
def test_skin_without_melanosomes_would_be_its_dermis() -> None:
    """A thin epidermis of nearly the same medium changes little: the layers meet the exact half-space."""
    kind = skin("I", thickness=1e-6)
    R = trace(kind.layers(600), 1.0, 200_000, 3).reflectance()
    assert abs(R.value - kind.dermis.medium(600.0).reflectance(1.0)) < 4 * R.standard_error


BAD = [
    ({"blood": 1.5}, r"blood must be a number in \[0, 1\], got 1.5"),
    ({"oxygenation": -0.1}, "oxygenation must be a number in"),
    ({"melanosomes": float("nan")}, "melanosomes must be a number in"),
    ({"wavelengths": [240.0, 500.0]}, r"wavelengths must be in \[250, 1000\] nm, which the tables cover, got 240"),
    (
        {"fat": 0.1, "wavelengths": [400.0, 500.0]},
        r"must be in \[450, 1000\] nm, which the table of fat covers, got 400",
    ),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_tissue_out_of_range_is_refused(arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tissue(1.0, 0.0, 1.0, **arguments)


def test_unknown_tissues_and_types_of_skin_are_refused() -> None:
    with pytest.raises(ValueError, match="tissue must be one of blood, fat"):
        published_tissue("liver")
    with pytest.raises(ValueError, match="kind must be one of I, II, III, IV, V, VI, got 'VII'"):
        skin("VII")
