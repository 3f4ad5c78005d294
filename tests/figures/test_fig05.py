"""Fig. 5: images at growing times of three ways, of which one learns, and what is drawn of them."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from quick_light import gather_by_few

mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

from figures import fig05  # noqa: E402
from figures.parts.part import Part, Result, Task  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.network_fitting import Recipe  # noqa: E402

pytestmark = pytest.mark.slow

QUICK = Recipe(width=16, depth=2, batch=1024, chunk=2**12, reuse=2)
SIZE = 12


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Result]:
    """Both parts of one material, small and short."""
    train = training.train
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "train", lambda *a, **how: train(*a, **{**how, "recipe": QUICK, "chunks": 1}))
        gather_by_few(patch.setattr)
        for name, value in (("EXITS", 16), ("WALKS", 128), ("SAMPLES", 64)):
            patch.setattr(training, name, value)
        for name, value in (("SCENES", (("ketchup", "both"),)), ("SIZES", SIZE), ("TRUTH_SPP", 64)):
            patch.setitem(getattr(fig05, name), "draft", value)
        patch.setitem(fig05.SECONDS, "draft", 0.4)
        patch.setattr(fig05, "WARM_UP", 0.1)
        return {part.name: _result(part, tmp_path_factory.mktemp("part")) for part in fig05.parts("draft")}


def _result(part: Part, folder: Path) -> Result:
    found: dict[str, Any] = dict(part.function(Task(part.params, folder)))
    images = {name: v for name, v in found.items() if isinstance(v, np.ndarray)}
    return Result(images, {name: v for name, v in found.items() if name not in images}, 1.0, part.work)


def test_each_way_has_images_at_times_that_grow(results: dict[str, Result]) -> None:
    found = results["ketchup, both: ways"]
    assert set(found.numbers["ways"]) == set(fig05.LOOKS)
    for way, about in found.numbers["ways"].items():
        assert np.all(np.diff(about["seconds"]) > 0) and np.all(np.diff(about["spp"]) > 0)
        assert found.images[f"{way}-{len(about['spp']) - 1}"].shape == (SIZE, SIZE, 3)


def test_the_figure_marks_the_switch_and_its_table_tells_the_phases(results: dict[str, Result]) -> None:
    files = fig05.draw(results)
    assert files["fig05.pdf"].startswith(b"%PDF") and files["fig05.png"].startswith(b"\x89PNG")
    table = pandas.read_csv(io.StringIO(files["fig05.csv"]))
    switch = results["ketchup, both: ways"].numbers["switch"]
    assert switch > 0
    online = table[table["way"] == "online"]
    assert np.array_equal(online["phase"] == "learning", online["seconds"] < switch)
    assert {"learning", "rendering"} == set(online["phase"]) and set(table[table["way"] == "walks"]["phase"]) == {
        "rendering"
    }
    assert np.isfinite(table[["relMSE", "FLIP"]]).all().all()
