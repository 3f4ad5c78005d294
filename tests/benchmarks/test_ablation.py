"""The ablation: what a budget buys, that every variant learns, and the command that makes the table."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
import torch
from typer.testing import CliRunner

from benchmarks import ablation as module
from benchmarks.__main__ import app
from benchmarks.ablation import (
    BUDGETS,
    VARIANTS,
    SharedTurn,
    Variant,
    ablation,
    caption,
    drawn_by_area,
    model_of,
    summary,
)
from benchmarks.budgets import Samples, Seconds, Within
from benchmarks.kept_rows import KeptRows
from halfspace_sss import Medium, materials
from halfspace_sss.arrays import library
from halfspace_sss.comparison import model_errors
from halfspace_sss.comparison.model_errors import ReferenceSize, TracedMaps, model_error, reference_maps
from halfspace_sss.maps import noisy_maps
from halfspace_sss.maps.noisy_maps import CellGrid, draw_directions, make_pool
from halfspace_sss.neural.paper_model import paper_inputs
from halfspace_sss.neural.training import train_material as training
from halfspace_sss.neural.training.fit import Fit, fit
from halfspace_sss.neural.training.learners import MapPool
from halfspace_sss.neural.training.train_material import MaterialRecipe

FIG10 = materials.load("fig10").medium
GRID, HOW = CellGrid(8, 4), Fit(steps=1, n_groups=4, n_queries=32)
TINY = MaterialRecipe(n_groups=8, events=1e5, grid=CellGrid(4, 4), how=HOW)
BATCH = HOW.n_groups * HOW.n_queries
ALMOST = 3 * BATCH - 1  # samples, for which three batches are needed


@pytest.fixture(scope="module", autouse=True)
def _fewer_directions_and_points() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SETS", 1)
        patch.setattr(model_errors, "GRID", CellGrid(16, 8))
        patch.setattr(model_errors, "LAST_N_PSI", model_errors.FIRST_N_PSI)  # points of a cell, enough where g is 0
        yield


@pytest.fixture(scope="module")
def pool() -> MapPool:
    one = np.ones(64)
    groups = draw_directions(0.75 * one, 0.0 * one, 1.3 * one, np.random.default_rng(1))
    return MapPool(groups, GRID, make_pool(groups, GRID, 1e6, (1,)))


@pytest.fixture(scope="module")
def reference() -> TracedMaps:
    return reference_maps([FIG10], ReferenceSize(1, GRID, 2), 1e6, (2,))[0]


@pytest.fixture(scope="module")
def table() -> pandas.DataFrame:
    """Every variant, at equal time and at equal data."""
    return ablation(FIG10, TINY, (Seconds(0.05), Samples(ALMOST)), seeds=1)


def _first_and_small(seeds: int, executor: Executor | None = None) -> pandas.DataFrame:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "VARIANTS", (VARIANTS[0], VARIANTS[-2]))
        return ablation(FIG10, TINY, [Samples(ALMOST)], seeds=seeds, seed=5, executor=executor)


@pytest.fixture(scope="module")
def repeated() -> pandas.DataFrame:
    """Two variants with two seeds."""
    return _first_and_small(2)


def _trained(variant: Variant, pool: MapPool, steps: int, measure: Callable[[Any], float]) -> tuple[float, float]:
    """A measure before and after the training."""
    learner = variant.learner(FIG10.in_mfp(), pool, 0)
    before = measure(learner)
    fit(learner, pool.batches(HOW.n_groups, HOW.n_queries), Within(Samples(steps * BATCH), HOW), 0)
    return before, measure(learner)


# the last variant starts where there is little to learn from such maps
RELATIVE = [v for v in VARIANTS if v.learned != "S" and not v.warm]
SQUARED = [v for v in VARIANTS if v.learned == "S"]


@pytest.mark.slow
@pytest.mark.parametrize("variant", RELATIVE[-2:], ids=[v.name for v in RELATIVE[-2:]])
def test_a_variant_lowers_its_error_against_its_start(variant: Variant, pool: MapPool, reference: TracedMaps) -> None:
    def error(learner: Any) -> float:
        return model_error(model_of(learner, reference.medium), reference).error

    before, after = _trained(variant, pool, 40, error)
    assert after < 0.8 * before


@pytest.mark.parametrize("variant", SQUARED, ids=[v.name for v in SQUARED])
def test_a_variant_of_squared_error_lowers_it_against_its_start(variant: Variant, pool: MapPool) -> None:
    shown = drawn_by_area(pool) if variant.by_area else pool
    batch = shown.batch(64, 256, torch.Generator().manual_seed(1))
    before, after = _trained(variant, shown, 60, lambda learner: float(learner.loss(batch).detach()))
    assert after < 0.9 * before


def test_the_variant_that_starts_from_the_universal_network_starts_ahead(pool: MapPool, reference: TracedMaps) -> None:
    cold, warm = (
        model_error(model_of(v.learner(reference.medium, pool, 0), reference.medium), reference).error
        for v in VARIANTS[-2:]
    )
    assert warm < 0.1 * cold


def test_both_points_of_a_cell_are_seen_under_one_azimuth_of_incidence(pool: MapPool) -> None:
    batch, medium = pool.batch(8, 16, torch.Generator().manual_seed(0)), FIG10.in_mfp()
    found = SharedTurn(medium, 1.0, width=1).inputs(batch)
    turn = torch.atan2(-found[..., 3], -found[..., 2])  # the forward direction
    torch.testing.assert_close(turn[:, :16], turn[:, 16:], atol=1e-4, rtol=0.0)
    assert float(turn[:, :16].std()) > 1.0
    w_i, w_o = (1.3 * torch.sqrt(1 - mu**2) for mu in (batch.mu_i, batch.mu_o))
    directions = (w_i, turn + math.pi), (w_o, turn + batch.delta_phi)
    expected = paper_inputs(library(batch.r), batch.r, turn + batch.psi, *directions, batch.L)
    torch.testing.assert_close(found, torch.stack(torch.broadcast_tensors(*expected), -1), atol=1e-4, rtol=1e-3)


def test_cells_by_area_are_drawn_as_often_as_their_area_says(pool: MapPool) -> None:
    r = drawn_by_area(pool).batch(64, 4096, torch.Generator().manual_seed(0)).r
    low, high = 0.02, float(r.max())
    assert float((r < high / 2).float().mean()) == pytest.approx((0.25 * high**2 - low**2) / high**2, abs=0.08)
    assert float((pool.batch(64, 4096, torch.Generator().manual_seed(0)).r < high / 2).float().mean()) > 0.6


@pytest.mark.slow
def test_at_equal_data_every_variant_sees_the_same_samples(table: pandas.DataFrame) -> None:
    found = table[table["budget"] == "383 samples"]
    assert list(found["variant"]) == [v.name for v in VARIANTS]
    assert set(found["samples"]) == {3 * BATCH} and set(found["steps"]) == {3}


@pytest.mark.slow
def test_at_equal_time_every_variant_trains_until_the_time_is_spent(table: pandas.DataFrame) -> None:
    found = table[table["budget"] == "0.05 s"]
    assert list(found["variant"]) == [v.name for v in VARIANTS]
    assert (found["seconds"] >= 0.05).all() and (found["samples"] == found["steps"] * BATCH).all()


@pytest.mark.slow
def test_at_equal_data_a_seed_repeats_in_an_executor_and_another_one_differs(repeated: pandas.DataFrame) -> None:
    with ThreadPoolExecutor(1) as executor:
        again = _first_and_small(1, executor).drop(columns="seconds")
    first, other = (t.drop(columns="seconds").reset_index(drop=True) for _, t in repeated.groupby("seed"))
    pandas.testing.assert_frame_equal(first, again, check_exact=True)
    assert (first["error"] != other["error"]).all()


@pytest.mark.slow
def test_the_summary_is_of_each_budget_and_variant_over_the_seeds(
    table: pandas.DataFrame, repeated: pandas.DataFrame
) -> None:  # fmt: skip
    assert summary(table)["budget"].value_counts().to_dict() == {"0.05 s": len(VARIANTS), "383 samples": len(VARIANTS)}
    found = summary(repeated).iloc[0]
    errors = repeated.loc[repeated["variant"] == VARIANTS[0].name, "error"]
    assert found["variant"] == VARIANTS[0].name and found["seeds"] == len(errors) == 2
    assert found["error"] == pytest.approx(errors.mean())
    assert found["error_sd"] == pytest.approx(abs(errors.diff().iloc[1]) / 2**0.5)


def test_a_medium_beyond_the_universal_network_is_trained_without_it(monkeypatch: Any) -> None:
    monkeypatch.setattr(module, "VARIANTS", VARIANTS[-2:])
    beyond = Medium.from_albedo(albedo=0.75, sigma_t=1.0, g=0.0, eta=2.1)
    assert list(ablation(beyond, TINY, [Samples(1)], seeds=1)["variant"]) == [VARIANTS[-2].name]


REFUSED: list[tuple[Callable[[], Any], str]] = [
    (lambda: Seconds(0.0), "seconds must be a number in"),
    (lambda: Samples(0), "samples must be a whole number >= 1, got 0"),
    (lambda: Samples(1e6), "samples must be a whole number >= 1, got 1000000.0"),
    (lambda: ablation(FIG10, budgets=()), "budgets must be one or more different ones, got none"),
    (lambda: ablation(FIG10, budgets=[Samples(5)] * 2), "different ones, got 5 samples, 5 samples"),
    (lambda: ablation(FIG10, seeds=0), "seeds must be a whole number >= 1, got 0"),
    (lambda: ablation(FIG10, seed=-1), "seed must be a whole number >= 0, got -1"),
    (lambda: ablation(materials.load("ketchup").medium), "medium must have one channel"),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_what_is_out_of_range_is_refused_before_tracing(
    call: Callable[[], Any], message: str, monkeypatch: Any
) -> None:  # fmt: skip
    monkeypatch.setattr(noisy_maps, "_launch", None)
    with pytest.raises(ValueError) as error:
        call()
    assert message in str(error.value)


@pytest.fixture
def small(monkeypatch: Any, tmp_path: Path) -> Path:
    """A recipe of a second and fewer variants, in an empty folder."""
    monkeypatch.setattr(training, "STANDARD", TINY)
    monkeypatch.setattr(module, "VARIANTS", VARIANTS[-2:])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _invoke(*arguments: str) -> Any:
    return CliRunner().invoke(app, ["ablation", *arguments])


def test_the_command_writes_and_prints_both_tables_and_the_caption(small: Path) -> None:
    result = _invoke("fig10", "--seconds", "0.05", "--samples", "300", "--seeds", "1", "--out", "deep/found")
    assert result.exit_code == 0, result.output
    for words in ("fig10: 0.05 s each, 1 seed(s)", "fig10: 300 samples each", *(v.name for v in VARIANTS[-2:])):
        assert words in result.stdout
    assert " ".join(caption([Seconds(0.05), Samples(300)], torch.get_num_threads()).split()) in " ".join(
        result.stdout.split()
    )
    assert "ablation" in result.stderr  # the bar
    rows, content = pandas.read_csv("deep/found/ablation.csv"), json.loads(Path("deep/found/ablation.json").read_text())
    assert len(rows) == len(content["summary"]) == 4 and rows["error"].notna().all()
    assert content["provenance"]["parameters"]["budgets"] == ["0.05 s", "300 samples"]
    assert content["machine"]["threads"] >= 1 and "not their converged error" in content["caption"]
    for name in ("ablation.csv", "ablation.json"):
        assert f"deep/found/{name}" in result.stdout


def test_a_budget_that_is_given_stands_alone_and_both_are_the_default(small: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(module, "VARIANTS", VARIANTS[-1:])
    assert _invoke("--samples", "100", "--seeds", "1", "--albedo", "0.6").exit_code == 0
    assert set(pandas.read_csv("ablation/ablation.csv")["budget"]) == {"100 samples"}
    monkeypatch.setattr(module, "BUDGETS", (Seconds(0.02), Samples(50)))
    assert _invoke("ketchup", "--channel", "G", "--seeds", "1").exit_code == 0
    assert list(dict.fromkeys(pandas.read_csv("ablation/ablation.csv")["budget"])) == ["0.02 s", "50 samples"]


def test_the_caption_says_what_the_table_does_and_does_not_say() -> None:
    text = caption(BUDGETS, 2)
    for words in (
        "for 20 s, or 1,000,000 samples each",
        "not their converged error",
        "says nothing against",
        "the gain",
    ):
        assert words in text


REFUSED_BY_COMMAND = [
    (["no such material"], "material must be one of"),
    (["ketchup", "--channel", "X"], "channel must be one of R, G, B"),
    (["fig10", "--albedo", "0.5"], "albedo must be left out for a named material"),
    (["--albedo", "1.5"], "albedo must be in [0, 1], got 1.5"),
    (["--seconds", "0"], "seconds must be a number in [0.01, 1e+06], got 0.0"),
    (["--samples", "0"], "samples must be a whole number >= 1, got 0"),
    (["--seeds", "0"], "seeds must be a whole number >= 1, got 0"),
    (["--seed", "-1"], "seed must be a whole number >= 0, got -1"),
    (["--backend", "opencl"], "'opencl' is not one of 'llvm', 'cuda'"),
    (["--out", "file"], "folder must be a folder or new, got 'file'"),
]


@pytest.mark.parametrize(("arguments", "message"), REFUSED_BY_COMMAND, ids=[" ".join(a) for a, _ in REFUSED_BY_COMMAND])
def test_bad_input_ends_with_2_and_writes_nothing(
    arguments: list[str], message: str, small: Path, monkeypatch: Any
) -> None:  # fmt: skip
    monkeypatch.setattr(noisy_maps, "_launch", None)
    (small / "file").touch()
    result = _invoke(*arguments)
    assert result.exit_code == 2, result.output
    assert result.stderr.startswith("error: ") and message in result.stderr and len(result.stderr.splitlines()) == 1
    assert [path.name for path in small.iterdir()] == ["file"]


def test_an_ablation_goes_on_after_the_trainings_that_it_has_finished(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr(module, "VARIANTS", module.VARIANTS[-3:])
    arguments = (FIG10, TINY, [Samples(100)], 1)

    def ends(what: str, done: int, total: int) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        module.ablation(*arguments, progress=ends, kept=KeptRows(tmp_path / "a", {}))
    kept = KeptRows(tmp_path / "a", {})
    assert len(kept) == 1
    left = [run for name, run in module.trainings(*arguments[:1], *arguments[2:], 0).items() if name not in kept]
    assert module.cost(left).startswith(f"{len(module.VARIANTS) - 1} trainings: {len(left)} as long as their data take")
    resumed = module.ablation(*arguments, kept=kept)
    monkeypatch.setattr(module, "_data", None)  # all rows are there
    again = module.ablation(*arguments, kept=KeptRows(tmp_path / "a", {}))
    assert again.equals(resumed)
    whole = KeptRows(tmp_path / "a", {})
    assert list(whole)[:1] == list(kept)[:1] and len(whole) == len(module.VARIANTS)
