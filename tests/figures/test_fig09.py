"""Fig. 9 and the spheres in miniature: the parts are rendered, the figures drawn from them."""

from __future__ import annotations

import csv
import io

import numpy as np
import pytest

pytest.importorskip("mitsuba")
pytest.importorskip("flip_evaluator")

import benchmarks.__main__  # noqa: F401 - its figures
from benchmarks import spheres_figure as spheres
from figures import fig09
from figures.parts import runner  # noqa: E402

pytestmark = pytest.mark.slow


@pytest.fixture()
def small(monkeypatch):
    monkeypatch.setattr(fig09, "SHOWN", {"draft": ("marble",)})
    monkeypatch.setattr(fig09, "MODELS", ("better_dipole", "neural"))
    monkeypatch.setattr(fig09, "SIZES", {"draft": 20})
    monkeypatch.setattr(fig09, "MODEL_SPP", {"draft": 8})
    monkeypatch.setattr(fig09, "TRUTH_SPP", {"draft": 32})
    monkeypatch.setattr(spheres, "MODELS", ("better_dipole",))
    monkeypatch.setattr(spheres, "RADII", (3.0, 30.0))
    monkeypatch.setattr(spheres, "SPP", {"draft": 16})
    monkeypatch.setattr(spheres, "SIZE", {"draft": 12})


def table(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_fig_9_compares_each_model_with_the_path_traced_image(small, tmp_path):
    results = runner.compute("fig09", "draft", tmp_path)
    walks = ["marble, path traced"]
    assert [name for name in results] == [*walks, "marble, better_dipole", "marble, neural"]
    image = results["marble, neural"].images["image"]
    assert image.shape == (20, 20, 3) and np.isfinite(image).all() and image.max() > 0.05
    files = fig09.draw(results)
    rows = table(files["fig09.csv"])
    assert [row["model"] for row in rows] == ["Path traced", "Better dipole", "Neural half-space"]
    assert all(0 < float(row["FLIP"]) < 1 for row in rows)
    assert files["fig09.png"][:4] == b"\x89PNG" and "<html" in files["fig09.html"]
    assert runner.plan("fig09", "draft", tmp_path).missing == ()  # nothing is rendered again


def test_a_half_space_is_better_on_large_spheres_than_on_small_ones(small, tmp_path):
    results = runner.compute("spheres", "draft", tmp_path)
    files = spheres.draw(results)
    sky = [float(row["ratio"]) for row in table(files["spheres.csv"]) if row["light"] == "even sky"]
    assert abs(sky[1] - 1) < abs(sky[0] - 1)
