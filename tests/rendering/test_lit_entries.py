"""Entries drawn where light arrives: the same means as by S alone, and less noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rendered import independent

import full_geometry
from full_geometry.integrators import lit_entries

mi = pytest.importorskip("mitsuba")

SEEDS = 12
Z = 5.0  # Student's t of 22 degrees, of 3 channels: 1 in 6000 by chance


@pytest.fixture(autouse=True)
def _variant() -> None:
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


def _scene() -> Any:
    """A cube on a floor under a point light behind it."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 2, 8], [0, 0, 0], [0, 1, 0])
    medium = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}
    down = mi.ScalarTransform4f().translate([0, -1.05, 0]).rotate([1, 0, 0], -90)
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "bssrdf", "mm_per_unit": 6.0, "hide_emitters": True},
            "sensor": {"type": "perspective", "fov": 13.0, "to_world": view, "film": film},
            "wax": {"type": "cube", "bsdf": {"type": "translucent", **medium, "model": "better_dipole"}},
            "floor": {"type": "rectangle", "to_world": down},
            "point": {"type": "point", "position": [-1.5, 2, -2.5], "intensity": 20.0},
        }
    )


@pytest.mark.slow
def test_entries_drawn_by_light_have_the_same_mean_and_less_noise(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lit_entries, "LEAST", 0)
    images = []
    for gain in (np.inf, 0.0):
        monkeypatch.setattr(lit_entries, "LEAST_GAIN", gain)
        images.append(independent(_scene(), SEEDS, 256))
    means = [part.mean(axis=(1, 2)) for part in images]
    error = np.sqrt(sum(m.var(axis=0, ddof=1) / SEEDS for m in means))
    assert (np.abs(means[0].mean(axis=0) - means[1].mean(axis=0)) < Z * error).all()
    by_S, by_light = (part[:, 2:6, 2:6].var(axis=0, ddof=1).mean() for part in images)
    assert by_light < by_S
