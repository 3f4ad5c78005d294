"""Scenes give the same picture in any unit of length and at any place that float32 tells from the next."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from full_geometry.geometry.instances import InstanceScene, bounds_of
from full_geometry.geometry.rounding import ray_from

pytestmark = pytest.mark.usefixtures("rgb")


def T() -> mi.ScalarTransform4f:
    """The identity, of the current variant."""
    return mi.ScalarTransform4f()


class Frame:
    """Where a scene in mm stands, and how many of its units a mm is."""

    def __init__(self, at: tuple[float, float, float] = (0, 0, 0), scale: float = 1.0) -> None:
        self.at, self.scale = np.array(at, dtype=float), scale

    def __call__(self, *p: float) -> list[float]:
        """The coordinates of a point."""
        return (self.scale * (np.array(p) + self.at)).tolist()

    def camera(self, origin: tuple[float, float, float], fov: float, size: int) -> dict[str, Any]:
        """One that looks at the origin of the scene."""
        film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
        look = T().look_at(self(*origin), self(0, 0, 0), [0, 1, 0.01])
        return {"type": "perspective", "fov": fov, "near_clip": 0.1 * self.scale, "far_clip": 1e5 * self.scale,
                "to_world": look, "film": film}  # fmt: skip


def _box(to: Frame, half: tuple[float, float, float], bsdf: dict[str, Any]) -> dict[str, Any]:
    size = T().scale([to.scale * h for h in half])
    return {"type": "cube", "to_world": T().translate(to(0, 0, 0)) @ T().rotate([0, 0.6, 0.8], 25) @ size, "bsdf": bsdf}


def _ball(to: Frame, half: tuple[float, float, float], bsdf: dict[str, Any]) -> dict[str, Any]:
    return {"type": "sphere", "center": to(0, 0, 0), "radius": to.scale * half[1], "bsdf": bsdf}


def _furnace(to: Frame, half: float, sigma_t: float, shape: Callable = _box) -> dict[str, Any]:
    bsdf = {"type": "translucent", "sigma_t": str(sigma_t), "albedo": "1", "eta": 1.4}
    return {"type": "scene", "integrator": {"type": "translucent_walk", "mm_per_unit": 1 / to.scale},
            "sky": {"type": "constant"}, "block": shape(to, (half,) * 3, bsdf),
            "cam": to.camera((0, -12 * half, 6 * half), 9.0, 8)}  # fmt: skip


@pytest.mark.parametrize("shape", [_box, _ball])
@pytest.mark.parametrize(
    ("half", "sigma_t", "away"), [(30, 1.0, 0), (30, 1.0, 10_000), (2.5, 12.0, 3_000), (2.5, 12.0, 10_000)]
)
def test_a_furnace_is_white_wherever_it_stands(half: float, sigma_t: float, away: float, shape: Callable) -> None:
    scene = mi.load_dict(_furnace(Frame((away, 0, 0)), half, sigma_t, shape))
    image = np.array(mi.render(scene, spp=256, seed=1))
    assert abs(image.mean() - 1) < 3e-4


def _scene(to: Frame, shape: Callable, half: tuple[float, float, float], integrator: dict[str, Any]) -> dict[str, Any]:
    bsdf = {"type": "translucent", "sigma_t": "40", "albedo": "0.9,0.98,0.6", "g": 0.7, "eta": 1.4,
            "model": "better_dipole"}  # fmt: skip
    if half[2] < 0.03:  # less would be too clear for a model
        bsdf["sigma_t"] = "80"
    turned = T().translate(to(0, -15, -10)) @ T().rotate([1, 0, 0], -60) @ T().scale(60 * to.scale)
    return {"type": "scene", "integrator": {"mm_per_unit": 1 / to.scale, **integrator},
            "sky": {"type": "constant", "radiance": 0.2}, "thing": shape(to, half, bsdf),
            "lamp": {"type": "sphere", "center": to(0, 40, -60), "radius": 20 * to.scale,
                     "emitter": {"type": "area", "radiance": 10.0}},
            "floor": {"type": "rectangle", "to_world": turned, "bsdf": {"type": "diffuse", "reflectance": 0.5}},
            "cam": to.camera((0, 10, 80), 14.0, 12)}  # fmt: skip


def _image(to: Frame, *scene: Any, spp: int = 128, seed: int = 1) -> np.ndarray:
    return np.array(mi.render(mi.load_dict(_scene(to, *scene)), spp=spp, seed=seed), dtype=float)


WALK, MODEL = {"type": "translucent_walk"}, {"type": "bssrdf", "light": "sampled"}
LEAF, BALL = (_box, (2, 2, 0.025)), (_ball, (2, 2, 2))
AWAY = Frame((300, 200, -100), 1e3)  # in micrometres


@pytest.mark.slow
@pytest.mark.parametrize(("thing", "integrator"), [(BALL, WALK), (LEAF, MODEL)], ids=["ball-walk", "leaf-model"])
def test_a_scene_is_the_same_in_metres(thing: tuple, integrator: dict[str, Any]) -> None:
    known, other = (_image(frame, *thing, integrator, spp=32) for frame in (Frame(), Frame(scale=1e-3)))
    apart = other - known
    assert np.median(np.abs(apart) / known) < 1e-4
    assert abs(apart.mean()) < 4.5 * apart.std() / np.sqrt(apart.size / 3) + 1e-5 * known.mean()  # some paths part


def _images(frame: Frame, thing: tuple, integrator: dict[str, Any]) -> np.ndarray:
    """By two seeds; the scene is loaded, and what lies inside objects found, once."""
    scene = mi.load_dict(_scene(frame, *thing, integrator))
    return np.array([np.array(mi.render(scene, spp=64, seed=k), dtype=float) for k in range(2)])


@pytest.mark.slow
@pytest.mark.parametrize(("thing", "integrator"), [(LEAF, WALK), (BALL, MODEL)], ids=["leaf-walk", "ball-model"])
def test_a_scene_is_the_same_anywhere(thing: tuple, integrator: dict[str, Any]) -> None:
    """Paths of one seed part where rounding does alone: their difference has a tenth of their own error."""
    known, moved = (_images(frame, thing, integrator) for frame in (Frame(), AWAY))
    apart = (moved - known) / known.mean()
    error = apart.std() / np.sqrt(apart.size / 3)  # as if all channels of a path parted together
    assert error < 3e-3  # reached by the leaf, where the float32 of its place is coarsest
    assert abs(apart.mean()) < 4.5 * error + 1e-4


def test_a_close_lamp_is_found_as_far_from_the_origin_as_at_it() -> None:
    """Distances along rays that only graze it are rounded by more than a thousandth of the distance."""

    def brightness(to: Frame) -> np.ndarray:
        bsdf = {"type": "translucent", "sigma_t": "5", "albedo": "0.95", "eta": 1.4, "model": "better_dipole"}
        lamp = {"type": "sphere", "center": to(2, 3, 1.5), "radius": 0.7, "emitter": {"type": "area"}}
        scene = {"type": "scene", "integrator": MODEL, "ball": _ball(to, (1, 1, 1), bsdf), "lamp": lamp,
                 "cam": to.camera((0, 1.5, 6), 20.0, 8)}  # fmt: skip
        loaded = mi.load_dict(scene)
        return np.array([np.array(mi.render(loaded, spp=512, seed=k)).mean() for k in range(4)])

    near, far = brightness(Frame()), brightness(Frame((9600, -8000, 9920)))
    assert abs(far.mean() / near.mean() - 1) < 0.03


@pytest.mark.parametrize("kind", ["cube", "sphere", "cylinder", "disk", "rectangle", "bsplinecurve", "sdfgrid"])
@pytest.mark.parametrize(
    "frame", [Frame(), Frame((1000, 300, 0)), Frame((1e3, 1e3, 1e3), 1e-3)], ids=["mm", "moved", "m, moved"]
)
def test_rays_that_begin_on_a_surface_do_not_meet_it_there(kind: str, frame: Frame, tmp_path: Any) -> None:
    scene = mi.load_dict({"type": "scene", "it": _of_kind(kind, frame, tmp_path)})
    n, rng, box = 2**17, np.random.default_rng(1), scene.bbox()
    low, high = (np.reshape(np.array(end, dtype=float), (3, 1)) for end in (box.min, box.max))
    size, (from_, to, along) = np.linalg.norm(high - low), (_unit(rng, n) for _ in range(3))
    start = 0.5 * (low + high) + 0.6 * size * from_
    d = 0.5 * (low + high) + 0.4 * size * to * rng.random(n) ** (1 / 3) - start
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(start), mi.Vector3f(d / np.linalg.norm(d, axis=0))))
    ray = ray_from(si, mi.Vector3f(along), InstanceScene([], {}, bounds_of(scene.shapes())).rounding(si))
    again = scene.ray_intersect(ray, mi.RayFlags.All, False, si.is_valid())
    wrong = again.is_valid() & (again.t < 1e-2 * size) & (dr.dot(si.n, ray.d) * dr.dot(again.n, ray.d) > 0)
    assert dr.mean(dr.select(si.is_valid(), 1.0, 0.0))[0] > 0.2
    assert dr.mean(dr.select(wrong, 1.0, 0.0))[0] < 2e-5  # through an edge


def _unit(rng: np.random.Generator, n: int) -> np.ndarray:
    v = rng.standard_normal((3, n))
    return v / np.linalg.norm(v, axis=0)


def _of_kind(kind: str, frame: Frame, folder: Any) -> dict[str, Any]:
    to_world = T().translate(frame(0, 0, 0)) @ T().rotate([0.6, 0, 0.8], 30) @ T().scale(frame.scale)
    if kind == "bsplinecurve":
        angle = np.linspace(0, 2 * np.pi, 20)
        places = [frame(np.cos(a), np.sin(a), a / 3) + [0.2 * frame.scale] for a in angle]
        np.savetxt(folder / "curve.txt", places)
        return {"type": kind, "filename": str(folder / "curve.txt")}
    if kind == "sdfgrid":
        x = np.linspace(-1.2, 1.2, 16)
        x, y, z = np.meshgrid(x, x, x, indexing="ij")
        grid = mi.TensorXf((np.sqrt(x * x + y * y + z * z) - 0.9).astype(np.float32)[..., None])
        return {"type": kind, "grid": grid, "to_world": to_world @ T().scale(2) @ T().translate([-0.5, -0.5, -0.5])}
    return {"type": kind, "to_world": to_world}
