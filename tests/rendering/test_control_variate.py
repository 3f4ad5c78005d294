"""Light gathered as control variate: the same means as without, less noise, objects that go without it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from halfspace_sss import rendering
from halfspace_sss.rendering.gathered import patches
from halfspace_sss.rendering.paths import control_variate, lit_entries

mi = pytest.importorskip("mitsuba")

SEEDS = 12
Z = 5.0  # Student's t of 22 degrees, of 3 channels and 2 scenes: 1 in 3000 by chance


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few cells and little light: what holds for any transfer holds for a coarse one."""
    mi.set_variant("llvm_ad_rgb")
    rendering.register()
    monkeypatch.setattr(patches, "FEWEST", 128)
    monkeypatch.setattr(patches, "MOST", 128)
    monkeypatch.setattr(patches, "SAMPLES", 2**17)
    monkeypatch.setattr(control_variate, "MOST_SHARE", 1e9)


def _scene(kind: str, light: str = "room", model: str = "better_dipole", shape: str = "sphere", **more: Any):
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 2, 8], [0, 0, 0], [0, 1, 0])
    medium = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, -1.05, 0]).rotate([1, 0, 0], -90)}
    lamp = {"type": "sphere", "center": [1.5, 3, 2.5], "radius": 0.5, "emitter": {"type": "area", "radiance": 20.0}}
    point = {"type": "point", "position": [-1.5, 2, -2.5], "intensity": 20.0}
    sky = {"type": "constant", "radiance": 0.5}
    lights = {"room": {"floor": floor, "lamp": lamp, "sky": sky}, "point": {"floor": floor, "point": point}}[light]
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "bssrdf", "mm_per_unit": 6.0, "hide_emitters": True, "light": kind, **more},
            "sensor": {"type": "perspective", "fov": 13.0, "to_world": view, "film": film},
            "wax": {"type": shape, "bsdf": {"type": "translucent", **medium, "model": model}},
            **lights,
        }
    )


def _images(scene: Any, spp: int = 128) -> np.ndarray:
    """Independent images, each with light of its own gathering."""
    return np.array([np.array(mi.render(scene, spp=spp, seed=k), dtype=float) for k in range(SEEDS)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "model", "shape", "depth"),
    [("room", "better_dipole", "cube", 8), ("point", "better_dipole", "sphere", 2)],
)
def test_means_are_those_without_it_and_noise_is_less(light: str, model: str, shape: str, depth: int) -> None:
    a, b = (_images(_scene(kind, light, model, shape, max_depth=depth)) for kind in ("sampled", "corrected"))
    means = [images.mean(axis=(1, 2)) for images in (a, b)]
    error = np.sqrt(sum(m.var(axis=0, ddof=1) / SEEDS for m in means))
    assert (np.abs(means[0].mean(axis=0) - means[1].mean(axis=0)) < Z * error).all()
    without, with_it = (images[:, 2:6, 2:6].var(axis=0, ddof=1).mean() for images in (a, b))
    assert with_it < without


@pytest.mark.slow
def test_the_same_seed_gives_the_same_image() -> None:
    images = [np.array(mi.render(_scene("corrected"), spp=4, seed=3)) for _ in range(2)]
    assert (images[0] == images[1]).all()


@pytest.mark.slow
def test_entries_drawn_by_light_have_the_same_mean_and_less_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lit_entries, "LEAST", 0)
    images = []
    for gain in (np.inf, 0.0):
        monkeypatch.setattr(lit_entries, "LEAST_GAIN", gain)
        images.append(_images(_scene("sampled", "point", "better_dipole", "cube"), spp=256))
    means = [part.mean(axis=(1, 2)) for part in images]
    error = np.sqrt(sum(m.var(axis=0, ddof=1) / SEEDS for m in means))
    assert (np.abs(means[0].mean(axis=0) - means[1].mean(axis=0)) < Z * error).all()
    by_S, by_light = (part[:, 2:6, 2:6].var(axis=0, ddof=1).mean() for part in images)
    assert by_light < by_S
