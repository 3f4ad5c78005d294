"""The figure `gathered`: what ways make of the same time, the gathering of light counted."""

from __future__ import annotations

import io

import numpy as np
import pandas
import pytest

from benchmarks import gathered_figure as gathered
from figures.computing.learnt import FULL_GEOMETRY
from figures.parts.part import Result, Task
from full_geometry.scenes.scene_files import load_scene

pytest.importorskip("mitsuba")

pytestmark = pytest.mark.slow


def test_all_ways_have_the_same_time_in_which_light_is_gathered(
    tmp_path: object, monkeypatch: pytest.MonkeyPatch, little_light: None
) -> None:
    dipole = "better_dipole"
    ways = {
        way: (dipole if model == FULL_GEOMETRY else model, light)
        for way, (model, light) in gathered.WAYS.items()
        if way in ("walked", "gathered")
    }
    monkeypatch.setattr(gathered, "WAYS", ways)
    monkeypatch.setitem(gathered.SIZES, "draft", 24)
    monkeypatch.setitem(gathered.SECONDS, "draft", 0.4)
    monkeypatch.setitem(gathered.TRUTH_SPP, "draft", 64)
    results = {}
    for part in gathered.parts("draft"):
        if "training" in part.name:
            continue
        found = part.function(Task(part.params, tmp_path))
        images = {name: v for name, v in found.items() if isinstance(v, np.ndarray)}
        results[part.name] = Result(images, {k: v for k, v in found.items() if k not in images}, 1.0, part.work)
    numbers = results["marble, equal time"].numbers["ways"]
    assert numbers["gathered"]["seconds of gathering"] > 100 * numbers["walked"]["seconds of gathering"]
    assert all(about["seconds"] > 0.5 * gathered.SECONDS["draft"] for about in numbers.values())
    files = gathered.draw(results)
    table = pandas.read_csv(io.StringIO(files["gathered.csv"])).set_index(pandas.Index(ways))
    assert files["gathered.png"].startswith(b"\x89PNG") and list(table["spp"]) == [numbers[w]["spp"] for w in ways]
    covered = results["marble, truth"].images["cover"] > 0.999
    scene = load_scene(gathered.scan_scene("marble", 24, gathered.LIGHTS), dipole, settings={"light": "sampled"})
    sampled = gathered.rendered(scene, 64, 1, 0)[0]  # a loaded machine has a few samples in a second
    found = results["marble, equal time"].images["gathered"][covered].mean()
    assert found == pytest.approx(sampled[covered].mean(), rel=0.1)  # a firefly of a lamp is 2 % of this image
