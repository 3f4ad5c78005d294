"""What lies inside or around objects, and meshes that are not what they seem: traced, repaired or refused by name."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered import direction, independent, surface
from test_rendering_normals import ellipsoid

mi = pytest.importorskip("mitsuba")

from full_geometry.geometry.shape import analyse_shape  # noqa: E402
from full_geometry.objects.objects import find_inclusions  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

INTEGRATORS = ("bssrdf", "translucent_walk")


def view(integrator: str, **objects: dict) -> dict:
    """Objects of about 8 units, from the front."""
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    at = mi.ScalarTransform4f().look_at((30 * direction(20)).tolist(), [0, 0, 0], [0, 1, 0])
    sensor = {"type": "perspective", "fov": 18.0, "to_world": at, "film": film}
    return {"type": "scene", "integrator": {"type": integrator}, "sensor": sensor, "light": {"type": "constant"},
            **objects}  # fmt: skip


def ball(radius: float = 4.0, **more: dict) -> dict:
    return {"type": "sphere", "radius": radius, "bsdf": surface(orders="total"), **more}


def mesh(folder: Path, faces: np.ndarray, smooth: bool = False) -> dict:
    """An OBJ file of the ellipsoid with the faces given."""
    vertices, _ = ellipsoid()
    lines = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f {} {} {}".format(*face) for face in faces + 1]
    (folder / "mesh.obj").write_text("\n".join(lines))
    shape = {"type": "obj", "filename": str(folder / "mesh.obj"), "face_normals": not smooth}
    return {**shape, "bsdf": surface(orders="total")}


def refused(message: str, scene: dict) -> None:
    loaded = mi.load_dict(scene)
    with pytest.raises(ValueError, match=message):
        loaded.integrator().render(loaded, spp=1)


def fog() -> dict:
    return {"type": "cube", "to_world": mi.ScalarTransform4f().scale(9), "bsdf": {"type": "null"},
            "interior": {"type": "homogeneous"}}  # fmt: skip


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_media_of_mitsuba_around_objects_or_in_them_are_refused_by_name(integrator: str) -> None:
    refused("without media of Mitsuba, such as fog, got the interior of 'fog'", view(integrator, a=ball(), fog=fog()))
    filled = ball(interior={"type": "homogeneous"})
    refused("translucent object must be without interior.* of 'wax'", view(integrator, wax=filled))
    around = view(integrator, wax=ball())
    around["sensor"]["medium"] = {"type": "homogeneous"}
    refused("such as fog, got one around 'sensor'", around)


COPIES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "as they are": lambda faces: np.concatenate([faces, faces]),
    "wound the other way": lambda faces: np.concatenate([faces, faces[:, ::-1]]),
    "begun at another corner": lambda faces: np.concatenate([faces, np.roll(faces, 1, axis=1)[: len(faces) // 20]]),
}


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("kind", COPIES)
def test_a_mesh_whose_faces_exist_twice_is_refused_by_name(kind: str, integrator: str, tmp_path: Path) -> None:
    shape = mesh(tmp_path, COPIES[kind](ellipsoid()[1]))
    refused(r"faces of object 'wax' must exist once, got \d+ of \d+ that are copies", view(integrator, wax=shape))


def _mixed() -> np.ndarray:
    faces = ellipsoid()[1]
    return np.where(np.random.default_rng(3).random((len(faces), 1)) < 0.5, faces, faces[:, ::-1])


def _vertex_normals(shape: Any) -> np.ndarray:
    """In the order of their places; those of the first point outwards."""
    parameters = mi.traverse(shape)
    at, normals = (np.array(parameters[key]).reshape(-1, 3) for key in ("vertex_positions", "vertex_normals"))
    order = np.lexsort(at.T)
    return normals[order] * np.sign(np.sum(normals[order[0]] * at[order[0]]))


@pytest.mark.parametrize("smooth", [False, True], ids=["faces", "vertex normals"])
def test_a_mesh_whose_faces_point_to_both_sides_is_turned_with_a_warning(smooth: bool, tmp_path: Path) -> None:
    right, mixed = (mi.load_dict(mesh(tmp_path, faces, smooth)) for faces in (ellipsoid()[1], _mixed()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = analyse_shape(right)
    said = "point to both sides: [0-9]+ of 528 were turned" + (", and vertex normals were made anew" if smooth else "$")
    with pytest.warns(UserWarning, match=said):
        found = analyse_shape(mixed)
    assert found.closed and whole.signs is None
    turned = (_mixed() != ellipsoid()[1]).any(axis=1)
    np.testing.assert_array_equal(np.array(found.signs), np.where(turned, -1, 1))
    if smooth:
        np.testing.assert_allclose(_vertex_normals(mixed), _vertex_normals(right), atol=1e-5)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_mesh_that_was_turned_is_seen_as_one_that_was_right(integrator: str, tmp_path: Path) -> None:
    """Means of images of the same seed, in which the same rays go the same ways."""
    found = []
    for faces in (ellipsoid()[1], _mixed()):
        scene = mi.load_dict(view(integrator, wax=mesh(tmp_path, faces)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found.append(independent(scene, 8, 256).mean(axis=(1, 2, 3)))
    a, b = np.array(found)
    error = np.hypot(a.std(ddof=1), b.std(ddof=1)) / np.sqrt(8)
    assert abs(a.mean() - b.mean()) < 4.5 * error
    assert error < 0.01 * a.mean()


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_faces_to_both_sides_of_a_mesh_with_a_hole_are_refused(integrator: str, tmp_path: Path) -> None:
    shape = mesh(tmp_path, _mixed()[::2])
    refused("faces of object 'wax' point to both sides, and the object must be closed", view(integrator, wax=shape))


def test_a_surface_of_one_side_is_refused(tmp_path: Path) -> None:
    strip = np.array([[0, 1, 2], [2, 1, 3], [2, 3, 4], [4, 3, 5], [4, 5, 1], [1, 5, 0]])  # of Möbius
    with pytest.raises(ValueError, match="must have two sides, got a one-sided strip"):
        analyse_shape(mi.load_dict(mesh(tmp_path, strip)))


def _stone(**more: Any) -> dict:
    return {"type": "sphere", "radius": 2.0, "bsdf": {"type": "diffuse"}, **more}


def _glow() -> dict:
    return {"type": "area", "radiance": 5.0}


INSIDE: dict[str, Callable[[], tuple[dict, str]]] = {
    "stone": lambda: ({"stone": _stone()}, "'stone' inside object 'wax'"),
    "bubble": lambda: ({"air": _stone(bsdf={"type": "dielectric"})}, "'air' inside object 'wax'"),
    "translucent": lambda: ({"seed": _stone(bsdf=surface(orders="total"))}, "'seed' inside object 'wax'"),
    "led": lambda: ({"led": _stone(radius=0.1, emitter=_glow())}, "'led' inside object 'wax'"),
    "point": lambda: ({"lamp": {"type": "point"}}, "'lamp' inside object 'wax'"),
    "spot": lambda: ({"lamp": {"type": "spot"}}, "'lamp' inside object 'wax'"),
    "wick": lambda: (
        {"wick": {"type": "cylinder", "p1": [0, 6, 0], "radius": 0.3}},
        "'wick' partly inside object 'wax'",
    ),
    "instance": lambda: (
        {
            "group": {"type": "shapegroup", "part": _stone()},
            "one": {"type": "instance", "of": {"type": "ref", "id": "group"}},
        },
        "'one' inside object 'wax'",
    ),
    "blade": lambda: (
        {"blade": {"type": "rectangle", "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 80).scale([2, 0.004, 1])}},
        "'blade' inside object 'wax'",
    ),
    "wall": lambda: ({"wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(400)}}, "'wall' partly"),
}


@pytest.mark.parametrize("kind", INSIDE)
def test_models_refuse_by_name_what_lies_inside_an_object(kind: str) -> None:
    objects, named = INSIDE[kind]()
    refused(
        f"must be empty for (the model '.*'|models of their light), got the (shape|emitter) {named}",
        view("bssrdf", wax=ball(), **objects),
    )


@pytest.mark.parametrize("model", ["neural_shape", "lambert"])
def test_models_of_whole_objects_refuse_it_too(model: str) -> None:
    pytest.importorskip("torch")
    wax = ball(bsdf=surface(model, orders="total"))
    message = f"must be empty for the model '{model}', got the shape 'stone' inside object 'wax'"
    refused(message, view("bssrdf", wax=wax, stone=_stone()))


def test_an_instance_of_glass_beside_an_object_is_no_content_and_one_partly_inside_overlaps_it() -> None:
    def placed(bsdf: dict, x: float) -> dict:
        one = {"type": "instance", "to_world": mi.ScalarTransform4f().translate([x, x, 0]), "of": ref}
        return view("translucent_walk", wax=ball(), group={"type": "shapegroup", "part": _stone(bsdf=bsdf)}, one=one)

    ref, glass = {"type": "ref", "id": "group"}, {"type": "dielectric"}
    beside = mi.load_dict(placed(glass, 4.5))  # in the box of the object, but not in it
    assert beside.integrator().tracer(beside).visitor.media.inner is None
    partly = mi.load_dict(placed(glass, 2.7))
    assert partly.integrator().tracer(partly).visitor.media.inner.priorities.members().tolist() == [0, 1]


def test_what_stands_at_the_surface_of_an_object_is_not_inside() -> None:
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -3.999]).scale(400)}
    lamp = {"type": "point", "position": [0, 0, 4.1]}
    scene = mi.load_dict(view("bssrdf", wax=ball(), floor=floor, lamp=lamp, near=_stone(center=[0, 6, 0])))
    assert find_inclusions(scene, [analyse_shape(shape) for shape in scene.shapes() if shape.id() == "wax"]) == []


def test_a_curve_that_is_moved_into_an_object_by_its_points_is_refused_at_the_next_render(tmp_path: Path) -> None:
    (tmp_path / "hair.txt").write_text("".join(f"{x} 8 0 0.1\n" for x in range(-2, 3)))
    hair = {"type": "bsplinecurve", "filename": str(tmp_path / "hair.txt")}
    scene = mi.load_dict(view("bssrdf", wax=ball(), hair=hair))
    scene.integrator().render(scene, spp=1)
    parameters = mi.traverse(scene)
    points = np.array(parameters["hair.control_points"]).reshape(-1, 4)
    parameters["hair.control_points"] = mi.Float((points - [0, 8, 0, 0]).ravel())
    parameters.update()
    with pytest.raises(ValueError, match="got the shape 'hair' inside object 'wax'"):
        scene.integrator().render(scene, spp=1)


def test_what_is_moved_into_an_object_is_refused_at_the_next_render() -> None:
    lamp = {"type": "point", "position": [0, 9, 0]}
    scene = mi.load_dict(view("bssrdf", wax=ball(), stone=_stone(center=[0, 8, 0]), lamp=lamp))
    scene.integrator().render(scene, spp=1)
    parameters = mi.traverse(scene)
    parameters["lamp.position"] = [0, 0, 0]
    parameters.update()
    with pytest.raises(ValueError, match="got the emitter 'lamp' inside object 'wax'"):
        scene.integrator().render(scene, spp=1)
    parameters["lamp.position"] = [0, 9, 0]
    parameters["stone.to_world"] = mi.Transform4f().scale(1.0)
    parameters.update()
    with pytest.raises(ValueError, match="got the shape 'stone' inside object 'wax'"):
        scene.integrator().render(scene, spp=1)
