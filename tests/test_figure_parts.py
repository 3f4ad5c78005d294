"""The pieces behind figures: well-formed parts, EXR files, durations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from figures.exr import exr_bytes, read_exr
from figures.part import Part, Task, keys_of
from figures.projection import duration


def shade(task: Task) -> dict[str, Any]:
    """A number."""
    return {"level": task.params["level"]}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Part("!", shade, {}, 1), "name of a part must hold a letter or digit"),
        (lambda: Part("p", shade, {"x": {1, 2}}, 1), "params of part 'p' must be finite and ready for JSON"),
        (lambda: Part("p", shade, {}, 0), "work of part 'p' must be a number in"),
        (lambda: keys_of([Part("a b", shade, {}, 1), Part("a-B", shade, {}, 1)]), "must differ in letters or digits"),
        (lambda: keys_of([Part("p", shade, {}, 1, needs=("q",))]), "must need parts that stand before it, got 'q'"),
        (lambda: keys_of([Part("p", shade, {}, 1, inputs=("nowhere",))]), "inputs of part 'p' must be files"),
    ],
)
def test_badly_formed_parts_are_refused(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("shape", [(3, 5), (3, 5, 3)])
def test_exr_keeps_every_bit_of_float32(shape: tuple[int, ...], tmp_path: Path) -> None:
    image = np.random.default_rng(0).standard_normal(shape).astype(np.float32) * 1e3
    (tmp_path / "a.exr").write_bytes(exr_bytes(image, "image", "{}"))
    np.testing.assert_array_equal(read_exr(tmp_path / "a.exr"), image)
    assert exr_bytes(image, "image", "{}") == (tmp_path / "a.exr").read_bytes()


def test_a_file_that_is_no_image_is_refused_by_name(tmp_path: Path) -> None:
    (tmp_path / "a.exr").write_text("no image")
    with pytest.raises(ValueError, match="a.exr must be an EXR image"):
        read_exr(tmp_path / "a.exr")


def test_durations_are_said_as_people_say_them() -> None:
    assert [duration(s) for s in (0.04, 7.32, 42, 99.6, 3000, 12600)] == [
        "0.04 s",
        "7.3 s",
        "42 s",
        "2 min",
        "50 min",
        "3.5 h",
    ]
