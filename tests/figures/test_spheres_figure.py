"""The spheres in miniature: their parts are rendered, the figure is drawn from them."""

from __future__ import annotations

import csv
import io

import pytest

pytest.importorskip("mitsuba")

import benchmarks.__main__  # noqa: E402, F401 - its figures
from benchmarks import spheres_figure as spheres  # noqa: E402
from figures.parts import runner  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture()
def small(monkeypatch):
    monkeypatch.setattr(spheres, "MODELS", ("better_dipole",))
    monkeypatch.setattr(spheres, "RADII", (3.0, 30.0))
    monkeypatch.setattr(spheres, "SPP", {"draft": 16})
    monkeypatch.setattr(spheres, "SIZE", {"draft": 12})


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_a_half_space_is_better_on_large_spheres_than_on_small_ones(small, tmp_path):
    results = runner.compute("spheres", "draft", tmp_path)
    files = spheres.draw(results)
    sky = [float(row["ratio"]) for row in table(files["spheres.csv"]) if row["light"] == "even sky"]
    assert abs(sky[1] - 1) < abs(sky[0] - 1)
