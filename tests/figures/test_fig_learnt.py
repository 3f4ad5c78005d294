"""Figures 3, 8 and 12 are drawn from the results of their parts."""

from __future__ import annotations

import io
import itertools
import re

import numpy as np
import pandas
import pytest

pytest.importorskip("matplotlib")

from benchmarks.published import fig03, fig08  # noqa: E402
from figures import fig12  # noqa: E402
from figures.parts.part import Result, keys_of  # noqa: E402
from halfspace_sss.neural.store import weights_folder, weights_in  # noqa: E402


def result(**found) -> Result:
    images = {name: value for name, value in found.items() if isinstance(value, np.ndarray)}
    return Result(images, {name: value for name, value in found.items() if name not in images}, 1.0, 1.0)


@pytest.mark.parametrize("module", [fig03, fig08, fig12])
def test_parts_have_keys_and_more_work_in_paper_quality(module) -> None:
    draft, paper = (module.parts(quality) for quality in ("draft", "paper"))
    assert len(keys_of(draft)) == len(draft)
    assert sum(p.work for p in paper) >= 10 * sum(p.work for p in draft)


def test_points_of_both_objects_are_drawn_with_their_distances() -> None:
    rng = np.random.default_rng(0)
    kinds = (*fig03.SHOWN, "flow, in space")
    numbers = {
        "points": {kind: rng.random((8, 3)).tolist() for kind in fig03.SHOWN},
        "rmsd": dict.fromkeys(kinds, 0.01), "light": dict.fromkeys(kinds, 2.0),
        "mesh": rng.random((20, 3)).tolist(), "E": [0.5] * 20, "exit": [0.5, 0.5, 0.5], "seconds": 1,
    }  # fmt: skip
    files = fig03.draw({name: result(**numbers) for name in fig03.SHAPES})
    assert files["fig03.png"].startswith(b"\x89PNG")
    assert len(pandas.read_csv(io.StringIO(files["fig03.csv"]))) == 2 * len(kinds)


def test_curves_of_all_methods_are_drawn() -> None:
    rows = [{"method": m, "N": n, "constant": 0.1 / n, "lobes": 0.2 / n} for m in fig08.LOOKS for n in (1, 4)]
    files = fig08.draw({"all": result(rows=rows)})
    assert files["fig08.pdf"].startswith(b"%PDF")
    assert set(pandas.read_csv(io.StringIO(files["fig08.csv"]))["method"]) == set(fig08.LOOKS)


def test_one_estimate_has_the_noise_of_its_samples() -> None:
    ones, exits = np.ones((3, 50, 5)), np.random.default_rng(1).standard_normal((3, 50, 5))
    truth = type("Truth", (), {"truth": type("E", (), {"mean": ones, "variance": 0 * ones})})
    found = type("E", (), {"mean": ones + 0.01 * exits, "variance": 1e-4 * ones})
    errors = fig08._rmse(found, truth, 100.0)
    assert abs(errors["constant"] - 0.1) < 0.01 and abs(errors["lobes"] - 0.1) < 0.01


def test_images_of_all_samplers_are_compared() -> None:
    rng = np.random.default_rng(2)
    names = [fig12._key(*case) for case in itertools.product(fig12.LIGHTS, fig12.SAMPLERS, fig12.ENTRIES)]
    names += [fig12._key(light, name) for light in fig12.LIGHTS for name in ("converged", "gathered")]
    assert all(re.fullmatch(r"[\w-]+", name) for name in names)  # what images of parts may be called
    images = {name: 0.5 + 0.1 * rng.random((32, 32, 3)).astype(np.float32) for name in names}
    halves = {fig12._key(light, "halves"): 0.04 for light in fig12.LIGHTS}
    files = fig12.draw({"bunny": result(**images, **halves)})
    table = pandas.read_csv(io.StringIO(files["fig12.csv"]))
    assert len(table) == len(names) - len(fig12.LIGHTS) and table["relMSE"].max() < 0.1


def test_renders_look_for_weights_in_the_folder_of_the_part_only(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", "elsewhere")
    with weights_in(tmp_path):
        assert weights_folder() == tmp_path
    assert str(weights_folder()) == "elsewhere"
