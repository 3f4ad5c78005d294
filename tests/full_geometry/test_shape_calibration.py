"""S of any shape is held to the light that leaves by walks, by one number for each channel."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss import Medium

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
pytest.importorskip("igl")

from full_geometry.learning.model_errors import errors_of  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.transport.any_shape import (  # noqa: E402
    NeuralShape,
    calibrated,
    calibration_weight,
    load,
    shipped_weights,
    transport,
)
from full_geometry.transport.descriptors import Mixed, mixed  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("mono")

WAX = Medium(0.95, 0.05, 0.0, 1.3)


def ball(radius: float, medium: Medium = WAX) -> TranslucentObject:
    return object_of(mi.load_dict({"type": "sphere", "radius": radius}), medium)


def free(obj: TranslucentObject) -> NeuralShape:
    """By the shipped weights, not held."""
    return NeuralShape.of(obj, load(shipped_weights()))


def halved(obj: TranslucentObject) -> NeuralShape:
    """S of half its size, so that there is something to hold."""
    model = free(obj)
    return NeuralShape(model.object, model.half_space, model.weights, model.media, [0.5] * len(model.media))


@pytest.mark.slow
def test_as_much_light_leaves_a_small_sphere_as_by_walks() -> None:
    # the noise of the ratio is below 1 %; the tolerance is three times that
    found = errors_of(ball(1.0), {"held": transport(ball(1.0))}, exits=64, walks=4096, samples=2048)
    assert abs(found["held"][0].ratio - 1) < 0.03


def test_what_is_too_dark_is_made_as_bright_as_what_is_not() -> None:
    obj = ball(3.0)
    one, other = (calibrated(model(obj)).scales[0] for model in (free, halved))
    assert np.isclose(one, other, rtol=0.01) and not np.isclose(other, 0.5, rtol=0.5)


def test_it_is_the_same_number_for_every_pair_so_that_light_may_take_the_way_back() -> None:
    obj = ball(3.0)
    model, bare = transport(obj), free(obj)
    rng = generator(mi, 512, pass_seed(7))
    o, i = obj.random_points(rng), obj.random_points(rng)
    there, back, unheld = (np.array(m.S(m.prepare(a), b)) for m, a, b in ((model, o, i), (model, i, o), (bare, o, i)))
    assert np.allclose(there, model.scales[0] * unheld, rtol=1e-5)
    assert np.allclose(there, back, rtol=5e-3, atol=1e-6 * there.max())


def test_the_same_object_is_held_by_the_same_numbers() -> None:
    one, other = (transport(ball(3.0)).scales for _ in range(2))
    assert one == other


def test_what_is_as_good_as_flat_is_left_as_it_is() -> None:
    assert calibration_weight(mixed(ball(800.0))[0]) == 0 and transport(ball(800.0)).scales == ()
    chords = [calibration_weight(Mixed(0.0, 1.0, chord, 0.0, 0.0, 0.0, 1.0)) for chord in (0.0, 500.0, 1000.0, 1e6)]
    assert chords == [1.0, 0.5, 0.0, 0.0]


@pytest.mark.parametrize("medium", [Medium(0.0, 1.0, 0.0, 1.3), Medium(1e-6, 1.0, 0.0, 1.3)])
def test_where_nothing_or_next_to_nothing_leaves_it_stays_finite(medium: Medium) -> None:
    obj = ball(3.0, medium)
    model = transport(obj)
    rng = generator(mi, 512, pass_seed(7))
    value = np.array(model.S(model.prepare(obj.random_points(rng)), obj.random_points(rng)))
    assert np.isfinite(value).all() and (value >= 0).all() and all(0.25 <= s <= 4 for s in model.scales)


def test_what_is_open_is_left_as_it_is() -> None:
    with pytest.warns(UserWarning):
        obj = object_of(mi.load_dict({"type": "rectangle"}), WAX)
    assert transport(obj).scales == ()
