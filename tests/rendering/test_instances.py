"""Instances of translucent objects: walks and models see each as they see an object of its own at that place."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from rendered import independent, surface

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")

from full_geometry.geometry.instances import InstanceScene, InstanceTable, shapes_of, shown_groups  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

WIDEST_Z = 4.0
CLEAR = {"type": "translucent", "sigma_a": "0,0,0", "g": 0.2}
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
SEED = {"type": "translucent", "sigma_s": "4,2,1", "sigma_a": ".5,.1,.02", "g": 0.0, "eta": 1.2}


def turned(x: float, degrees: float) -> Any:
    return mi.ScalarTransform4f().translate([x, 0.1, 0.0]).rotate([0.6, 0.8, 0.0], degrees)


def places() -> list[Any]:
    return [turned(-1.3, 30), turned(1.3, 110)]


def box(**more: Any) -> dict:
    """About four mean free paths across, turned in its group too."""
    at = mi.ScalarTransform4f().rotate([1, 0, 0], 20).scale([0.8, 0.5, 0.6])
    return {"type": "cube", "to_world": at, "bsdf": surface(orders="total"), **more}


def view(integrator: str | dict = "translucent_walk", **things: dict) -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 6, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip
    at = mi.ScalarTransform4f().look_at([0, -2, 12], [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 26.0, "to_world": at, "film": film}
    integrator = integrator if isinstance(integrator, dict) else {"type": integrator}
    return {"type": "scene", "integrator": integrator, "sensor": sensor, **things}


def shown(parts: dict[str, dict], to_world: list[Any]) -> dict[str, dict]:
    """A group of parts, at several places."""
    ref = {"type": "ref", "id": "group"}
    copies = {f"copy{k}": {"type": "instance", "to_world": T, "of": ref} for k, T in enumerate(to_world)}
    return {"group": {"type": "shapegroup", **parts}, **copies}


def direct(parts: dict[str, dict], to_world: list[Any]) -> dict[str, dict]:
    """The same as shapes of the scene."""
    one = mi.ScalarTransform4f()
    return {
        f"{name}{k}": {**part, "to_world": T @ part.get("to_world", one)}
        for k, T in enumerate(to_world) for name, part in parts.items()
    }  # fmt: skip


def light() -> dict[str, dict]:
    """From above and the left, large, so that little light is left to chance."""
    at = mi.ScalarTransform4f().look_at([-4, 9, 7], [0, 0, 0], [0, 0, 1]).scale(5)
    lamp = {"type": "rectangle", "to_world": at, "emitter": {"type": "area", "radiance": 2.0}}
    return {"sky": {"type": "constant", "radiance": 0.3}, "lamp": lamp}


def images(scene: dict, spp: int, seed: int, runs: int = 12) -> np.ndarray:
    loaded = mi.load_dict(scene, optimize=False)  # which would merge meshes
    return independent(loaded, runs, spp, seed)


def agree(found: np.ndarray, wanted: np.ndarray, known_to: float) -> None:
    """The means of images, and those of their halves to three times the error."""
    for part, times in ((np.s_[:], 1), (np.s_[:, :, :4], 3), (np.s_[:, :, 4:], 3)):
        a, b = (x[part].mean(axis=(1, 2)) for x in (found, wanted))
        error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (a, b)))
        assert np.abs((a.mean(axis=0) - b.mean(axis=0)) / error).max() < WIDEST_Z
        assert (error < times * known_to * b.mean(axis=0)).all()


def test_each_instance_knows_the_side_of_its_normals() -> None:
    from full_geometry.walk.media import WalkMedia

    inwards = {"type": "sphere", "radius": 0.5, "flip_normals": True, "bsdf": SEED}
    parts = {"ball": inwards, "other": {**inwards, "flip_normals": False, "center": [2, 0, 0]}}
    media = WalkMedia.of(mi.load_dict(view(**shown(parts, [turned(5.0 * k, 0) for k in range(3)]))), 1.0)
    assert np.array(media.side(mi.Int32([*range(6)]), mi.UInt32(0))).tolist() == [-1.0] * 3 + [1.0] * 3


@pytest.mark.slow
def test_turned_stretched_and_mirrored_instances_look_like_such_meshes() -> None:
    found, wanted = (images(view(**light(), **made({"box": box()}, stretched())), 256, seed, runs=6)
                     for seed, made in ((1, shown), (1001, direct)))  # fmt: skip
    agree(found, wanted, 0.005)


@pytest.mark.slow
def test_instances_inside_an_object_look_like_objects_there() -> None:
    seed = {"type": "sphere", "radius": 0.4, "bsdf": SEED}
    glass = {"type": "sphere", "radius": 0.2, "bsdf": {"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.2}}
    jelly = {"jelly": {"type": "sphere", "radius": 2.5, "bsdf": surface(orders="total")}}
    sampled, parts = {"type": "translucent_walk", "light": "sampled"}, {"seed": seed, "glass": glass}
    found, wanted = (images(view(sampled, **light(), **jelly, **made(parts, places())), 256, start)
                     for start, made in ((1, shown), (1001, direct)))  # fmt: skip
    agree(found, wanted, 0.01)


@pytest.mark.slow
def test_an_even_sky_stays_even_over_instances_nested_three_deep_that_absorb_nothing() -> None:
    def clear(sigma_s: str, eta: float, radius: float) -> dict:
        return {"type": "sphere", "radius": radius, "bsdf": {**CLEAR, "sigma_s": sigma_s, "eta": eta}}

    parts = {"a": clear("1,2,3", 1.4, 1.0), "b": clear("5,2,1", 0.8, 0.7), "c": clear("1,9,1", 1.3, 0.4),
             "stone": {"type": "sphere", "radius": 0.2, "bsdf": {"type": "diffuse", "reflectance": 1.0}}}  # fmt: skip
    scene = view(sky={"type": "constant"}, **shown(parts, places()))
    means = images(scene, 128, 1).mean(axis=(1, 2))
    error = means.std(axis=0, ddof=1) / np.sqrt(len(means))
    assert (np.abs(means.mean(axis=0) - 1) < WIDEST_Z * error).all() and (error < 0.01).all()


@pytest.mark.slow
def test_a_thousand_instances_are_made_ready_by_the_launches_of_a_few() -> None:
    def kernels(n: int) -> int:
        grid = [mi.ScalarTransform4f().translate([2.3 * (k % 40), 2.3 * (k // 40), -3]) for k in range(n)]
        scene = mi.load_dict(view(**light(), **shown({"box": box()}, grid)))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            scene.integrator().tracer(scene)
            return sum(each["type"] == dr.KernelType.JIT for each in dr.kernel_history())

    few, many = kernels(50), kernels(1000)
    assert many <= few + 4  # pairs of neighbours are looked at in parts


@pytest.mark.slow
def test_a_hit_on_an_instance_is_what_mitsuba_makes_of_it() -> None:
    parts = {"box": box(), "ball": {"type": "sphere", "radius": 0.5, "center": [0, 0, 0.9]}}
    scaled = [turned(2.3 * k, 40 * k) @ mi.ScalarTransform4f().scale([1, 1.3, -0.7]) for k in range(4)]
    scene = mi.load_dict(view(**light(), **shown(parts, scaled), wall={"type": "rectangle"}))
    rng = np.random.default_rng(1)
    d = np.stack([rng.normal(0, 1, 2000), rng.normal(0, 0.3, 2000), np.full(2000, -4.0)])
    d /= np.linalg.norm(d, axis=0)
    ray = mi.Ray3f(mi.Point3f(3, 0, 8), mi.Vector3f(d))
    flags = mi.RayFlags.All | mi.RayFlags.dNSdUV
    own = InstanceScene.of(scene, shown_groups(scene)).intersect(scene, ray, flags)
    theirs = scene.ray_intersect(ray, flags, False)
    hit = np.array(theirs.is_valid())
    assert (hit == np.array(own.is_valid())).all() and 0.3 < hit.mean() < 0.95
    assert np.array((own.shape == theirs.shape) & (own.instance == theirs.instance)).all()
    for name in ("t", "p", "n", "uv", "dp_du", "dp_dv", "dn_du", "dn_dv", "wi"):
        a, b = (np.array(getattr(si, name))[..., hit] for si in (own, theirs))
        assert np.abs(a - b).max() < 1e-4 * max(np.abs(b).max(), 1), name
    assert np.abs(np.array(own.sh_frame.s)[:, hit] - np.array(theirs.sh_frame.s)[:, hit]).max() < 1e-4


def test_each_shape_of_each_instance_has_a_number_of_its_own() -> None:
    parts = {"box": box(), "ball": {"type": "sphere", "radius": 0.5, "center": [0, 0, 0.9]}}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3]).scale(9)}
    scene = mi.load_dict(view(**shown(parts, places()), wall=wall))
    groups = shown_groups(scene)
    instance_table = InstanceTable(shapes_of(scene, groups), groups)
    ray = mi.Ray3f(mi.Point3f([-1.3, 1.3, 0], [0.1, 0.1, 4], [8, 8, 8]), mi.Vector3f(0, 0, -1))
    number = np.array(instance_table.number(scene.ray_intersect(ray)))
    assert len(instance_table) == 5 and [instance_table.shapes[instance_table.kind[k]].id() for k in number[2:]] == [
        "wall"
    ]
    assert abs(int(number[1]) - int(number[0])) == 1  # two instances of one shape


def agree_in_slopes(integrator: str, wax: dict, by: str) -> None:
    """Derivatives of images by the medium of instances, and of boxes that stand there."""

    def slopes(made: Any, seed: int) -> np.ndarray:
        bsdf, results = {"type": "ref", "id": "wax"}, []
        things = {**light(), "wax": {**wax, "id": "wax"}, **made({"box": box(bsdf=bsdf)}, places())}
        scene = mi.load_dict(view(integrator, **things))
        parameters = mi.traverse(scene)
        (key,) = (name for name in parameters.keys() if name.endswith(by))
        dr.enable_grad(parameters[key])
        for k in range(8):
            dr.set_grad(parameters[key], 1.0)
            image = scene.integrator().render_forward(scene, parameters, seed=seed + k, spp=128)
            results.append(np.array(image, dtype=float).mean(axis=(0, 1)))
        return np.array(results)

    found, wanted = slopes(shown, 1), slopes(direct, 1001)
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (found, wanted)))
    assert np.abs((found.mean(axis=0) - wanted.mean(axis=0)) / error).max() < WIDEST_Z
    assert (error < 0.1 * np.abs(wanted.mean(axis=0))).all()


@pytest.mark.slow
def test_derivatives_by_the_medium_are_those_of_objects_that_stand_there() -> None:
    agree_in_slopes("translucent_walk", surface(orders="total"), "sigma_t")


def refusal(scene: dict) -> str:
    loaded = mi.load_dict(scene)
    with pytest.raises(ValueError) as caught:
        loaded.integrator().render(loaded, spp=1)
    return str(caught.value)


DENSE = {"albedo": "0.95,0.8,0.5", "sigma_t": "4.0"}  # so that models of the half-space take it


def seen(model: str, to_world: list[Any], **more: Any) -> tuple[np.ndarray, np.ndarray]:
    """Images of a box by a model, as instances and as boxes that stand there."""
    parts = {"box": box(bsdf=surface(model, "total", **more))}
    return tuple(images(view("bssrdf", **light(), **made(parts, to_world)), 128, seed, 8)
                 for seed, made in ((1, shown), (1001, direct)))  # fmt: skip


def stretched() -> list[Any]:
    a, b = places()
    return [a @ mi.ScalarTransform4f().scale([0.9, 1.4, 0.7]), b @ mi.ScalarTransform4f().scale([1.0, 1.0, -1.2])]


@pytest.mark.slow
def test_a_diffuse_surface_sees_turned_instances_as_objects_that_stand_there() -> None:
    agree(*seen("lambert", places(), medium=DENSE), 0.005)


@pytest.mark.slow
def test_a_model_of_the_half_space_and_textures_see_stretched_and_mirrored_instances_as_such_meshes() -> None:
    checks = {"type": "checkerboard", "color0": {"type": "rgb", "value": [0.95, 0.7, 0.4]}, "color1": 0.2}
    agree(*seen("better_dipole", stretched(), medium={"albedo": checks, "sigma_t": 3.0}), 0.005)


@pytest.mark.slow
def test_an_object_that_is_learnt_once_is_known_in_all_its_instances(monkeypatch: Any, tmp_path: Any) -> None:
    training = pytest.importorskip("full_geometry.learning.training")
    from full_geometry.objects.objects import object_of
    from halfspace_sss.neural import store

    quick = replace(training.STANDARD, width=16, depth=2, batch=1024, chunk=2**12)
    for name, value in (("EXITS", 64), ("WALKS", 256), ("SAMPLES", 64)):  # of errors that nobody reads
        monkeypatch.setattr(training, name, value)
    monkeypatch.setenv(store.ENVIRONMENT_VARIABLE, str(tmp_path))
    parts = {"box": box(bsdf=surface("full_geometry", "total"))}
    group = mi.load_dict(view("bssrdf", **light(), **shown(parts, places())), optimize=False)
    training.train(object_of(group, None, None, "box"), chunks=2, recipe=quick)
    agree(*seen("full_geometry", places()), 0.01)  # what stands there is the same object too


@pytest.mark.slow
def test_derivatives_of_a_model_by_the_medium_of_instances_are_those_of_objects_that_stand_there() -> None:
    agree_in_slopes("bssrdf", surface("better_dipole", "total", medium=DENSE), "albedo")


@pytest.mark.slow
def test_a_thousand_instances_are_rendered_by_the_kernels_of_a_few() -> None:
    def kernels(n: int) -> int:
        grid = [mi.ScalarTransform4f().translate([2.3 * (k % 40), 2.3 * (k // 40), -3]) for k in range(n)]
        parts = {"box": box(bsdf=surface("better_dipole", "multiple"))}
        scene = mi.load_dict(view("bssrdf", sky={"type": "constant"}, **shown(parts, grid)))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            mi.render(scene, spp=1)
            return sum(each["type"] == dr.KernelType.JIT for each in dr.kernel_history())

    assert kernels(1000) <= kernels(50) + 4  # pairs of neighbours are looked at in parts


def test_an_instance_that_has_moved_is_seen_where_it_stands() -> None:
    parts = {"box": box(bsdf=surface("better_dipole", "multiple"))}
    scene = mi.load_dict(view("bssrdf", sky={"type": "constant"}, **shown(parts, places())))
    before = np.array(mi.render(scene, spp=4))
    parameters = mi.traverse(scene)
    key = next(name for name in parameters.keys() if "copy0" in name and name.endswith("to_world"))
    parameters[key] = mi.Transform4f().translate([0, 0, -500])
    parameters.update()
    after = np.array(mi.render(scene, spp=4))
    fresh = mi.load_dict(view("bssrdf", sky={"type": "constant"}, **shown(parts, [
        mi.ScalarTransform4f().translate([0, 0, -500]), places()[1]])))  # fmt: skip
    assert (after == np.array(mi.render(fresh, spp=4))).all() and (after != before).any()


@pytest.mark.parametrize(
    ("bsdf", "integrator", "wanted"),
    [
        ({"model": "neural_shape"}, {}, "must be moved, turned or mirrored for the model 'neural_shape', got lengths"),
        ({"model": "better_dipole"}, {"light": "gathered"}, "light must be sampled of objects that instances show"),
        ({"model": "auto"}, {}, "objects must be no instances for the model 'auto', got the shape 'box'"),
    ],
)
def test_what_models_do_not_have_for_instances_is_refused_by_name(bsdf: dict, integrator: dict, wanted: str) -> None:
    parts = {"box": box(bsdf=surface(orders="total") | bsdf)}
    scene = view({"type": "bssrdf", **integrator}, **light(), **shown(parts, stretched()))
    assert wanted in refusal(scene)


def test_things_inside_instances_are_refused_by_models() -> None:
    stone = {"type": "sphere", "radius": 0.2, "bsdf": GREY}
    found = refusal(view("bssrdf", **light(), **shown({"box": box(), "stone": stone}, places())))
    assert "objects must be empty for models of their light" in found and "inside object 'box'" in found


def test_a_camera_inside_the_last_instance_is_refused() -> None:
    at = mi.ScalarTransform4f().translate([0, -2, 12]) @ turned(0.0, 30)
    found = refusal(view(**light(), **shown({"box": box()}, [*places(), at])))
    assert found == "the camera must be outside of every object, got it inside 'box'"


def test_a_lamp_in_one_instance_is_a_light_of_that_alone() -> None:
    lamp = {"lamp": {"type": "point", "position": [1.3, 0.1, 0.0], "intensity": 5.0}}
    scene = mi.load_dict(view(**lamp, **shown({"box": box()}, places())))
    media = scene.integrator().tracer(scene).visitor.media
    ((_, k),) = media.inner.lights
    assert np.allclose(media.instance_table.to_world(0)[k, :3, 3], [1.3, 0.1, 0.0])


def test_a_medium_that_varies_in_space_is_refused_in_a_group() -> None:
    grid = {"type": "gridvolume", "grid": mi.VolumeGrid(np.ones((2, 2, 2, 1), dtype=np.float32))}
    varying = {"type": "translucent", "sigma_t": grid, "albedo": "0.9,0.8,0.7"}
    found = refusal(view(**light(), **shown({"box": box(bsdf=varying)}, places())))
    assert found == "the medium of an instance must not vary in space, got object 'box'"
