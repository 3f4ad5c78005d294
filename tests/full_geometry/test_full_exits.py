"""Walks inside one object and the exact way to the first event: energy, the plane, reciprocity, orders.

Statistical tests have fixed seeds; a z-test fails at 4 standard errors (two-sided 6e-5).
"""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium, trace
from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.tracing.walk import generator, pass_seed

mi = pytest.importorskip("mitsuba")

from full_geometry.geometry.points import SurfacePoint, refract_in  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.transport.exit_pairs import trace_exits  # noqa: E402
from full_geometry.transport.features import first_event  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

N = 2**16
COLOURS = Medium(np.array([0.99, 0.75, 0.3]), np.array([0.01, 0.25, 0.7]), np.array([0.0, 0.3, 0.0]), 1.4)


def ball(medium: Medium, radius: float) -> TranslucentObject:
    return object_of(mi.load_dict({"type": "sphere", "radius": radius}), medium)


def starts(obj: TranslucentObject, n: int = N, seed: int = 1) -> SurfacePoint:
    return obj.random_points(generator(mi, n, pass_seed(seed)))


def mean_and_error(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values.mean(axis=-1), values.std(axis=-1, ddof=1) / np.sqrt(values.shape[-1])


def test_all_light_comes_out_where_nothing_absorbs() -> None:
    obj = ball(Medium(1.0, 0.0, 0.5, 1.5), 2.0)
    points = starts(obj)
    T = np.array(trace_exits(obj, points, (2,), fewest=0).T)
    entering = np.array(refract_in(points, 1.5)[1])
    mean, error = mean_and_error(T - entering)
    assert np.all(np.abs(mean) < 4 * error + 1e-4)


@pytest.mark.parametrize(("fewest", "most", "order"), [(1, 1, "single"), (2, 2**31 - 1, "multiple")])
def test_a_large_ball_reflects_diffuse_light_as_the_plane_does(fewest: int, most: int, order: str) -> None:
    obj = ball(COLOURS, 1000.0)
    exits = trace_exits(obj, starts(obj), (3,), fewest=fewest, most=most)
    mean, error = mean_and_error(np.array(exits.T))
    for c in range(3):
        plane = trace(COLOURS.channel(c), "diffuse", 200_000, 5).reflectance(order)
        assert abs(mean[c] - plane.value) < 4 * np.hypot(error[c], plane.standard_error) + 1e-3 * plane.value


def test_orders_outside_of_those_kept_carry_nothing() -> None:
    obj = ball(COLOURS, 2.0)
    exits = trace_exits(obj, starts(obj, 4096), (4,), fewest=2, most=5)
    order, T = np.array(exits.order), np.array(exits.T).max(axis=0)
    assert set(np.unique(order[T > 0])) == {2, 3, 4, 5}


def test_walks_there_and_back_carry_the_same_light() -> None:
    obj = object_of(mi.load_dict({"type": "cube"}), COLOURS)
    points = starts(obj)
    exits = trace_exits(obj, points, (5,))
    T, x_o, x_i = (np.array(v) for v in (exits.T, points.p, exits.at.p))
    mu_o = np.sum(np.array(points.w) * np.array(points.n_out), axis=0)
    mu_i = np.sum(np.array(exits.at.w) * np.array(exits.at.n_out), axis=0)
    forward = T * ((x_o[0] > 0.99) & (mu_o > 0.8) & (x_i[1] > 0.99) & (mu_i < 0.6))
    backward = T * ((x_i[0] > 0.99) & (mu_i > 0.8) & (x_o[1] > 0.99) & (mu_o < 0.6))
    mean, error = mean_and_error(forward - backward)
    assert np.all(forward.mean(axis=-1) > 5 * error) and np.all(np.abs(mean) < 4 * error)


def test_the_same_seed_gives_the_same_exits() -> None:
    obj = ball(COLOURS, 2.0)
    a, b = (trace_exits(obj, starts(obj, 1024), (6,)) for _ in range(2))
    assert np.array_equal(np.array(a.T), np.array(b.T)) and np.array_equal(np.array(a.at.p), np.array(b.at.p))


def test_on_a_plane_light_is_always_scattered_a_mean_free_path_along_the_refracted_ray() -> None:
    obj = ball(COLOURS, 1000.0)
    points = starts(obj, 1024)
    event = first_event(obj, points)
    d, _, _ = refract_in(points, obj.media[0].eta)
    expected = np.array(points.p) + np.array(d)
    steep = np.abs(np.sum(np.array(d) * np.array(points.n), axis=0)) > 0.3
    assert np.allclose(np.array(event.P)[:, steep], 1, atol=1e-5)
    assert np.allclose(np.array(event.y)[:, steep], expected[:, steep], atol=2e-3)
    assert np.allclose(np.array(event.length)[steep], 1, atol=1e-4)


def test_the_way_to_the_first_event_is_that_of_walks() -> None:
    medium = Medium(0.5, 0.2, 0.0, 1.5)
    obj = ball(medium, 0.4)
    points = starts(obj)
    P, entering = np.array(first_event(obj, points).P)[0], np.array(refract_in(points, 1.5)[1])
    unscattered = np.array(trace_exits(obj, points, (7,), fewest=0, most=0).T)[0]
    mean, error = mean_and_error(unscattered - entering * (1 - P))
    assert unscattered.mean() > 0.1 and abs(mean) < 4 * error + 1e-3  # what is still inside after all reflections


def test_the_way_to_the_first_event_is_that_of_walks_along_a_thin_plate() -> None:
    """Light that enters by the edge is reflected totally until it is scattered."""
    plate = mi.load_dict({"type": "cube", "to_world": mi.ScalarTransform4f().scale([1.0, 1.0, 0.04])})
    obj = object_of(plate, Medium(0.6, 0.2, 0.0, 1.5))
    points = starts(obj)
    P, entering = np.array(first_event(obj, points).P)[0], np.array(refract_in(points, 1.5)[1])
    unscattered = np.array(trace_exits(obj, points, (8,), fewest=0, most=0).T)[0]
    by_edge = np.abs(np.array(points.p)[2]) < 0.0399
    mean, error = mean_and_error((unscattered - entering * (1 - P))[by_edge])
    assert by_edge.mean() > 0.03 and abs(mean) < 4 * error + 1e-3


@pytest.mark.parametrize("mm_per_unit", [0.0, -1.0, float("nan")])
def test_a_scale_that_is_no_length_is_refused(mm_per_unit: float) -> None:
    with pytest.raises(ValueError, match="mm_per_unit must be a number in"):
        object_of(mi.load_dict({"type": "sphere"}), COLOURS, mm_per_unit)


def test_a_medium_of_other_channels_than_the_variant_is_refused() -> None:
    with pytest.raises(ValueError, match="3 channels"):
        object_of(mi.load_dict({"type": "sphere"}), Medium(np.ones(2), np.ones(2)))


def test_transmittance_enters_with_the_light() -> None:
    obj = ball(COLOURS, 10.0)
    points = starts(obj, 512)
    _, T, valid = refract_in(points, obj.media[0].eta)
    mu = np.sum(np.array(points.w) * np.array(points.n_out), axis=0)
    assert np.allclose(np.array(T), np.where(np.array(valid), F_t(mu, obj.media[0].eta), 0), atol=1e-4)


def test_the_mean_first_event_is_that_of_the_channels_by_their_chances() -> None:
    obj = ball(Medium(np.array([0.9, 0.3, 0.1]), np.array([0.1, 0.2, 0.4]), 0.0, 1.4), 1.5)
    event = first_event(obj, starts(obj, 1024))
    P, lengths = np.array(event.P), np.array(event.lengths)
    ys = np.array([np.array(y) for y in event.ys])
    assert np.allclose((P[:, None] * ys).sum(axis=0) / P.sum(axis=0), np.array(event.y), atol=1e-4)
    assert np.allclose((P * lengths).sum(axis=0) / P.sum(axis=0), np.array(event.length), rtol=1e-4)
    assert (lengths[0] < lengths[1]).all()  # denser, so nearer
