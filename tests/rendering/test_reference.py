"""Long renders: passes add up, killed ones resume to the same image, and other files are refused by name."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from full_geometry.scenes import reference

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")


def _scene(radius: float = 1.0) -> dict:
    film = {"type": "hdrfilm", "width": 6, "height": 4, "rfilter": {"type": "box"}, "component_format": "float32",
            "pixel_format": "rgb"}  # fmt: skip
    surface = {"type": "translucent", "sigma_s": "3,4,5", "sigma_a": "0.1,0.5,1", "eta": 1.4}
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "translucent_walk", "light": "sampled"},  # sums on cells have no fixed order
        "sensor": {"type": "perspective", "fov": 40.0, "to_world": view, "film": film},
        "light": {"type": "constant"},
        "object": {"type": "sphere", "radius": radius, "bsdf": surface},
    }


KILLED = """
import sys
import full_geometry
import mitsuba as mi
from full_geometry.scenes import reference
sys.path.insert(0, {folder!r})
mi.set_variant("llvm_ad_rgb")
full_geometry.register()
from test_reference import _scene
print("ready", flush=True)
reference.render(_scene(), {path!r}, spp_per_pass=4, passes=10**6, interval=0)
"""


def test_mean_and_variance_are_those_of_the_passes(tmp_path: Path) -> None:
    images = []
    found = reference.render(_scene(), tmp_path / "a.exr", spp_per_pass=4, passes=5)
    for k in range(5):
        seed = int(np.random.SeedSequence([0, k]).generate_state(1)[0])
        images.append(np.array(mi.render(mi.load_dict(_scene()), spp=4, seed=seed), dtype=float))
    np.testing.assert_allclose(found.mean, np.mean(images, axis=0), rtol=1e-6)
    np.testing.assert_allclose(found.variance, np.var(images, axis=0, ddof=1) / 5, rtol=1e-5, atol=1e-12)
    assert (found.passes, found.spp) == (5, 20)


def test_a_file_reads_back_as_it_was_and_tells_its_origin(tmp_path: Path) -> None:
    made = reference.render(_scene(), tmp_path / "a.exr", spp_per_pass=4, passes=3, seed=7)
    found = reference.load(tmp_path / "a.exr")
    assert np.array_equal(found.mean, made.mean) and np.array_equal(found.variance, made.variance)
    header = json.loads((tmp_path / "a.json").read_text())
    assert (header["passes"], header["seed"], header["spp"]) == (3, 7, 12)
    assert "TranslucentWalk" in header["integrator"] and "mitsuba" in header["provenance"]["versions"]
    rgb = np.array(mi.Bitmap(str(tmp_path / "a.exr")))[..., :3]
    np.testing.assert_allclose(rgb, made.mean, rtol=1e-6)


@pytest.mark.parametrize(("rfilter", "most"), [("box", 0.0), ("gaussian", 1e-5)])
def test_equal_seeds_differ_by_rounding_alone_under_filters_wider_than_a_box(
    rfilter: str, most: float, tmp_path: Path
) -> None:
    scene = _scene()
    scene["sensor"]["film"] |= {"rfilter": {"type": rfilter}, "width": 32, "height": 32}
    unbroken = reference.render(scene, tmp_path / "a.exr", spp=64)
    for spp in (24, 64):
        resumed = reference.render(scene, tmp_path / "b.exr", spp=spp)
    assert resumed.passes == unbroken.passes
    np.testing.assert_allclose(resumed.mean, unbroken.mean, rtol=most, atol=most * unbroken.mean.max())


def _by_chance(folder: Path, orders: str, light: dict) -> tuple[reference.Reference, np.ndarray]:
    """A render of one sample in each pass by a model, and its passes."""
    scene = {**_scene(), "light": light}
    scene["integrator"] = {"type": "bssrdf", "hide_emitters": True}
    scene["object"]["bsdf"] |= {"model": "better_dipole", "orders": orders, "reflection": False}
    scene = mi.load_dict(scene)
    reference.render(scene, folder / "a.exr", spp_per_pass=1, passes=4, resume=False)
    seeds = [int(np.random.SeedSequence([0, k]).generate_state(1)[0]) for k in range(4)]
    images = [np.array(mi.render(scene, spp=1, seed=seed), dtype=float) for seed in seeds]
    return reference.load(folder / "a.exr"), np.stack(images)


@pytest.mark.slow
def test_light_that_orders_below_two_meet_by_chance_is_told_as_a_share_of_the_variance(tmp_path: Path) -> None:
    sky = {"type": "constant"}
    lamp = {"type": "sphere", "center": [1, 3, 3], "radius": 0.2, "emitter": {"type": "area", "radiance": 100.0}}
    by_sky, images = _by_chance(tmp_path, "single", sky)
    whole = (images**2).sum()
    assert by_sky.about["squares_by_chance"] == pytest.approx(whole, rel=1e-4)
    assert by_sky.share_by_chance == min(whole / 4**2 / by_sky.variance.sum(), 1.0)
    by_lamp, images = _by_chance(tmp_path, "single", lamp)
    assert by_lamp.about["squares_by_chance"] < 0.1 * (images**2).sum()
    assert _by_chance(tmp_path, "multiple", sky)[0].share_by_chance == 0.0


def test_a_run_in_two_parts_gives_the_bits_of_a_run_in_one(tmp_path: Path) -> None:
    whole = reference.render(_scene(), tmp_path / "whole.exr", spp_per_pass=4, passes=9)
    reference.render(_scene(), tmp_path / "parts.exr", spp_per_pass=4, passes=4)
    parts = reference.render(_scene(), tmp_path / "parts.exr", spp_per_pass=4, passes=9)
    assert np.array_equal(whole.mean, parts.mean) and np.array_equal(whole.variance, parts.variance)


def test_more_samples_asked_for_later_give_the_bits_of_a_run_that_asked_at_once(tmp_path: Path) -> None:
    whole = reference.render(_scene(), tmp_path / "whole.exr", spp=64)
    for spp in (4, 16, 64):
        parts = reference.render(_scene(), tmp_path / "parts.exr", spp=spp)
        assert parts.spp == spp
    assert np.array_equal(whole.mean, parts.mean) and np.array_equal(whole.variance, parts.variance)


def test_passes_of_any_size_count_by_their_samples(tmp_path: Path) -> None:
    images, sizes = [], (5, 2, 2, 1)
    reference.render(_scene(), tmp_path / "a.exr", spp=5, spp_per_pass=5)
    reference.render(_scene(), tmp_path / "a.exr", spp=9, spp_per_pass=2)
    found = reference.render(_scene(), tmp_path / "a.exr", spp=10)
    for k, n in enumerate(sizes):
        seed = int(np.random.SeedSequence([0, k]).generate_state(1)[0])
        images.append(np.array(mi.render(mi.load_dict(_scene()), spp=n, seed=seed), dtype=float))
    weights = np.array(sizes)[:, None, None, None]
    mean = np.sum(weights * images, axis=0) / 10
    np.testing.assert_allclose(found.mean, mean, rtol=1e-6)
    spread = np.sum(weights * (np.array(images) - mean) ** 2, axis=0)
    np.testing.assert_allclose(found.variance, spread / (3 * 10), rtol=1e-5, atol=1e-12)
    assert (found.passes, found.spp) == (4, 10)


@pytest.mark.slow
def test_the_error_of_passes_that_grow_is_the_error(tmp_path: Path) -> None:
    """Over seeds and pixels, the squared distance from a long run is the variance that is told, to 15 %."""
    truth = reference.render(_scene(), tmp_path / "long.exr", spp=2048, seed=99).mean
    runs = [reference.render(_scene(), tmp_path / f"{seed}.exr", spp=32, seed=seed) for seed in range(24)]
    told = np.mean([run.variance.sum() for run in runs])
    assert abs(np.mean([((run.mean - truth) ** 2).sum() for run in runs]) / told - 1) < 0.15


def test_a_run_that_begins_anew_forgets_the_file_that_is_there(tmp_path: Path) -> None:
    reference.render(_scene(radius=1.1), tmp_path / "a.exr", spp=4)
    assert reference.render(_scene(), tmp_path / "a.exr", spp=2, resume=False).spp == 2
    assert reference.load(tmp_path / "a.exr").spp == 2


def test_a_run_that_goes_on_from_another_file_leaves_it_as_it_is(tmp_path: Path) -> None:
    first, second = tmp_path / "first.exr", tmp_path / "second.exr"
    reference.render(_scene(), first, spp=4)
    before = first.read_bytes()
    for spp in (4, 8):
        assert reference.render(_scene(), second, spp=spp, resume=first).spp == reference.load(second).spp == spp
    assert first.read_bytes() == before


def test_a_killed_run_leaves_a_whole_file_and_resumes(tmp_path: Path) -> None:
    path = tmp_path / "killed.exr"
    code = KILLED.format(folder=str(Path(__file__).parent), path=str(path))
    run = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    deadline = time.monotonic() + 60
    while not path.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    time.sleep(0.3)
    os.kill(run.pid, signal.SIGKILL)
    run.wait()
    run.stdout.close()
    passes = reference.load(path).passes
    resumed = reference.render(_scene(), path, spp_per_pass=4, passes=passes + 2)
    whole = reference.render(_scene(), tmp_path / "whole.exr", spp_per_pass=4, passes=passes + 2)
    assert resumed.passes == passes + 2
    assert np.array_equal(resumed.mean, whole.mean) and np.array_equal(resumed.variance, whole.variance)


def test_a_run_stops_at_the_target_error(tmp_path: Path) -> None:
    seen = []
    found = reference.render(_scene(), tmp_path / "a.exr", spp_per_pass=16, target_error=0.02, passes=500,
                             progress=lambda r: seen.append(r.relative_error))  # fmt: skip
    assert found.relative_error <= 0.02 and 8 <= found.passes < 500
    assert all(error > 0.02 for error in seen[7:-1])


def test_a_run_stops_after_its_time(tmp_path: Path) -> None:
    found = reference.render(_scene(), tmp_path / "a.exr", spp_per_pass=1, seconds=0.3)
    assert 0.3 <= found.seconds < 5


def test_an_interrupted_run_keeps_its_passes(tmp_path: Path) -> None:
    def stop(found: reference.Reference) -> None:
        if found.passes == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reference.render(_scene(), tmp_path / "a.exr", spp_per_pass=1, passes=9, progress=stop)
    assert reference.load(tmp_path / "a.exr").passes == 3


@pytest.mark.parametrize("kept", [0, 100, -30])
def test_a_cut_file_is_refused_by_name(tmp_path: Path, kept: int) -> None:
    path = tmp_path / "cut.exr"
    reference.render(_scene(), path, spp_per_pass=1, passes=2)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match="cut.exr must be an EXR file"):
        reference.render(_scene(), path, spp_per_pass=1, passes=3)


def test_a_file_of_another_render_is_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "other.exr"
    reference.render(_scene(), path, spp_per_pass=1, passes=2)
    with pytest.raises(ValueError, match=r"other.exr must be of the same render.*: scene is"):
        reference.render(_scene(radius=1.1), path, spp_per_pass=1, passes=3)
    with pytest.raises(ValueError, match="other.exr.*seed is 0 there and 1 here"):
        reference.render(_scene(), path, spp_per_pass=1, passes=3, seed=1)
    with pytest.raises(ValueError, match="other.exr.*: scene is"):
        reference.render(_scene(), path, integrator={"type": "path"}, spp_per_pass=1, passes=3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({}, "one of spp, passes"),
        ({"passes": 0}, "passes must be .* got 0"),
        ({"target_error": 0.0}, "target_error must be .* got 0.0"),
        ({"passes": 1, "spp_per_pass": 1.5}, "spp_per_pass must be .* got 1.5"),
    ],
)
def test_arguments_out_of_range_are_refused(tmp_path: Path, arguments: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        reference.render(_scene(), tmp_path / "a.exr", **arguments)
    assert not list(tmp_path.iterdir())
