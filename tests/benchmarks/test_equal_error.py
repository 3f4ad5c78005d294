"""Equal-error times: the estimates of error, small real runs of every part, and the tables."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest
from quick_light import gather_by_few

from benchmarks import equal_error, equal_error_tables
from benchmarks.equal_error import MODELLED, STEPS, furnace, furnace_models, modelled_contender, modelled_scene
from benchmarks.methods import VOLUMES, contender
from benchmarks.timed import TimedRender, rendered
from figures.computing.contenders import MODELS, WALK
from figures.computing.scans import MM_PER_UNIT, prepare
from figures.parts.part import Part, Result, Task
from full_geometry.learning import training
from full_geometry.learning.network_fitting import Recipe
from halfspace_sss import materials

mi = pytest.importorskip("mitsuba")

pytestmark = pytest.mark.slow
DIPOLE, BARE = MODELS[0], f"{MODELS[0]}, bare"
LEARNT = "full_geometry"
CHOSEN = (VOLUMES[0], VOLUMES[2], WALK, DIPOLE, BARE, LEARNT)
QUICK = Recipe(width=16, depth=2, batch=1024, chunk=2**12, reuse=2)


def _computed(part: Part, done: dict[str, Result], folder: Path) -> Result:
    """The function of a part, run as the machinery runs it, with few methods."""
    params = dict(part.params)
    if "passes" in params:
        params["spp"] = {name: 16 if name in (DIPOLE, BARE, LEARNT) else 4 for name in CHOSEN}
    params |= {"models": [DIPOLE], "repeats": 1} if "repeats" in params else {}
    found = part.function(Task(params, folder, {name: done[name] for name in part.needs}))
    images = {name: v for name, v in found.items() if isinstance(v, np.ndarray)}
    return Result(images, {name: v for name, v in found.items() if name not in images}, 1.0, part.work)


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Result]:
    """All parts of one material under the sky, small."""
    train = training.train_unattended
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "train_unattended", lambda *a, **how: train(*a, **{**how, "recipe": QUICK}))
        patch.setitem(equal_error.CHUNKS, "draft", 1)
        gather_by_few(patch.setattr)
        for name, value in (("EXITS", 16), ("WALKS", 128), ("SAMPLES", 64)):
            patch.setattr(training, name, value)
        patch.setattr(equal_error, "SUBJECTS", {"ketchup": ("bunny", "ketchup")})
        patch.setitem(equal_error.COMPARED, "draft", {"ketchup": ("even sky",)})
        patch.setattr(equal_error, "OBJECTS", ())
        patch.setattr(equal_error, "furnace_models", lambda: [DIPOLE])
        for name, value in (("SIZES", 24), ("TRUTH_SPP", 64), ("LANES", 4096), ("FURNACE", {"size": 8, "spp": 64})):
            patch.setitem(getattr(equal_error, name), "draft", value)
        parts, found = equal_error.parts("draft"), {}
        for part in parts:
            found[part.name] = _computed(part, found, tmp_path_factory.mktemp("part"))
    return found


def test_every_method_of_a_scene_has_errors_and_times(results: dict[str, Result]) -> None:
    found = results["ketchup, even sky, errors"].numbers
    rows = {row["method"]: row for row in found["rows"]}
    assert tuple(rows) == CHOSEN
    for row in rows.values():
        assert row["seconds"] > 0 and row["spread"] > 0
        assert all(np.isfinite(row[key]) for key in ("variance", "bias2", "error"))
    assert rows[DIPOLE]["variance"] == rows[DIPOLE]["spread"] > rows[BARE]["spread"]
    walk = rows[WALK]  # about the truth as about itself: nothing but noise is between them
    assert abs(walk["error"] - walk["spread"]) < 5 * walk["error standard error"] < walk["spread"]
    assert 0 < found["truth"]["variance"] < found["truth"]["mean square"]


def test_the_tables_say_ratios(results: dict[str, Result]) -> None:
    files = equal_error.draw(results)
    table = pandas.read_csv(io.StringIO(files["equal_error_errors.csv"])).set_index("method")
    assert table["is best volpathmis"].sum() == 1
    best = table.index[table["is best volpathmis"]][0]
    assert table.loc[best, "ratio"] == pytest.approx(1.0)
    expected = table.loc[best, "cost"] / (table.loc[DIPOLE, "spread"] * table.loc[DIPOLE, "seconds"])
    assert table.loc[DIPOLE, "ratio"] == pytest.approx(expected)
    assert list(pandas.read_csv(io.StringIO(files["equal_error_sampling.csv"])).columns) == ["model", *STEPS, "sum"]
    assert list(pandas.read_csv(io.StringIO(files["equal_error_furnace.csv"]))["method"]) == [WALK, DIPOLE]
    for said in (
        "Standard dipole",
        "Our walk",
        "volpathmis",
        "White furnace",
        "| to rr_depth 200 |",
        "Seconds per million",
    ):
        assert said in files["equal_error.md"]
    assert "nan" not in files["equal_error.md"]


def _noisy(truth: np.ndarray, bias: float, sigma: float, passes: int, spp: int) -> TimedRender:
    rng = np.random.default_rng(spp)
    images = truth + bias + sigma / np.sqrt(spp) * rng.standard_normal((passes, *truth.shape))
    return TimedRender(images.astype(np.float32), passes * spp, *[(0.01 * spp,) * passes] * 2)


def test_variance_and_bias_are_told_apart_and_the_noise_of_the_truth_is_taken_off() -> None:
    rng, exact = np.random.default_rng(1), np.full((64, 64, 3), 2.0)
    noise = 0.3
    image = (exact + noise * rng.standard_normal(exact.shape)).astype(np.float32)
    truth = Result({"image": image, "variance": np.full(exact.shape, noise**2, np.float32)}, {}, 1.0, 1.0)
    mask = np.ones((64, 64), dtype=bool)
    found = equal_error.errors(_noisy(exact, 0.5, 1.0, 4, 4), truth, mask, False)
    assert found["spp"] == 4 and found["seconds"] == pytest.approx(0.04)
    assert found["variance"] == pytest.approx(0.25, rel=0.05)
    assert found["bias2"] == pytest.approx(0.25, abs=0.02)
    assert found["error"] == pytest.approx(0.5, abs=0.03)
    assert abs(found["bias2"] - 0.25) < 4 * found["bias2 standard error"] < 0.05
    traced = equal_error.errors(_noisy(exact, 0.0, 1.0, 4, 4), truth, mask, True)
    assert traced["variance"] == traced["error"] == pytest.approx(0.25, abs=0.02)


def test_a_cost_does_not_depend_on_how_long_the_render_was() -> None:
    exact, mask = np.zeros((64, 64, 3)), np.ones((64, 64), dtype=bool)
    truth = Result({"image": exact.astype(np.float32), "variance": exact.astype(np.float32)}, {}, 1.0, 1.0)
    found = [equal_error.errors(_noisy(exact, 0.0, 1.0, 3, spp), truth, mask, False) for spp in (1, 4, 64)]
    assert found[0]["variance"] > 3 * found[1]["variance"] > 30 * found[2]["variance"]
    costs = [row["variance"] * row["seconds"] for row in found]
    assert max(costs) < 1.1 * min(costs)


def _table(*errors: tuple[str, float, float]) -> pandas.DataFrame:
    """The table of methods with a variance and an error, of the same time and number of samples, by method."""
    plain = {"seconds": 2.0, "spp": 4, "spread": 1.0, "bias2 standard error": 0.1, "error standard error": 0.1}
    rows = [
        {**plain, "method": name, "variance": variance, "error": error, "bias2": error - variance}
        for name, variance, error in errors
    ]
    scene = {"rows": rows, "truth": {"mean square": 4.0}}
    return equal_error_tables.equal_error({("marble", "even sky"): scene}).set_index("method")


def test_what_the_noise_of_the_truth_hides_is_left_out() -> None:
    table = _table((VOLUMES[0], 2.0, 2.0), (VOLUMES[2], -0.1, -0.1), (DIPOLE, 0.5, 0.15), (MODELS[1], 0.5, 1.5))
    assert list(table["is best volpathmis"]) == [True, False, False, False]
    assert np.isnan(table.loc[VOLUMES[2], "ratio"])
    assert table.loc[DIPOLE, "ratio"] == 4
    assert np.isnan(table.loc[DIPOLE, ["ratio with bias", "relative bias", "seconds until bias"]].astype(float)).all()
    assert table.loc[MODELS[1], "ratio with bias"] == pytest.approx(2 / 1.5)
    assert table.loc[MODELS[1], "relative bias"] == 0.5 and table.loc[MODELS[1], "seconds until bias"] == 4


def test_roulette_that_begins_earlier_counts_with_no_less_variance() -> None:
    table = _table((VOLUMES[0], 0.1, 0.1), (VOLUMES[1], 3.0, 3.0), (VOLUMES[2], 2.0, 2.0), (DIPOLE, 0.5, 0.5))
    assert list(table["cost"]) == [6.0, 6.0, 4.0, 1.0]
    assert list(table["is best volpathmis"]) == [False, False, True, False]
    assert table.loc[VOLUMES[0], "variance"] == 0.1


def test_a_training_has_paid_once_the_images_have_saved_its_time() -> None:
    plain = {"seconds": 2.0, "spp": 4, "spread": 1.0, "bias2 standard error": 0.1, "error standard error": 0.1}
    rows = [
        {**plain, "method": name, "variance": variance, "error": variance, "bias2": 0.0}
        for name, variance in ((VOLUMES[0], 2.0), (DIPOLE, 0.5), (MODELS[1], 4.0))
    ]
    scene = {"rows": rows, "truth": {"mean square": 1000.0}, "training": {DIPOLE: 20.0, MODELS[1]: 20.0}}
    table = equal_error_tables.equal_error({("marble", "even sky"): scene}).set_index("method")
    saved = (2.0 - 0.5) * 2.0 / (equal_error_tables.WANTED**2 * 1000.0)  # seconds of an image of that noise
    assert table.loc[DIPOLE, "images until paid"] == np.ceil(20.0 / saved) == 3
    assert np.isnan(table.loc[[VOLUMES[0], MODELS[1]], "images until paid"]).all()


def test_a_bare_model_is_not_held_against_a_truth_with_all_orders() -> None:
    table = _table((VOLUMES[2], 2.0, 2.0), (BARE, 0.5, 1.5))
    assert table.loc[BARE, "ratio"] == table.loc[BARE, "ratio to rr_depth 200"] == 4
    assert np.isnan(table.loc[BARE, "ratio with bias"]) and np.isnan(table.loc[BARE, "relative bias"])


def test_the_time_of_a_sample_is_split_in_three(results: dict[str, Result]) -> None:
    (row,) = results["time per sample"].numbers["rows"]
    assert row["model"] == DIPOLE and all(0 < row[step] < 1e3 for step in STEPS)


def test_the_time_of_a_step_is_its_fastest_after_the_one_that_compiles(monkeypatch: Any, tmp_path: Path) -> None:
    seconds = iter([0.1, 0.1, 0.1, 5.0, 6.0, 9.0, 4.0, 7.0, 8.0])  # by repeat, the steps in turn
    monkeypatch.setattr(equal_error, "_steps", lambda *_: dict.fromkeys(STEPS))
    monkeypatch.setattr(equal_error, "kernel_seconds", lambda _: next(seconds))
    params = {"material": "ketchup", "models": [DIPOLE], "lanes": 10**6, "repeats": 2}
    (row,) = equal_error.split(Task(params, tmp_path))["rows"]
    assert [row[step] for step in STEPS] == [4.0, 6.0, 8.0]


def test_the_white_furnace_of_a_walk_is_one(tmp_path: Path, results: dict[str, Result]) -> None:
    found = results[f"furnace, {WALK}"].numbers
    assert abs(found["mean"] - 1) < 4 * found["standard error"] + 1e-3
    assert DIPOLE in furnace_models() and "neural" in furnace_models()
    conserving: Any = furnace(Task({"model": "normalized_diffusion", "size": 16, "spp": 64}, tmp_path))
    assert conserving["mean"] < 1 + 4 * conserving["standard error"]


def test_a_medium_with_a_mean_cosine_for_each_channel_is_shown_to_mitsuba_channel_by_channel() -> None:
    prepare()
    name = "regular chocolate milk"
    medium, scenes = materials.load(name).medium, contender(VOLUMES[-1], name, 8, "even sky")
    assert len(scenes) == 3
    for k, scene in enumerate(scenes):
        found = mi.traverse(scene)
        assert float(found["bunny.interior_medium.phase_function.g"][0]) == pytest.approx(medium.g[k])
        assert float(found["bunny.interior_medium.scale"]) == pytest.approx(MM_PER_UNIT * medium.sigma_t[k])
        albedo = np.array(found["bunny.interior_medium.albedo.value.value"]).ravel()
        np.testing.assert_allclose(albedo, medium.albedo[k], rtol=1e-6)


def test_scenes_of_one_channel_each_make_one_image() -> None:
    prepare()
    film = {"type": "hdrfilm", "width": 4, "height": 4, "rfilter": {"type": "box"}}
    skies = [{"type": "rgb", "value": [k, k + 1, k + 2]} for k in (1, 4, 7)]
    scenes = tuple(
        mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "path"},
                "sensor": {"type": "perspective", "film": film},
                "sky": {"type": "constant", "radiance": sky},
            }
        )
        for sky in skies
    )
    np.testing.assert_allclose(rendered(scenes, 4, 1)[0].mean(axis=(0, 1)), [1, 5, 9], rtol=1e-5)


@pytest.mark.parametrize("shown", MODELLED)
def test_modelled_objects_are_shown_alike_to_walks_and_to_mitsuba(shown: str, tmp_path: Path) -> None:
    """Means of two images of 16 x 16 pixels, within four standard errors of passes and 3 % for Mitsuba's horizon."""
    prepare()
    p = {"object": shown, "resolution": 24, "size": 16, "lights": "even sky"}
    means = []
    for method in (WALK, VOLUMES[-1]):
        scene = modelled_contender(method, p, tmp_path)
        means.append([rendered(scene, 4, k)[0].mean(axis=(0, 1)) for k in range(4)])
    found, wanted = (np.mean(m, axis=0) for m in means)
    noise = np.hypot(*(np.std(m, axis=0, ddof=1) / 2 for m in means))
    assert np.all(np.abs(found - wanted) < 4 * noise + 0.03 * wanted) and np.all(noise < 0.1 * wanted)


def test_the_small_light_of_the_candle_is_its_flame_and_that_of_others_a_lamp(tmp_path: Path) -> None:
    prepare()
    lights = {name: modelled_scene(name, 16, 8, "small light", tmp_path) for name in MODELLED}
    assert "lamp" not in lights["candle"] and "emitter" in lights["candle"]["flame"]
    assert "emitter" in lights["mandarin"]["lamp"] and all("sky" not in found for found in lights.values())
    assert set(modelled_scene("candle", 16, 8, "even sky", tmp_path)) & {"sky", "flame", "wick"} == {"sky"}
    with pytest.raises(ValueError, match="lights must be one of small light, even sky"):
        modelled_scene("candle", 16, 8, "dusk", tmp_path)


def test_the_figure_covers_scans_and_modelled_objects_two_lights_and_every_model() -> None:
    paper = {part.name: part for part in equal_error.parts("paper")}
    assert f"{MODELS[1]}, bare" in paper["marble, small light, errors"].params["spp"]
    scenes = [part for part in paper.values() if part.name.endswith(", errors")]
    assert len(scenes) == 16
    for part in scenes:
        assert {*VOLUMES, WALK, *MODELS, LEARNT} <= set(part.params["spp"])
        assert any(name.endswith(", training") for name in part.needs)
    assert sum(part.params.get("scan") == "dragon" for part in scenes) == 2
    assert [part.params["object"] for part in scenes if "object" in part.params] == [n for n in MODELLED for _ in "ab"]
    assert all(("neural_shape" in part.params["spp"]) == (part.params.get("object") != "mandarin") for part in scenes)
    assert sum(BARE in part.params["spp"] for part in scenes) == 6


def test_a_draft_is_a_part_of_the_figure() -> None:
    draft, paper = ({part.name: part for part in equal_error.parts(quality)} for quality in ("draft", "paper"))
    assert all(paper[name].work >= 4 * part.work for name, part in draft.items())
    scenes = [name for name in draft if name.endswith(", errors")]
    assert any("candle" in name for name in scenes) and any("even sky" in name for name in scenes)
    assert all(set(draft[name].params["spp"]) < set(paper[name].params["spp"]) for name in scenes)
