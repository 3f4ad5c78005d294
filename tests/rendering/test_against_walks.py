"""How far images by models are off, told by few walks; scenes that name no integrator are walked."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")


def _scene(surface: dict, **integrator: Any) -> dict:
    film = {"type": "hdrfilm", "width": 32, "height": 24, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 1, 4], [0.2, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        **({"integrator": integrator} if integrator else {}),
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        "ball": {"type": "sphere", "bsdf": {"type": "translucent", **surface}},
        "light": {"type": "constant"},
    }


KETCHUP = {"material": "ketchup", "model": "neural"}


def _ratio(image: np.ndarray, scene: Any) -> Any:
    from full_geometry.learning.model_errors import mean_ratios

    (found,) = mean_ratios(scene, image)
    return found


def test_an_image_by_walks_has_the_light_of_walks() -> None:
    scene = mi.load_dict(_scene(KETCHUP, type="bssrdf", mm_per_unit=5.0))
    walks = mi.load_dict({"type": "translucent_walk", "mm_per_unit": 5.0})
    found = _ratio(np.array(mi.render(scene, integrator=walks, spp=256)), scene)
    assert found.object == "ball" and found.error < 0.05
    assert abs(found.value - 1) < 4 * found.error


def test_a_half_space_on_a_small_ball_is_told_to_be_off() -> None:
    from full_geometry.learning.model_errors import told

    scene = mi.load_dict(_scene(KETCHUP, type="bssrdf", mm_per_unit=5.0))
    image = np.array(mi.render(scene, spp=64))
    found = _ratio(image, scene)
    (sentence,) = told([found], "neural")
    assert "'ball'" in sentence and f"{found.value:.2f}" in sentence
    assert not told([found._replace(value=1.0)], "neural")

    # twice the image is twice as far
    assert _ratio(2 * image, scene).value == pytest.approx(2 * found.value)


@pytest.mark.parametrize(
    ("surface", "settings", "plugin"),
    [
        ({"material": "ketchup"}, None, "TranslucentWalk"),
        (KETCHUP, None, "BSSRDF"),
        ({"material": "ketchup"}, {"light": "gathered"}, "BSSRDF"),
    ],
)
def test_a_scene_without_integrator_is_walked_unless_a_model_is_named(surface, settings, plugin: str) -> None:
    from full_geometry.scenes.scene_files import open_scene

    assert plugin in str(open_scene(_scene(surface), settings=settings).integrator())
