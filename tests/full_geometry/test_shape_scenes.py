"""The model of every shape in scenes: no training, warnings before anything is rendered, errors by the command."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import numpy as np
import pandas
import pytest
from typer.testing import CliRunner

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")

from figures import app as cli  # noqa: E402
from full_geometry.learning import model_errors  # noqa: E402
from full_geometry.scenes.scene_files import load_scene  # noqa: E402
from full_geometry.settings import Settings  # noqa: E402
from full_geometry.transport import any_shape  # noqa: E402
from full_geometry.transport.models import lookup, model_names  # noqa: E402
from full_geometry.transport.prepare import make_objects  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

REFERENCE = model_errors.reference
SURFACE = {"type": "translucent", "sigma_s": 0.95, "sigma_a": 0.05, "g": 0.0, "eta": 1.3, "model": "neural_shape"}
XML = """<scene version="3.0.0">
    <integrator type="bssrdf"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, 0, 20" target="0, 0, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="sphere" id="ball"><float name="radius" value="3"/>
        <bsdf type="translucent">
            <string name="sigma_s" value="0.95"/><string name="sigma_a" value="0.05"/>
            <float name="eta" value="1.3"/><string name="model" value="neural_shape"/>
        </bsdf>
    </shape>
</scene>
"""


def scene(ball: dict | None = None, **surface: object) -> dict:
    """A ball of three mean free paths under an even sky."""
    view = mi.ScalarTransform4f().look_at([0, 0, 20], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "bssrdf"},
        "sensor": {"type": "perspective", "fov": 15.0, "to_world": view,
                   "film": {"type": "hdrfilm", "width": 8, "height": 8}},
        "sky": {"type": "constant"},
        "ball": {"type": "sphere", "radius": 3.0, **(ball or {}), "bsdf": {**SURFACE, **surface}},
    }  # fmt: skip


def image(content: dict, model: str | None = None, spp: int = 256) -> np.ndarray:
    return np.array(mi.render(load_scene(content, model), spp=spp))


def test_it_is_listed_with_the_transports() -> None:
    assert "neural_shape" in model_names() and not lookup("neural_shape").capabilities.of_half_space


@pytest.fixture
def uncalibrated(monkeypatch: pytest.MonkeyPatch) -> None:
    """No walks for the light that leaves, which warnings come before."""
    monkeypatch.setattr(any_shape, "calibrated", lambda model: model)


@pytest.mark.usefixtures("uncalibrated")
@pytest.mark.parametrize(
    ("ball", "surface", "words"),
    [
        ({}, {"sigma_s": 0.019, "sigma_a": 0.001}, r"'ball'.*sigma_t sqrt\(area\) 0\.21"),
        ({}, {"g": 0.97}, r"'ball'.*g 0\.97"),
        ({}, {"eta": 1.9}, r"'ball'.*eta 1\.9"),
        ({"type": "disk", "radius": None, "to_world": 3.0}, {}, "'ball'.*not closed"),
    ],
)
def test_it_warns_by_name_and_number_out_of_its_range(ball: dict, surface: dict, words: str) -> None:
    content = scene(ball, **surface)
    if "to_world" in ball:
        content["ball"]["to_world"] = mi.ScalarTransform4f().scale(ball["to_world"])
        del content["ball"]["radius"]
    with pytest.warns(UserWarning, match="neural_shape was trained on") as caught:
        make_objects(load_scene(content), Settings())
    assert any(re.search(words, str(w.message)) for w in caught)


@pytest.mark.usefixtures("uncalibrated")
def test_it_warns_of_a_clear_object_by_its_mean_chord() -> None:
    """4/3 of the radius of 3: in grapefruit juice it was 1.13 of walks under a lamp, without a word."""
    with pytest.warns(UserWarning, match="object 'ball' is clear for neural_shape.*mean chord is 2.6, 2.6, 2.6 transp"):
        make_objects(load_scene(scene(sigma_s=0.6, sigma_a=0.05)), Settings())


@pytest.mark.usefixtures("uncalibrated")
def test_within_its_range_it_says_nothing() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_objects(load_scene(scene(orders="multiple")), Settings())


def test_a_rough_boundary_is_refused() -> None:
    rough = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.3, "ext_ior": 1.0}
    with pytest.raises(ValueError, match="boundary of object 'ball' must be smooth"):
        mi.render(load_scene(scene(boundary=rough)), spp=1)


@pytest.mark.slow
def test_the_command_errors_measures_it_beside_a_half_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(model_errors, "reference", lambda *a: REFERENCE(a[0], 32, 1024, *a[3:]))
    Path("ball.xml").write_text(XML, encoding="utf-8")
    words = ["errors", "object", "--scene", "ball.xml", "--model", "neural_shape", "--model", "neural"]
    result = CliRunner().invoke(cli.app, words)
    assert result.exit_code == 0, result.output
    mean = pandas.read_csv("errors/errors.csv").groupby("model")["error"].mean()
    assert mean["neural_shape"] < 0.5 * mean["neural"]
