"""Random scenes, and their records, which are measured once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import trade_check
from benchmarks.random_scenes import random_scene, write_scene

mi = pytest.importorskip("mitsuba")
pytestmark = pytest.mark.usefixtures("rgb")


def test_random_scenes_come_again_by_their_number(tmp_path: Path) -> None:
    assert random_scene(3, 1) == random_scene(3, 1) != random_scene(4, 1)
    first = write_scene(random_scene(3, 1), tmp_path / "a").read_bytes()
    assert first == write_scene(random_scene(3, 1), tmp_path / "b").read_bytes()


@pytest.mark.parametrize("number", range(6))
def test_a_random_scene_is_closed_and_faces_outwards(number: int, tmp_path: Path) -> None:
    from full_geometry.geometry.shape import analyse_shape
    from full_geometry.scenes.scene_files import load_objects

    loaded = load_objects(write_scene(random_scene(number, 5), tmp_path))
    (shape,) = (s for s in loaded.shapes() if s.id() == "object")
    found = analyse_shape(shape)
    assert found.closed and found.upright and found.size == pytest.approx(100, rel=0.01)


@pytest.mark.slow
def test_a_scene_that_was_measured_is_not_measured_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(trade_check, "WAYS", ("path_traced", "lambert"))
    first = trade_check.check_scene(random_scene(1, 1), tmp_path, 0.2, 0.3)
    monkeypatch.setattr(trade_check, "assess_for", None)
    monkeypatch.setattr(trade_check, "assess_stage", None)
    again = trade_check.check_scene(random_scene(1, 1), tmp_path, 0.2, 0.3)
    assert json.dumps(again) == json.dumps(first)
    found = trade_check.outcome(first)
    assert (
        found["way"] in ("path_traced", "lambert")
        and found["ratio"] >= found["sure_ratio"] > 0
        and found["technique_ratio"] >= 1
        and len(trade_check.z_values(first)) == 1
    )
