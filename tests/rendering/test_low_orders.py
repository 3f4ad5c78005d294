"""Orders 0 and 1 beside a model of the others: against random walks that are scattered at most once.

Comparisons are z-tests per quarter of the image and channel; every one states its orders.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_translucent_walk import COLOURED, _agree, _lamp, _runs, _scene, _small_lamp, _z

from full_geometry.geometry.points import ObjectModel
from full_geometry.integrators import ballistic_and_single
from full_geometry.transport import half_space, prepare
from full_geometry.walk import media as walks

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
BRIGHT = {"sigma_s": "0.19,0.1,0.05", "sigma_a": "0.01,0.002,0.001", "g": 0.3, "eta": 1.3}
DARK = {"sigma_s": "0.02,0.05,0.1", "sigma_a": "0.2,0.1,0.02", "g": -0.2, "eta": 1.5}


@pytest.fixture
def only_few(monkeypatch: pytest.MonkeyPatch) -> None:
    """No order from two on: neither in walks nor by a model."""
    monkeypatch.setattr(prepare, "_model_of", lambda *_: ObjectModel(None, None))
    monkeypatch.setitem(walks._MOST, "total", 1)
    monkeypatch.setattr(half_space, "MOST_STRAIGHT", 1.0)  # no model has to know what passes


def _shape(name: str) -> dict:
    at = mi.ScalarTransform4f()
    if name == "slab":
        return {"type": "cube", "to_world": at.rotate([1, 1, 0], 30).scale([7, 7, 0.7])}
    if name == "bunny":
        return {"type": "ply", "filename": str(BUNNY), "to_world": at.scale(1.5).translate([0, -4.5, 0])}
    return {"type": "sphere", "radius": 9.0}


def _pair(surface: dict, light: dict | None, shape: str, spp: tuple[int, int], runs: int = 12) -> list[np.ndarray]:
    """Images by the integrators `bssrdf` and `translucent_walk`."""
    found = []
    for k, kind in enumerate(("bssrdf", "translucent_walk")):
        scene = _scene({**surface, "model": "better_dipole"}, light, _shape(shape))
        walk = {"light": "sampled"} if kind == "translucent_walk" else {}
        scene["integrator"] = {"type": kind, "max_depth": -1, "rr_depth": 20, **walk}
        found.append(_runs(mi.load_dict(scene), runs, spp[k], 1 + 100 * k))
    return found


CASES = {
    "bright sphere, sky": ("sphere", BRIGHT, None),
    "bright slab, lamp": ("slab", BRIGHT, "lamp"),
    "dark slab, sky": ("slab", DARK, None),
    "bright bunny, sky": ("bunny", BRIGHT, None),
    "dark bunny, lamp": ("bunny", DARK, "lamp"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "medium", "light"), CASES.values(), ids=CASES)
@pytest.mark.filterwarnings("ignore:object:UserWarning")
def test_orders_below_two_are_those_of_walks(only_few: None, shape: str, medium: dict, light: str | None) -> None:
    lamp = _lamp() if light else None
    _agree(*_pair({**medium, "orders": "total"}, lamp, shape, (192, 768 if light else 192)))


@pytest.mark.parametrize("light", [None, "lamp"], ids=["sky", "lamp"])
@pytest.mark.filterwarnings("ignore:object:UserWarning")
def test_single_scattering_holds_what_is_reflected_inside(light: str | None) -> None:
    lamp = _lamp() if light else None
    _agree(*_pair({**DARK, "orders": "single", "reflection": False}, lamp, "slab", (256, 256)))


@pytest.mark.filterwarnings("ignore:object:UserWarning")
def test_a_medium_that_does_not_scatter_shows_what_is_behind_it() -> None:
    surface = {"sigma_s": 0.0, "sigma_a": "0.001,0.05,0.2", "eta": 1.5, "orders": "total"}
    images = _pair(surface, None, "sphere", (64, 64))
    _agree(*images)
    assert images[0][..., 0].mean() > 0.95 and images[0][..., 2].mean() < 0.7


@pytest.mark.filterwarnings("ignore:object:UserWarning")
def test_a_small_lamp_is_found_by_the_refracted_ray_to_it(only_few: None) -> None:
    """What it brings unscattered and by reflection is left to chance, and so to the sky in this test."""
    surface = {**BRIGHT, "orders": "single", "reflection": False, "eta": 1.0}
    found, truth = _pair(surface, _small_lamp(), "sphere", (64, 256))
    _agree(found, truth)
    assert 64 * np.median(found.var(axis=0)) < 256 * np.median(truth.var(axis=0))


def test_each_part_of_the_light_of_a_body_is_counted_once() -> None:
    parts = []
    for k, (orders, reflection) in enumerate((("total", True), ("single", False), ("multiple", False))):
        surface = {**COLOURED, "g": 0.3, "eta": 1.4, "orders": orders, "reflection": reflection}
        scene = _scene({**surface, "model": "better_dipole"}, None, {"type": "sphere", "radius": 10.0})
        scene["integrator"] = {"type": "bssrdf", "max_depth": 2, "hide_emitters": True}
        parts.append(_runs(mi.load_dict(scene), 12, 256, 1 + 100 * k))
    mirror = _scene({"sigma_s": 1e-3, "sigma_a": 50.0, "eta": 1.4, "model": "better_dipole", "orders": "multiple"})
    mirror["integrator"] = {"type": "bssrdf", "max_depth": 2, "hide_emitters": True}
    reflected = _runs(mi.load_dict(mirror), 12, 256, 1000)
    total, inside = parts[0], parts[1] + parts[2] + reflected
    assert np.abs(_z(total, inside)).max() < 6.0


def test_points_of_a_lamp_are_left_to_chance_where_they_are_seen_at_grazing_angles_or_from_behind() -> None:
    n, d = mi.Normal3f(0, 0, 1), mi.Vector3f(*np.array([[0.6, 1, 1, 0.6], [0, 0, 0, 0], [-0.8, -0.06, -0.04, 0.8]]))
    assert list(ballistic_and_single._faces(n, d)) == [True, True, False, False]
    assert list(ballistic_and_single._faces(mi.Normal3f(0), d)) == [True] * 4
