"""The exact reflectance of the half-space, and the medium that has a wanted one."""

import os
import subprocess
import sys

import numpy as np
import pytest

from benchmarks.truths import read_truths
from halfspace_sss import Medium
from halfspace_sss.physics.reflectance import LARGEST_G, albedo_of_reflectance, half_space_reflectance

EXACT = [t for t in read_truths()[0] if t.measure == "R_d" and t.kind == "exact"]
MEDIA = [(0.0, 1.0), (0.0, 1.3), (0.9, 1.5), (-0.5, 1.33), (0.99, 1.4), (0.3, 0.8)]


def test_the_reflectance_is_that_of_every_exact_row_to_1e_5():
    assert len(EXACT) > 100
    wrong = {}
    for t in EXACT:
        m = t.medium
        found = t.factor * half_space_reflectance(float(m.albedo), float(m.g), m.eta, t.mu_i)
        if abs(found / t.value - 1) > 1e-5:
            wrong[t.id] = found, t.value
    assert not wrong


@pytest.mark.parametrize("g, eta", MEDIA)
def test_without_absorption_all_light_that_enters_comes_back(g, eta):
    entered = half_space_reflectance(1.0, 0.0, eta)
    assert half_space_reflectance(1.0, g, eta) == pytest.approx(entered, rel=1e-10)


@pytest.mark.parametrize("eta", [0.5, 1.0, 1 + 1e-9, 1.0001, 1.001, 1.01, 2.0])
@pytest.mark.parametrize("g", [-LARGEST_G, -0.999, 0.0, 0.999, LARGEST_G])
def test_reflectances_at_the_ends_of_their_arguments_rise_with_the_albedo_to_what_enters(g, eta):
    for mu_i in ("diffuse", 0.01, 1.0):
        albedos = (0.0, 0.5, 1 - 1e-5, 1 - 1e-6, 1 - 1e-7, 1 - 1e-9, 1.0)
        R = [half_space_reflectance(albedo, g, eta, mu_i) for albedo in albedos]
        entered = half_space_reflectance(1.0, 0.0, eta, mu_i)
        assert min(R) >= 0 and np.diff(R).min() >= -1e-9
        assert max(R) <= entered * (1 + 1e-9) and R[-1] == pytest.approx(entered, rel=1e-3)
        assert Medium.from_albedo(1 - 1e-7, 1.0, g, eta).reflectance(mu_i) == R[4]


@pytest.mark.parametrize("g", [0.0, 0.9, 0.98, 0.99])
def test_a_boundary_that_hardly_refracts_is_nearly_none(g):
    for albedo in (0.9, 0.9999):
        for mu_i in ("diffuse", 0.3, 1.0):
            none, hardly = (half_space_reflectance(albedo, g, eta, mu_i) for eta in (1.0, 1 + 1e-8))
            assert hardly == pytest.approx(none, rel=3e-4)


def test_a_black_medium_reflects_nothing():
    assert half_space_reflectance(0.0, 0.5, 1.3, 0.7) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("mu_i", ["diffuse", 1.0, 0.2])
@pytest.mark.parametrize("g, eta", MEDIA)
def test_reflectances_come_back_after_a_round_trip(g, eta, mu_i):
    if eta < 1 and mu_i == 0.2:
        pytest.skip("nothing enters beyond the critical angle")
    wanted = np.array([0.001, 0.01, 0.1, 0.3, 0.6, 0.8, 0.95, 0.9999]) * half_space_reflectance(1.0, g, eta, mu_i)
    medium = Medium.from_reflectance(wanted, 2.0, g, eta, mu_i)
    np.testing.assert_allclose(medium.reflectance(mu_i), wanted, rtol=1e-6)
    assert_albedos_come_back(medium.albedo, g, eta, mu_i)


def assert_albedos_come_back(albedo, g, eta, mu_i):
    """To 1e-6 of the albedo and of 1 - albedo, and to the spacing of numbers at 1."""
    back = albedo_of_reflectance([half_space_reflectance(a, g, eta, mu_i) for a in albedo], g, eta, mu_i)
    smaller = np.minimum(albedo, 1 - albedo)
    assert np.all(np.abs(back - albedo) <= 1e-6 * smaller + 2 * np.finfo(float).eps)


KERNELS = """
import numpy as np
from halfspace_sss.physics.fresnel import C_1
from halfspace_sss.physics.medium import Medium
from halfspace_sss.physics.reflectance import half_space_reflectance
from halfspace_sss.physics.single_scattering import reflectance
for g, eta, mu in ((0.99, 1.4, 0.2), (0.9, 1.5, "diffuse")):
    top = half_space_reflectance(1.0, g, eta, mu)
    medium = Medium.from_reflectance(np.array([0.01, 0.5, 0.9999]) * top, 1.0, g, eta, mu)
    print(*map(float.hex, [top, *medium.albedo_prime, C_1(eta)]))
    print(*map(float.hex, np.ravel(reflectance(Medium.from_albedo(0.9, 1.0, g, eta), 0.7))))
print(*map(float.hex, np.polynomial.legendre.leggauss(96)[0][:4]))
"""


@pytest.mark.slow
def test_results_do_not_depend_on_the_kernels_of_the_linear_algebra():
    def run(kernel):
        environment = os.environ | {"OPENBLAS_CORETYPE": kernel, "OPENBLAS_NUM_THREADS": "1"}
        command = [sys.executable, "-c", KERNELS]
        return subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)

    texts = [process.communicate()[0] for process in [run(kernel) for kernel in ("Haswell", "Prescott")]]
    found, other = ([float.fromhex(v) for v in text.split()] for text in texts)
    assert len(found) == 16
    np.testing.assert_allclose(found, other, rtol=1e-9)


def test_a_colour_and_a_mean_free_path_for_each_channel_are_kept():
    medium = Medium.from_reflectance([0.8, 0.5, 0.0], [2.0, 0.5, 0.1], g=[0.0, 0.5, 0.9], eta=1.4)
    np.testing.assert_allclose(medium.mfp, [2.0, 0.5, 0.1], rtol=1e-12)
    limit = Medium.from_reflectance([0.7, 0.5, 0.2], [2.0, 0.5, 0.0])
    np.testing.assert_allclose(limit.mfp, [2.0, 0.5, 2e-3], rtol=1e-12)
    np.testing.assert_allclose(medium.reflectance(), [0.8, 0.5, 0.0], rtol=1e-6, atol=1e-9)


def test_one_colour_gives_a_scalar_medium():
    medium = Medium.from_reflectance(0.5, 1.0)
    assert medium.n_channels is None and isinstance(medium.reflectance(), float)


def test_a_texture_of_colours_keeps_its_shape_and_order():
    texture = np.linspace(0, 0.9, 24).reshape(2, 4, 3)
    albedo = albedo_of_reflectance(texture, 0.0, 1.3)
    assert albedo.shape == texture.shape and np.all(np.diff(albedo.ravel()) > 0)


def test_the_walk_gives_the_wanted_reflectance():
    import halfspace_sss as sss

    medium = Medium.from_reflectance(0.6, 1.0, g=0.5, eta=1.4, mu_i=1.0)
    R = sss.trace(medium, mu_i=1.0, n_paths=400_000, seed=3).reflectance()
    assert abs(R.value - 0.6) < 4 * R.standard_error and R.standard_error < 1e-3


@pytest.mark.parametrize(
    "arguments, text",
    [
        (dict(reflectance=0.95, mfp=1.0, eta=1.3), "reflectance must be in \\[0, 0.9389\\].*got 0.95"),
        (dict(reflectance=-0.1, mfp=1.0), "reflectance must be in"),
        (dict(reflectance=float("nan"), mfp=1.0), "reflectance must be in"),
        (dict(reflectance=0.5, mfp=0.0), "mfp must be finite and > 0"),
        (dict(reflectance=0.5, mfp=1.0, g=1.0), "g must be in the open interval"),
        (dict(reflectance=0.5, mfp=1.0, g=-0.99999), "g must be in \\[-0.9999, 0.9999\\] for the exact .*got -0.99999"),
        (dict(reflectance=0.5, mfp=1.0, eta=0.0), r"eta must be in \[0.01, 100\]"),
        (dict(reflectance=0.5, mfp=1.0, mu_i=1.5), "mu_i must be a number in"),
        (dict(reflectance=[0.5, 0.4], mfp=[1.0, 2.0, 3.0]), "same number of channels"),
    ],
)
def test_what_no_medium_can_be_is_refused_by_name(arguments, text):
    with pytest.raises(ValueError, match=text):
        Medium.from_reflectance(**arguments)


def test_a_g_beyond_what_the_nodes_resolve_is_refused_by_name():
    for g in (-1 + 1e-9, 0.99995):
        with pytest.raises(ValueError, match=r"g must be in \[-0.9999, 0.9999\] for the exact reflectance, got"):
            Medium.from_albedo(0.9, 1.0, g, 1.4).reflectance()


def test_rounding_makes_no_reflectance_above_1():
    assert Medium(1.28e-4, 0.0, 0.9, 1.0000000000000129).reflectance() <= 1
