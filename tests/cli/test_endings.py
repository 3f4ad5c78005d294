"""How every command ends on bad input, interrupts, a full disk, a read-only folder: the table in docs/endings.md."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from command_list import COMMANDS
from render_files import XML

pytestmark = pytest.mark.slow

SMALL = {  # a small run of each command, and what it refuses
    "curves": (["--paths", "4096", "--theta-i", "0", "--model", "better_dipole", "--out", "o"], ["marbel"]),
    "errors materials": (["marble", "--model", "better_dipole", "--events", "1e4", "--out", "o"], ["marbel"]),
    "errors object": (["--scene", "ball.xml", "--model", "better_dipole", "--out", "o"], ["--scene", "none.xml"]),
    "figures all": (["fig10", "--out", "o"], ["nope"]),
    "figures compute": (["fig10", "--out", "o"], ["nope"]),
    "figures draw": (["fig10", "--out", "o"], ["nope"]),
    "figures list": (["fig10", "--out", "o"], ["nope"]),
    "fit": (["ball.xml", "--images", "views.json", "--out", "o"], ["none.xml", "--images", "views.json"]),
    "maps": (["--grid", "2,16,6,4", "--paths", "2048", "--out", "o"], ["marbel"]),
    "materials import": (["skin.mtlx", "--out", "o/skin.toml"], ["none.mtlx"]),
    "materials list": ([], ["extra"]),
    "materials show": (["marble"], ["marbel"]),
    "models": ([], ["extra"]),
    "render": (["ball.xml", "--spp", "4", "--out", "o"], ["none.xml"]),
    "trade": (["ball.xml", "--model", "better_dipole", "--assess", "0.05", "--out", "o"], ["marbel"]),
    "train material": (["--fast", "--steps", "20", "--out", "o", "--work", "o/work"], ["marbel"]),
    "train object": (["--scene", "ball.xml", "--out", "o"], ["--scene", "none.xml"]),
    "view": (["ball.xml", "--port", "0"], ["none.xml"]),
}
HARNESS = """
import atexit, dataclasses, gc, json, os, signal, subprocess, sys
from pathlib import Path
# once for all runs: each is a fork
import matplotlib.backends.backend_pdf, matplotlib.pyplot, pandas, scipy.interpolate, scipy.stats
import torch._dynamo, xarray, zarr
import quick_kernels
from halfspace_sss.cli import shared
from halfspace_sss.comparison import model_errors, reflectance_curves, style
from figures import fig10
from figures.parts import command
from figures import app as cli
from figures.command_line import main
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.neural.training.train_material import FAST
training = sys.modules["halfspace_sss.neural.training.train_material"]  # a function of the package has its name
fig10.WALKS["draft"] = 2**14
training.FAST = dataclasses.replace(FAST, n_groups=16, events=1e5, grid=CellGrid(8, 4))
command.MOST_WORKERS = 1  # the process that is interrupted writes the files, and no other has written some by then
quick_kernels.compile_quickly()
reflectance_curves.evaluations_per_s.__defaults__ = (4096, 0.01)
reflectance_curves.REFLECTANCE_POINTS = 2**8
model_errors.GRID, model_errors.LAST_N_PSI = CellGrid(16, 8), model_errors.FIRST_N_PSI
style.saved.__defaults__ = (60,)
gc.freeze()

for folder, mount, moment, arguments in json.loads(sys.argv[1]):
    os.chdir(folder)
    if mount:
        os.mkdir("o")
        subprocess.run(["mount", "-t", "tmpfs", "-o", mount, "none", "o"], check=True)
    child = os.fork()
    if child == 0:
        break
    status = os.waitpid(child, 0)[1]
    files = [str(path.relative_to("o")) for path in Path("o").rglob("*") if path.is_file()]
    Path("ended.json").write_text(json.dumps([os.waitstatus_to_exitcode(status), Path("err").read_text(), files]))
    if mount:
        subprocess.run(["umount", "-l", "o"], check=True)
else:
    sys.exit()

for k, name in ((1, "out"), (2, "err")):
    os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), k)
sys.argv[1:] = arguments
def before(function):
    def changed(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return function(*arguments, **options)
    return changed
if moment == "start":
    cli.app = before(cli.app)
elif moment == "progress":
    shared.Bar.show = before(shared.Bar.show)
elif moment == "file":
    os.fsync, os.replace = before(os.fsync), before(os.replace)
try:
    main()
except SystemExit as end:  # as the interpreter ends, but for its modules, which take half a second
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(end.code or 0)
"""
COLUMNS = {
    "bad input": ("none", "work", "2"),
    "interrupt at the start": ("start", "work", "130"),
    "interrupt at the first progress": ("progress", "work", "130"),
    "interrupt at the first file": ("file", "work", "130"),
    "full disk": ("none", "full", "1"),
    "read-only folder": ("none", "locked", "2"),
}
MOUNTS = {"full": "size=4k", "locked": "ro"}
NO_FILES = ("materials import", "materials list", "materials show", "models", "figures draw", "figures list")
LONG = (
    "errors object",
    "figures all",
    "fit",
    "train object",
    "view",
)  # minutes, or without an end


def _run(command: str, column: str, folder: Path) -> tuple[str, str | None, str, list[str]]:
    """Folder, mount, moment of the interrupt and arguments of a run."""
    moment, place, _ = COLUMNS[column]
    small, wrong = SMALL[command]
    (folder / "ball.xml").write_text(XML)
    arguments = [*command.split(), *(wrong if column == "bad input" else small)]
    return str(folder), MOUNTS.get(place), moment, arguments


def _kinds(files: set[str]) -> str:
    """The files in the folder of the results, a store as one."""
    names = {re.sub(r"\.zarr/.*", ".zarr/", name) for name in files}
    return ", ".join(sorted(names)) or "none"


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], tuple[str, str, set[str]]]:
    if shutil.which("unshare") is None or subprocess.run(["unshare", "-rm", "true"]).returncode:
        pytest.skip("a full disk and a read-only folder need a mount namespace")
    runs = {
        (command, column): _run(command, column, tmp_path_factory.mktemp("run"))
        for command in SMALL
        for column in COLUMNS
        if command not in (*NO_FILES, *LONG) or column in ("bad input", "interrupt at the start")
    }
    command = ["unshare", "-rm", sys.executable, "-c", HARNESS, json.dumps(list(runs.values()))]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    subprocess.run(command, check=True, timeout=1800, env=env)
    ended = {key: json.loads((Path(run[0]) / "ended.json").read_text()) for key, run in runs.items()}
    return {key: (str(code), messages, set(files)) for key, (code, messages, files) in ended.items()}


def test_every_command_is_in_the_table() -> None:
    assert set(COMMANDS) == set(SMALL)


def test_exit_codes_are_those_that_are_promised(table: dict) -> None:
    assert {key: code for key, (code, _, _) in table.items()} == {key: COLUMNS[key[1]][2] for key in table}


def test_no_command_ends_with_a_traceback_or_in_silence(table: dict) -> None:
    for key, (_, messages, _) in table.items():
        assert "Traceback" not in messages and messages.strip(), (key, messages)


def test_bad_input_and_a_read_only_folder_leave_no_file(table: dict) -> None:
    left = {key: files for key, (_, _, files) in table.items() if COLUMNS[key[1]][2] == "2" and files}
    assert not left


def test_no_temporary_file_is_left(table: dict) -> None:
    hidden = {key: [n for n in files if re.search(r"(^|/)\.(?!z)", n)] for key, (_, _, files) in table.items()}
    assert not {key: names for key, names in hidden.items() if names}


def test_the_table_of_the_documentation_is_what_happens(table: dict) -> None:
    lines = ["| command | " + " | ".join(COLUMNS) + " |", "|---" * (len(COLUMNS) + 1) + "|"]
    for command in SMALL:
        cells = (table.get((command, column)) for column in COLUMNS)
        lines.append(f"| `{command}` | " + " | ".join(f"{c[0]}: {_kinds(c[2])}" if c else "–" for c in cells) + " |")
    document = Path(__file__).parents[2] / "docs" / "endings.md"
    if "HALFSPACE_SSS_WRITE_DOCS" in os.environ:
        head = document.read_text().split("| command")[0]
        document.write_text(head + "\n".join(lines) + "\n")
    assert "\n".join(lines) in document.read_text()
