"""Coefficients from integrating-sphere readings, and the slab solver below them."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss.materials import from_spheres
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.physics.reflectance import half_space_reflectance, slab_fluxes

HEAD = (
    "IAD1 # as in the tests of iadpython\n\n{eta} # index\n{slide}\n1.0 # mm\n1.0\n5.0\n0.96\n{spheres} # spheres\n"
    + 2 * "203.2\n25.4\n12.7\n1.0\n0.96\n"
    + "{kind}\n#lambda\n"
)
UNCERTAINTY = 0.002  # at which iad's own quadrature of eight points, 1e-3 in M_R, lies within the errors
# readings, and sigma_a, sigma_s', g as iad found them (iadpython, MIT licence: basic-B, basic-C, basic-D, sample-A)
B = [("0.5148573445 0.1959644572", 0.1006, 4.9842), ("0.3990923512 0.0156151639", 0.5024, 9.9630),
     ("0.4487541006 0.0001916681754", 0.9041, 24.8962)]  # fmt: skip
C = [("0.1874440456 0.5762005443 0.0056059263", 0.1007, 0.5035),
     ("0.1633374780 0.2987243441 3.0925399e-5", 0.3025, 0.9969),
     ("0.1969789331 0.1029811332 7.7451909e-12", 0.5036, 2.4875)]  # fmt: skip
D = [("4.20236699283e-2 1.91254597157e-2", 3.2256, 0.7753), ("2.14577898383e-1 7.13708102703e-2", 0.6280, 3.3933),
     ("6.29535913467e-1 3.70464086533e-1", 0.0, 4.0422)]  # fmt: skip
A = [("800 0.16830 0.24974", 0.4509, 1.2995), ("900 0.16201 0.23465", 0.4919, 1.3117),
     ("1000 0.28689 0.42759", 0.1215, 1.3129)]  # fmt: skip


def write(folder, rows: list[str], eta: float = 1.4, slide: float = 1.5, kind: int = 2, spheres: int = 0):
    file = folder / "sample.rxt"
    head = HEAD.format(eta=eta, slide=slide, kind=kind, spheres=spheres)
    file.write_text(head + "\n".join(rows) + "\n", encoding="utf-8")
    return file


@pytest.mark.parametrize(
    ("rows", "how"),
    [(B, {}), (C, {"kind": 3}), (D, {"slide": 1.0}), (A, {"eta": 1.34})],
    ids=["glass", "unscattered", "bare", "sample"],
)
def test_coefficients_are_those_of_iad_within_the_errors(tmp_path, rows, how):
    found = from_spheres(write(tmp_path, [row[0] for row in rows], **how), UNCERTAINTY)
    assert found.residual.max() < 1e-3
    for k, (_, sigma_a, sigma_s_prime) in enumerate(rows):
        assert abs(found.sigma_a[k] - sigma_a) < found.sigma_a_error[k]
        assert abs(found.sigma_s_prime[k] - sigma_s_prime) < found.sigma_s_prime_error[k]
    assert np.allclose(found.g, 0.9 if how.get("kind") == 3 else 0.0, atol=2e-3)


def test_coefficients_that_made_the_readings_come_back(tmp_path):
    found = from_spheres(write(tmp_path, [row[0] for row in B]), UNCERTAINTY)
    np.testing.assert_allclose(found.sigma_a, [0.1, 0.5, 0.9], rtol=3e-4)
    np.testing.assert_allclose(found.sigma_s_prime, [5.0, 10.0, 25.0], rtol=3e-4)


def test_errors_are_those_of_the_readings(tmp_path):
    """A reading moved by its uncertainty moves the coefficients by their part of the error."""
    asked, moved = [0.30, 0.20], []
    for step in (np.zeros(2), np.array([0.001, 0.0]), np.array([0.0, 0.001])):
        moved.append(from_spheres(write(tmp_path, ["{} {}".format(*(asked + step))]), 0.001, g=0.5))
    for name in ("sigma_a", "sigma_s_prime"):
        value, *others = (float(getattr(m, name)[0]) for m in moved)
        expected = float(getattr(moved[0], name + "_error")[0])
        assert np.hypot(*(o - value for o in others)) == pytest.approx(expected, rel=0.03)


def test_reflectance_alone_gives_the_albedo_of_a_thick_sample(tmp_path):
    file = write(tmp_path, ["800 0.16830", "1000 0.28689"], eta=1.34, kind=1)
    found = from_spheres(file, UNCERTAINTY, sigma_s_prime=1.0)
    np.testing.assert_allclose(found.sigma_a, [0.3578, 0.1256], rtol=0.01)  # as iad, basic-B
    with pytest.raises(ValueError, match="sigma_s_prime must be given where M_R alone"):
        from_spheres(file, UNCERTAINTY)


def test_spectra_of_a_sample_are_its_medium_by_wavelength(tmp_path):
    found = from_spheres(write(tmp_path, [row[0] for row in A], eta=1.34), UNCERTAINTY, g=0.8)
    medium = found.spectra.medium(900)
    assert medium.sigma_a == pytest.approx(found.sigma_a[1]) and medium.eta == 1.34 and medium.g == pytest.approx(0.8)
    assert medium.sigma_s_prime == pytest.approx(found.sigma_s_prime[1])


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"rows": ["0.3 0.2"], "spheres": 1}, "sample.rxt: number of spheres must be 0.*got 1"),
        ({"rows": ["0.3 zero"]}, "sample.rxt, line 22: must be numbers, got '0.3 zero'"),
        ({"rows": ["0.3 0.2"], "kind": 4}, "line 22: must have the readings of one of"),
        ({"rows": []}, "rows of readings must follow"),
        ({"rows": ["0.3 0.2"], "eta": 0.5}, "sample.rxt: index must be .* got 0.5"),
    ],
)
def test_files_that_cannot_be_read_are_refused_with_their_name(tmp_path, how, message):
    with pytest.raises(ValueError, match=message):
        from_spheres(write(tmp_path, **how), UNCERTAINTY)


# van de Hulst 1980 and Wang, Jacques and Zheng 1995, matched slab, to their last digit
def test_the_slab_solver_has_published_values():
    slab = slab_fluxes(0.9, 0.75, 2.0, 1.0)
    assert (slab.reflectance, slab.transmittance) == pytest.approx((0.09739, 0.66096), abs=6e-6)
    assert slab.unscattered == pytest.approx(np.exp(-2))


@pytest.mark.parametrize(
    ("albedo", "g", "tau", "slide"), [(0.9, 0.3, 0.5, 1.5), (0.99, 0.8, 20.0, 1.5), (0.6, 0.0, 4.0, 1.0)]
)
def test_the_slab_solver_agrees_with_adding_doubling(albedo, g, tau, slide):
    iadpython = pytest.importorskip("iadpython")
    coarse, fine = (
        iadpython.Sample(a=albedo, b=tau, g=g, n=1.4, n_above=slide, n_below=slide, quad_pts=n).rt() for n in (24, 40)
    )
    slab = slab_fluxes(albedo, g, tau, 1.4, slide)
    for k, value in enumerate((slab.reflectance, slab.transmittance)):
        assert value == pytest.approx(fine[k], abs=5e-5 + 3 * abs(fine[k] - coarse[k]))


def test_a_thick_slab_is_the_half_space_and_a_slab_without_absorption_loses_nothing():
    thick = slab_fluxes(0.9, 0.3, 60.0, 1.4)
    assert thick.reflectance == pytest.approx(half_space_reflectance(0.9, 0.3, 1.4, 1.0) + F_r(1.0, 1.4), abs=1e-7)
    white = slab_fluxes(1.0, 0.5, 3.0, 1.4, 1.5)
    assert white.reflectance + white.transmittance == pytest.approx(1.0, abs=1e-7)
