"""What help() shows of files and scenes is taken by the library as it stands there."""

from __future__ import annotations

import importlib
import pkgutil
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest

import full_geometry
import halfspace_sss
from halfspace_sss.materials.files import parse

NAMES = [
    found.name
    for package in (halfspace_sss, full_geometry)
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
]
HELP = {name: textwrap.dedent(importlib.import_module(name).__doc__ or "") for name in NAMES}
XML = [
    block
    for text in HELP.values()
    for block in re.findall(r"^ {4}(<(\w+)(?: [^\n]*)?>\n.*?^ {4}</\2>)$", text, re.M | re.S)
]
DICTS = [line for text in HELP.values() for line in re.findall(r'^ {4}(\{"type".*\})$', text, re.M)]
TOML = [text for text in HELP.values() if "[[material]]\n" in text]


@pytest.fixture
def mi():
    mitsuba = pytest.importorskip("mitsuba")
    import full_geometry

    mitsuba.set_variant("llvm_ad_rgb")
    full_geometry.register()
    return mitsuba


def test_there_are_examples() -> None:
    assert XML and DICTS and TOML


@pytest.mark.parametrize("block", [block for block, _ in XML])
def test_a_piece_of_xml_loads(mi, block: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mi.VolumeGrid(np.ones((2, 2, 2, 1), dtype=np.float32)).write(str(tmp_path / "wax.vol"))
    monkeypatch.chdir(tmp_path)
    scene = mi.load_string(f'<scene version="3.0.0"><shape type="sphere">{block}</shape></scene>')
    label = "medium" if "wax.vol" in block else "marble"
    assert f"Translucent[MediumSpec(label='{label}'" in str(scene.shapes()[0].bsdf())


@pytest.mark.parametrize("line", DICTS)
def test_a_dict_loads(mi, line: str) -> None:
    from ast import literal_eval

    assert "label='marble'" in str(mi.load_dict(literal_eval(line)))


@pytest.mark.parametrize("text", TOML)
def test_a_material_file_is_read(text: str) -> None:
    block = text[text.index("    set = ") : text.rindex("\n\nOptional")]
    assert [found.name for found in parse(textwrap.dedent(block), "help")] == ["soap"]
