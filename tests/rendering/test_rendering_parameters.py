"""Parameters of scenes: which may have gradients, and what follows when they change."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import MEDIUM, surface

from halfspace_sss import Medium

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402
from differentiated import LIGHTS, backward, image, make, weights  # noqa: E402  # fmt: skip

pytestmark = pytest.mark.usefixtures("quiet_rgb")


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
    scene = make("point")
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters[key])
    for render in (
        lambda: mi.render(scene, parameters, spp=1),
        lambda: mi.render(scene, spp=1),
        lambda: scene.integrator().render_backward(scene, parameters, mi.TensorXf(weights(scene)), 0, 1, 1),
    ):
        assert refused(key, render)


def test_the_walk_refuses_derivatives_by_emitters():
    scene = make("sky")
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters["light.radiance.value"])
    found = mi.render(scene, parameters, integrator=mi.load_dict({"type": "translucent_walk"}), spp=1)
    with pytest.raises((ValueError, RuntimeError)) as caught:
        dr.backward(dr.sum(found, axis=None))
    assert "light.radiance.value must not have gradients enabled" in str(caught.value) + str(caught.value.__cause__)


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
    moved = scene.integrator().prepare(scene)[0].geometry
    assert np.allclose(moved.scene.bbox().center(), [0.5, 0, 0], atol=1e-5)
    assert np.isfinite(image(scene)).all()


def test_a_medium_out_of_range_is_refused_by_name():
    parameters = mi.traverse(make())
    parameters["ball.bsdf.albedo"] = mi.Color3f(1.2)
    with pytest.raises((ValueError, RuntimeError), match="albedo must be in"):
        parameters.update()


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_a_channel_without_a_mean_free_path_has_the_reflectance_of_its_half_space(integrator: str) -> None:
    """The mean over the disk of a ball under an even sky is the mean over exits by their cosine."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    wax = {"reflectance": "0.8,0.5,0.7", "mfp": "1,0.2,0", "reflection": False}
    scene = {"type": "scene", "integrator": {"type": integrator, "mm_per_unit": 5.0, "hide_emitters": True},
             "sensor": {"type": "orthographic", "to_world": view, "film": film}, "sky": {"type": "constant"},
             "ball": {"type": "sphere", "bsdf": {"type": "translucent", **wax}}}  # fmt: skip
    found = np.array(mi.render(mi.load_dict(scene), spp=2048, seed=1)).mean(axis=(0, 1)) * 4 / np.pi
    assert found[2] == pytest.approx(0.7, rel=0.015)
