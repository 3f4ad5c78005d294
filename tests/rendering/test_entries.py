"""Several points of entry for an exit: the same light with less noise, whatever lights the object."""

import numpy as np
import pytest
from rendered import independent, mean_of_pixels, render, surface

mi = pytest.importorskip("mitsuba")

LIGHTS = {
    "sky": {"type": "constant"},
    "sun": {"type": "directional", "direction": [-0.5, 0.2, -1.0]},
    "lamp": {"type": "sphere", "center": [2, 1, 3], "radius": 0.3, "light": {"type": "area", "radiance": 40.0}},
    "window": {"type": "envmap", "filename": None},
}


@pytest.fixture(autouse=True)
def _variant():
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


DARK = {"type": "point", "position": [0, 0, 9], "intensity": 1e-6}  # beside it directions are not chosen by the sky


def scene_of(light: str, entries: int, **beside: dict) -> dict:
    """All pixels show the ball."""
    emitter = dict(LIGHTS[light])
    if light == "window":
        sky = np.full((8, 16, 3), 0.1, np.float32)
        sky[2:4, 3:6] = 8.0
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale(0.7)
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    ball = {"type": "sphere", "bsdf": surface(medium={"sigma_s": 6.0, "sigma_a": 0.1})}
    return {
        "type": "scene", "integrator": {"type": "bssrdf", "max_depth": 3, "entries": entries}, "light": emitter,
        "ball": ball, "sensor": {"type": "orthographic", "to_world": view, "film": film},
        **beside,
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("light", LIGHTS)
def test_several_entries_give_the_light_of_one(light):
    (one, one_error), (four, four_error) = (mean_of_pixels(scene_of(light, entries), spp=256) for entries in (1, 4))
    assert np.all(np.abs(one - four) < 4 * np.hypot(one_error, four_error)) and np.all(one > 0)
    assert np.all(np.abs(four / one - 1) < 0.03)


@pytest.mark.slow
def test_directions_that_a_sky_chooses_give_the_same_light_with_less_noise():
    grey, down = {"type": "diffuse"}, mi.ScalarTransform4f().translate([0, -1.02, 0]).rotate([1, 0, 0], -90).scale(3)
    floor, means, errors = {"type": "rectangle", "to_world": down, "bsdf": grey}, [], []
    for dark in ({}, {"dark": DARK}):
        one, two = (render(scene_of("window", 2, floor=floor, **dark), 512, seed) for seed in (3, 4))
        means.append(0.5 * (one + two).mean(axis=(0, 1)))
        errors.append(0.5 * (one - two).std(axis=(0, 1)) / np.sqrt(one[..., 0].size))
    assert np.all(np.abs(means[0] - means[1]) < 5 * np.hypot(*errors)) and np.all(errors[0] < 0.85 * errors[1])


def test_several_entries_are_less_noisy_under_a_sky():
    def noise(entries):
        emitter = {"type": "constant"}
        view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale(0.3)
        film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
        scene = mi.load_dict({
            "type": "scene", "integrator": {"type": "bssrdf", "max_depth": 2, "entries": entries}, "light": emitter,
            "ball": {"type": "sphere", "bsdf": surface(medium={"sigma_s": 6.0, "sigma_a": 0.1})},
            "sensor": {"type": "orthographic", "to_world": view, "film": film},
        })  # fmt: skip
        return independent(scene, 16, 64).var(axis=0, ddof=1).mean()

    assert noise(4) < 0.5 * noise(1)


@pytest.mark.parametrize("entries", [0, -3])
def test_fewer_than_one_entry_is_refused(entries):
    with pytest.raises(Exception, match="entries must be -1 or a whole number >= 1"):
        mi.load_dict({"type": "bssrdf", "entries": entries})
