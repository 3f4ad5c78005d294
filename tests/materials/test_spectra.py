"""Media by wavelength: interpolation, both conventions of RGB, files and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.materials import SpectralMedium, read_spectra

NM = np.arange(380.0, 781.0, 5.0)


def skin_like() -> SpectralMedium:
    """Scattering that falls, and an absorption band in the green."""
    band = 0.3 * np.exp(-(((NM - 545) / 40) ** 2)) + 0.5 * np.exp(-(((NM - 420) / 25) ** 2))
    return SpectralMedium(NM, 20 * (NM / 500) ** -1.2, 0.02 + band, 0.8, 1.4)


def grey(albedo: float) -> SpectralMedium:
    return SpectralMedium(NM, 10 * albedo, 10 * (1 - albedo), 0.3, 1.3)


def test_a_medium_has_a_channel_for_each_wavelength_linear_between() -> None:
    spectra = SpectralMedium([400, 500, 700], [1.0, 2.0, 4.0], [0.1, 0.3, 0.1], [0.0, 0.5, 0.9], [1.3, 1.4, 1.6])
    medium = spectra.medium([450, 600])
    assert np.allclose(medium.sigma_s, [1.5, 3.0]) and np.allclose(medium.sigma_a, [0.2, 0.2])
    assert np.allclose(medium.g, [0.25, 0.7]) and medium.eta == pytest.approx(1.425)
    assert spectra.medium(600.0).eta == pytest.approx(1.5) and spectra.medium(600.0).n_channels is None


def test_the_observer_sees_d65_as_white() -> None:
    """Chromaticity of D65 for the observer of 1931: x = 0.3127, y = 0.3290 (CIE 15)."""
    from halfspace_sss.materials.spectra import XYZ_TO_RGB, _observer

    X, Y, Z = _observer()[1].sum(axis=1)
    assert X / (X + Y + Z) == pytest.approx(0.3127, abs=1e-4) and Y / (X + Y + Z) == pytest.approx(0.3290, abs=1e-4)
    assert np.allclose(XYZ_TO_RGB @ np.array([X, Y, Z]) / Y, 1, atol=2e-3)


@pytest.mark.parametrize("albedo", [0.5, 0.99])
def test_a_grey_spectrum_is_the_same_grey_in_rgb_by_both_conventions(albedo: float) -> None:
    spectra = grey(albedo)
    R = Medium.from_albedo(albedo, 10.0, 0.3, 1.3).reflectance()
    for found in (spectra.to_rgb(), spectra.to_rgb([610, 550, 465])):
        assert np.allclose(found.spectral_reflectance, R, rtol=1e-9) and np.allclose(found.reflectance, R, rtol=1e-4)
        assert np.allclose(found.medium.sigma_t, 10.0, rtol=1e-9)


def test_the_rgb_medium_reflects_the_colour_of_the_spectrum_under_d65() -> None:
    found = skin_like().to_rgb()
    assert np.abs(found.difference).max() < 1e-5
    R, G, B = found.reflectance
    assert R > G and R > B  # blood-like bands take green and blue


def test_three_wavelengths_differ_from_the_colour_and_say_by_how_much() -> None:
    found = skin_like().to_rgb([610, 550, 465])
    assert np.allclose(found.reflectance, skin_like().medium([610, 550, 465]).reflectance())
    assert 0.01 < np.abs(found.difference).max() < 0.2
    assert str(found).count("0.") == 6 and "under D65" in str(found)


def test_a_file_comes_back_in_both_units(tmp_path: Path) -> None:
    path = tmp_path / "skin.csv"
    path.write_text("# measured\nwavelength, mu_a, mu_s, g, n\n400, 5, 200, 0.8, 1.4\n700, 1, 100, 0.9, 1.38\n")
    per_cm, per_mm = read_spectra(path, "1/cm"), read_spectra(path, "1/mm")
    assert np.allclose(per_cm.sigma_s, [20, 10]) and np.allclose(per_mm.sigma_a, [5, 1])
    assert np.allclose(per_mm.g, [0.8, 0.9]) and np.allclose(per_mm.n, [1.4, 1.38]) and str(path) in per_mm.source


@pytest.mark.parametrize("column", ["mu_s'", "mu_s_prime"])
def test_a_column_of_reduced_scattering_is_read_by_its_own_name(column: str, tmp_path: Path) -> None:
    path = tmp_path / "skin.csv"
    path.write_text(f"wavelength,mu_a,{column},g,n\n400,.5,4,0.8,1.4\n700,.1,1,0.9,1.4\n")
    assert np.allclose(read_spectra(path).sigma_s, [20, 10])
    path.write_text(f"wavelength,mu_a,{column},mu_s,g,n\n400,.5,4,20,0.8,1.4\n700,.1,1,10,0.9,1.4\n")
    with pytest.raises(ValueError, match="columns must be wavelength, mu_a, mu_s, g, n, or mu_s' for mu_s, got"):
        read_spectra(path)


def test_coefficients_that_no_tissue_has_are_told_where_no_unit_was_given(tmp_path: Path) -> None:
    """Skin of Jacques 2013 in 1/cm: sigma_s' = 46 (l / 500 nm)^-1.421."""
    path, lines = tmp_path / "skin.csv", ["wavelength,mu_a,mu_s',g,n"]
    path.write_text("\n".join(lines + [f"{nm},.5,{46 * (nm / 500) ** -1.421},0.8,1.4" for nm in (400, 500, 600, 700)]))
    with pytest.warns(UserWarning, match=r"no tissue has mu_s' = 43\.3 1/mm .* need unit '1/cm'"):
        wrong = read_spectra(path)
    assert np.allclose(read_spectra(path, "1/mm").sigma_s, wrong.sigma_s)  # asked for by name: no warning
    assert np.allclose(read_spectra(path, "1/cm").sigma_s, wrong.sigma_s / 10)


FILES = [
    ("wavelength,mu_a,mu_s,g\n400,1,1,0\n", "columns must be wavelength, .*, or mu_s' for mu_s, got"),
    ("", "columns must be .* got none"),
    ("wavelength,mu_a,mu_s,g,n\n400,1,x,0,1\n500,1,1,0,1\n", "row 1: mu_s must be a number, got 'x'"),
    ("wavelength,mu_a,mu_s,g,n\n400,1,1,0\n", "row 1: n must be a number, got None"),
    ("wavelength,mu_a,mu_s,g,n\n400,nan,1,0,1\n500,1,1,0,1\n", "sigma_a must be finite"),
    ("wavelength,mu_a,mu_s,g,n\n400,1,-2,0,1\n500,1,1,0,1\n", "sigma_s must be >= 0.* got -2 at 400 nm"),
    ("wavelength,mu_a,mu_s,g,n\n400,1,1,1,1\n500,1,1,0,1\n", "g must be in the open interval .* got 1 at 400 nm"),
    ("wavelength,mu_a,mu_s,g,n\n400,1,1,0,0\n500,1,1,0,1\n", "n must be > 0, got 0 at 400 nm"),
    ("wavelength,mu_a,mu_s,g,n\n500,1,1,0,1\n400,1,1,0,1\n", "wavelengths must be ascending, got 400"),
    ("wavelength,mu_a,mu_s,g,n\n500,1,1,0,1\n", "wavelengths must be two or more"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), FILES)
def test_files_that_hold_no_spectra_are_refused_with_row_and_column(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=f"bad.csv.*{message}"):
        read_spectra(path)


def test_a_file_that_is_not_there_and_a_unit_that_is_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="must be a readable CSV file"):
        read_spectra(tmp_path / "none.csv")
    with pytest.raises(ValueError, match="unit must be one of 1/mm, 1/cm, got '1/m'"):
        read_spectra(tmp_path / "none.csv", "1/m")


def test_wavelengths_that_the_spectra_do_not_cover_are_refused() -> None:
    green = SpectralMedium([500, 600], 1.0, 0.1, 0.0, 1.3)
    with pytest.raises(ValueError, match=r"must be in \[500, 600\] nm, which the spectra cover, got 650"):
        green.medium([550, 650])
    with pytest.raises(ValueError, match=r"must be in \[500, 600\] nm.*got 400"):
        green.to_rgb()
    with pytest.raises(ValueError, match="must be three, of R, G and B"):
        skin_like().to_rgb([500, 600])
    with pytest.raises(ValueError, match=r"sigma_s must have 2 values.*\(3,\)"):
        SpectralMedium([500, 600], [1, 2, 3], 0.1, 0.0, 1.3)


def test_spectra_come_back_from_a_csv_file_with_all_digits(tmp_path: Path) -> None:
    written = SpectralMedium([400.0, 550.5, 700.0], [2 / 3, 1.0, 0.1], [0.0, 1e-7, 3.0], 0.85, 1.37, "a lab")
    written.to_csv(tmp_path / "a.csv")
    read = read_spectra(tmp_path / "a.csv", "1/mm")
    for name in ("wavelengths", "sigma_s", "sigma_a", "g", "n"):
        assert np.array_equal(getattr(read, name), getattr(written, name)), name
