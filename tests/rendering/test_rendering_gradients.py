"""Derivatives of images: by replay, against finite differences of images with the same random numbers."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import MEDIUM, surface

import halfspace_sss
from halfspace_sss import Medium

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402
from differentiated import (  # noqa: E402
    ENVMAP,
    LIGHTS,
    ROUGH,
    SPP,
    UNTRAINED,
    backward,
    difference,
    envmap,
    forward,
    image,
    make,
    medium_difference,
    weights,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("quiet_rgb")


@pytest.mark.slow
@pytest.mark.parametrize("parameter", ["albedo", "sigma_t", "g"])
def test_derivatives_by_the_medium_agree_with_finite_differences_for_every_model(name, parameter):
    if name == "neural_paper" or name in UNTRAINED and parameter != "sigma_t":
        pytest.skip("trained for one medium; the same scaling law as neural_material, and a kernel of a minute")
    model = halfspace_sss.interface.model.bssrdf(name, Medium(**MEDIUM))
    scene = make("point", name, n=8, floor=False, orders="total" if model.orders == "total" else "multiple")
    expected, size = medium_difference(scene, parameter)
    assert backward(scene, f"ball.bsdf.{parameter}").sum() == pytest.approx(expected, abs=2e-3 * size)


@pytest.mark.parametrize("light", [*LIGHTS, pytest.param("envmap", marks=pytest.mark.slow)])
def test_derivatives_by_each_channel_agree_with_finite_differences_under_every_light(light):
    scene = make(envmap() if light == "envmap" else light)
    for parameter in ("albedo", "sigma_t", "g"):
        found = backward(scene, f"ball.bsdf.{parameter}")
        for k in range(3):
            expected, size = medium_difference(scene, parameter, k)
            assert found[k] == pytest.approx(expected, abs=2e-3 * size)
    assert forward(scene, "ball.bsdf.g") == pytest.approx(found.sum(), abs=1e-4 * np.abs(found).sum())


def test_single_scattering_alone_is_differentiated_by_the_medium():
    scene = make("lamp", orders="single", floor=False)
    for parameter in ("albedo", "sigma_t", "g"):
        expected, size = medium_difference(scene, parameter)
        assert backward(scene, f"ball.bsdf.{parameter}").sum() == pytest.approx(expected, abs=2e-3 * size)


def test_the_radiance_of_a_constant_sky_times_its_derivative_is_the_image(name):
    model = halfspace_sss.interface.model.bssrdf(name, Medium(**MEDIUM))
    orders = "total" if model.orders == "total" else "multiple"
    scene = make(model=name, orders=orders, floor=False, n=4)
    expected = (image(scene) * weights(scene)).sum()
    assert backward(scene, "light.radiance.value").sum() == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("key", ["light.radiance.value", "floor.bsdf.reflectance.color1.value", "ball.bsdf.albedo"])
@pytest.mark.parametrize("reflection", [True, False])
def test_forward_and_backward_derivatives_agree(key, reflection):
    scene = make(orders="total", reflection=reflection, boundary=ROUGH)
    assert forward(scene, key) == pytest.approx(backward(scene, key).sum(), rel=1e-4)


@pytest.mark.parametrize(
    "light, key",
    [("lamp", "light.emitter.radiance.value"), ("point", "light.intensity.value"), ("sun", "light.irradiance.value"),
     ("envmap", "light.data")],
)  # fmt: skip
def test_the_light_of_emitters_times_its_derivative_is_the_image(light, key):
    scene = make(envmap() if light == "envmap" else light, boundary=ROUGH)
    value = np.array(mi.traverse(scene)[key], dtype=float).ravel()
    found = backward(scene, key)
    assert value.size in (found.size, 1)
    assert (value * found).sum() == pytest.approx((image(scene) * weights(scene)).sum(), rel=2e-3)


@pytest.mark.parametrize("light", ["sky", "lamp", "point"])
def test_derivatives_by_the_texture_of_another_surface_agree_with_finite_differences(light):
    scene = make(light)
    key = "floor.bsdf.reflectance.color1.value"
    assert backward(scene, key).sum() == pytest.approx(difference(scene, key, 5e-3, mi.Float), rel=5e-3)


def test_derivatives_by_a_bitmap_agree_with_finite_differences():
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "bssrdf", "max_depth": 4},
        "light": LIGHTS["lamp"], "ball": {"type": "sphere", "bsdf": surface()},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(4.0),
                  "bsdf": {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(ENVMAP / 5),
                                                              "raw": True}}},
        "sensor": {"type": "perspective", "fov": 30.0, "film": {"type": "hdrfilm", "width": 6, "height": 6},
                   "to_world": mi.ScalarTransform4f().look_at([0, 8, 6], [0, 0, 0], [0, 0, 1])}})  # fmt: skip
    key = "floor.bsdf.reflectance.data"
    found = backward(scene, key)
    assert (found != 0).mean() > 0.5
    assert found.sum() == pytest.approx(difference(scene, key, 2e-3, mi.TensorXf), rel=1e-2)


def test_derivatives_by_the_roughness_of_the_boundary_agree_with_finite_differences():
    """Of what a point light shows at the first vertex: there the roughness moves no sampled direction."""
    scene = make("point", boundary=ROUGH, floor=False, max_depth=2)
    key = "ball.bsdf.boundary.alpha.value"
    assert backward(scene, key).sum() == pytest.approx(difference(scene, key, 2e-3, mi.Float), rel=5e-3)


def test_render_and_backward_give_the_derivative_of_the_image():
    scene = make()
    parameters = mi.traverse(scene)
    key = "light.radiance.value"
    dr.enable_grad(parameters[key])
    parameters.update()
    found = mi.render(scene, parameters, spp=32 * SPP, seed=1)
    total = float(np.array(dr.detach(dr.sum(found, axis=None))))
    dr.backward(dr.sum(found, axis=None))
    assert float(dr.grad(parameters[key])[0]) == pytest.approx(total, rel=0.02)


@pytest.mark.slow
def test_the_albedo_of_a_ball_is_found_from_its_image():
    target = make(floor=False, sigma_s=1.6, sigma_a=0.1, n=6)
    target = mi.TensorXf(mi.render(target, spp=512, seed=9))
    scene = make(floor=False, sigma_s=1.02, sigma_a=0.68, n=6)
    parameters, key = mi.traverse(scene), "ball.bsdf.albedo"
    optimiser = mi.ad.Adam(lr=0.05)
    optimiser[key] = parameters[key]
    for step in range(40):
        optimiser[key] = dr.clip(optimiser[key], 0.1, 0.99)
        parameters.update(optimiser)
        found = mi.render(scene, parameters, spp=32, seed=step)
        dr.backward(dr.mean(dr.square(found - target), axis=None))
        optimiser.step()
    assert np.array(optimiser[key]).mean() == pytest.approx(1.6 / 1.7, abs=0.01)
