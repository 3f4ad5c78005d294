"""Every command of README.md and of docs/start.md runs for a new user: in the order of the page, in an empty home."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
LESS = {  # what a command is given beside, by its first words, as it would take minutes
    "curves": "--paths 20000 --theta-i 0",
    "render": "--spp 2",
    "render scene.xml --model path_traced --target-error": "--target-error 0.5",
    "fit": "--steps 2 --spp 2",
    "train object": "--seconds 1",
    "train material": "--channel R --steps 100",
    "trade": "--assess 0.1",
}
FIGURE = "halfspace-sss figures"
SMALLER = """
from figures import fig09

fig09.SHOWN, fig09.MODELS, fig09.SIZES = {"draft": ("ketchup",)}, ("better_dipole",), {"draft": 24}
"""
SCENE = """<scene version="3.0.0">
    <integrator type="bssrdf"/> <emitter type="constant"/>
    {shape}
    <sensor type="perspective">
        <transform name="to_world"> <lookat origin="0, 10, 120" target="0, 10, 0" up="0, 1, 0"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="16"/> <integer name="height" value="16"/> </film>
    </sensor>
</scene>
"""
RUN = """
import shlex
import sys

from figures.command_line import main

for line in sys.argv[1:]:
    sys.argv = shlex.split(line)
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise SystemExit(f"{line}: exit code {end.code}")
    print(f"ran: {line}", flush=True)
"""


def _blocks(page: str, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), flags=re.M | re.S)


def _commands(page: str) -> list[str]:
    lines = [line.split("#")[0] for text in _blocks(page, "bash") for line in text.splitlines()]
    return [part.strip() for line in lines for part in line.split("&&") if part.strip()]


def _shortened(line: str) -> str:
    words = line.removeprefix("halfspace-sss ")
    return " ".join([line, *(more for start, more in LESS.items() if words.startswith(start))])


def _run(lines: list[str], folder: Path, before: str = "") -> None:
    """Run commands after the statements `before`."""
    home = folder / "home"
    home.mkdir()
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("XDG_", "HALFSPACE_SSS", "MPL"))}
    run = subprocess.run(
        [sys.executable, "-c", before + RUN, *lines], cwd=folder, capture_output=True, text=True,
        env={**kept, "HOME": str(home), "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert [f"ran: {line}" for line in lines] == re.findall(r"^ran: .*$", run.stdout, flags=re.M)


def _readme_scene(folder: Path) -> None:
    """The scene that README.md speaks of, about the shape that it shows, and the views of it."""
    (shape,) = _blocks("README.md", "xml")
    (folder / "scene.xml").write_text(SCENE.format(shape=shape))
    shutil.copy(ROOT / "figures" / "assets" / "bunny.ply", folder / "bunny.ply")
    views = {"views": [{"image": "render/scene_path_traced.exr", "sensor": 0}]}
    (folder / "views.json").write_text(json.dumps(views))


def test_the_commands_of_the_first_five_minutes_run(tmp_path: Path) -> None:
    (scene,) = _blocks("docs/start.md", "xml")
    (tmp_path / "ball.xml").write_text(scene)
    install, *lines = _commands("docs/start.md")
    assert install.startswith("pip install ")
    _run([_shortened(line) for line in lines], tmp_path)


def test_the_commands_of_the_readme_run(tmp_path: Path) -> None:
    _readme_scene(tmp_path)
    lines = _commands("README.md")
    others = [line for line in lines if not line.startswith("halfspace-sss ")]
    assert all(line == "pytest" or line.startswith("pip install -c constraints.txt ") for line in others)
    _run([_shortened(line) for line in lines if line not in others and not line.startswith(FIGURE)], tmp_path)


def test_the_figure_of_the_readme_is_drawn(tmp_path: Path) -> None:
    """Of one material by walks and a model, with few pixels; `test_fig09.py` knows others."""
    lines = [line for line in _commands("README.md") if line.startswith(FIGURE)]
    assert lines
    _run(lines, tmp_path, SMALLER)
