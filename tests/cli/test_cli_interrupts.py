"""Ctrl-C where it is hard to hear: wrapped, swallowed, in an import, in a kernel."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from halfspace_sss.maps.map_store import load_maps

pytestmark = pytest.mark.skipif(os.name == "nt", reason="POSIX signals")

START = """
import sys, time
from halfspace_sss import materials
from figures.command_line import main
def table():
{body}
materials.table = table
sys.argv = ["halfspace-sss", "materials", "list"]
main()
"""


def _started(body: str, folder: Path) -> subprocess.Popen:
    """A command that runs the body, from the line that it is ready on."""
    code = START.format(body="".join(f"    {line}\n" for line in body.splitlines()))
    run = [sys.executable, "-c", code]
    process = subprocess.Popen(run, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "ready\n"
    return process


def _interrupted(body: str, folder: Path) -> tuple[int, str]:
    process = _started(body, folder)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=30)
    return process.returncode, messages


LINE = "interrupted; files that were being written are whole or absent\n"


def test_an_interrupt_that_a_library_wraps_ends_with_130_and_one_line(tmp_path: Path) -> None:
    body = """
print('ready', flush=True)
try:
    time.sleep(9)
except KeyboardInterrupt as error:
    raise RuntimeError("error in a callback") from error"""
    assert _interrupted(body, tmp_path) == (130, LINE)


def test_an_interrupt_that_a_library_swallows_is_raised_by_the_progress(tmp_path: Path) -> None:
    body = """
from halfspace_sss.cli.shared import Bar
print('ready', flush=True)
try:
    time.sleep(9)
except KeyboardInterrupt:
    pass
with Bar("work") as bar:
    bar.show(0, 1)
raise SystemExit("not heard")"""
    assert _interrupted(body, tmp_path) == (130, LINE)


def test_an_interrupt_in_a_destructor_is_not_lost(tmp_path: Path) -> None:
    body = """
from halfspace_sss.cli.shared import Bar
class Late:
    def __del__(self):
        print('ready', flush=True)
        time.sleep(9)
late = Late()
del late
with Bar("work") as bar:
    bar.show(0, 1)"""
    assert _interrupted(body, tmp_path) == (130, LINE)


def test_an_interrupt_in_an_import_waits_for_its_end(tmp_path: Path) -> None:
    lines = "import time", "print('ready', flush=True)", "time.sleep(1)", "print('whole', flush=True)"
    (tmp_path / "slow_module.py").write_text("\n".join(lines))
    process = _started("sys.path.insert(0, '')\nimport slow_module\ntime.sleep(9)", tmp_path)
    time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    output, messages = process.communicate(timeout=30)
    assert (process.returncode, output, messages) == (130, "whole\n", LINE)


def test_a_second_interrupt_does_not_disturb_what_the_first_one_puts_in_order(tmp_path: Path) -> None:
    body = """
print('ready', flush=True)
try:
    time.sleep(9)
finally:
    time.sleep(1)
    print('in order', flush=True)"""
    process = _started(body, tmp_path)
    for _ in range(3):
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
    output, messages = process.communicate(timeout=30)
    assert (process.returncode, output, messages) == (130, "in order\n", LINE)


def test_a_kernel_that_hears_nothing_is_told_of_and_ended_by_the_next_interrupt(tmp_path: Path) -> None:
    body = """
import ctypes
from halfspace_sss import interrupts as cli_interrupts
cli_interrupts.PATIENCE = 0.3
print('ready', flush=True)
mutex = ctypes.create_string_buffer(128)
for _ in range(2):
    ctypes.CDLL(None).pthread_mutex_lock(mutex)"""
    process = _started(body, tmp_path)
    time.sleep(0.2)
    started = time.monotonic()
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=30)
    assert process.returncode == 130 and time.monotonic() - started < 5
    assert messages == "interrupted; waits for a kernel that cannot be, the next one ends it\n"


@pytest.mark.slow
def test_long_walks_of_a_slow_medium_end_within_two_seconds(tmp_path: Path) -> None:
    body = """
import halfspace_sss as sss
medium = sss.Medium.from_albedo(0.999, 1.0, 0.9, 1.5)
sss.trace(medium, n_paths=256)
print('ready', flush=True)
sss.trace(medium, n_paths=10**8)"""
    process = _started(body, tmp_path)
    time.sleep(2.5)  # launches have found their size
    started = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 130 and time.monotonic() - started < 4  # on cores with other work too
    assert messages == LINE


@pytest.mark.slow
def test_maps_of_a_slow_medium_end_within_two_seconds_and_keep_what_is_finished(tmp_path: Path) -> None:
    body = """
import halfspace_sss as sss
from halfspace_sss.maps.grid import MapGrid
from halfspace_sss.maps.map_store import make_maps
media = {"quick": sss.Medium.from_albedo(0.1, 1.0, 0.0, 1.5), "slow": sss.Medium.from_albedo(0.9999, 1.0, 0.9, 1.5)}
def told(done, total, what):
    if done == 2:
        print('ready', flush=True)
make_maps(media, "maps", grid=MapGrid(2, 16, 6, 4), target_error=None, n_paths=2**21, progress=told)"""
    process = _started(body, tmp_path)
    time.sleep(2.5)  # into a kernel of long walks
    started = time.monotonic()
    process.send_signal(signal.SIGINT)
    _, messages = process.communicate(timeout=60)
    assert process.returncode == 130 and time.monotonic() - started < 4  # on cores with other work too
    assert messages == LINE
    assert (load_maps(tmp_path / "maps" / "quick.zarr")["n_paths"] >= 2**21).all()
    with pytest.raises(ValueError, match="unfinished"):
        load_maps(tmp_path / "maps" / "slow.zarr")


def test_a_signal_to_terminate_ends_in_order_too(tmp_path: Path) -> None:
    process = _started("print('ready', flush=True)\ntime.sleep(9)", tmp_path)
    time.sleep(0.2)
    process.terminate()
    _, messages = process.communicate(timeout=30)
    assert (process.returncode, messages) == (143, LINE)


SCRIPT = """import sys
from figures.command_line import main
sys.exit(main())
"""
SITE = """
import os, signal, sys
class Interrupting:
    def find_spec(self, name, *_):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
"""
FIRST = ("backend", "lazy", "cli", "interrupts", "cli.shared")


@pytest.mark.parametrize("module", [f"halfspace_sss.{name}" for name in FIRST] + ["typer"])
def test_an_interrupt_while_the_command_is_being_imported_ends_with_130_and_one_line(module, tmp_path) -> None:
    """Sent by what Python asks first for each of the modules."""
    (tmp_path / "halfspace-sss").write_text(SCRIPT)
    (tmp_path / "sitecustomize.py").write_text(SITE.format(module=module))
    path = os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])])
    run = [sys.executable, str(tmp_path / "halfspace-sss"), "materials", "list"]
    done = subprocess.run(run, capture_output=True, text=True, env={**os.environ, "PYTHONPATH": path})
    assert (done.returncode, done.stdout, done.stderr) == (130, "", LINE)


def test_the_library_alone_leaves_signals_as_they_are() -> None:
    code = "import signal, halfspace_sss.cli; print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "True\n"
