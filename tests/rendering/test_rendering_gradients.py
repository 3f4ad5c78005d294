"""Derivatives of images: by replay, against finite differences of images with the same random numbers."""

from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest
from rendered import MEDIUM, direction, surface

import halfspace_sss
from halfspace_sss import Medium, bssrdf

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

SEED, SPP = 5, 64
ENVMAP = 4 * np.random.default_rng(1).random((4, 8, 3)).astype(np.float32) ** 4
LIGHTS = {
    "sky": {"type": "constant"},
    "lamp": {"type": "sphere", "center": [12, 3, 12], "radius": 2.0, "emitter": {"type": "area", "radiance": 10.0}},
    "point": {"type": "point", "position": [9, 5, 15], "intensity": 200.0},
    "sun": {"type": "directional", "direction": [-0.5, 0.1, -1.0], "irradiance": 3.0},
}
ROUGH = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.4, "ext_ior": 1.0}
UNTRAINED = ("neural_material", "neural_paper")  # know one medium each


@pytest.fixture(autouse=True)
def _variant():
    from halfspace_sss import rendering

    mi.set_variant("llvm_ad_rgb")
    rendering.register()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def make(
    light: str | dict = "sky",
    model: str = "standard_dipole",
    n: int = 8,
    floor: bool = True,
    max_depth: int = 4,
    **bsdf,
):
    """A ball over a floor, three media in its channels."""
    medium = {**MEDIUM, "sigma_s": "1, 2, 0.5"}
    orders = bsdf.pop("orders", "total")
    at = mi.ScalarTransform4f()
    sensor = {"type": "perspective", "fov": 20.0, "film": {"type": "hdrfilm", "width": n, "height": n}}
    sensor["to_world"] = at.look_at((30 * direction(50)).tolist(), [0, 0, 0], [0, 0, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "bssrdf", "max_depth": max_depth, "rr_depth": 100, "hide_emitters": True},
        "light": LIGHTS[light] if isinstance(light, str) else light, "sensor": sensor,
        "ball": {"type": "sphere", "radius": 3.0,
                 "bsdf": {**surface(model, orders, medium), "reflection": True, **bsdf}},
    }  # fmt: skip
    if floor:
        board = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.2, 0.5, 0.7]}, "color1": 0.4}
        scene["floor"] = {"type": "rectangle", "to_world": at.translate([0, 0, -3.2]).scale(8.0),
                          "bsdf": {"type": "diffuse", "reflectance": board}}  # fmt: skip
    return mi.load_dict(scene)


def envmap() -> dict:
    return {"type": "envmap", "bitmap": mi.Bitmap(ENVMAP)}


def image(scene, bodies: list | None = None) -> np.ndarray:
    """The image whose derivative the replay gives for the same seed."""
    from halfspace_sss.rendering.paths.differentiable import replayer
    from halfspace_sss.rendering.paths.tracing import trace_paths

    integrator = scene.integrator()
    bodies = bodies or integrator.prepare(scene)
    tracer = replayer(lambda scene, *path: trace_paths(scene, bodies, integrator.settings, *path), None)
    return np.array(tracer.render(scene, spp=SPP, seed=SEED), dtype=float)


def weights(scene) -> np.ndarray:
    """A function of the image, so that its pixels count differently."""
    size = scene.sensors()[0].film().crop_size()
    return np.random.default_rng(3).uniform(0.5, 1.5, (size[1], size[0], 3)).astype(np.float32)


def followed(parameters, key: str):
    """The parameter with gradients enabled; some emitters keep a copy of what they are given."""
    value = type(parameters[key])(parameters[key])
    dr.enable_grad(value)
    return value


def backward(scene, key: str) -> np.ndarray:
    """Derivative of the weighted sum of the image."""
    parameters = mi.traverse(scene)
    value = followed(parameters, key)
    parameters[key] = value
    parameters.update()
    scene.integrator().render_backward(scene, parameters, mi.TensorXf(weights(scene)), 0, SEED, SPP)
    parameters[key] = dr.detach(value)
    parameters.update()
    return np.array(dr.grad(value), dtype=float).ravel()


def forward(scene, key: str) -> float:
    """The sum of it over all numbers of the parameter."""
    parameters = mi.traverse(scene)
    value = followed(parameters, key)
    dr.set_grad(value, 1.0)
    parameters[key] = value
    dr.forward_to(parameters[key], flags=dr.ADFlag.ClearEdges)
    parameters.update()
    found = np.array(scene.integrator().render_forward(scene, parameters, 0, SEED, SPP), dtype=float)
    parameters[key] = dr.detach(value)
    parameters.update()
    return float((found * weights(scene)).sum())


class Shifted:
    """Stands in for the `Variation` of a body: the light of another medium along paths of this one."""

    def __init__(self, body, name: str, h: float, only: int | None) -> None:
        self.inside, media = body.variation.inside, []
        for k, m in enumerate(self.inside.channels()):
            ratios = {key: float(getattr(m, key)) for key in ("albedo", "sigma_t", "g")}
            ratios[name] += h if only in (None, k) else 0.0
            media.append(Medium.from_albedo(**ratios, eta=m.eta))
        if self.inside.model in UNTRAINED:  # by the scaling law, so that the stand-ins keep their weights
            self.models = [type(own)(Medium(own.medium.sigma_s * m.sigma_t, own.medium.sigma_a * m.sigma_t, m.g, m.eta))
                           for own, m in ((bssrdf(self.inside.model, c.in_mfp()), s)
                                          for c, s in zip(self.inside.channels(), media))]  # fmt: skip
        else:
            self.models = [bssrdf(self.inside.model, m) for m in media] if body.transport else []
        self.media = media

    def S(self, values: list, query: tuple) -> list:
        return [model.eval(*query) for model in self.models]

    def coefficients(self, media: list) -> list:
        from halfspace_sss.rendering.transport.plane import number

        return [tuple(number(v) for v in (m.sigma_s, m.sigma_t, m.g)) for m in self.media]


def _varied(body, variation):
    transport = body.transport and dataclasses.replace(body.transport, variation=variation)
    return dataclasses.replace(body, variation=variation, transport=transport)


def medium_difference(scene, name: str, only: int | None = None) -> tuple[float, float]:
    """Central difference by a coefficient of the medium, with densities held; and the sum of its size over pixels."""
    bodies = scene.integrator().prepare(scene)
    h = {"albedo": 1e-3, "sigma_t": 5e-3, "g": 4e-3}[name]
    sides = []
    for sign in (1, -1):
        shifted = [_varied(body, Shifted(body, name, sign * h, only)) for body in bodies]
        sides.append(image(scene, shifted) * weights(scene))
    difference = (sides[0] - sides[1]) / (2 * h)
    return float(difference.sum()), float(np.abs(difference).sum())


@pytest.mark.parametrize("parameter", ["albedo", "sigma_t", "g"])
def test_derivatives_by_the_medium_agree_with_finite_differences_for_every_model(name, parameter):
    if name in UNTRAINED and parameter != "sigma_t":
        pytest.skip("trained for one albedo and g")
    model = halfspace_sss.interface.model.bssrdf(name, Medium(**MEDIUM))
    scene = make("point", name, n=4, floor=False, orders="total" if model.orders == "total" else "multiple")
    expected, size = medium_difference(scene, parameter)
    assert backward(scene, f"ball.bsdf.{parameter}").sum() == pytest.approx(expected, abs=2e-3 * size)


@pytest.mark.parametrize("light", [*LIGHTS, "envmap"])
def test_derivatives_by_each_channel_agree_with_finite_differences_under_every_light(light):
    scene = make(envmap() if light == "envmap" else light)
    for parameter in ("albedo", "sigma_t", "g"):
        found = backward(scene, f"ball.bsdf.{parameter}")
        for k in range(3):
            expected, size = medium_difference(scene, parameter, k)
            assert found[k] == pytest.approx(expected, abs=2e-3 * size)
        assert forward(scene, f"ball.bsdf.{parameter}") == pytest.approx(found.sum(), abs=1e-4 * np.abs(found).sum())


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


def difference(scene, key: str, h: float, kind) -> float:
    parameters = mi.traverse(scene)
    value, sides = kind(parameters[key]), []
    for sign in (1, -1):
        parameters[key] = value + sign * h
        parameters.update()
        sides.append((image(scene) * weights(scene)).sum())
    parameters[key] = value
    parameters.update()
    return float(sides[0] - sides[1]) / (2 * h)


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
    found = mi.render(scene, parameters, spp=SPP, seed=1)
    total = float(np.array(dr.detach(dr.sum(found, axis=None))))
    dr.backward(dr.sum(found, axis=None))
    assert float(dr.grad(parameters[key])[0]) == pytest.approx(total, rel=0.02)


def refused(key: str, render) -> bool:
    """Whether it is refused with the name of the parameter; Mitsuba wraps the error once more."""
    with pytest.raises((ValueError, RuntimeError)) as caught:
        render()
    errors = [caught.value]
    while errors[-1].__cause__ is not None:
        errors.append(errors[-1].__cause__)
    return any(f"{key} must not have gradients enabled" in str(error) for error in errors)


@pytest.mark.parametrize(
    "key", ["ball.to_world", "floor.to_world", "sensor.to_world", "ball.bsdf.boundary.eta", "light.position"]
)
def test_geometry_is_refused_before_anything_is_rendered(key):
    scene = make("point", boundary=ROUGH)
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[key])
    for render in (
        lambda: mi.render(scene, parameters, spp=1),
        lambda: mi.render(scene, spp=1),
        lambda: scene.integrator().render_backward(scene, parameters, mi.TensorXf(weights(scene)), 0, 1, 1),
    ):
        assert refused(key, render)


def test_the_walk_refuses_derivatives():
    scene = make("sky")
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters["light.radiance.value"])
    found = mi.render(scene, parameters, integrator=mi.load_dict({"type": "translucent_walk"}), spp=1)
    with pytest.raises((ValueError, RuntimeError)) as caught:
        dr.backward(dr.sum(found, axis=None))
    assert "must be bssrdf" in str(caught.value) + str(caught.value.__cause__)


def test_derivatives_through_another_integrator_around_it_are_refused():
    scene = make("sky")
    parameters = mi.traverse(scene)
    around = mi.load_dict({"type": "moment", "nested": {"type": "bssrdf"}})
    assert np.isfinite(np.array(mi.render(scene, integrator=around, spp=1))).all()
    dr.enable_grad(parameters["light.radiance.value"])
    found = mi.render(scene, parameters, integrator=around, spp=1)
    with pytest.raises((ValueError, RuntimeError)) as caught:
        dr.backward(dr.sum(found, axis=None))
    assert "outermost" in str(caught.value) + str(caught.value.__cause__)


def test_the_vertices_of_a_mesh_are_refused():
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "bssrdf"},
                          "cube": {"type": "cube", "bsdf": surface()},
                          "light": LIGHTS["sky"], "sensor": {"type": "perspective"}})  # fmt: skip
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters["cube.vertex_positions"])
    assert refused("cube.vertex_positions", lambda: mi.render(scene, parameters, spp=1))


def test_a_model_that_knows_one_medium_refuses_derivatives_by_albedo(monkeypatch):
    from halfspace_sss.neural import material_model

    known = material_model.find_weights
    at = Medium(**MEDIUM).albedo

    def find(kind: str, medium: Medium):
        if abs(float(medium.albedo) - at) > 1e-6:
            raise ValueError("medium must be trained for neural_material, got one that is not")
        return known(kind, medium)

    monkeypatch.setattr(material_model, "find_weights", find)
    scene = make(model="neural_material", orders="multiple", sigma_s=MEDIUM["sigma_s"], n=4)
    with pytest.raises(ValueError, match="'neural_material' cannot be differentiated by albedo: medium must be"):
        backward(scene, "ball.bsdf.albedo")


def test_a_changed_medium_is_rendered_as_if_the_scene_had_been_made_with_it():
    scene = make(floor=False)
    image(scene)
    parameters = mi.traverse(scene)
    parameters["ball.bsdf.albedo"] = mi.Color3f(0.8)
    parameters["ball.bsdf.sigma_t"] = mi.Color3f(1.5)
    parameters.update()
    fresh = make(floor=False, sigma_s=1.2, sigma_a=0.3)
    assert np.allclose(image(scene), image(fresh), rtol=1e-4, atol=1e-6)


def test_a_moved_object_is_rendered_as_if_the_scene_had_been_made_so():
    scene = make(floor=False)
    image(scene)
    parameters = mi.traverse(scene)
    parameters["ball.to_world"] = mi.AffineTransform4f().translate([0.5, 0, 0]) @ parameters["ball.to_world"]
    parameters.update()
    moved = scene.integrator().prepare(scene)[0].found
    assert np.allclose(moved.scene.bbox().center(), [0.5, 0, 0], atol=1e-5)
    assert np.isfinite(image(scene)).all()


def test_a_medium_out_of_range_is_refused_by_name():
    parameters = mi.traverse(make())
    parameters["ball.bsdf.albedo"] = mi.Color3f(1.2)
    with pytest.raises((ValueError, RuntimeError), match="albedo must be in"):
        parameters.update()


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
