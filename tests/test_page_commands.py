"""Every block of the pages for users runs: commands and Python, in the order of the page, in an empty home.

All pages share one process, and so its kernels. A line of `LESS` shortens what would take minutes, and a line of
`UNDERSTOOD` says what is only parsed, with the reason.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from materials.test_looks import glb, mtlx
from PIL import Image

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parent.parent
PAGES = ["README.md", *(f"docs/{name}.md" for name in (
    "start", "materials", "curves", "tracing", "rendering", "light", "learnt_models", "inverse", "trade", "train",
    "cluster", "plugins", "biomedical", "errors", "figures", "add_model",
))]  # fmt: skip
LESS = {  # what a command is given beside, by the longest of these that it starts with
    "curves": "--paths 20000 --theta-i 0 --model better_dipole --model neural",
    "curves marble": "--paths 20000 --theta-i 0",
    "curves --sigma-t": "--paths 20000 --theta-i 0",
    "render": "--spp 2",
    "render scene.xml --model path_traced --target-error": "--target-error 0.5",
    "render toy.xml": "--spp 2 -D size=32",
    "fit": "--steps 2 --spp 2",
    "train object": "--seconds 1",
    "train material": "--steps 20",
    "train material ketchup": "--channel R --fast --steps 20",
    "trade ball.xml": "--assess 0.1 --model better_dipole",
    "errors materials": "--events 1e5 --channel R --model better_dipole",
    "errors object": "--exits 16",
    "maps": "--grid 2,16,6,4 --paths 2048 --channel R",
    "maps --sigma-t": "--grid 2,16,6,4 --paths 2048",
    "maps marble ketchup --workers": "--grid 2,16,6,4 --paths 2048 --channel R --workers 1",
    "figures all fig09": "--quality draft",
    "figures compute": "--quality draft",
    "figures draw": "--quality draft",
}
UNDERSTOOD = {  # by their beginnings, why
    "train material fig10 --model neural_paper": "minutes for its maps",
    "fit object.xml": "photographs",
    "render scene.glb": "a file that Blender writes: tests/rendering/test_gltf.py renders one",
    "figures all --quality draft": "15 minutes",
    "figures all fig09 fig10 --scheduler": "a scheduler",
    "maps marble ketchup --scheduler": "a scheduler",
    "maps marble --scheduler": "a scheduler and a bucket",
}
HOME = ("XDG_", "HALFSPACE_SSS", "MPL")
SCENE = """<scene version="3.0.0">
    <integrator type="bssrdf"/> <emitter type="constant"/>
    {shape}
    <sensor type="perspective">
        <transform name="to_world"> <lookat origin="0, 10, 120" target="0, 10, 0" up="0, 1, 0"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="16"/> <integer name="height" value="16"/> </film>
    </sensor>
</scene>
"""
TEXTURE = """<texture name="albedo" type="bitmap"> <string name="filename" value="texels.pfm"/>
    <boolean name="raw" value="true"/> </texture>"""
RUN = """
import contextlib
import dataclasses
import functools
import io
import json
import os
import shlex
import sys
import time

import one_thread
import quick_kernels
import quick_light
from figures import fig09, fig10
from figures.command_line import main
from figures.parts import command as figure_command
from full_geometry.learning import model_errors as errors_of_objects
from full_geometry.learning import training
from full_geometry.transport import any_shape
from halfspace_sss.comparison import model_errors, reflectance_curves, style
from halfspace_sss.maps.noisy_maps import CellGrid
from halfspace_sss.neural.training.train_material import FAST
import halfspace_sss.neural.training.train_material

quick_kernels.compile_quickly()
one_thread.work_in_one_thread()
fig09.SHOWN, fig09.MODELS, fig09.SIZES = {"draft": ("ketchup",)}, ("better_dipole",), {"draft": 12}
fig09.MODEL_SPP["draft"], fig09.TRUTH_SPP["draft"] = 4, 16
reflectance_curves.evaluations_per_s.__defaults__ = (4096, 0.01)
reflectance_curves.REFLECTANCE_POINTS = 2**8
fig10.WALKS["draft"], fig10.accepting = 2**14, lambda medium: ["better_dipole", "neural"]
figure_command.MOST_WORKERS = 1  # others would import and compile for themselves
# walks of numbers that nobody reads
training.EXITS, training.WALKS, training.SAMPLES = 16, 256, 64
any_shape.WALKS = any_shape.PAIRS = 2**12, 2**12
few = dataclasses.replace(training.STANDARD, chunk=2**12)
training.TrainingPlan = functools.partial(training.TrainingPlan, recipe=few)
errors_of_objects.errors_of.__kwdefaults__.update(walks=256, samples=64)
quick_light.gather_by_few(setattr)
model_errors.GRID, model_errors.LAST_N_PSI = CellGrid(16, 8), model_errors.FIRST_N_PSI
style.saved.__defaults__ = (60,)
train_material = sys.modules["halfspace_sss.neural.training.train_material"]  # a function of the package has its name
train_material.FAST = train_material.STANDARD = dataclasses.replace(FAST, n_groups=16, events=1e5, grid=CellGrid(8, 4))
recipes = train_material.MaterialRecipe
recipes.__init__ = functools.partialmethod(recipes.__init__, grid=CellGrid(8, 4))


def command(line):
    sys.argv = shlex.split(line)
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise ValueError(f"exit code {end.code}") from None


def python(text):
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(text, "block", "exec"), {"__name__": "__main__"})
    if not printed.getvalue().strip():
        raise ValueError("nothing is printed")


for folder, kind, text in json.loads(sys.argv[1]):
    os.chdir(folder)
    start, error, told = time.process_time(), "", io.StringIO()
    try:
        with contextlib.redirect_stderr(told):
            {"bash": command, "python": python}[kind](text)
    except Exception as wrong:
        error = f"{wrong!r}: {told.getvalue()[-2000:]}"
    print("\\nRAN", json.dumps([folder, text, error, time.process_time() - start]), flush=True)
"""


def _blocks(page: str) -> list[tuple[str, str]]:
    return re.findall(r"^```(\w+)\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), flags=re.M | re.S)


def _commands(text: str) -> list[str]:
    parts = [part.strip() for line in text.splitlines() for part in line.split("#")[0].split("&&")]
    return [part for part in parts if part.startswith("halfspace-sss ") or part == "halfspace-sss"]


def _start(line: str, starts: dict[str, str]) -> str | None:
    words = line.removeprefix("halfspace-sss ")
    return max((start for start in starts if words.startswith(start)), key=len, default=None)


def _shortened(line: str) -> str:
    start = _start(line, LESS)
    return line if start is None else f"{line} {LESS[start]}"


def _items(page: str) -> list[tuple[str, str]]:
    """Kind and text of what runs, in the order of the page."""
    found = []
    for kind, text in _blocks(page):
        found += [("python", text)] if kind == "python" else []
        for line in _commands(text) if kind == "bash" else ():
            if _start(line, UNDERSTOOD) is None:
                found.append(("bash", _shortened(line)))
    return found


def _alike(kind: str, text: str) -> str:
    """What a command does, whatever the number of its samples and the folder of its results."""
    numbers = r" --(spp|quality|out) \S+"
    again = kind == "bash" and text.startswith(("halfspace-sss render scene.xml", "halfspace-sss figures all"))
    return re.sub(numbers, "", text) if again else text


def _pages(top: Path) -> Iterator[tuple[str, str, str]]:
    """Folder, kind and text of all that runs; a command without files of its page runs where it stands first."""
    ran = set()
    for page in PAGES:
        folder = top / Path(page).stem
        folder.mkdir()
        _lay_out(page, folder)
        for kind, text in _items(page):
            alike = _alike(kind, text)
            if alike not in ran or alike == text and ".xml" in text:
                yield str(folder), kind, text
            ran.add(alike)


def _of_kind(page: str, kind: str) -> str:
    return next(text for language, text in _blocks(page) if language == kind)


def _lay_out(page: str, folder: Path) -> None:
    """The files that a page speaks of."""
    mesh = _of_kind("README.md", "xml")
    box = '<shape type="cube" id="bunny"> <transform name="to_world"> <scale value="10"/> </transform>'
    scene = SCENE.format(shape=mesh if page == "README.md" else re.sub(r"<shape.*?/>", box, mesh, flags=re.S))
    if page == "docs/start.md":
        (folder / "ball.xml").write_text(_of_kind(page, "xml"))
    elif page == "docs/materials.md":
        mtlx(folder)
        glb(folder)
    elif page == "docs/rendering.md":
        (folder / "toy.xml").write_text(_of_kind(page, "xml"))
        shutil.copy(ROOT / "docs" / "scenes" / "toy.ply", folder)
        shutil.copy(ROOT / "figures" / "assets" / "studio.exr", folder / "sky.exr")
        Image.frombytes("RGB", (2, 1), bytes([200, 140, 120, 90, 60, 200])).save(folder / "skin.png")
    elif page == "docs/inverse.md":
        scene = _of_kind(page, "xml")
        truth = scene.replace('name="albedo" value="0.8"', 'name="albedo" value="0.97, 0.93, 0.8"')
        truth = truth.replace('name="sigma_t" value="1"', 'name="sigma_t" value="2, 2, 1.5"')
        painted = re.sub(r'<string name="albedo" value="0.8"/>', TEXTURE, scene)
        (folder / "truth.xml").write_text(truth)
        (folder / "bust.xml").write_text(painted)
        (folder / "texels.pfm").write_bytes(b"PF\n2 2\n-1.0\n" + np.full((2, 2, 3), 0.8, np.float32).tobytes())
        (folder / "views.json").write_text(_of_kind(page, "json"))
    else:
        views = {"views": [{"image": "render/scene_path_traced.exr", "sensor": 0}]}
        (folder / "views.json").write_text(json.dumps(views))
        shutil.copy(ROOT / "figures" / "assets" / "bunny.ply", folder / "bunny.ply")
    (folder / "scene.xml").write_text(scene)


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """By page, what failed."""
    top = tmp_path_factory.mktemp("pages")
    ran = _run(top, list(_pages(top)))
    if told := os.environ.get("HALFSPACE_SSS_PAGES"):
        Path(told).write_text(json.dumps(ran, indent=1))
    failed: dict[str, list[str]] = {Path(page).stem: [] for page in PAGES}
    for folder, text, error, _ in ran:
        failed[Path(folder).name] += [f"{text}: {error}"] if error else []
    return failed


def _run(top: Path, items: list[tuple[str, str, str]]) -> list[list]:
    """Folder, text, error and CPU seconds of each item, run in one process with an empty home."""
    (top / "home").mkdir()
    kept = {key: value for key, value in os.environ.items() if not key.startswith(HOME)}
    run = subprocess.run(
        [sys.executable, "-c", RUN, json.dumps(items)], capture_output=True, text=True,
        env={**kept, "HOME": str(top / "home"), "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    ran = [json.loads(line.removeprefix("RAN ")) for line in run.stdout.splitlines() if line.startswith("RAN ")]
    assert [row[:2] for row in ran] == [[folder, text] for folder, _, text in items], run.stderr[-2000:]
    return ran


@pytest.mark.parametrize("page", PAGES)
def test_every_block_of_a_page_runs(page: str, wrong: dict[str, list[str]]) -> None:
    assert not wrong[Path(page).stem], "\n".join(wrong[Path(page).stem])


@pytest.mark.parametrize("starts", [LESS, UNDERSTOOD])
def test_every_line_of_the_tables_is_of_a_command(starts: dict[str, str]) -> None:
    lines = [line for page in PAGES for kind, text in _blocks(page) if kind == "bash" for line in _commands(text)]
    used = {_start(line, starts) for line in lines}
    assert set(starts) <= used, set(starts) - used
