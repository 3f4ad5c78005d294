"""Assessments of scenes: what they say of spheres and extremes, the model auto and the commands."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from render_files import XML
from typer.testing import CliRunner

from figures import app as cli
from full_geometry.integrators import translucent_walk
from full_geometry.precomputed.unscattered_light import ImageSamples
from full_geometry.trade import advice, assess, automatic, measuring, recommend, recommend_flat
from full_geometry.trade.assessing import assess_stage
from full_geometry.trade.denoised_walks import Tiles, _apart, _side_by_side
from full_geometry.trade.denoising import guides
from full_geometry.trade.images import small_images
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade
from full_geometry.trade.sampling import first_sample, sample_more, visible_exits
from full_geometry.trade.techniques import DENOISED_WALKS, PRECOMPUTED_WALKS, WALKS, Effort, Job, Technique, stage
from halfspace_sss import Medium
from halfspace_sss.physics.fresnel import F_r

mi = pytest.importorskip("mitsuba")
QUICK = {"seconds": 0.2, "exits": 64}
FEW = ["better_dipole", "lambert"]


@pytest.fixture(autouse=True)
def rendering(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    import full_geometry

    monkeypatch.setenv("HALFSPACE_SSS_CHOICES", str(tmp_path / "choices"))
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()


def scene(medium: dict | None = None, light: dict | None = None, n: int = 1, **more: Any) -> dict[str, Any]:
    """Balls of radius 1 mm in a row under an even sky."""
    medium = medium or {"sigma_s": 9.5, "sigma_a": 0.5}
    view = mi.ScalarTransform4f().look_at([0, 0, 4 + 3 * n], [0, 0, 0], [0, 1, 0])
    balls = {
        f"ball{k}": {
            "type": "sphere",
            "center": [2.5 * (k - 0.5 * (n - 1)), 0, 0],
            "bsdf": {"type": "translucent", **medium, **more},
        }
        for k in range(n)
    }
    film = {"type": "hdrfilm", "width": 64, "height": 64}
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf", "hide_emitters": True},
        "light": light or {"type": "constant"},
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film},
        **balls,
    }


def test_a_ball_of_ten_mean_free_paths_is_as_dark_by_a_half_space_as_images_say() -> None:
    on, ways = (
        stage(scene({"sigma_s": 9.5, "sigma_a": 0.5, "eta": 1.3})),
        [Technique.of("path_traced"), Technique.of("neural")],
    )
    found = assess_stage(on, ways, Effort(samples=1024, exits=64))
    row = found.objects[0].way("neural")
    # 0.85 of light from inside is left (spheres), and all that is reflected or single; four seeds: 0.845 to 0.86
    assert row.ratio[0] == pytest.approx(0.87, abs=0.05) and row.bias > 0.05
    assert row.ratio_error[0] < 0.03
    assert found.objects[0].mfp == pytest.approx((34.6, 34.6), rel=0.01)
    assert row.seconds > 0 and row.memory > 0 and row.samples > 0


def test_the_scene_is_as_it_was_after_an_assessment() -> None:
    loaded = mi.load_dict(scene(model="standard_dipole"))
    before = loaded.shapes()[0].bsdf().spec
    assess(loaded, models=FEW, **QUICK)
    assert loaded.shapes()[0].bsdf().spec is before


def test_a_diffuse_surface_is_right_for_a_large_object_under_an_even_sky() -> None:
    found = assess(scene({"sigma_s": 950, "sigma_a": 50}), models=["lambert"], **{**QUICK, "seconds": 0.4})
    row = found.objects[0].way("lambert")
    assert row.bias_bound < 0.15
    assert all(abs(r - 1) < 0.06 for r in row.ratio)


ROUGH = {"boundary": {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.4, "ext_ior": 1.0}, "eta": 1.4}


@pytest.mark.parametrize("boundary", [{}, ROUGH], ids=["smooth", "rough"])
def test_an_object_without_weights_has_cost_no_training(boundary: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", "none")
    loaded = mi.load_dict(scene(**boundary))
    for model in ("full_geometry", "neural_shape", "better_dipole"):
        assert measuring.training_seconds(loaded, "ball0", model) == 0


@pytest.mark.usefixtures("little_light")
@pytest.mark.slow
def test_a_way_that_cannot_be_is_left_out_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", "none")
    for boundary, why in (({}, "must be trained"), (ROUGH, "must be smooth under a model, got a RoughDielectric")):
        found = recommend(
            scene(**boundary), tolerance=0.3, models=[*FEW, "full_geometry"], assess_seconds=0.2, exits=64
        )
        (learnt,) = (option for option in found.objects[0].options if option.way == "full_geometry")
        assert why in learnt.why
        assert found.objects[0].way is not None


EXTREMES = {
    "smaller than a mean free path": {"sigma_s": 0.1, "sigma_a": 0.02},
    "larger than 5000": {"sigma_s": 3000.0, "sigma_a": 300.0},
    "albedo 0": {"sigma_s": 0.0, "sigma_a": 5.0},
    "albedo 1": {"sigma_s": 5.0, "sigma_a": 0.0},
    "eta 1": {"sigma_s": 9.5, "sigma_a": 0.5, "eta": 1.0},
    "black": {"sigma_s": 0.0, "sigma_a": 5.0, "eta": 1.0},
}


@pytest.mark.parametrize("extreme", EXTREMES)
def test_an_extreme_object_is_assessed(extreme: str) -> None:
    assessed = assess(scene(EXTREMES[extreme]), models=FEW, **QUICK)
    found, advice = assessed.objects[0], recommend(assessed, tolerance=0.5).objects[0]
    clear = extreme.startswith("smaller")  # models of the half-space refuse it
    assert all((row.refusal and clear and row.way in FEW) or row.seconds > 0 for row in found.ways)
    assert any(row.refusal for row in found.ways) == clear
    assert advice.way is not None and len(advice.options) == 3
    assert bool(found.notes) == extreme.startswith(("smaller", "larger"))


def test_without_light_every_way_shows_it_black() -> None:
    found = recommend(scene(light={"type": "constant", "radiance": 0.0}), models=FEW, **QUICK_ASSESS)
    assert "no light comes from it, every technique shows it black" in str(found)


QUICK_ASSESS = {"assess_seconds": 0.2, "exits": 64}


def test_all_channels_of_exits_and_images_are_traced_once_and_by_one_kernel() -> None:
    import drjit as dr

    on, way = stage(scene()), Technique.of("better_dipole")
    (exits,) = visible_exits(on.scene, on.shapes, 0, 32, 0)
    found = first_sample(on, way, exits, 0)
    known = len(found.launches)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        sample_more(on, way, exits, found, 0, samples=66)
        small_images(on, [way], 0, 0, side=8, spp=4)
        kernels = dr.kernel_history([dr.KernelType.JIT])
    paths = [kernel["hash"] for kernel in kernels if "Symbolic loop: bssrdf" in kernel["ir"].getvalue()]
    assert len(paths) == len(found.launches) - known + 1 == 2 and len(set(paths)) == 1


def test_four_objects_are_assessed_one_by_one() -> None:
    found = assess(scene(n=4), models=["lambert"], **{**QUICK, "seconds": 0.05, "exits": 32})
    assert [o.object for o in found.objects] == [f"ball{k}" for k in range(4)]
    assert all(o.ways for o in found.objects)


def test_an_object_behind_another_is_refused_in_a_sentence() -> None:
    hidden = scene()
    hidden["ball1"] = {**hidden["ball0"], "center": [0, 0, -1.5], "radius": 0.3}
    found = recommend(hidden, models=["lambert"], **QUICK_ASSESS).objects[1]
    assert found.way is None and "hardly seen by the camera" in str(found)


def test_an_object_in_a_ball_of_glass_is_seen_through_it() -> None:
    """As wide as by its index."""
    glass = {"type": "sphere", "radius": 1.5, "bsdf": {"type": "dielectric", "int_ior": 1.1, "ext_ior": 1.0}}
    (bare,), (found,) = (
        visible_exits(on.scene, on.shapes, 0, 32, 0)
        for on in (stage(scene()), stage({**scene(), "glass": {**scene()["ball0"], **glass}}))
    )
    assert found.share / bare.share == pytest.approx(1.21, rel=0.02)


def test_an_instance_is_refused_in_a_sentence() -> None:
    group = {"type": "shapegroup", "ball": scene()["ball0"]}
    instanced = {**scene(), "group": group, "one": {"type": "instance", "g": {"type": "ref", "id": "group"}}}
    with pytest.raises(ValueError, match="must be no instances for the trade, got the shape 'ball' in a shapegroup"):
        assess(instanced, models=FEW, **QUICK)


def windows() -> np.ndarray:
    """An environment map, dark but for a window."""
    pixels = np.full((32, 64, 3), 0.1, dtype=np.float32)
    pixels[8:14, 20:28] = (9.0, 8.0, 6.0)
    return pixels


@pytest.mark.slow
@pytest.mark.usefixtures("little_light")
def test_the_second_look_goes_on_with_the_samples_of_the_first(monkeypatch: pytest.MonkeyPatch) -> None:
    known: list[tuple[Technique, int, Any]] = []

    def noted(on: Any, way: Technique, points: Any, sampled: Any, *args: Any, **more: Any) -> None:
        known.append((way, sampled.estimate.samples, sampled))
        sample_more(on, way, points, sampled, *args, **more)

    monkeypatch.setattr(measuring, "sample_more", noted)
    asked = ["better_dipole", "better_dipole, gathered"]
    found = assess(scene(orders="multiple"), models=asked, job=Job(0.05), **QUICK).objects[0]
    counts = [samples for way, samples, _ in known if way == WALKS]
    (walks,) = {sampled for way, _, sampled in known if way == WALKS}
    assert counts == sorted(counts) and 0 < counts[0] < walks.estimate.samples
    sampled, gathered = (found.way(name) for name in asked)
    error = np.hypot(sampled.ratio_error, gathered.ratio_error)
    assert np.all(np.abs(np.subtract(sampled.ratio, gathered.ratio)) < 4 * error + 0.03)


def test_a_point_through_which_a_lamp_would_be_seen_is_left_out() -> None:
    from full_geometry.trade.sampling import visible_exits
    from full_geometry.trade.techniques import stage

    lit = scene({"sigma_s": 9.5, "sigma_a": 0.5, "eta": 1.0})
    lamp = {"type": "sphere", "center": [0, 0, -5.0], "radius": 0.4}
    lit["lamp"] = {**lamp, "emitter": {"type": "area", "radiance": 9.0}}
    on = stage(lit)
    (found,) = visible_exits(on.scene, on.shapes, 0, 10**5, 1)
    nearest = np.linalg.norm(np.cross(found.d.T, np.array([0, 0, -5.0]) - found.o.T), axis=1)  # d is a unit vector
    assert 0.4 - 1e-3 < nearest.min() < 0.43


def test_a_way_that_refuses_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", str(tmp_path))
    found = assess(scene(), models=["full_geometry"], **QUICK).objects[0]
    assert "must be trained" in found.way("full_geometry").refusal


def test_walks_refuse_to_precompute_light_where_that_cannot_be() -> None:
    ways = [WALKS, PRECOMPUTED_WALKS]
    found = assess_stage(stage(scene(orders="multiple")), ways, Effort(samples=48, exits=32)).objects[0]
    assert found.way("path_traced, precomputed").refusal.endswith("orders of object 'ball0' are 'multiple'")


def test_light_that_is_kept_for_samples_is_precomputed_anew_where_an_emitter_has_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(translucent_walk, "FEWEST_RAYS", 2**19)
    loaded = mi.load_dict(scene({"sigma_s": 9.5, "sigma_a": 0.5, "eta": 1.3}))
    walks = mi.load_dict({"type": "translucent_walk", "light": "precomputed", "hide_emitters": True})
    (exits,) = visible_exits(loaded, list(loaded.shapes()), 0, 32, 0)
    rays, means = exits.rays(64), []
    walks.prepare(loaded, ImageSamples(2**18, 2**8))
    for _ in range(2):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(1, exits.n * 64)
        means.append(np.mean(np.array(walks.sample(loaded, sampler, rays)[0])))
        parameters = mi.traverse(loaded)
        parameters["light.radiance.value"] = 2 * parameters["light.radiance.value"]
        parameters.update()
    assert means[1] == pytest.approx(2 * means[0], rel=0.02)  # the same walks in the noise of another fill, .3 %


def _found(*ways: tuple[str, float, float]) -> Assessment:
    """An assessment of names, bias² and seconds of a sample."""
    rows = (TechniqueTrade(name, bias2, 0.0, (1.0,), (0.0,), 1.0, 0.0, cost, 100) for name, bias2, cost in ways)
    return Assessment((ObjectTrade("ball", (30.0, 40.0), 0.5, 100.0, (1.0,), tuple(rows)),), 1.0, 0.0, 0)


CHANCE, QUICKER = ("path_traced", 0.0, 1e-5), ("path_traced, precomputed", 0.0, 1e-6)


@pytest.mark.slow
@pytest.mark.usefixtures("little_light")
@pytest.mark.parametrize("arguments", [["--model", "auto", "--spp", "1"], ["--target-error", "0.5"]])
def test_the_command_takes_the_cheapest_way_where_that_is_left_to_it_and_finds_it_again(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    named = "--model" in arguments
    unnamed = re.sub(r'<integrator.*?</integrator>|<string name="model"[^>]*>', "", XML)
    (tmp_path / "ball.xml").write_text(XML if named else unnamed)
    known = []
    monkeypatch.setattr(automatic, "assess_for", lambda *args: known.append(args) or _found(CHANCE, QUICKER))
    for _ in range(2):
        result = CliRunner().invoke(cli.app, ["render", "ball.xml", *arguments])
        assert result.exit_code == 0, result.output
        assert "path_traced, precomputed: the cheapest that keeps" in " ".join(result.output.split())
    about = json.loads((tmp_path / "render" / f"ball_{'auto' if named else 'scene'}.json").read_text())
    assert "TranslucentWalk" in about["integrator"] and len(known) == 1
    ways = [each.name for each in known[0][1]]
    assert ways[:2] == ["path_traced", "path_traced, precomputed"]
    own = ["path_traced, denoised", "path_traced, precomputed, denoised", "better_dipole, corrected"]
    assert (ways[2:] == own) != named
    assert known[0][2].tolerance == (0.05 if named else 0.5)


def test_auto_inside_the_integrator_of_models_refuses_what_none_of_them_keeps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(automatic, "assess_for", lambda *args: _found(CHANCE, ("neural", 0.01, 1e-7)))
    loaded = mi.load_dict(scene(model="auto"))
    with pytest.raises(ValueError, match="a model must be known to keep the tolerance 0.05, or be named"):
        loaded.integrator().prepare(loaded)


@pytest.mark.slow
@pytest.mark.usefixtures("little_light")
def test_auto_takes_corrected_light_of_a_clear_object(monkeypatch: pytest.MonkeyPatch) -> None:
    """Objects are made for the light that is chosen: gathered light of this one is refused."""
    monkeypatch.setattr(automatic, "assess_for", lambda *args: _found(CHANCE, ("better_dipole, corrected", 0.0, 1e-8)))
    described = scene({"sigma_s": 0.3, "sigma_a": 0.02}, model="auto")
    described["integrator"]["light"] = "auto"
    loaded = mi.load_dict(described)
    (obj,) = loaded.integrator().prepare(loaded)
    assert loaded.integrator().choices.light == "corrected" and obj.gathered is not None


def _painted(*albedos: float) -> dict[str, Any]:
    """A medium of ten mean free paths whose albedo is a row of texels."""
    texels = np.array([[[albedo] * 3 for albedo in albedos]], dtype=np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels), "raw": True, "filter_type": "nearest"}
    return {"albedo": bitmap, "sigma_t": 10.0}


@pytest.mark.slow
@pytest.mark.usefixtures("little_light")
def test_a_textured_object_is_assessed_by_the_ways_that_take_it() -> None:
    """A texture of one colour is as far from walks as its medium; others of two colours say what they refuse."""
    ways = ["better_dipole", "neural_shape", "better_dipole, gathered"]
    medium = {"sigma_s": 9.5, "sigma_a": 0.5}
    plain, one = (assess(scene(m), models=ways[:1], **QUICK).objects[0].way(ways[0]) for m in (medium, _painted(0.95)))
    assert abs(plain.ratio[0] - one.ratio[0]) < 4 * np.hypot(plain.ratio_error[0], one.ratio_error[0])
    found = assess(scene(_painted(0.95, 0.5)), models=ways, **QUICK)
    two = [found.objects[0].way(way) for way in ways]
    assert not two[0].refusal and two[0].samples > 0
    assert "must be without textures for the model 'neural_shape'" in two[1].refusal
    assert not two[2].refusal and two[2].samples > 0
    assert recommend(found, tolerance=0.9).objects[0].way in ("path_traced", *ways)


def test_an_unknown_way_is_refused_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="did you mean 'neural'"):
        assess(scene(), models=["nural"], **QUICK)


@pytest.mark.usefixtures("little_light")
@pytest.mark.slow
def test_auto_is_chosen_once_kept_and_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(automatic, "Effort", lambda: Effort(1.0, exits=64))
    names = []
    asked = scene({"sigma_s": 95.0, "sigma_a": 5.0}, model="auto")
    asked["integrator"]["tolerance"] = 0.3
    for _ in range(2):
        loaded = mi.load_dict(asked)
        loaded.integrator().prepare(loaded)
        names.append(loaded.integrator().choices.models[0])
    (file,) = (tmp_path / "choices").iterdir()
    assert names[0] == names[1] != "auto"
    assert loaded.integrator().choices.sentences["ball0"].startswith("object 'ball0'")
    assert loaded.shapes()[0].bsdf().spec.model == "auto"
    file.write_text("{}")
    with pytest.raises(ValueError, match="delete it to choose anew"):
        damaged = mi.load_dict(asked)
        damaged.integrator().prepare(damaged)


@pytest.mark.slow
def test_denoised_walks_are_told_with_what_is_left_of_their_noise() -> None:
    pytest.importorskip("mitsuba_oidn")
    lit = scene(light={"type": "envmap", "bitmap": mi.Bitmap(windows())})
    lit["sensor"]["film"]["rfilter"] = {"type": "box"}
    ways = [WALKS, PRECOMPUTED_WALKS, DENOISED_WALKS[1]]
    found = assess_stage(stage(lit), ways, Effort(0.5, exits=64), denoising=1.0).objects[0]
    plain, row = (found.way(way.name) for way in ways[1:])
    doubt = row.variance_error / row.variance
    assert row.bias2 == plain.bias2 and row.power < 1.2 and row.seconds > plain.seconds
    assert 0 < row.noise2(64) * (1 + 2 * doubt) < plain.noise2(64)  # after two standard errors
    gaussian = stage(scene())
    refused = assess_stage(gaussian, [WALKS, DENOISED_WALKS[0]], Effort(samples=48, exits=32)).objects[0]
    assert refused.way("path_traced, denoised").refusal == "the film must have a box filter for a denoiser"


def test_tiles_that_are_drawn_where_samples_differ_have_the_mean_of_the_object() -> None:
    pytest.importorskip("mitsuba_oidn")
    near = scene()
    near["sensor"]["fov"] = 16
    on, film = stage(near), (64, 64)
    camera, p = on.scene.sensors()[0], np.tile(np.linspace(1.0, 9.0, 64), (64, 1))  # nine times as often at the right
    tiles = Tiles(on, camera, film, [p / p.sum()] * 36, 0)
    normals = guides(on.scene)[1][..., 0]  # of a ball: 0 in the mean
    x, w = _apart(tiles.guides[1], tiles.shape)[..., 0], tiles.weights[..., 0]
    assert abs(normals.mean()) < 0.01 and x[w > 0].mean() > 0.2
    assert abs((w * x).sum() / w.sum()) < 0.1  # six seeds: 0 ± 0.06
    assert np.array_equal(_apart(_side_by_side(tiles.weights), w.shape), tiles.weights.astype(np.float32))


def test_lambert_in_a_white_furnace_is_the_diffuse_reflectance_and_what_the_boundary_mirrors() -> None:
    """Of all that enters nothing is lost, but it leaves alike in all directions: 0.96 along the normal."""
    white = scene({"sigma_s": 5.0, "sigma_a": 0.0}, model="lambert")
    image = np.array(mi.render(mi.load_dict(white), spp=256))[24:40, 24:40, :3]
    expected = Medium(5.0, 0.0, eta=1.3).reflectance() + float(F_r(0.98, 1.3))  # of the middle of the ball
    assert image.mean() == pytest.approx(expected, abs=0.01)


def test_the_command_measures_a_scene_and_writes_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cli, "drawers", lambda: None)  # neither figure nor page
    file = tmp_path / "ball.xml"
    file.write_text(XML, encoding="utf-8")
    arguments = ["--model", "lambert", "--tolerance", "0.4", "--assess", "0.3", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(cli.app, ["trade", str(file), *arguments])
    assert result.exit_code == 0, result.stderr
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["ball_trade.csv", "ball_trade.json"]
    assert "is the cheapest that keeps 0.4" in result.stdout


def test_objects_without_weights_are_learnt_before_and_refusals_are_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    from full_geometry.trade import assessing

    class Learnt:
        asked: list[tuple[str, float]] = []

        def cost(self, scene: Any, object: str) -> float:
            if object != "ball0":
                raise ValueError("no weights")
            return 3.0

        def train(self, scene: Any, *, object: str, seconds: float, **how: Any) -> None:
            self.asked.append((object, seconds))
            if object == "ball2":
                raise ValueError("ball2 must be closed")

    monkeypatch.setattr(assessing, "learner", Learnt)
    with pytest.warns(UserWarning, match="'ball2' is not learnt: ball2 must be closed"):
        assessing.learn(stage(scene(n=3)), 7.0)
    assert Learnt.asked == [("ball1", 7.0), ("ball2", 7.0)]


def test_a_medium_without_a_scene_gets_a_model_of_the_half_space() -> None:
    medium = Medium.from_albedo(0.75, 0.241, 0.0, 1.3)
    found = recommend_flat(medium, r=(1.0, 40.0), tolerance=0.2, events=2e5, models=["better_dipole", "neural"])
    assert found.model == "neural"
    assert [option.model for option in found.options] == ["neural", "path_traced", "better_dipole"]
    assert found.options[-1].why.endswith("the tolerance is 20 %")
    neural, traced, _ = found.options
    for option in (neural, traced):
        assert f"{option.seconds_per_million:.3g} s for a million values" in option.why
    record = json.loads(json.dumps(found.record()))
    assert [option["model"] for option in record["options"]] == list(found.table()["model"])


def test_the_command_writes_what_it_says_of_a_material(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        advice.recommend_flat, "__kwdefaults__", {**advice.recommend_flat.__kwdefaults__, "events": 2e5}
    )
    arguments = ["--model", "better_dipole", "--tolerance", "0.6", "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(cli.app, ["trade", "fig10", *arguments])
    assert result.exit_code == 0, result.stderr
    written = json.loads((tmp_path / "out" / "fig10_trade.json").read_text())
    assert written["model"] == "better_dipole" and written["provenance"]["parameters"]["tolerance"] == 0.6
    assert (tmp_path / "out" / "fig10_trade.csv").read_text().startswith("model,error,bound,seconds_per_million,why")
    assert "fig10_trade.csv" in result.stdout
    blocked = CliRunner().invoke(cli.app, ["trade", "fig10", "--out", str(tmp_path / "out" / "fig10_trade.csv")])
    assert blocked.exit_code == 2 and "is a file" in blocked.stderr


@pytest.mark.parametrize(
    ("medium", "r", "message"),
    [((1.0, 0.2), (2.0, 1.0), "r must ascend"), ((0.0, 1.0), None, "medium must scatter, got albedo 0")],
)
def test_a_medium_or_a_range_without_light_is_refused(medium: tuple, r: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        recommend_flat(Medium(*medium), r)


def test_without_an_argument_the_shipped_table_is_shown() -> None:
    result = CliRunner().invoke(cli.app, ["trade"])
    assert result.exit_code == 0, result.stderr
    assert all(word in result.stdout for word in ("marble", "exact", "< ", "corrected")) and " 0 ±" not in result.stdout


def test_the_figure_and_the_page_are_drawn() -> None:
    pytest.importorskip("matplotlib")
    from benchmarks.trade_tables import multiples
    from figures.drawing.trade_plot import render
    from full_geometry.trade.images import TradePicture
    from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade

    numbers = {"ratio": (1.0,), "ratio_error": (0.0,), "variance": 1.0, "variance_error": 0.1, "samples": 9}
    ways = [TechniqueTrade("path_traced", 0.0, 0.0, seconds=1e-5, **numbers)]
    ways += [TechniqueTrade(name, 0.01, 0.001, seconds=1e-6, **numbers) for name in ("neural", "lambert")]
    ball = ObjectTrade("ball", (3.0, 4.0), 0.5, 100.0, (1.0,), tuple(ways))
    images = {way.way: np.full((8, 8, 3), 0.5, np.float32) for way in ways}
    files = render(TradePicture("ball", Assessment((ball,), 1.0, 0.0, 0), 0.05, ("neural",), images))
    assert set(files) == {"pdf", "png", "html"} and b"Neural" in files["html"]
    assert len(multiples({("marble", "ball", "sky"): ball}, 0.05).axes) == 1
