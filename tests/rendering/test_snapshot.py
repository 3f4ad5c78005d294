"""A snapshot of a scene differs from the next as soon as one number of one parameter does, whatever Dr.Jit calls it."""

from __future__ import annotations

import gc
from typing import Any

import numpy as np
import pytest

import full_geometry.geometry.shape as shape_module
from full_geometry.geometry.shape import SceneMark
from full_geometry.geometry.snapshot import Snapshot, scene_hash

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

SURFACE = {"type": "translucent", "material": "marble"}


def _scene(**more: Any) -> mi.Scene:
    texels = mi.Bitmap(np.linspace(0.1, 0.9, 48, dtype=np.float32).reshape(4, 4, 3))
    painted = {"type": "diffuse", "reflectance": {"type": "bitmap", "bitmap": texels, "raw": True}}
    things = {
        "ball": {"type": "sphere", "bsdf": SURFACE, "to_world": mi.ScalarTransform4f().translate([1, 2, 3])},
        "floor": {"type": "rectangle", "bsdf": painted},
        "group": {"type": "shapegroup", "tile": {"type": "cube", "bsdf": {"type": "diffuse"}}},
        "shown": {"type": "instance", "group": {"type": "ref", "id": "group"}},
        "point": {"type": "point", "position": [1, 2, 3]},
        "sky": {"type": "envmap", "bitmap": texels},
    }
    return mi.load_dict({"type": "scene", "integrator": {"type": "path"}, **things, **more})


def _nudged(value: Any) -> list[tuple[str, Any]]:
    """A value with one number after the other a little larger; whole numbers by one."""
    if isinstance(value, (bool, int, float)):
        return [("", value + 1 if isinstance(value, int) else value * (1 + 1e-6) + 1e-6)]
    if "Transform" in type(value).__name__:
        size = len(value.matrix)
        entries = [value.matrix[k // size, k % size] for k in range(size * size)]
        one = np.array(entries, dtype=float).reshape(size, size)
        places = [(i, j) for i in range(size - 1) for j in range(size)]
        return [(str(at), type(value)((one + 1e-5 * _unit(one.shape, at)).tolist())) for at in places]
    if isinstance(value, (mi.Point3f, mi.Color3f)):
        one = np.array(value).reshape(3)
        return [(str(k), type(value)(*(one + 1e-6 * _unit(3, k)).tolist())) for k in range(3)]
    numbers = np.array(value)
    return [("last", type(value)(numbers + _unit(numbers.shape, -1) * (1e-6 if numbers.dtype.kind == "f" else 1)))]


def _unit(shape: Any, at: Any) -> np.ndarray:
    result = np.zeros(shape)
    result[(-1,) * result.ndim if at == -1 else at] = 1
    return result.astype(np.float32)


def test_every_number_of_every_parameter_counts() -> None:
    scene = _scene()
    parameters = mi.traverse(scene)
    left_out = ("faces", "allow_thread_reordering", "vertex_count", "face_count")
    keys = [key for key in parameters.keys() if not key.endswith(left_out)]
    assert {"ball.bsdf.sigma_t", "group.tile.vertex_positions", "point.position", "sky.data"} <= set(keys)
    for key in keys:
        kept, before = parameters[key], Snapshot(scene)
        kept = type(kept)(kept)
        for number, value in _nudged(kept):
            parameters[key] = value
            assert Snapshot(scene) != before, (key, number)
        parameters[key] = kept
        assert Snapshot(scene) == before, key


def test_what_is_written_into_an_array_counts() -> None:
    scene = _scene()
    parameters, before = mi.traverse(scene), Snapshot(scene)
    parameters["group.tile.vertex_positions"].numpy()[:] += 1
    assert Snapshot(scene) != before


def test_the_same_values_in_other_variables_are_the_same() -> None:
    scene = _scene()
    parameters, before = mi.traverse(scene), Snapshot(scene)
    for key in ("floor.bsdf.reflectance.data", "sky.data"):
        parameters[key] = type(parameters[key])(np.array(parameters[key]))
    parameters.update()
    assert Snapshot(scene) == before


def test_other_objects_with_the_same_values_are_not_the_same() -> None:
    assert Snapshot(_scene()) != Snapshot(_scene())


def test_the_identity_of_a_scene_has_every_component_of_a_point() -> None:
    scenes = [_scene(point={"type": "point", "position": [1, y, 3]}) for y in (2, 2 + 1e-6)]
    first, second = (scene_hash(scene, scene.integrator()) for scene in scenes)
    assert first != second


def test_a_scene_at_the_address_of_a_freed_one_is_another(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shape_module, "_by_optix", lambda: True)
    shape, seen = mi.load_dict({"type": "sphere"}), {}
    for _ in range(20):
        scene = mi.load_dict({"type": "scene", "shape": shape})
        mark, place = SceneMark(scene), scene.ptr
        assert mark == SceneMark(scene)
        assert not any(mark == other for other in seen.values())
        again = place in seen
        seen[place] = mark
        del scene
        gc.collect()
        if again:
            break
    assert again  # so that an address tells nothing
