"""A flat object under the integrator is the half-space: every model, both kinds of light, every order."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from rendered import MEDIUM, mean_of_pixels, plane_scene, sun, surface

import halfspace_sss
from halfspace_sss import Medium, bssrdf
from halfspace_sss.physics import single_scattering

mi = pytest.importorskip("mitsuba")
THETA_I, THETA_O, DELTA = 40.0, 30.0, 0.7
UNTRAINED = ("neural_material", "neural_paper")
NAMES = [name for name in halfspace_sss.models() if name not in UNTRAINED]


@pytest.fixture(autouse=True)
def _variant():
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a rectangle is not closed
        yield


def orders_of(name: str) -> str:
    return bssrdf(name, Medium(**MEDIUM)).orders


def radiance_under_sun(name: str, theta_i: float, theta_o: float, delta: float) -> float:
    """mu_i ∫ S dA for parallel light, by quadrature over the plane."""
    model = bssrdf(name, Medium(**MEDIUM))
    mu_i, mu_o = np.cos(np.radians([theta_i, theta_o]))
    x, w = np.polynomial.legendre.leggauss(300)
    span = np.log(300.0 / 1e-7)
    r = 1e-7 * np.exp(0.5 * span * (x + 1))
    phi = np.arange(128) / 128 * 2 * np.pi
    S = model.eval(r[:, None], mu_i, phi + delta, mu_o, phi)
    return float(mu_i * np.sum(S.mean(axis=1) * 2 * np.pi * 0.5 * span * w * r * r))


@pytest.mark.parametrize("model", NAMES)
def test_a_flat_object_under_parallel_light_shows_the_radiance_of_the_half_space(model):
    scene = plane_scene(surface(model, orders_of(model)), sun(THETA_I, DELTA), THETA_O)
    mean, error = mean_of_pixels(scene, 128)
    expected = radiance_under_sun(model, THETA_I, THETA_O, DELTA)
    assert abs(mean[1] - expected) < 4 * error[1]
    assert error[1] < 0.02 * expected


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_both_samplers_of_entries_have_the_same_mean(share):
    at = mi.ScalarTransform4f()
    shape = {"type": "rectangle", "to_world": at.scale(20.0)}
    scene = plane_scene(surface(), sun(THETA_I, DELTA), THETA_O, shape, n=32, area_share=share)
    mean, error = mean_of_pixels(scene, 256)
    expected = radiance_under_sun("standard_dipole", THETA_I, THETA_O, DELTA)
    assert abs(mean[1] - expected) < 4 * error[1] + 1e-3 * expected  # what lies beyond 20 mm


@pytest.mark.parametrize("theta_i, theta_o", [(40, 30), (0, 60), (70, 0)])
def test_single_scattering_of_a_flat_object_is_the_brdf(theta_i, theta_o):
    scene = plane_scene(surface(orders="single"), sun(theta_i, DELTA), theta_o)
    mean, error = mean_of_pixels(scene, 256)
    mu_i, mu_o = np.cos(np.radians([theta_i, theta_o]))
    expected = mu_i * single_scattering.brdf(Medium(**MEDIUM), mu_i, mu_o, DELTA + np.pi)
    assert abs(mean[1] - expected) < 4 * error[1] + 1e-3 * mean[1]


def test_single_scattering_under_a_sky_is_the_same_as_under_parallel_light_from_everywhere():
    mean, error = mean_of_pixels(plane_scene(surface(orders="single"), {"type": "constant"}, 40.0, n=32), 256)
    x, w = np.polynomial.legendre.leggauss(40)
    phi = np.arange(24) / 24 * 2 * np.pi
    total = 0.0
    for mu_i, share in zip(0.5 * (x + 1), 0.5 * w):
        f = single_scattering.brdf(Medium(**MEDIUM), mu_i, np.cos(np.radians(40.0)), phi)
        total += share * 2 * np.pi * mu_i * f.mean()
    assert abs(mean[1] - total) < 4 * error[1] + 2e-3 * total


def test_total_is_multiple_and_single_together():
    parts = {o: mean_of_pixels(plane_scene(surface(orders=o), sun(40, DELTA), 30.0), 256) for o in
             ("multiple", "single", "total")}  # fmt: skip
    error = np.sqrt(sum(e[1] ** 2 for _, e in parts.values()))
    assert abs(parts["total"][0][1] - parts["multiple"][0][1] - parts["single"][0][1]) < 4 * error


def test_units_of_the_scene_do_not_change_the_picture():
    small = {"sigma_s": 100.0, "sigma_a": 20.0, "g": 0.3, "eta": 1.4}
    scene = plane_scene(surface(medium=small), sun(THETA_I, DELTA), THETA_O, mm_per_unit=0.01)
    mean, error = mean_of_pixels(scene, 128)
    assert abs(mean[1] - radiance_under_sun("standard_dipole", THETA_I, THETA_O, DELTA)) < 4 * error[1]


def test_normals_that_point_inwards_change_nothing():
    shape = {"type": "rectangle", "flip_normals": True, "to_world": mi.ScalarTransform4f().scale(300.0)}
    scene = plane_scene(surface(), sun(THETA_I, DELTA), THETA_O, shape)
    mean, error = mean_of_pixels(scene, 128)
    assert abs(mean[1] - radiance_under_sun("standard_dipole", THETA_I, THETA_O, DELTA)) < 4 * error[1]


def test_a_mono_variant_renders_one_channel_of_a_material():
    mi.set_variant("llvm_ad_mono")
    bsdf = {"type": "translucent", "material": "marble", "model": "standard_dipole", "orders": "multiple",
            "reflection": False, "channel": "G"}  # fmt: skip
    mono, error = mean_of_pixels(plane_scene(bsdf, sun(THETA_I, DELTA), THETA_O), 128)
    mi.set_variant("llvm_ad_rgb")
    del bsdf["channel"]
    rgb, error_rgb = mean_of_pixels(plane_scene(bsdf, sun(THETA_I, DELTA), THETA_O), 128)
    assert abs(mono[0] - rgb[1]) < 4 * np.hypot(error[0], error_rgb[1])
