"""Several points of entry for an exit: the same light with less noise, whatever lights the object."""

import numpy as np
import pytest
from rendered import mean_of_pixels, surface

mi = pytest.importorskip("mitsuba")

LIGHTS = {
    "sky": {"type": "constant"},
    "sun": {"type": "directional", "direction": [-0.5, 0.2, -1.0]},
    "lamp": {"type": "sphere", "center": [2, 1, 3], "radius": 0.3, "light": {"type": "area", "radiance": 40.0}},
    "window": {"type": "envmap", "filename": None},
}


@pytest.fixture(autouse=True)
def _variant():
    from halfspace_sss import rendering

    mi.set_variant("llvm_ad_rgb")
    rendering.register()


def seen(light: str, entries: int) -> tuple[np.ndarray, np.ndarray]:
    """Pixels that show the ball only."""
    emitter = dict(LIGHTS[light])
    if light == "window":
        sky = np.full((8, 16, 3), 0.1, np.float32)
        sky[2:4, 3:6] = 8.0
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(sky)}
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale(0.7)
    film = {"type": "hdrfilm", "width": 24, "height": 24, "rfilter": {"type": "box"}}
    ball = {"type": "sphere", "bsdf": surface(medium={"sigma_s": 6.0, "sigma_a": 0.1})}
    scene = {
        "type": "scene", "integrator": {"type": "bssrdf", "max_depth": 3, "entries": entries}, "light": emitter,
        "ball": ball, "sensor": {"type": "orthographic", "to_world": view, "film": film},
    }  # fmt: skip
    return mean_of_pixels(scene, spp=256)


@pytest.mark.parametrize("light", LIGHTS)
def test_several_entries_give_the_light_of_one(light):
    (one, one_error), (four, four_error) = seen(light, 1), seen(light, 4)
    assert np.all(np.abs(one - four) < 4 * np.hypot(one_error, four_error)) and np.all(one > 0)
    assert np.all(np.abs(four / one - 1) < 0.03)


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
        images = np.array([np.array(mi.render(scene, spp=64, seed=k)) for k in range(16)])
        return images.var(axis=0, ddof=1).mean()

    assert noise(4) < 0.5 * noise(1)


@pytest.mark.parametrize("entries", [0, -3])
def test_fewer_than_one_entry_is_refused(entries):
    with pytest.raises(Exception, match="entries must be at least 1"):
        mi.load_dict({"type": "bssrdf", "entries": entries})
