"""The pieces behind figures: well-formed parts, EXR files, durations."""

from __future__ import annotations

import importlib
import linecache
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import figures
from figures.computing.images import Shot, absent, compared
from figures.drawing.image_grid import image_grid
from figures.drawing.page import page
from figures.parts import part as parts_module
from figures.parts.part import Part, Result, Task, code_hash, keys_of
from figures.parts.runner import compute, draw, duration, exr_bytes, read_exr
from halfspace_sss.comparison.style import paper, saved


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


def test_keys_follow_code_that_computes_and_not_what_draws(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a package that the figures compute with, and of the package of the function."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(parts_module, "COMPUTING", ("toy_library",))
    for name in ("toy_library/__init__", "toy_library/cli/render", "toy_library/inner/walk", "toy_figures/__init__"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / f"{name}.py").write_text("x = 1\n")
    (tmp_path / "toy_figures/fig.py").write_text("def part(task):\n    return {}\n\n\ndef draw(r):\n    return {}\n")

    def keyed() -> str:
        for name in [name for name in sys.modules if name.startswith("toy_")]:
            del sys.modules[name]
        linecache.clearcache()
        code_hash.cache_clear()
        parts_module._package_hash.cache_clear()
        return keys_of([Part("p", importlib.import_module("toy_figures.fig").part, {}, 1)])["p"]

    keys = [keyed()]
    for name, text in (("toy_library/cli/render", "x = 2\n"), ("toy_library/inner/walk", "x = 2\n")):
        (tmp_path / f"{name}.py").write_text(text)
        keys.append(keyed())
    assert keys[0] == keys[1] != keys[2]
    (tmp_path / "toy_figures/__init__.py").write_text("x = 2\n")
    assert keyed() not in keys


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


def paint(task: Task) -> dict[str, Any]:
    """An image of one brightness with noise."""
    noise = np.random.default_rng(task.params["seed"]).uniform(0.95, 1.05, (16, 24, 3))
    return {"image": (task.params["level"] * noise).astype(np.float32)}


class Images(SimpleNamespace):
    """A figure of images: a part for each material and model, a grid and a page from the same shots."""

    TITLE = "two models against a reference"
    LEVELS = {"path traced": 0.3, "model A": 0.35, "model B": 0.6}

    def parts(self, quality: str) -> list[Part]:
        work = {"draft": 1, "paper": 64}[quality]
        return [
            Part(f"{material}, {model}", paint, {"level": level * scale, "seed": seed}, work)
            for material, scale in (("marble", 1.0), ("ketchup", 0.5))
            for seed, (model, level) in enumerate(self.LEVELS.items())
        ]

    def draw(self, results: dict[str, Result]) -> dict[str, bytes | str]:
        scenes = {}
        for material in ("marble", "ketchup"):
            reference = results[f"{material}, path traced"]
            scenes[material] = [Shot("path traced", reference.images["image"], {"time, s": reference.seconds})]
            for model in list(self.LEVELS)[1:]:
                found = results[f"{material}, {model}"]
                numbers = {"time, s": found.seconds}
                image = found.images["image"]
                scenes[material].append(compared(model, image, reference.images["image"], numbers=numbers))
            scenes[material].append(absent("full geometry"))
        with paper():
            files = saved(image_grid(scenes), dpi=60)
        named = {f"images.{ending}": data for ending, data in files.items()}
        return {**named, "images.html": page(self.TITLE, scenes)}


def test_a_figure_of_images_is_parts_a_grid_and_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "FIGURES", ("images",))
    monkeypatch.setitem(sys.modules, "figures.images", Images())
    compute("images", "draft", tmp_path)
    written = draw("images", "draft", tmp_path)
    assert [path.name for path in written] == ["images.pdf", "images.png", "images.html", "images.json"]
    assert len(list(tmp_path.rglob("*.exr"))) == 6
    before = {path.name: path.read_bytes() for path in written if path.suffix != ".json"}
    for path in written:
        path.unlink()
    again = {path.name: path.read_bytes() for path in draw("images", "draft", tmp_path) if path.suffix != ".json"}
    assert again == before
