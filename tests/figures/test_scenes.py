"""The painted head, the leaf and the jelly: what they are made of."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mitsuba")
pytest.importorskip("igl")

from benchmarks import head_and_leaf as head  # noqa: E402
from benchmarks import scenes_figure as scenes  # noqa: E402
from benchmarks.random_shapes import make_shape  # noqa: E402


def test_a_head_is_one_closed_surface_with_paint_in_range() -> None:
    mesh = head.make_head(24)  # a mesh that is not closed is refused
    uv, paint = head.texture_coordinates(mesh.vertices), head.paint()
    assert uv.min() >= 0 and uv.max() <= 1
    assert paint.min() > 0 and paint.max() < 0.9
    front = mesh.vertices[np.abs(uv[:, 0] - 0.5) < 0.02]
    assert front[:, 2].max() > 1.1 and np.abs(front[:, 0]).max() < 0.2  # the nose, in the middle of the picture
    half = paint[:, : head.TEXELS // 2]
    assert np.abs(half[:, ::-1] - paint[:, head.TEXELS // 2 :]).max() > 0.1  # one cheek is striped


def test_colours_of_a_leaf_vary_and_are_those_of_media() -> None:
    colours = scenes.leaf_colours(make_shape("leaves", scenes.LEAF_SEED, 24, scenes.LEAVES).vertices)
    assert colours.min() > 0 and colours.max() < 0.9
    assert np.ptp(colours, axis=0).min() > 0.15


def test_parts_of_paper_quality_are_more_work_and_all_differ() -> None:
    draft, paper = scenes.parts("draft"), scenes.parts("paper")
    assert len({part.name for part in draft}) == len(draft) == 13
    assert sum(p.work for p in paper) > 10 * sum(p.work for p in draft)
