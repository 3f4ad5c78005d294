"""Long use of one process: memory stays flat, threads agree, many queries are answered block by block.

And many processes, of which some are killed all the time.

Minutes, so only where HALFSPACE_SSS_SOAK is set: 1 for all of it, a smaller number for that share.
"""

from __future__ import annotations

import contextlib
import gc
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest

import halfspace_sss
from halfspace_sss import Medium, executors
from halfspace_sss.executors import completed
from halfspace_sss.maps.map_store import load_maps

SHARE = float(os.environ.get("HALFSPACE_SSS_SOAK", "0"))
pytestmark = [pytest.mark.slow, pytest.mark.skipif(SHARE <= 0, reason="HALFSPACE_SSS_SOAK is not set")]

RENDERS, QUERIES, BLOCK, THREADS = 500, 10**8, 10**6, 64
MIB = 2**20


def _resident() -> float:
    """Memory of this process, MiB."""
    gc.collect()
    return psutil.Process().memory_info().rss / MIB


INTEGRATORS = {
    "bssrdf": {"type": "bssrdf", "max_depth": 4},
    "gathered": {"type": "bssrdf", "light": "gathered"},
    "walk": {"type": "translucent_walk"},
}


def _scene(rng: np.random.Generator, integrator: str) -> dict:
    """A ball of another size, medium and model over a floor, under a sky."""
    import mitsuba as mi

    albedo, sigma_t = rng.uniform(0.3, 0.99, 3), rng.uniform(0.5, 4, 3)
    at = mi.ScalarTransform4f().look_at([0, 20, 20], [0, 0, 0], [0, 0, 1])
    film = {"type": "hdrfilm", "width": 16, "height": 16}
    return {
        "type": "scene", "integrator": INTEGRATORS[integrator], "sky": {"type": "constant"},
        "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -4]).scale(9.0)},
        "ball": {"type": "sphere", "radius": rng.uniform(2, 4), "bsdf": {
            "type": "translucent", "albedo": ", ".join(map(str, albedo)), "sigma_t": ", ".join(map(str, sigma_t)),
            "model": str(rng.choice(["better_dipole", "directional_dipole", "neural"]))}},
        "camera": {"type": "perspective", "fov": 25.0, "to_world": at, "film": film},
    }  # fmt: skip


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_renders_of_changing_scenes_leave_no_memory_behind(integrator: str) -> None:
    """The mean of the last quarter against that of the second; what a process caches at first is not counted."""
    import full_geometry

    mi = pytest.importorskip("mitsuba")
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    rng, used = np.random.default_rng(1), []
    n = max(40, int(SHARE * RENDERS))
    for k in range(n):
        scene = mi.load_dict(_scene(rng, integrator), parallel=False)
        image = np.array(mi.render(scene, spp=4, seed=k))
        assert np.isfinite(image).all() and image.mean() > 0
        del scene
        used.append(_resident())
    quarter = n // 4
    second, last = np.mean(used[quarter : 2 * quarter]), np.mean(used[-quarter:])
    print(f"{n} renders: {used[0]:.0f} MiB after the first, {second:.0f} in the second quarter, {last:.0f} in the last")
    assert last - second < 0.05 * second


def test_threads_that_ask_at_once_get_the_answers_of_one_alone() -> None:
    medium = Medium(1.0, 0.1, 0.3, 1.3)
    rng = np.random.default_rng(2)
    query = [10 ** rng.uniform(-2, 1, 5000), *rng.random((4, 5000))]
    names = [name for name in halfspace_sss.models() if name not in ("neural_material", "neural_paper")]
    alone = {name: halfspace_sss.bssrdf(name, medium).eval(*query) for name in names}

    def ask(k: int) -> bool:
        name = names[k % len(names)]
        return np.array_equal(halfspace_sss.bssrdf(name, medium).eval(*query), alone[name])

    with ThreadPoolExecutor(THREADS) as threads:
        assert all(threads.map(ask, range(max(THREADS, int(SHARE * 10 * THREADS)))))


def test_many_queries_are_answered_block_by_block_in_flat_memory() -> None:
    """1e8 queries: the mean of S over them agrees with that of the first block, within five standard errors."""
    model = halfspace_sss.bssrdf("better_dipole", Medium(1.0, 0.1, 0.3, 1.3))
    rng, means, used = np.random.default_rng(3), [], []
    for _ in range(max(8, int(SHARE * QUERIES / BLOCK))):
        r, mu_i, mu_o = rng.uniform(0.1, 3, BLOCK), rng.random(BLOCK), rng.random(BLOCK)
        S = model.eval(r, mu_i, 0.0, mu_o, 0.0)
        assert S.shape == (BLOCK,) and np.isfinite(S).all() and (S >= 0).all()
        means.append((S.mean(), S.std() / np.sqrt(BLOCK)))
        used.append(_resident())
    values, errors = np.array(means).T
    assert np.all(np.abs(values - values.mean()) < 5 * errors)
    print(f"{len(used) * BLOCK:.0e} queries: {used[1]:.0f} MiB after the second block, {max(used):.0f} at most")
    assert max(used) < 1.1 * used[1]


MAPS = [
    sys.executable,
    "-m",
    "figures.command_line",
    "maps",
    "--albedo",
    "0.95",
    "--grid",
    "64,16,6,4",
    "--paths",
    "3e6",
]
KILLS, EVERY = 12, 5.0  # seconds


@contextlib.contextmanager
def _dask(folder: Path, n_workers: int = 2) -> Iterator[tuple[subprocess.Popen, subprocess.Popen, Path]]:
    """A scheduler and workers of one thread that are started again when they end."""
    file = folder / f"scheduler{time.monotonic_ns()}.json"
    options = ["--scheduler-file", str(file)]
    # a part meets several kills before it is done
    environment = os.environ | {"DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "100"}
    common = {"env": environment, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    dask = [sys.executable, "-m", "dask"]
    quiet = ["--no-dashboard", "--port", "0"]
    scheduler = subprocess.Popen([*dask, "scheduler", *options, *quiet], **common)
    workers = subprocess.Popen([*dask, "worker", *options, "--nthreads", "1", "--nworkers", str(n_workers)], **common)
    try:
        yield scheduler, workers, file
    finally:
        for process in (scheduler, workers):
            if process.poll() is None:
                for child in psutil.Process(process.pid).children(recursive=True):
                    with contextlib.suppress(psutil.NoSuchProcess):
                        child.kill()
                process.kill()
            process.wait()


def _kill_a_worker(nannies: subprocess.Popen, k: int) -> None:
    """One of the processes that compute."""
    children = psutil.Process(nannies.pid).children(recursive=True)
    found = [c for c in children if any("spawn_main" in word for word in c.cmdline())]
    if found:
        found[k % len(found)].kill()


@pytest.mark.skipif(SHARE < 1, reason="HALFSPACE_SSS_SOAK is below 1")
def test_a_minute_of_killed_workers_and_a_killed_scheduler_leave_the_bits_of_a_quiet_run(tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    out = ["--out", str(tmp_path / "there")]
    subprocess.run([*MAPS, "--out", str(tmp_path / "here")], check=True, capture_output=True)
    with _dask(tmp_path) as (scheduler, workers, file):
        run = subprocess.Popen([*MAPS, "--scheduler", str(file), *out], stderr=subprocess.PIPE, text=True)
        for k in range(KILLS):
            time.sleep(EVERY)
            _kill_a_worker(workers, k)
        assert run.poll() is None, run.communicate()  # else nothing was left to be killed
        scheduler.kill()
        _, said = run.communicate(timeout=120)
        assert run.returncode == 1 and "ended" in said
    with pytest.raises(ValueError, match="unfinished"):
        load_maps(tmp_path / "there" / "medium.zarr")
    with _dask(tmp_path) as (_, _, file):
        subprocess.run([*MAPS, "--scheduler", str(file), *out], check=True, capture_output=True, timeout=600)
    here, there = (load_maps(tmp_path / name / "medium.zarr").drop_vars("seconds") for name in ("here", "there"))
    assert here.equals(there)


MEDIA = [
    "marble", "ketchup", "apple", "potato", "chicken1", "chicken2", "cream", "espresso", "gatorade", "clorox", "pepsi",
    "lowfat milk",
]  # fmt: skip


def test_maps_of_twelve_media_by_two_workers_are_those_of_one_in_little_more_than_half_the_time(tmp_path: Path) -> None:
    """Needs two free cores: 1.8 times as fast was asked for."""
    pytest.importorskip("distributed")
    command = [sys.executable, "-m", "figures.command_line", "maps", *MEDIA, "--grid", "4,16,6,4"]
    seconds = {}
    for n_workers in (1, 2):
        with _dask(tmp_path, n_workers) as (_, _, file):
            begin = time.perf_counter()
            out = ["--paths", str(int(1e5 * SHARE)), "--scheduler", str(file), "--out", str(tmp_path / str(n_workers))]
            subprocess.run([*command, *out], check=True, capture_output=True)
            seconds[n_workers] = time.perf_counter() - begin
    print(f"one worker {seconds[1]:.0f} s, two workers {seconds[2]:.0f} s: {seconds[1] / seconds[2]:.2f} times")
    stores = sorted((tmp_path / "1").glob("*.zarr"))
    assert len(stores) == len(MEDIA)
    for store in stores:
        one, two = (load_maps(path).drop_vars("seconds") for path in (store, tmp_path / "2" / store.name))
        assert one.equals(two)
    assert seconds[1] > 1.6 * seconds[2]


def nothing(k: int) -> int:
    return k


def test_ten_thousand_parts_cost_little_time_and_no_memory() -> None:
    n, used = max(1000, int(SHARE * 10_000)), []
    with executors.workers(2) as executor:
        next(completed(executor, nothing, {"first": (0,)}))
        begin = time.perf_counter()
        for k, _ in enumerate(completed(executor, nothing, {str(k): (k,) for k in range(n)})):
            if k % (n // 10) == 0:
                used.append(_resident())
        seconds = time.perf_counter() - begin
    print(f"{n} parts: {seconds:.1f} s, {used[0]:.0f} MiB after the first, {max(used):.0f} at most")
    assert seconds < 6e-3 * n
    assert max(used) < used[0] + 10
