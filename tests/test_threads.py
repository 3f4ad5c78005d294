"""What is made on first use is made once and whole, however many threads ask for it at the same time."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from halfspace_sss.lazy import once

THREADS = 8
OBJECTS = ["marble", "skin1", "apple", "ketchup", "skin2", "cream", "potato", "chicken1", "chicken2", "spectralon"]
START = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
import full_geometry
full_geometry.register()
"""
ASK = """
import sys, threading
from concurrent.futures import ThreadPoolExecutor
import halfspace_sss
together = threading.Barrier({n})
def ask(k):
    together.wait()
    return {what}
sys.setswitchinterval(1e-6)
with ThreadPoolExecutor({n}) as pool:
    answers = list(pool.map(ask, range({n})))
print(answers[0])
assert all(answer == answers[0] for answer in answers), answers
"""


def in_fresh_process(code: str, folder: Path) -> str:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, timeout=300)
    assert run.returncode == 0, run.stderr
    return run.stdout


def shapes() -> dict:
    """Objects of different materials: equal surfaces would be merged into one."""
    return {
        f"object_{k}": {"type": "sphere", "center": [3 * k, 0, 0], "bsdf": {"type": "translucent", "material": name}}
        for k, name in enumerate(OBJECTS)
    }


def test_a_dict_with_several_objects_loads_in_a_fresh_process(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    scene = {"type": "scene", **shapes()}
    assert in_fresh_process(f"{START}\nprint(len(mi.load_dict({scene}, parallel=True).shapes()))", tmp_path) == "10\n"


def test_a_file_with_several_objects_loads_in_a_fresh_process(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    bodies = "\n".join(
        f'<shape type="sphere"><point name="center" x="{3 * k}" y="0" z="0"/>'
        f'<bsdf type="translucent"><string name="material" value="{name}"/></bsdf></shape>'
        for k, name in enumerate(OBJECTS)
    )
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{bodies}</scene>')
    code = f'{START}\nprint(len(mi.load_file("scene.xml", parallel=True).shapes()))'
    assert in_fresh_process(code, tmp_path) == "10\n"


@pytest.mark.parametrize(
    "what",
    [
        "halfspace_sss.materials.load('marble').name",
        "halfspace_sss.materials.names()",
        "halfspace_sss.models()",
        "float(halfspace_sss.bssrdf('neural', halfspace_sss.Medium(1.0, 0.1)).eval(1.0, 0.9, 0.0, 0.8, 1.0))",
    ],
)
def test_threads_that_ask_first_are_all_answered(what: str, tmp_path: Path) -> None:
    in_fresh_process(ASK.format(n=THREADS, what=what), tmp_path)


def test_threads_that_register_materials_lose_none(tmp_path: Path) -> None:
    name = "f'stone {k}'"
    made = f"halfspace_sss.materials.Material({name}, halfspace_sss.Medium(1.0, 0.1))"
    code = ASK.format(n=THREADS, what=f"len(halfspace_sss.materials.register({made}))")
    wanted = [f"stone {k}" for k in range(THREADS)]
    in_fresh_process(f"{code}\nassert set({wanted}) <= set(halfspace_sss.materials.names())", tmp_path)


def test_threads_share_one_run_of_a_function() -> None:
    runs, together = [], threading.Barrier(THREADS)

    @once
    def slow(x: int) -> object:
        runs.append(x)
        time.sleep(0.05)
        return object()

    def ask(_: int) -> object:
        together.wait()
        return slow(3)

    with ThreadPoolExecutor(THREADS) as pool:
        answers = list(pool.map(ask, range(THREADS)))
    assert runs == [3] and len(set(map(id, answers))) == 1


def test_a_function_that_failed_runs_again() -> None:
    runs = []

    @once
    def fails(x: int) -> None:
        runs.append(x)
        raise ValueError("no")

    for _ in range(2):
        with pytest.raises(ValueError, match="no"):
            fails(3)
    assert runs == [3, 3]
