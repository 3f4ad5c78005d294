"""Parts on workers: the same bits as in one process, errors with the name of the part, and no process left behind."""

from __future__ import annotations

import errno
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

import halfspace_sss
from halfspace_sss import Medium, executors, make_maps
from halfspace_sss.backend import BackendError, cores
from halfspace_sss.executors import completed
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_store import load_maps

MEDIA = {"even": Medium.from_albedo(0.75, 1.0, 0.0, 1.3), "forward": Medium.from_albedo(0.99, 1.0, 0.8, 1.5)}
HOW = {"grid": MapGrid(2, 16, 6, 4), "target_error": None, "n_paths": 2048}


def odd(k: int) -> int:
    if k % 2 == 0:
        raise ValueError(f"k must be odd, got {k}")
    return k * k


def place(_: int) -> tuple[int, int]:
    """Process and threads of Dr.Jit."""
    import drjit as dr

    return os.getpid(), dr.thread_count()


def full(path: str) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


@pytest.mark.parametrize("executor", [None, ThreadPoolExecutor(2)], ids=["here", "threads"])
def test_a_part_gives_its_result_or_its_error_under_its_name(executor: Executor | None) -> None:
    assert dict(completed(executor, odd, {"three": (3,), "five": (5,)})) == {"three": 9, "five": 25}
    with pytest.raises(ValueError, match="part four: k must be odd, got 4"):
        list(completed(executor, odd, {"part four": (4,)}))


def test_without_an_executor_a_part_runs_when_it_is_asked_for() -> None:
    threads = []
    parts = completed(None, lambda k: threads.append((k, threading.get_ident())), {"a": (1,), "b": (2,)})
    assert not threads
    next(parts)
    assert threads == [(1, threading.get_ident())]


def test_parts_wait_for_those_that_they_need() -> None:
    needs = {"image": ["weights", "mesh"], "weights": ["mesh", "kept"]}
    parts = {name: (k,) for name, k in {"image": 5, "mesh": 1, "weights": 3, "other": 7}.items()}
    for executor in (None, ThreadPoolExecutor(2)):
        order = [name for name, _ in completed(executor, odd, parts, needs, most=2)]
        assert sorted(order) == sorted(parts) and order.index("mesh") < order.index("weights") < order.index("image")
    assert [name for name, _ in completed(None, odd, parts, needs)] == ["mesh", "weights", "image", "other"]
    with pytest.raises(ValueError, match="circle, got a, b"):
        list(completed(None, odd, {"a": (1,), "b": (3,)}, {"a": ["b"], "b": ["a"]}))


def test_a_forked_process_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executors, "_PROCESS", -1)
    with ThreadPoolExecutor(1) as executor, pytest.raises(ValueError, match="part: executor must start .* by spawn"):
        list(completed(executor, odd, {"part": (1,)}))


def test_what_is_no_number_of_workers_and_no_scheduler_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValueError, match="workers must be a whole number >= 1, got 0"), executors.workers(0):
        pass
    with pytest.raises(ValueError, match=r"workers must be a number in \[1, 1024\], got 2281362504"):
        executors.workers(2281362504).__enter__()
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(BackendError, match=r"pip install \"halfspace-sss\[cluster\]\""), executors.scheduler("x"):
        pass


@contextmanager
def dask(threads: int) -> Iterator[str]:
    """Address of a scheduler with one worker."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=threads, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


@pytest.mark.slow
def test_two_processes_share_the_cores_and_give_the_bits_of_one(tmp_path: Path) -> None:
    here = make_maps(MEDIA, tmp_path / "here", **HOW)
    with executors.workers(2) as executor:
        there = make_maps(MEDIA, tmp_path / "there", executor=executor, **HOW)
        ((process, threads),) = dict(completed(executor, place, {"place": (0,)})).values()
        assert process != os.getpid() and threads == max(cores() // 2, 1)
        with pytest.raises(OSError, match="No space left on device: 'where/part'"):  # as on one worker's disk
            list(completed(executor, full, {"part": ("where/part",)}))
    for name in MEDIA:
        assert load_maps(there[name]).S.equals(load_maps(here[name]).S)


@pytest.mark.slow
def test_workers_of_dask_are_refused_with_more_threads_or_another_version(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    with executors.scheduler("local", said.append):
        pass
    assert re.fullmatch(r"dashboard of Dask: http://127\.0\.0\.1:\d+/status", *said)
    with dask(threads=2) as address:
        with pytest.raises(ValueError, match="must run one part at a time .* got 2 threads"):
            with executors.scheduler(address):
                pass
        monkeypatch.setattr(halfspace_sss, "__version__", "0.0.1")  # of this process, not of its workers
        with pytest.raises(ValueError, match="worker .* must have halfspace-sss 0.0.1, got"):
            with executors.scheduler(address):
                pass


@pytest.mark.slow
@pytest.mark.parametrize("said", [None, "3"])
def test_a_worker_of_dask_has_the_threads_that_the_environment_says_and_one_otherwise(
    said: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if said:
        monkeypatch.setenv("OMP_NUM_THREADS", said)
    with dask(threads=1) as address, executors.scheduler(address) as executor:
        ((_, threads),) = dict(completed(executor, place, {"place": (0,)})).values()
    assert threads == int(said or 1)


@pytest.mark.slow
def test_a_cluster_that_takes_a_worker_away_and_brings_others_gives_the_bits_of_one_process(tmp_path: Path) -> None:
    distributed, taken = pytest.importorskip("distributed"), []
    here = make_maps(MEDIA, tmp_path / "here", **HOW)
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:

        def take(done: int, *_: object) -> None:
            if done and not taken:
                taken.append(True)
                cluster.scale(1)
                while len(cluster.scheduler_info["workers"]) > 1:
                    time.sleep(0.1)
                cluster.scale(3)

        with executors.scheduler(cluster.scheduler_address) as executor:
            there = make_maps(MEDIA, tmp_path / "there", executor=executor, progress=take, **HOW)
    assert taken
    for name in MEDIA:
        assert load_maps(there[name]).S.equals(load_maps(here[name]).S)


def _is_worker(process: psutil.Process) -> bool:
    """Whether Dask spawned this process; a child that ended meanwhile, such as `uname`, has no command line."""
    try:
        return any("spawn_main" in word for word in process.cmdline())
    except psutil.NoSuchProcess:  # zombies are among them
        return False


@pytest.mark.slow
def test_a_killed_worker_ends_the_command_and_the_next_one_goes_on(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "figures.command_line",
        "maps",
        "--albedo",
        "0.9",
        "--grid",
        "4,16,6,4",
        "--paths",
        "3e5",
    ]
    run = [*command, "--workers", "2", "--out", str(tmp_path)]
    process = subprocess.Popen(run, stderr=subprocess.PIPE, text=True)
    workers: list[psutil.Process] = []
    for _ in range(600):
        workers = [child for child in psutil.Process(process.pid).children() if _is_worker(child)]
        if len(workers) == 2:
            break
        time.sleep(0.1)
    workers[0].kill()
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 1 and "a worker or the scheduler ended" in messages
    assert not psutil.wait_procs(workers, timeout=10)[1]
    assert subprocess.run([*command, "--out", str(tmp_path)], capture_output=True).returncode == 0
    assert (load_maps(tmp_path / "medium.zarr")["n_paths"] >= 300_000).all()
