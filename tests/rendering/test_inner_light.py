"""Light at events of order 1 gathered inside objects: against traced events, where it stands for them, noise."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from full_geometry.integrators import gathering
from full_geometry.integrators.inner_light import _directions
from full_geometry.objects.objects import object_of
from full_geometry.precomputed import inner
from full_geometry.transport import prepare

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

CLEAR = {"sigma_s": ".3,.25,.2", "sigma_a": ".02,.1,.3", "eta": 1.4}  # a ball of 4 to 6 mean free paths
LAMP = {"type": "sphere", "center": [1.5, 3, 2.5], "radius": 0.5, "emitter": {"type": "area", "radiance": 40.0}}
SKY = {"type": "constant", "radiance": 0.5}


def _uneven() -> dict:
    texels = np.full((16, 32, 3), 0.2, np.float32)
    texels[3:8, 4:12] = 3.0, 2.5, 2.0
    return {"type": "envmap", "bitmap": mi.Bitmap(texels)}


def _floor() -> dict:
    to_world = mi.ScalarTransform4f().translate([0, -1.05, 0]).rotate([1, 0, 0], -90).scale(4)
    return {"type": "rectangle", "to_world": to_world}


def _lights(name: str) -> dict:
    return {
        "windows": {"sky": _uneven()},
        "floor": {"floor": _floor(), "sky": SKY},
    }[name]


def _scene(lights: dict, **surface: Any) -> Any:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    surface = {"type": "translucent", **CLEAR, "model": "better_dipole", "reflection": False, **surface}
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "bssrdf", "mm_per_unit": 6.0, "hide_emitters": True, "light": "gathered"},
            "sensor": {"type": "perspective", "fov": 11.0, "to_world": view, "film": film},
            "wax": {"type": "sphere", "bsdf": surface},
            **lights,
        }
    )


def _image(scene: Any, spp: int, seed: int) -> np.ndarray:
    return np.array(mi.render(scene, spp=spp, seed=seed), dtype=float)


@cache
def _pictures(light: str) -> tuple[np.ndarray, np.ndarray]:
    """Three images with light at events traced, and three with that light gathered; orders 0 and 1 are much of it."""
    found = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(prepare, "_low_orders", lambda *_: (0, 1))
        for traces, spp in ((True, 1024), (False, 64)):
            patch.setattr(gathering, "has_inner_light", (lambda _: False) if traces else inner.has_inner_light)
            scene = _scene(_lights(light), g=0.3)
            found.append([_image(scene, spp, seed) for seed in (1, 2, 3)])
            assert (scene.integrator().prepare(scene)[0].gathered.inner is None) == traces
    return np.array(found[0]), np.array(found[1])


@pytest.mark.slow
@pytest.mark.parametrize("light", ["windows", "floor"])
def test_light_is_that_of_traced_events_within_1_percent_and_beside_a_floor_within_2(light: str) -> None:
    traced, gathered = (x.mean(axis=(1, 2)) for x in _pictures(light))
    noise, most = traced.std(axis=0, ddof=1) / np.sqrt(3), 0.02 if light == "floor" else 0.01
    assert (np.abs(gathered.mean(axis=0) - traced.mean(axis=0)) < most * traced.mean(axis=0) + 5 * noise).all()


@pytest.mark.slow
def test_pixels_of_a_sample_have_a_tenth_of_the_variance_at_most() -> None:
    traced, gathered = (x[:, 4:8, 4:8] for x in _pictures("windows"))
    assert np.median(64 * gathered.var(axis=0, ddof=1)) < 0.1 * np.median(1024 * traced.var(axis=0, ddof=1))


def _ball(radius: float = 5.0, **medium: Any) -> Any:
    from halfspace_sss import Medium

    values = {"sigma_s": np.full(3, 1.0), "sigma_a": np.full(3, 0.1), "g": 0.0, "eta": 1.4, **medium}
    return object_of(mi.load_dict({"type": "sphere", "radius": radius}), Medium(**values))


def test_a_plane_of_values_is_known_everywhere_inside() -> None:
    def plane(p: np.ndarray) -> np.ndarray:
        return 3 + p.T @ np.array([[0.1, 0.0, 0.2], [0.0, 0.3, 0.0], [0.2, 0.1, -0.1]])

    ball = _ball(radius=1.5)
    events = inner.Events.of(ball, 2**14)
    light = inner.InnerLight.of(ball, events, plane(np.array(events.p, dtype=float))[:, None])
    p = np.random.default_rng(1).uniform(-0.85, 0.85, (3, 1000))  # within the ball
    found = np.array(light(mi.Point3f(p), mi.Vector3f(0, 0, 1), mi.Bool(True))).T
    assert np.abs(found * np.sqrt(4 * np.pi) - plane(p)).max() < 0.05


def test_bands_are_as_many_as_the_mean_cosine_needs() -> None:
    found = [inner.bands(_ball(g=g)) for g in (0.0, 0.1, 0.3, -0.3)]
    assert found == [0, 1, 2, 2]


@pytest.mark.parametrize("eta", [1.0, 1.4])
def test_directions_by_an_environment_have_the_density_that_is_stated(eta: float) -> None:
    sky, n = _scene({"sky": _uneven()}).environment(), 2**16
    events = mi.Point3f(np.zeros((3, n))), mi.Normal3f(np.tile([[0.0], [0.6], [0.8]], n))
    u = mi.Point2f(np.random.default_rng(1).random((2, n)).astype(np.float32))
    d, inverse_pdf = (np.array(v, dtype=float) for v in _directions(sky, events, eta, u))
    moments = np.stack([np.ones(n), *d, d[0] ** 2, d[1] ** 2, d[1] * d[2]])
    values = moments * inverse_pdf
    expected = 4 * np.pi * np.array([1, 0, 0, 0, 1 / 3, 1 / 3, 0])
    assert np.allclose(np.linalg.norm(d, axis=0), 1, atol=1e-4)
    assert (np.abs(values.mean(axis=1) - expected) < 5 * values.std(axis=1) / np.sqrt(n)).all()


@pytest.mark.parametrize(
    "surface",
    [{"g": 0.6}, {"sigma_s": 0.0}, {"sigma_s": ".3,.25,.2", "orders": "multiple"}],
    ids=["forward", "no scattering", "multiple"],
)
def test_events_are_traced_where_the_grid_would_not_serve(surface: dict) -> None:
    scene = _scene({"sky": SKY}, **surface)
    (obj,) = scene.integrator().prepare(scene)
    assert obj.gathered is None or obj.gathered.inner is None


def test_an_object_of_very_many_mean_free_paths_has_its_events_traced() -> None:
    assert inner.Events.of(_ball(sigma_s=np.full(3, 1000.0)), 2**16) is None


@pytest.mark.slow
def test_light_inside_follows_an_emitter_that_was_edited() -> None:
    scene = _scene({"lamp": LAMP})
    before, parameters = _image(scene, 16, 1), mi.traverse(scene)
    parameters["lamp.emitter.radiance.value"] = mi.Color3f(10.0)
    parameters.update()
    assert np.allclose(_image(scene, 16, 1), before / 4, rtol=1e-4)
