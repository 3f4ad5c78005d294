"""What plugins refuse is the message of the error of Mitsuba's own functions."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

WALKS = "model must have an S, got 'path_traced': for walks take the integrator translucent_walk$"
XML = '<scene version="3.0.0"><integrator type="{}"><float name="{}" value="{}"/></integrator></scene>'


def _bitmap() -> dict:
    return {"type": "bitmap", "bitmap": mi.Bitmap(np.full((4, 4, 3), 0.5, dtype=np.float32))}


PLUGINS = [
    (
        {"type": "translucent", "material": "marble", "modle": "x"},
        "parameter of translucent must be .*got 'modle'; did",
    ),
    ({"type": "translucent", "material": "marbel"}, "material must be .*, got 'marbel'; did you mean 'marble'?"),
    ({"type": "translucent", "sigma_t": 1.0}, "a translucent surface must have material"),
    ({"type": "translucent", "sigma_s": -1.0, "sigma_a": 1.0}, "sigma_s must be .*got -1.0"),
    ({"type": "translucent", "material": "marble", "model": "path_traced"}, WALKS),
    ({"type": "bssrdf", "model": "path_traced"}, WALKS),
    ({"type": "bssrdf", "entrys": 3}, "parameter of bssrdf must be .*got 'entrys'"),
    ({"type": "bssrdf", "geometry": "tangent"}, "parameter of bssrdf must be .*got 'geometry'"),
    ({"type": "bssrdf", "mm_per_unit": -1.0}, "mm_per_unit must be .*got -1.0"),
    ({"type": "translucent_walk", "mm_per_unit": 3e12}, r"mm_per_unit must be .*got 3000000000000.0"),
    ({"type": "translucent_walk", "entries": 3}, "parameter of translucent_walk must be .*got 'entries'"),
    ({"type": "translucent_walk", "connection_share": 2.0}, "connection_share must be .*got 2.0"),
    ({"type": "translucent_walk", "blur": -1.0}, "blur must be .*got -1.0"),
    ({"type": "translucent_walk", "max_depth": 2.7}, "max_depth must be -1 or a whole number >= 1, got 2.7"),
    ({"type": "translucent_walk", "layers": "false"}, "layers must be true or false, got 'false'"),
    ({"type": "bssrdf", "max_depth": float("nan")}, "max_depth must be -1 or a whole number >= 1, got nan"),
    ({"type": "bssrdf", "entries": 2.5}, "entries must be -1 or a whole number >= 1, got 2.5"),
]


@pytest.mark.parametrize(("plugin", "reason"), PLUGINS)
def test_the_reason_is_the_message_of_load_dict(plugin: dict, reason: str) -> None:
    with pytest.raises(ValueError, match=f"^{reason}"):
        mi.load_dict(plugin)


def test_a_bitmap_for_a_number_is_refused_in_a_sentence() -> None:
    with pytest.raises(ValueError, match="^sigma_s must be constant, got a texture; albedo, sigma_t, .* may vary$"):
        mi.load_dict({"type": "translucent", "sigma_s": _bitmap(), "sigma_a": 1.0})


@pytest.mark.parametrize("integrator", ["bssrdf", "translucent_walk"])
def test_the_reason_is_the_message_of_files_and_strings(integrator: str, tmp_path) -> None:
    text = XML.format(integrator, "mm_per_unit", -2)
    (tmp_path / "scene.xml").write_text(text)
    for load in (lambda: mi.load_string(text), lambda: mi.load_file(str(tmp_path / "scene.xml"))):
        with pytest.raises(ValueError, match=r"^\S* ?\(line 1, col \d+\): mm_per_unit must be .*got -2.0"):
            load()


@pytest.mark.parametrize("integrator", ["bssrdf", "translucent_walk"])
def test_the_reason_is_the_message_of_render(integrator: str) -> None:
    ball = {"type": "sphere", "bsdf": {"type": "translucent", "material": "marble", "model": "better_dipole"}}
    scene = {"type": "scene", "integrator": {"type": integrator}, "ball": ball, "sensor": {"type": "perspective"}}
    with pytest.raises(ValueError, match="^the camera must be outside of every object, got it inside 'ball'"):
        mi.render(mi.load_dict(scene), spp=1)


def test_errors_of_other_plugins_stay_those_of_mitsuba() -> None:
    with pytest.raises(RuntimeError, match="unreferenced property") as error:
        mi.load_dict({"type": "sphere", "flop": 1})
    assert type(error.value) is RuntimeError


def test_plugins_that_are_not_registered_are_told_by_one_sentence() -> None:
    code = """
import halfspace_sss, mitsuba
mitsuba.set_variant("llvm_ad_rgb")
from full_geometry.scenes.scene_files import load_scene
load_scene({"type": "scene", "ball": {"type": "sphere", "bsdf": {"type": "translucent", "material": "wax"}}})
"""
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert ended.stderr.splitlines()[-1] == (
        "ValueError: plugins must be registered before a scene is loaded, got none: call `full_geometry.register()` "
        "after `mitsuba.set_variant()`"
    )


@pytest.mark.parametrize("integrator", ["bssrdf", "translucent_walk"])
def test_a_number_of_samples_below_zero_is_refused(integrator: str) -> None:
    """0 is Mitsuba's word for the samples of the sampler; -1 gave a black image."""
    film = {"type": "hdrfilm", "width": 2, "height": 2}
    view = mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0])
    ball = {"type": "sphere", "bsdf": {"type": "translucent", "sigma_t": 20.0, "albedo": 0.9, "model": "lambert"}}
    sensor = {"type": "perspective", "to_world": view, "film": film}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": integrator}, "ball": ball, "sensor": sensor})
    with pytest.raises(ValueError, match="^spp must be at least 1, or 0 for the samples of the sampler, got -1"):
        mi.render(scene, spp=-1)
