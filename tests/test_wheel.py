"""The wheel has every file of its packages, and renders where there is no source."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("analytic_models", "figures", "full_geometry", "halfspace_sss")
SCENE = """<scene version="3.0.0">
    <integrator type="bssrdf"> <float name="mm_per_unit" value="5"/> </integrator>
    <emitter type="constant"/>
    <shape type="sphere"> <bsdf type="translucent"> <string name="material" value="ketchup"/> </bsdf> </shape>
    <sensor type="perspective">
        <transform name="to_world"> <lookat origin="0, 0, 4" target="0, 0, 0" up="0, 1, 0"/> </transform>
        <film type="hdrfilm"> <integer name="width" value="8"/> <integer name="height" value="8"/> </film>
    </sensor>
</scene>
"""
RUN = """
import sys, halfspace_sss
from figures.command_line import main
print(halfspace_sss.__file__)
sys.argv = ["halfspace-sss", "render", "ball.xml", "--model", "neural", "--spp", "1"]
main()
"""


@pytest.mark.slow
def test_the_wheel_is_whole_and_renders_without_the_source(tmp_path: Path) -> None:
    pytest.importorskip("mitsuba")
    source, installed, empty = (tmp_path / name for name in ("source", "installed", "empty"))
    for name in PACKAGES:  # a copy, as a build leaves files in its folder
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    build = ["wheel", "-q", "--no-deps", "--no-index", "--no-build-isolation", "-w", str(tmp_path), str(source)]
    subprocess.run([sys.executable, "-m", "pip", *build], check=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    with ZipFile(wheel) as packed:
        packed.extractall(installed)
    built = {p.relative_to(installed).as_posix() for p in installed.rglob("*") if p.is_file()}
    wanted = {p.relative_to(source).as_posix() for name in PACKAGES for p in (source / name).rglob("*") if p.is_file()}
    assert {name for name in built if ".dist-info/" not in name} == wanted
    empty.mkdir()
    (empty / "ball.xml").write_text(SCENE)
    env = {**os.environ, "HOME": str(empty), "PYTHONPATH": str(installed)}
    done = subprocess.run([sys.executable, "-c", RUN], cwd=empty, env=env, check=True, capture_output=True, timeout=120)
    assert str(installed) in done.stdout.decode().splitlines()[0]
    assert (empty / "render" / "ball_neural.exr").stat().st_size
