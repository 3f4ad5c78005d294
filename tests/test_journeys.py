"""A newcomer reaches the goal with lines of the pages alone, in an empty folder and an empty home."""

from __future__ import annotations

from pathlib import Path

import pytest
from journeys import artist, optics
from test_page_commands import _blocks, _commands, _lay_out, _run, _shortened

pytestmark = pytest.mark.slow

JOURNEYS = {"artist": artist.STEPS, "optics": optics.STEPS}
FILES = (".xml", ".json")  # of a step that saves what its page shows
RESULTS = {
    "artist": ["render/ball_neural.exr", "mine.toml", "render/toy_path_traced.denoised.exr", "fit/scene_fit.toml",
               "fit/scene_fit_path_traced.exr"],
    "optics": ["mine.toml", "jelly.csv"],
}  # fmt: skip


def _standing(page: str) -> set[str]:
    """The commands, lines of Python and names of files of a page."""
    blocks = _blocks(page)
    commands = {line for kind, text in blocks if kind == "bash" for line in _commands(text)}
    lines = {line.strip() for kind, text in blocks if kind == "python" for line in text.splitlines()}
    named = {word.strip("`,:.") for word in Path(__file__).parent.parent.joinpath(page).read_text("utf-8").split()}
    return commands | lines | {word for word in named if word.endswith(FILES)}


def _lines(text: str) -> list[str]:
    return text.split() if text.endswith(FILES) else [line.strip() for line in text.strip().splitlines()]


def test_journeys_arrive_by_lines_of_the_pages(tmp_path: Path) -> None:
    items = []
    for name, steps in JOURNEYS.items():
        folder = tmp_path / name
        folder.mkdir()
        for page, text in steps:
            missing = [line for line in _lines(text) if line not in _standing(page)]
            assert not missing, (name, page, missing)
            if text.endswith(FILES):
                _lay_out(page, folder)
            elif text.startswith("halfspace-sss "):
                items.append((str(folder), "bash", _shortened(text)))
            else:
                items.append((str(folder), "python", text))
    failed = [(text, error) for _, text, error, _ in _run(tmp_path, items) if error]
    assert not failed
    for name, results in RESULTS.items():
        assert all((tmp_path / name / file).stat().st_size for file in results)
