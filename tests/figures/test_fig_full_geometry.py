"""Figures 1, 6, 7, 9, 11 and Table 1 with `full_geometry`, in miniature: trained, rendered and drawn."""

from __future__ import annotations

import io
from pathlib import Path

import pandas
import pytest

pytest.importorskip("mitsuba")
pytest.importorskip("torch")
pytest.importorskip("flip_evaluator")

import benchmarks.__main__  # noqa: E402, F401 - its figures
from benchmarks.methods import VOLUMES  # noqa: E402
from benchmarks.published import distant_light, fig01, fig07, fig11, table1  # noqa: E402
from figures import fig06, fig09  # noqa: E402
from figures.computing import learnt  # noqa: E402
from figures.computing import scans as scenes
from figures.computing.contenders import OF_OBJECTS  # noqa: E402
from figures.parts import runner  # noqa: E402
from figures.parts.part import Result, keys_of  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.network_fitting import Recipe  # noqa: E402

pytestmark = pytest.mark.slow

QUICK = Recipe(width=16, depth=2, batch=1024, chunk=2**12, reuse=2)
MODEL = "full_geometry"
SETTINGS = {
    fig01: {
        "OBJECTS": ("candle",), "MODELS": (MODEL,), "SIZES": {"draft": 12}, "RESOLUTION": {"draft": 24},
    },
    fig06: {"LIGHTS": ("sunset",), "VIEWS": (0, 180), "SIZES": {"draft": 12}},
    fig07: {
        "SHOWN": {"draft": ("meat",)}, "SIZES": {"draft": 12}, "RESOLUTION": {"draft": 24}, "STEPS": {"draft": 2},
        "PHOTOGRAPHS": {"draft": {"n": 2, "size": 8, "spp": 4}}, "STEP_SPP": {"draft": 1}, "BACKGROUND_SPP": 4,
    },
    fig09: {
        "SHOWN": {"draft": ("ketchup",)}, "MODELS": (MODEL,), "SIZES": {"draft": 12}, "MODEL_SPP": {"draft": 4},
        "TRUTH_SPP": {"draft": 32},
    },
    fig11: {"MATERIALS": ("ketchup",), "METHODS": (VOLUMES[0], MODEL), "SIZES": {"draft": 12}},
    table1: {"SUBJECTS": {"draft": ("ketchup",)}, "MODELS": (MODEL,), "SIZES": {"draft": 12}, "SPP": {"draft": 4}},
}  # fmt: skip


@pytest.fixture()
def small(monkeypatch: pytest.MonkeyPatch, little_light: None) -> None:
    train = training.train_unattended
    monkeypatch.setattr(training, "train_unattended", lambda *a, **how: train(*a, **{**how, "recipe": QUICK}))
    for module, settings in SETTINGS.items():
        monkeypatch.setitem(module.CHUNKS, "draft", 1)
        for name, value in settings.items():
            monkeypatch.setattr(module, name, value)
    monkeypatch.setitem(fig01.SPP, "draft", {"path_traced": 16, "model": 4})
    monkeypatch.setitem(fig06.SPP, "draft", {"path_traced": 16, MODEL: 4})
    monkeypatch.setattr(fig06, "MATERIAL", "ketchup")
    for name, value in (("EXITS", 16), ("WALKS", 128), ("SAMPLES", 64)):
        monkeypatch.setattr(training, name, value)
    monkeypatch.setitem(fig07.RIVALS_SPP, "draft", dict.fromkeys(fig07.RIVALS_SPP["draft"], 16))
    monkeypatch.setitem(fig07.SECONDS, "draft", 0.01)
    monkeypatch.setattr(distant_light, "DIRECTIONS", 12)
    monkeypatch.setattr(distant_light, "CHUNK", 2**10)
    monkeypatch.setitem(fig11.SECONDS, "draft", 0.1)
    monkeypatch.setitem(fig11.TRUTH_SPP, "draft", 32)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of all figures, which share what an object learnt, as they do for a user."""
    return tmp_path_factory.mktemp("out")


def drawn(name: str, folder: Path) -> tuple[dict[str, Result], dict[str, bytes | str]]:
    results = runner.compute(name, "draft", folder)
    return results, runner.figure(name).draw(results)


def rows(text: bytes | str) -> pandas.DataFrame:
    return pandas.read_csv(io.StringIO(str(text)))


def test_fig_9_has_a_column_of_the_full_geometry_with_the_time_of_its_training(small: None, folder: Path) -> None:
    results, files = drawn("fig09", folder)
    assert list(results) == [
        "ketchup, path traced",
        "ketchup, training",
        "ketchup, full_geometry",
    ]
    row = rows(files["fig09.csv"]).iloc[-1]
    assert row["model"] == "Full geometry" and 0 < row["FLIP"] < 1 and row["CPU seconds of training"] > 0
    assert files["fig09.png"].startswith(b"\x89PNG") and "<html" in files["fig09.html"]
    assert runner.plan("fig09", "draft", folder).missing == ()


def test_fig_1_compares_objects_with_walks_where_they_cover_pixels(small: None, folder: Path) -> None:
    results, files = drawn("fig01", folder)
    table = rows(files["fig01.csv"])
    assert list(table["object"]) == ["candle"] * 2 and table["FLIP"].between(0, 1).all()
    mask = results["candle, path_traced"].images["cover"] > 0.5
    assert 0.02 < mask.mean() < 0.9 and results["candle, full_geometry, corrected"].images["image"][mask].mean() > 1e-3
    assert files["fig01.png"].startswith(b"\x89PNG")


def test_fig_7_compares_both_rivals_and_ours_with_walks(small: None, folder: Path) -> None:
    results, files = drawn("fig07", folder)
    table = rows(files["fig07.csv"])
    assert list(table["method"]) == [fig07.DENG, fig07.TG, "Ours, full geometry"]
    assert table["FLIP"].between(0, 1).all() and (table["training, CPU s"] > 0).all()
    mask = results["meat, path_traced"].images["cover"] > 0.5
    for name in (fig07.DENG, fig07.TG):
        assert results[f"meat, {name}"].images["image"][mask].mean() > 1e-3
    assert files["fig07.png"].startswith(b"\x89PNG") and "Deng et al." in files["fig07.html"]


def test_fig_6_renders_a_light_and_all_views_by_one_training(small: None, folder: Path) -> None:
    results, files = drawn("fig06", folder)
    assert sum(name.endswith("training") for name in results) == 1
    table = rows(files["fig06.csv"])
    assert sorted(zip(table["light"], table["view"])) == [("sunset", 0), ("sunset", 180)]
    for name in ("fig06_environments.png", "fig06_views.png"):
        assert files[name].startswith(b"\x89PNG")
    front, back = (results[f"sunset, {view} degrees, path_traced"].images["image"] for view in (0, 180))
    assert ((front > 0) != (back > 0)).any()


def test_table_1_tells_time_samples_and_size_with_the_papers_beside(small: None, folder: Path) -> None:
    results, files = drawn("table1", folder)
    one, four = (results[f"ketchup, full_geometry, N = {n}"].images["image"] for n in (1, 4))
    assert (one != four).any()
    table = rows(files["table1.csv"])
    assert list(table["N"]) == [1, 4] and (table["samples"] == 4 * 12**2).all()
    assert (table[["training, CPU s", "render, CPU s", "weights, kB", "steps", "walks"]] > 0).all(axis=None)
    rivals = rows(files["table1_rivals.csv"])
    assert list(rivals["method"]) == list(fig07.LABELS.values()) and set(rivals["object"]) == {"meat"}
    assert (rivals[["training, CPU s", "weights, kB", "render, CPU s per 10⁶"]] > 0).all(axis=None)
    assert "2118" in files["table1.md"] and "RTX 4090" in files["table1_paper.csv"]


def test_weights_of_another_training_are_not_found(small: None, tmp_path: Path) -> None:
    from full_geometry.scenes.scene_files import load_scene

    scenes.prepare()
    scene = scenes.scan_scene("ketchup", 8)
    with learnt.with_weights(tmp_path, {}), pytest.raises(ValueError, match="must be trained for full_geometry"):
        load_scene(scene, MODEL)


@pytest.mark.parametrize("module", [fig01, fig06, fig07, table1])
def test_parts_have_keys_and_more_work_in_paper_quality(module) -> None:
    draft, paper = (module.parts(quality) for quality in ("draft", "paper"))
    assert len(keys_of(draft)) == len(draft)
    assert sum(p.work for p in paper) > 10 * sum(p.work for p in draft)


def test_models_of_objects_are_among_the_columns() -> None:
    assert MODEL in OF_OBJECTS
    for module in (fig01, fig06, fig07, fig09, fig11, table1):
        assert any(MODEL in part.name or MODEL in part.params.get("methods", ()) for part in module.parts("draft"))
