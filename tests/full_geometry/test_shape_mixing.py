"""Light that an object has mixed: the exact chance to leave, and what it brings where objects are thin."""

from __future__ import annotations

import math

import numpy as np
import pytest

from halfspace_sss import Medium

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
pytest.importorskip("igl")

from benchmarks.held_out import HELD_OUT  # noqa: E402
from benchmarks.random_shapes import make_shape  # noqa: E402
from full_geometry.geometry.points import SurfacePoint, cosine_direction  # noqa: E402
from full_geometry.learning.model_errors import errors_of  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.transport.any_shape import Backbone  # noqa: E402
from full_geometry.transport.descriptors import mean_chord, mixed  # noqa: E402
from full_geometry.transport.features import (  # noqa: E402
    Side,
    first_event,
)
from full_geometry.transport.one_object import HalfSpace  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")


class Alone:
    """S_0 P_o P_i alone, f = 0."""

    orders, alpha = "multiple", None

    def __init__(self, obj: TranslucentObject, S_0: HalfSpace) -> None:
        self.object, self.S_0 = obj, S_0

    def prepare(self, at: SurfacePoint, active: object = True) -> Side:
        return Side(at, first_event(self.object, at))

    def S(self, exit: Side, at: SurfacePoint, active: object = True) -> object:
        return dr.select(active, self.S_0(exit, self.prepare(at)), 0)


@pytest.mark.parametrize("radius", [0.2, 1.0, 5.0])
def test_the_chance_to_leave_a_sphere_without_a_boundary_is_the_exact_one(radius: float) -> None:
    obj = object_of(mi.load_dict({"type": "sphere", "radius": radius}), Medium(0.9, 0.1, 0.0, 1.0))
    t = 2 * radius  # optical diameter; <exp(-t mu)> = 2 ∫ mu exp(-t mu) dmu
    stays = 1 - 2 * (1 - math.exp(-t) * (1 + t)) / t**2
    found = mixed(obj)[0]
    assert np.isclose(mean_chord(obj), 4 / 3 * radius, rtol=0.01)
    assert np.isclose(1 - found.q, stays / (4 / 3 * radius), rtol=0.015)


def test_the_mean_chord_of_a_box_that_is_turned_is_four_times_volume_over_area() -> None:
    box = mi.ScalarTransform4f().rotate([0.36, 0.8, 0.48], 40).scale([0.1, 1, 2])
    obj = object_of(mi.load_dict({"type": "cube", "to_world": box}), Medium(1.0, 0.0))
    V, A = 8 * 0.2, 8 * (0.1 + 0.2 + 2)
    assert np.isclose(mean_chord(obj), 4 * V / A, rtol=0.02)


def test_what_is_open_mixes_nothing() -> None:
    obj = object_of(mi.load_dict({"type": "rectangle"}), Medium(1.0, 0.0))
    assert abs(mixed(obj)[0].M) < 1e-9


@pytest.mark.parametrize(("g", "least"), [(-0.3, 0.75), (0.0, 0.75), (0.6, 0.5), (0.9, 0.5)])
def test_they_are_most_of_the_light_of_a_thin_sheet(g: float, least: float) -> None:
    obj = object_of(make_shape("sheets", 3, 24).mitsuba("sheet"), Medium(0.95, 0.05, g, 1.45).scaled(0.15))
    S_0 = HalfSpace(obj, "neural")
    models = {"mixed": Alone(obj, Backbone(obj, mixed(obj))), "plane": Alone(obj, S_0)}
    found = errors_of(obj, models, exits=64, walks=2048, samples=1024)
    with_mixed, plane = (found[name][0].ratio for name in models)
    assert plane < 0.3 and least < with_mixed < 1.25


def test_light_that_is_scattered_twice_is_the_same_both_ways() -> None:
    obj = object_of(make_shape("leaves", 3, 24, HELD_OUT).mitsuba("leaf"), Medium(0.95, 0.05, 0.6, 1.45))
    S_0, (o, i) = Backbone(obj, mixed(obj)), ends(obj)
    there, back = (S_0.twice(*pair)[0].numpy() for pair in ((o, i), (i, o)))
    assert np.allclose(there, back, rtol=1e-4) and there.max() > 0


def test_shares_of_what_a_plane_lacks_are_parts_of_one_and_most_of_a_thin_leaf() -> None:
    obj = object_of(make_shape("leaves", 3, 24, HELD_OUT).mitsuba("leaf"), Medium(0.95, 0.05, 0.0, 1.45).scaled(0.5))
    S_0, (o, i) = Backbone(obj, mixed(obj)), ends(obj)
    parts = np.stack([part.numpy() for part in S_0.shares(S_0(o, i), o, i)[0]])
    assert parts.min() >= 0 and parts.sum(axis=0).max() < 1 + 1e-4
    assert np.median(parts.sum(axis=0)) > 0.5


def test_light_of_two_events_is_that_of_the_half_space_on_a_plane() -> None:
    box = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale(1000.0)})
    obj = object_of(box, Medium(0.9, 0.1, 0.3, 1.4))
    S_0 = Backbone(obj, [mixture._replace(m_2=1.0) for mixture in mixed(obj)])
    rng = generator(mi, 512, pass_seed(3))
    n = mi.Normal3f(dr.zeros(mi.Float, 512), dr.zeros(mi.Float, 512), dr.full(mi.Float, 1.0, 512))
    points = [mi.Point3f(6 * rng.next_float32(), 6 * rng.next_float32(), 1000.0) for _ in range(2)]
    pair = [SurfacePoint(p, n, n, cosine_direction(n, n, rng)) for p in points]
    o, i = (Side(at, first_event(obj, at)) for at in pair)
    assert S_0.twice(o, i)[0].numpy().max() < 2e-3


def test_a_thick_object_keeps_the_half_space() -> None:
    obj = object_of(mi.load_dict({"type": "sphere"}), Medium(0.95, 0.05, 0.0, 1.3).scaled(1000.0))
    pair = ends(obj)
    mine, plane = (np.array(S_0(*pair)) for S_0 in (Backbone(obj, mixed(obj)), HalfSpace(obj, "neural", 2e-3)))
    assert np.abs(mine - plane).max() < 1e-5 * plane.max()


def ends(obj: TranslucentObject) -> list[Side]:
    """Exits and entries with their first events."""
    points = (obj.random_points(generator(mi, 4096, pass_seed(k))) for k in (1, 2))
    return [Side(at, first_event(obj, at)) for at in points]
