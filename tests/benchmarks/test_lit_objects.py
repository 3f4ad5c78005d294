"""What studies of errors and times render, and the errors of gathered light."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mitsuba")

from benchmarks.gathered_error import off  # noqa: E402
from benchmarks.hand_and_ribbon import SHAPES  # noqa: E402
from benchmarks.lit_objects import LitObject  # noqa: E402
from benchmarks.modelling.meshes import surface  # noqa: E402


def test_an_error_is_told_without_the_noise_of_samples() -> None:
    rng, pixels = np.random.default_rng(2), 4000
    truth, bias = rng.uniform(0.5, 1.5, (pixels, 3)), 0.04 * rng.standard_normal((3, 1, pixels, 3))
    reference = truth + 0.1 * rng.standard_normal((2, pixels, 3))
    found = off(truth + bias + 0.1 * rng.standard_normal((3, 2, pixels, 3)), reference)
    assert abs(found.rms - 0.04 / np.sqrt((truth**2).mean())) < 4 * found.error < 0.02
    assert found.mean == pytest.approx(1, abs=0.01)
    again = off(truth + 0.1 * rng.standard_normal((3, 2, pixels, 3)), reference)
    assert again.rms < 4 * again.error < 0.06


@pytest.mark.parametrize(
    ("thing", "light", "said"),
    [
        ("teapot of potato", "windows", "object must be one of"),
        ("candle of potato", "windows", "object must be one of"),
        ("hand of marbel", "windows", "material"),
    ],
)
def test_an_object_that_there_is_not_is_refused(thing: str, light: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        LitObject(thing, light)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_shape_is_closed_and_in_one_piece(shape: str) -> None:
    mesh = surface(*SHAPES[shape](), 48)
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    label = np.arange(len(mesh.vertices))
    for _ in range(len(label)):
        least = np.minimum(label[edges[:, 0]], label[edges[:, 1]])
        after = label.copy()
        np.minimum.at(after, edges.ravel(), np.repeat(least, 2))
        if (after == label).all():
            break
        label = after
    assert (label[np.unique(edges)] == label[edges[0, 0]]).all()
