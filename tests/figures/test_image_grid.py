"""Figures of images: what is in each cell, what is printed, and the place of a model that is not there."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from figures.computing.images import Shot, absent, compared
from figures.drawing.image_grid import image_grid
from full_geometry.trade.image_differences import srgb
from halfspace_sss.comparison.style import paper, saved


@pytest.fixture(scope="module")
def scenes() -> dict[str, list[Shot]]:
    rng = np.random.default_rng(1)
    scenes = {}
    for name in ("marble", "ketchup"):
        reference = rng.uniform(0.1, 0.6, (12, 16, 3)).astype(np.float32)
        near, far = (compared(label, reference * s, reference) for label, s in (("near", 1.05), ("far", 1.8)))
        scenes[name] = [Shot("path traced", reference, {"time, s": 3600.0}), far, near, absent("later", "to come")]
    return scenes


@pytest.fixture(scope="module")
def figure(scenes: dict[str, list[Shot]]) -> Figure:
    with paper():
        return image_grid(scenes, printed=("FLIP", "time, s"))


def _pictures(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(image.get_array()) for ax in figure.axes for image in ax.images]


def _texts(figure: Figure) -> list[Any]:
    return [*figure.texts, *(text for ax in figure.axes for text in ax.texts)]


def _contains(pictures: list[np.ndarray], wanted: np.ndarray) -> bool:
    return any(p.shape == wanted.shape and np.allclose(p, wanted, atol=1e-6) for p in pictures)


def test_every_image_and_map_is_in_the_figure(figure: Figure, scenes: dict[str, list[Shot]]) -> None:
    pictures = _pictures(figure)
    for shot in (shot for name in ("marble", "ketchup") for shot in scenes[name][:3]):
        assert _contains(pictures, srgb(shot.image))
        assert shot.flip is None or _contains(pictures, shot.flip)


def test_names_and_numbers_are_printed(figure: Figure, scenes: dict[str, list[Shot]]) -> None:
    texts = [text.get_text() for text in _texts(figure)]
    assert {"path traced", "near", "far", "later", "marble", "ketchup", "time 3600 s"} <= set(texts)
    for shot in (shot for shots in scenes.values() for shot in shots if shot.flip is not None):
        assert f"FLIP {shot.numbers['FLIP']:#.3g}" in texts


def test_the_smallest_number_of_a_row_is_bold(figure: Figure, scenes: dict[str, list[Shot]]) -> None:
    bold = [text.get_text() for text in _texts(figure) if text.get_fontweight() == "bold"]
    assert bold == [f"FLIP {scenes[name][2].numbers['FLIP']:#.3g}" for name in ("marble", "ketchup")]


def test_a_model_that_is_not_there_has_a_frame_that_says_so(figure: Figure, scenes: dict[str, list[Shot]]) -> None:
    assert sum(text.get_text() == "to come" for text in _texts(figure)) == 2
    without = {"marble": scenes["marble"], "ketchup": scenes["ketchup"][:2]}
    assert sum(text.get_text() == "not available" for text in _texts(image_grid(without))) == 2


def test_nothing_overlaps_and_nothing_leaves_the_figure(figure: Figure) -> None:
    boxes = [ax.get_position() for ax in figure.axes]
    for k, a in enumerate(boxes):
        assert a.x0 >= 0 and a.x1 <= 1 + 1e-9 and a.y0 >= 0 and a.y1 <= 1
        for b in boxes[:k]:
            width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
            assert width <= 1e-9 or height <= 1e-9


def test_it_is_saved_as_pdf_with_type_and_as_png(figure: Figure) -> None:
    with paper():
        files = saved(figure)
    assert b"/FontFile2" in files["pdf"] and files["png"].startswith(b"\x89PNG")


def test_images_without_maps_make_a_figure(scenes: dict[str, list[Shot]]) -> None:
    plain = {"marble": [Shot("raw", scenes["marble"][0].image), Shot("denoised", scenes["marble"][1].image)]}
    assert len(_pictures(image_grid(plain))) == 2


@pytest.mark.parametrize(
    ("scenes", "message"),
    [
        ({}, "scenes must hold at least one scene"),
        ({"s": [absent("a")]}, "scene 's' must start with the image of its reference"),
    ],
)
def test_scenes_without_a_reference_are_refused(scenes: dict[str, list[Shot]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        image_grid(scenes)


def test_what_noise_brings_below_zero_counts_as_zero() -> None:
    reference = np.full((16, 16, 3), 0.2)
    noisy = reference.copy()
    noisy[::2] = -0.1
    found, zero = compared("a", noisy, reference), compared("b", np.maximum(noisy, 0), reference)
    assert found.numbers == zero.numbers and found.image.min() == 0
