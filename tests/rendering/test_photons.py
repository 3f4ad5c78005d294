"""Light carried by photons: brightness against walks, furnace, noise, what makes them walk anew, refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from halfspace_sss.rendering.paths import gathering
from halfspace_sss.rendering.paths.integrator import is_bssrdf
from halfspace_sss.rendering.scenes.scene_files import open_scene
from halfspace_sss.trade.ways import Way

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

MEDIUM = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}
SKY = {"sky": {"type": "constant", "radiance": 1.0}}


def _lit() -> dict:
    """A lamp, a dim sky and a floor that sends light back."""
    lamp = {"type": "sphere", "center": [1.5, 3, 2.5], "radius": 0.5, "emitter": {"type": "area", "radiance": 20.0}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, -1.05, 0]).rotate([1, 0, 0], -90)}
    return {"lamp": lamp, "floor": floor, "sky": {"type": "constant", "radiance": 0.5}}


def _dict(lights: dict, integrator: dict, surface: dict = MEDIUM, **more: Any) -> dict:
    film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    surface = {"type": "translucent", **surface, "orders": "multiple", "reflection": False, **more}
    return {
        "type": "scene",
        "integrator": {"mm_per_unit": 6.0, "hide_emitters": True, **integrator},
        "sensor": {"type": "perspective", "fov": 11.0, "to_world": view, "film": film},
        "wax": {"type": "sphere", "bsdf": surface},
        **lights,
    }


def _gathered(lights: dict, surface: dict = MEDIUM, photons: int = 2**18, **more: Any) -> mi.Scene:
    integrator = {"type": "bssrdf", "light": "gathered", "photons": photons}
    return mi.load_dict(_dict(lights, integrator, surface, model="path_traced", **more))


def _image(scene: Any, spp: int = 64, seed: int = 0) -> np.ndarray:
    return np.array(mi.render(scene, spp=spp, seed=seed), dtype=float)


def test_pixels_are_those_of_walks_within_8_percent_and_their_mean_within_2() -> None:
    walks = mi.load_dict(_dict(_lit(), {"type": "translucent_walk"}))
    a, b = (_image(walks, 1024, seed) for seed in (1, 2))
    found = _image(_gathered(_lit()))
    square = ((found - a) * (found - b)).mean(axis=(0, 1))  # noise of the two is independent
    noise = np.abs(a - b).mean(axis=(0, 1)) / 12
    assert (np.sqrt(np.maximum(square, 0)) < 0.08 * a.mean(axis=(0, 1)) + 4 * noise).all()
    assert (np.abs((found - 0.5 * (a + b)).mean(axis=(0, 1))) < 0.02 * a.mean(axis=(0, 1)) + 4 * noise).all()


def test_what_absorbs_nothing_cannot_be_seen_under_an_even_sky() -> None:
    white = {"sigma_s": "1,1.5,2", "sigma_a": "0,0,0", "g": 0.3, "eta": 1.4}
    found = _image(_gathered(SKY, white, 2**17, orders="total", reflection=True))[2:-2, 2:-2]  # without the rim
    assert np.abs(found.mean(axis=(0, 1)) - 1).max() < 0.03  # noise is 0.01
    assert np.abs(found - 1).max() < 0.25


def test_objects_send_each_other_what_photons_brought(monkeypatch: pytest.MonkeyPatch) -> None:
    leaving, sent = gathering._leaving, []

    def watched(scene: Any, obj: Any, k: int, between: list, *rest: Any) -> Any:
        sent.append(between[k].gathered is not None)
        return leaving(scene, obj, k, between, *rest)

    monkeypatch.setattr(gathering, "_leaving", watched)
    scene = _gathered(SKY, photons=2**16)
    scene.integrator().prepare(scene)
    assert sent == [False, True]


def test_four_times_the_photons_have_half_the_noise() -> None:
    errors = []
    for photons in (2**14, 2**16):
        scene = _gathered(_lit(), photons=photons)
        errors.append(scene.integrator().prepare(scene)[0].gathered.error)
    assert 1.6 < errors[0] / errors[1] < 2.5


def test_a_render_tells_photons_and_noise() -> None:
    scene = _gathered(SKY, photons=2**16)
    _image(scene, 1)
    (told,) = scene.integrator().gathered
    assert "carried by 65536 photons" in told and "noise" in told


def test_twice_the_light_is_twice_as_bright() -> None:
    scene = _gathered(SKY, photons=2**16)
    before = _image(scene)
    parameters = mi.traverse(scene)
    parameters["sky.radiance.value"] = 2.0
    parameters.update()
    assert np.abs(_image(scene) / before - 2).max() < 1e-3


def test_a_dark_scene_is_dark() -> None:
    assert _image(_gathered({"sky": {"type": "constant", "radiance": 0.0}}, photons=2**12)).max() == 0


@pytest.mark.parametrize("light", ["sampled", "auto"])
def test_light_that_is_not_gathered_is_refused(light: str) -> None:
    scene = mi.load_dict(_dict(SKY, {"type": "bssrdf", "light": light}, model="path_traced"))
    with pytest.raises(ValueError, match=f"light must be gathered for the model 'path_traced'.*got {light}"):
        scene.integrator().prepare(scene)


def test_textures_are_refused() -> None:
    colours = np.array([[[0.8, 0.5, 0.3], [0.2, 0.6, 0.5]]], np.float32)
    painted = {"reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(colours), "raw": True}, "mfp": "0.8,0.6,0.4"}
    scene = _gathered(SKY, painted)
    with pytest.raises(ValueError, match="path_traced"):
        scene.integrator().prepare(scene)


def test_too_few_photons_are_refused() -> None:
    with pytest.raises(Exception, match="photons must be a whole number >= 1000, got 10"):
        _gathered(SKY, photons=10)


@pytest.mark.parametrize(("settings", "bssrdf"), [({"light": "gathered"}, True), ({}, False)])
def test_path_traced_is_the_walk_unless_its_light_is_gathered(settings: dict, bssrdf: bool) -> None:
    scene = open_scene(_dict(SKY, {"type": "bssrdf"}), "path_traced", None, None, settings)
    assert is_bssrdf(scene.integrator()) == bssrdf


@pytest.mark.parametrize("light", ["gatherd", "auto"])
def test_path_traced_takes_no_light_but_sampled_and_gathered(light: str) -> None:
    with pytest.raises(ValueError, match=f"light must be one of sampled, gathered, got '{light}'"):
        open_scene(_dict(SKY, {"type": "bssrdf"}), "path_traced", None, None, {"light": light})


def test_the_way_is_rendered_by_the_flags_that_it_names() -> None:
    assert Way.of("path_traced, gathered").flags == "--model path_traced --light gathered"
    assert not Way.of("path_traced, gathered").walks
