"""Derivatives of images: by replay, against finite differences of images with the same random numbers."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import MEDIUM, direction, surface

import halfspace_sss
from halfspace_sss import Medium, models

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402
from differentiated import (  # noqa: E402
    ENVMAP,
    LIGHTS,
    SPP,
    UNTRAINED,
    backward,
    derivatives,
    difference,
    forward,
    image,
    make,
    medium_difference,
    weights,
)  # fmt: skip

pytestmark = pytest.mark.usefixtures("quiet_rgb")


COEFFICIENTS = ("albedo", "sigma_t", "g")


def _by_the_medium(scene, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    found = derivatives(scene, [f"ball.bsdf.{name}" for name in names])
    return dict(zip(names, found.values()))


@pytest.mark.slow
def test_derivatives_by_the_medium_agree_with_finite_differences_for_every_model(name):
    if name == "neural_paper":
        pytest.skip("trained for one medium; the same scaling law as neural_material, and a kernel of a minute")
    model = halfspace_sss.registry.bssrdf(name, Medium(**MEDIUM))
    scene = make("point", name, n=8, floor=False, orders="total" if model.orders == "total" else "multiple")
    for parameter, found in _by_the_medium(scene, ("sigma_t",) if name in UNTRAINED else COEFFICIENTS).items():
        expected, size = medium_difference(scene, parameter)
        assert found.sum() == pytest.approx(expected, abs=2e-3 * size)


FLOOR = "floor.bsdf.reflectance.color1.value"


@pytest.mark.slow
def test_derivatives_under_a_lamp_agree_with_finite_differences_and_with_the_image_by_the_light():
    """By each channel of the medium and the texture of another surface; what light shows is linear in it."""
    scene, light = make("lamp"), "light.emitter.radiance.value"
    found = derivatives(scene, [*(f"ball.bsdf.{name}" for name in COEFFICIENTS), FLOOR, light])
    for parameter in COEFFICIENTS:
        for k in range(3):
            expected, size = medium_difference(scene, parameter, k)
            assert found[f"ball.bsdf.{parameter}"][k] == pytest.approx(expected, abs=2e-3 * size)
    by_g = found["ball.bsdf.g"]
    assert forward(scene, "ball.bsdf.g") == pytest.approx(by_g.sum(), abs=1e-4 * np.abs(by_g).sum())
    assert found[FLOOR].sum() == pytest.approx(difference(scene, FLOOR, 5e-3, mi.Float), rel=5e-3)
    value = np.array(mi.traverse(scene)[light], dtype=float).ravel()
    assert value.size in (found[light].size, 1)
    shown = (image(scene) * weights(scene)).sum()
    assert (value * found[light]).sum() == pytest.approx(shown, rel=2e-3)


def test_single_scattering_alone_is_differentiated_by_the_medium():
    scene = make("lamp", orders="single", floor=False)
    for parameter, found in _by_the_medium(scene, COEFFICIENTS).items():
        expected, size = medium_difference(scene, parameter)
        assert found.sum() == pytest.approx(expected, abs=2e-3 * size)


@pytest.mark.parametrize("model", ["standard_dipole", "neural"])
def test_the_radiance_of_a_constant_sky_times_its_derivative_is_the_image(model):
    scene = make(model=model, orders="multiple", floor=False, n=4)
    expected = (image(scene) * weights(scene)).sum()
    assert backward(scene, "light.radiance.value").sum() == pytest.approx(expected, rel=1e-3)


@pytest.mark.slow
def test_forward_and_backward_derivatives_agree():
    scene = make(orders="total", reflection=True)
    for key, found in derivatives(scene, ["light.radiance.value", FLOOR, "ball.bsdf.albedo"]).items():
        assert forward(scene, key) == pytest.approx(found.sum(), rel=1e-4)


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


def _painted(model: str) -> mi.Scene:
    """A ball of texels beside a tetrahedron with attributes of vertices and faces."""
    rng, at = np.random.default_rng(4), mi.ScalarTransform4f()

    def bitmap(low: float, high: float) -> dict:
        return {
            "type": "bitmap",
            "bitmap": mi.Bitmap(rng.uniform(low, high, (4, 8, 3)).astype(np.float32)),
            "raw": True,
        }

    def surface(albedo: dict, sigma_t: dict) -> dict:
        return {"type": "translucent", "model": model, "orders": "multiple" if model in models() else "total",
                "albedo": albedo, "sigma_t": sigma_t, "eta": 1.4, "reflection": False}  # fmt: skip

    props = mi.Properties()
    attributes = [{"type": "mesh_attribute", "name": name} for name in ("vertex_albedo", "face_sigma_t")]
    props["bsdf"] = mi.load_dict(surface(*attributes))
    mesh = mi.Mesh("tetrahedron", 4, 4, props=props)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ravel(5 * np.vstack([np.zeros(3), np.eye(3)]) + [2, -2, -2]))
    parameters["faces"] = mi.UInt32([0, 2, 1, 0, 1, 3, 0, 3, 2, 1, 2, 3])
    parameters.update()
    mesh.add_attribute("vertex_albedo", 3, rng.uniform(0.5, 0.95, 12).astype(np.float32))
    mesh.add_attribute("face_sigma_t", 1, rng.uniform(1, 3, 4).astype(np.float32))
    ball = surface(bitmap(0.5, 0.95), bitmap(1, 3))
    return mi.load_dict({"type": "scene", "light": LIGHTS["lamp"], "solid": mesh,
        "integrator": {"type": "bssrdf", "max_depth": 3, "rr_depth": 100, "hide_emitters": True},
        "ball": {"type": "sphere", "center": [-2, 1, 0], "radius": 2.5, "bsdf": ball},
        "sensor": {"type": "perspective", "fov": 20.0, "film": {"type": "hdrfilm", "width": 8, "height": 8},
                   "to_world": at.look_at((30 * direction(50)).tolist(), [0, 0, 0], [0, 0, 1])}})  # fmt: skip


@pytest.mark.slow
def test_derivatives_by_textures_of_a_medium_agree_with_finite_differences():
    scene = _painted("standard_dipole")
    bodies = scene.integrator().prepare(scene)
    keys = {"ball.bsdf.albedo.data": mi.TensorXf, "ball.bsdf.sigma_t.data": mi.TensorXf,
            "solid.vertex_albedo": mi.Float, "solid.face_sigma_t": mi.Float}  # fmt: skip
    found = derivatives(scene, list(keys))
    for key, kind in keys.items():
        expected = difference(scene, key, 4e-3 if "albedo" in key else 1e-2, kind, bodies)
        assert found[key].sum() == pytest.approx(expected, abs=1e-3 * np.abs(found[key]).sum())
        assert (found[key] != 0).mean() > 0.2


def test_derivatives_by_textures_of_a_medium_are_refused_under_lambert():
    with pytest.raises(ValueError, match="textures must not have gradients enabled under 'lambert'"):
        derivatives(_painted("lambert"), ["solid.vertex_albedo"])


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
