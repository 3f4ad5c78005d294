"""How much of an object surrounds a point: balls of known volume, their surface, what is moved, what is large; and how
far apart first events are."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mitsuba")

import mitsuba as mi  # noqa: E402

mi.set_variant("llvm_ad_rgb")

from waxen import BUNNY, WAX, wax_bunny  # noqa: E402

from full_geometry.geometry.points import surface_point  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.transport.features import (  # noqa: E402
    EVENT,
    FIELDS,
    POINT,
    WIDTHS,
    Side,
    first_event,  # noqa: E402
    n_side,
    pair_features,
    side_features,
    solid,
)
from full_geometry.transport.storing import frame_of, identify  # noqa: E402
from halfspace_sss import Medium  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

DENSE = Medium(np.array([9.5, 9.0, 8.0]), np.array([0.5, 1.0, 2.0]), 0.0, 1.4)  # 10 / mm


@pytest.fixture(scope="module")
def ball() -> TranslucentObject:
    return object_of(mi.load_dict({"type": "sphere", "radius": 1.5, "center": [0.3, -0.2, 0.1]}), DENSE)


def _along_a_radius(obj: TranslucentObject, radii: list[float], way: tuple[float, float, float]) -> np.ndarray:
    """Fields (n, FIELDS) as they were before they were turned, at distances from the middle of the ball."""
    frame, way = frame_of(obj), np.array(way) / np.linalg.norm(way)
    p = np.array(radii)[:, None] * way + [0.3, -0.2, 0.1]
    turn = frame.around.turns[POINT]
    fields = np.array(frame.around(frame.position(mi.Point3f(p.T.astype(np.float32))), POINT))
    return np.linalg.solve(turn[:, :-1].astype(float), fields - turn[:, -1:]).T


def test_cells_inside_of_a_ball_have_its_volume(ball: TranslucentObject) -> None:
    frame = frame_of(ball)
    cell, cells = 0.03, np.array([60, 70, 80])
    inside = solid(ball, frame, -0.5 * cell * cells, cell, cells)
    volume = inside.sum() * (cell * float(frame.radius[0] if np.ndim(frame.radius) else frame.radius)) ** 3
    assert inside.shape == (80, 70, 60)
    assert abs(volume / (4 / 3 * np.pi * 1.5**3) - 1) < 5e-3


def test_half_of_what_surrounds_a_point_of_a_flat_surface_is_inside(ball: TranslucentObject) -> None:
    for way in ((1, 0, 0), (0.3, -0.5, 0.8)):
        deep, at = _along_a_radius(ball, [0.0, 1.5], way)[:, : len(WIDTHS)]
        share = at / deep
        # of a ball s / (sqrt(2 pi) R) is missing to first order
        expected = 0.5 - np.array(WIDTHS) * 0.1 / (np.sqrt(2 * np.pi) * 1.5)
        assert np.allclose(share, expected, atol=0.05)  # a quarter of a cell, for the narrowest


def test_slopes_point_inwards_and_are_largest_at_the_surface(ball: TranslucentObject) -> None:
    way = np.array([0.3, -0.5, 0.8])
    slopes = _along_a_radius(ball, [0.0, 1.2, 1.5], tuple(way))[:, len(WIDTHS) :]
    along = slopes @ (way / np.linalg.norm(way))
    assert along[2] < along[1] < 0
    assert np.linalg.norm(slopes[0]) < 0.1 * abs(along[2])
    assert np.linalg.norm(slopes[2] - along[2] * way / np.linalg.norm(way)) < 0.15 * abs(along[2])


def test_fields_have_mean_zero_and_no_direction_of_larger_spread_over_points_and_over_first_events() -> None:
    obj = wax_bunny()
    frame, at = frame_of(obj), obj.random_points(generator(mi, 2**14, pass_seed(4)))
    for kind, place in ((POINT, at.p), (EVENT, first_event(obj, at).y)):
        fields = np.array(frame.around(frame.position(place), kind))
        spread = np.linalg.eigvalsh(np.cov(fields))
        assert np.all(np.abs(fields.mean(axis=1)) < 0.05)
        assert spread[-1] < 1.1 and np.all(spread[2:] > 0.7)  # what hardly varies stays small


@pytest.mark.slow
def test_what_surrounds_a_point_is_the_same_where_the_object_has_been_moved() -> None:
    obj = wax_bunny()
    turn = mi.ScalarTransform4f().translate([5, -2, 3]).rotate([0.6, 0, 0.8], 70)
    moved = object_of(mi.load_dict({"type": "ply", "filename": str(BUNNY), "to_world": turn}), WAX)
    moving = mi.Transform4f(turn.matrix)
    frame, frame_moved = frame_of(obj), frame_of(moved, identify(obj))
    at = obj.random_points(generator(mi, 256, pass_seed(3)))
    there = surface_point(moving @ at.p, moving @ at.n, moving @ at.n_out, moving @ at.w)
    columns = [
        np.array([np.broadcast_to(c.numpy(), 256) for c in side_features(f, Side(x, first_event(s, x)))])
        for f, s, x in ((frame, obj, at), (frame_moved, moved, there))
    ]
    assert columns[0].shape == (n_side(3), 256)
    fields, fields_moved = (c[-2 * FIELDS :] for c in columns)
    assert np.quantile(np.abs(fields - fields_moved), 0.99) < 0.05  # a cell at the surface may change sides
    assert fields.std() > 0.3


def test_widths_of_an_object_of_many_mean_free_paths_are_those_of_cells() -> None:
    dense = Medium(np.array([9.5, 9.0, 8.0]) * 100, np.array([0.5, 1.0, 2.0]) * 100, 0.0, 1.4)
    ball = object_of(mi.load_dict({"type": "sphere", "radius": 1.5, "center": [0.3, -0.2, 0.1]}), dense)
    fields = _along_a_radius(ball, [0.0, 1.42, 1.5, 1.55], (0.3, -0.5, 0.8))[:, : len(WIDTHS)]
    share = fields / fields[0]
    assert np.all(np.diff(share[:, -1]) < 0)  # 4 cells of 3 / 96 see what lies within 0.08 of the surface
    assert 0.05 < share[3, -1] < 0.45 < 0.55 < share[1, -1] < 0.95


def test_a_pair_is_told_how_far_apart_both_first_events_of_each_channel_are() -> None:
    obj = wax_bunny()
    frame, rng = frame_of(obj), generator(mi, 256, pass_seed(9))
    a, b = (Side(at, first_event(obj, at)) for at in (obj.random_points(rng), obj.random_points(rng)))
    for m, told, y_o, y_i in zip(obj.media, pair_features(frame, a, b)[-3:], a.event.ys, b.event.ys):
        gap = np.linalg.norm(np.array(y_o) - np.array(y_i), axis=0)
        assert np.allclose(np.exp(2 * np.array(told)), gap * float(m.sigma_t) + 1e-2, rtol=1e-3)
