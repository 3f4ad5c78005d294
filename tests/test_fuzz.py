"""Anything at the command line and damage in any file that is read: a sentence at most, never a traceback.

The tests try few cases; HALFSPACE_SSS_FUZZ=100000 tries that many for each property.
"""

from __future__ import annotations

import importlib
import os
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fuzz
import numpy as np
import pytest
from command_list import COMMANDS
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from render_files import XML
from typer.testing import CliRunner

import halfspace_sss
from figures import app as cli
from halfspace_sss import Medium, materials
from halfspace_sss.maps.map_store import load_maps, make_maps

CASES = int(os.environ.get("HALFSPACE_SSS_FUZZ", "0"))
HOW = {"deadline": None, "derandomize": CASES == 0, "database": None, "suppress_health_check": list(HealthCheck)}
COMPUTES = [  # what is replaced: the properties are of what comes before the computation
    "halfspace_sss.comparison.reflectance_curves.trace_curve", "halfspace_sss.maps.map_store.trace_unit",
    "halfspace_sss.comparison.model_errors.references", "halfspace_sss.neural.train",
    "full_geometry.scenes.reference.render",
    "figures.parts.runner.completed_plans",
    "full_geometry.trade.advice.references", "full_geometry.trade.assessing.assess_stage",
    "full_geometry.trade.assessing.assess_for",
    "full_geometry.learning.training._ObjectTraining",
    "full_geometry.learning.learners.errors_of", "full_geometry.inverse.fitting.MediumDescent",
]  # fmt: skip
ODD = ["", " ", "nan", "inf", "-inf", "-1", "0", "1", "2", "0.5", "1e6", "1e400", "1,2", "0,", "1/2", "2/1", "marble",
       "R", "fig10", "neural", "better_dipole", "total", "single", "llvm", "cuda", "[/red]", "[bold", "{", "%s", "../x",
       "marble,ketchup", "16,64,48,24", "x=1", "T0134", "R_d", "list", "ball.xml"]  # fmt: skip
VALUES = st.sampled_from(ODD) | st.integers().map(str) | st.floats().map(str) | st.text(max_size=8)


def _options(command: str) -> list[tuple[str, bool]]:
    """Every option of a command, and whether it is a switch."""
    found = []
    for parameter in COMMANDS[command].params:
        if parameter.name not in ("out", "work", "help") and parameter.opts[0].startswith("--"):
            found.append((parameter.opts[0], parameter.is_flag))
    return found


@st.composite
def _lines(draw: st.DrawFn, command: str) -> list[str]:
    arguments = [*command.split(), "--out", draw(st.sampled_from(["o", "o/deep", "file", "file/o"]))]
    arguments += draw(st.lists(VALUES.filter(lambda text: not text.startswith("-")), max_size=2))
    for option, switch in draw(st.lists(st.sampled_from(_options(command)), max_size=4)):
        arguments += [option] if switch else [f"{option}={draw(VALUES)}"]
    return arguments


def _refused_in(folder: Path, computes: Callable) -> Callable:
    """What computes, refused while `folder` is the working directory.

    Modules that the command line imports while it is replaced keep this for later tests, where it computes.
    """

    def reached(*arguments: Any, **named: Any) -> Any:
        if Path.cwd() == folder:
            raise ValueError("computes")
        return computes(*arguments, **named)

    return reached


WRITING = [name for name in COMMANDS if not name.startswith(("materials", "models"))]


@pytest.mark.parametrize("command", WRITING)
def test_nothing_at_the_command_line_ends_in_a_traceback(command: str, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    for place in COMPUTES:
        module, _, attribute = place.rpartition(".")
        monkeypatch.setattr(place, _refused_in(tmp_path, getattr(importlib.import_module(module), attribute)))
    (tmp_path / "file").write_text("a file")
    (tmp_path / "ball.xml").write_text(XML)

    @settings(max_examples=CASES or 12, **HOW)
    @given(_lines(command))
    def check(arguments: list[str]) -> None:
        result = CliRunner().invoke(cli.app, arguments)
        assert isinstance(result.exception, (SystemExit, type(None))), (arguments, result.exception)
        assert result.exit_code in (0, 1, 2) and "Traceback" not in result.output
        assert set(os.listdir()) <= {"file", "ball.xml", "o"}
        assert (tmp_path / "file").read_text() == "a file"
        shutil.rmtree("o", ignore_errors=True)

    check()


@settings(max_examples=CASES or 60, **HOW)
@given(st.text() | st.sampled_from(ODD))
def test_no_name_of_a_material_or_model_ends_in_a_traceback(name: str) -> None:
    for look_up in (materials.load, lambda text: halfspace_sss.bssrdf(text, Medium(1.0, 0.1))):
        try:
            look_up(name)
        except ValueError as error:
            assert "got" in str(error)


def _scene_file(folder: Path) -> tuple[Path, Callable]:
    import mitsuba as mi

    import full_geometry
    from full_geometry.scenes.scene_files import load_scene

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    (folder / "a.xml").write_text(XML)
    return folder / "a.xml", load_scene


def _render_file(folder: Path) -> tuple[Path, Callable]:
    from full_geometry.scenes import reference

    scene, load_scene = _scene_file(folder)
    reference.render(load_scene(scene), folder / "r" / "a.exr", spp=2)
    return folder / "r" / "a.exr", reference.load


def _weights_file(folder: Path) -> tuple[Path, Callable]:
    from halfspace_sss.neural.store import load_weights, save_weights

    path = save_weights(folder / "w" / "w.safetensors", "k", {"a": np.ones(9, np.float32)}, {"width": 3})
    return path.parent, lambda _: load_weights(path, "k")


def _store(folder: Path) -> tuple[Path, Callable]:
    from halfspace_sss.maps.grid import MapGrid

    (path,) = make_maps(
        {"m": Medium(1.0, 0.1)}, folder, grid=MapGrid(2, 16, 4, 4), target_error=None, n_paths=1024
    ).values()
    return path, load_maps


def _materials_file(folder: Path) -> tuple[Path, Callable]:
    from halfspace_sss.materials.files import read

    source = Path(materials.__file__).parent / "data" / "jensen2001.toml"
    (folder / "m").mkdir()
    return Path(shutil.copy(source, folder / "m" / "m.toml")), read


KINDS = {"scene": _scene_file, "render": _render_file, "weights": _weights_file, "store": _store,
         "materials": _materials_file}  # fmt: skip


def _damage(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes cut, or with some of them flipped, changed, left out or doubled."""
    found = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, max(len(found), 1)))
        what = rng.integers(5)
        if what == 0:
            del found[at:]
        elif what == 1:
            del found[at : at + int(rng.integers(1, 20))]
        elif what == 2:
            found[at:at] = found[at : at + int(rng.integers(1, 20))]
        elif at < len(found):
            found[at] = found[at] ^ (1 << int(rng.integers(8))) if what == 3 else int(rng.integers(256))
    return bytes(found)


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file_is_read_as_it_is_or_refused_in_a_sentence(kind: str, tmp_path: Path) -> None:
    path, read = KINDS[kind](tmp_path)
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    whole = {file: file.read_bytes() for file in files}
    read(path)
    rng = np.random.default_rng(len(kind))
    for _ in range(CASES or 60):
        file = files[int(rng.integers(len(files)))]
        file.write_bytes(_damage(whole[file], rng))
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                read(path)
        except ValueError as error:
            assert str(error) and "Traceback" not in str(error)
        except Exception as error:
            saved = Path(os.environ.get("HALFSPACE_SSS_FUZZ_FOUND", tmp_path)) / f"found-{kind}"
            saved.write_bytes(file.read_bytes())
            raise AssertionError(f"{file.name}, kept as {saved}: {error!r}") from error
        finally:
            file.write_bytes(whole[file])


@pytest.mark.parametrize(("door", "count"), [("eval", 40), ("materials", 80), ("scenes", 30)])
def test_what_is_answered_at_a_front_door_is_within_bounds(door: str, count: int, tmp_path: Path) -> None:
    fuzz.prepare()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        counts, wrong = fuzz.run(door, 0, CASES or count, tmp_path)
    assert not wrong, wrong[0]
    assert counts["answered"] > count / 5 and counts["refused"] > count / 10
