"""Of two runs that write the same result at once the second is refused by name; one that was killed hinders none."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from render_files import XML
from typer.testing import CliRunner

from figures import app as cli
from halfspace_sss import Medium
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_store import load_maps, make_maps
from halfspace_sss.provenance import one_writer

HOLD = """
import sys
from pathlib import Path
from halfspace_sss.provenance import one_writer

with one_writer(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""
GRID, MEDIUM = MapGrid(2, 16, 8, 4), Medium.from_albedo(0.5, 1.0)


@contextmanager
def _held(path: Path) -> Iterator[subprocess.Popen]:
    command = [sys.executable, "-c", HOLD, str(path)]
    run = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert run.stdout.readline() == "held\n"
        yield run
    finally:
        run.communicate("")


def _maps(folder: Path) -> Path:
    return make_maps({"a": MEDIUM}, folder, grid=GRID, target_error=None, n_paths=1024)["a"]


def test_the_second_writer_is_told_who_the_first_is(tmp_path: Path) -> None:
    path = tmp_path / "new" / "image.exr"
    with _held(path) as other:
        owner = f"process {other.pid} on {platform.node()}"
        with pytest.raises(ValueError, match=f"must be written by one run at a time, got one beside {owner}"):
            with one_writer(path):
                pass
    with one_writer(path):
        assert f"process {os.getpid()} on" in path.with_name(".image.exr.lock").read_text()
    assert not path.parent.exists()  # nothing was written to it


@pytest.mark.skipif(os.name == "nt", reason="signals")
def test_a_killed_run_leaves_no_lock(tmp_path: Path) -> None:
    with _held(tmp_path / "x") as other:
        other.kill()
        other.wait()
        assert (tmp_path / ".x.lock").exists()
        with one_writer(tmp_path / "x"):
            pass
    assert not list(tmp_path.iterdir())


def test_a_thread_may_lock_again_what_it_holds_and_another_thread_may_not(tmp_path: Path) -> None:
    found: list[ValueError] = []

    def other() -> None:
        try:
            with one_writer(tmp_path / "x"):
                pass
        except ValueError as error:
            found.append(error)

    with one_writer(tmp_path / "x"), one_writer(tmp_path / "x"):
        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
    assert len(found) == 1


def test_one_lock_of_many_that_come_at_once_is_given(tmp_path: Path) -> None:
    inside, most, refused = [0], [0], [0]

    def come() -> None:
        for _ in range(50):
            try:
                with one_writer(tmp_path / "x"):
                    inside[0] += 1
                    most[0] = max(most[0], inside[0])
                    inside[0] -= 1
            except ValueError:
                refused[0] += 1

    threads = [threading.Thread(target=come) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[0] == 1 and refused[0] < 400
    assert not list(tmp_path.iterdir())


def test_a_render_beside_another_of_the_same_name_is_refused_and_changes_nothing(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    (tmp_path / "ball.xml").write_text(XML)
    out = tmp_path / "out"
    with _held(out / "ball_scene.exr"):
        before = sorted(out.iterdir())
        result = CliRunner().invoke(cli.app, ["render", str(tmp_path / "ball.xml"), "--spp", "1", "--out", str(out)])
        assert result.exit_code == 2 and "must be written by one run at a time" in result.stderr
        assert sorted(out.iterdir()) == before


def test_maps_beside_others_of_the_same_name_are_refused(tmp_path: Path) -> None:
    with _held(tmp_path / "a.zarr"), pytest.raises(ValueError, match="must be written by one run at a time"):
        _maps(tmp_path)
    load_maps(_maps(tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["a.zarr"]
