"""S = alpha p, lights that samplers are compared in, and the tables of rivals.

Estimates are held against each other within four standard errors, with fixed seeds.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas
import pytest
from typer.testing import CliRunner

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")
torch = pytest.importorskip("torch")
pytest.importorskip("zuko")

from waxen import BUNNY, random_layers, random_patches, wax_bunny  # noqa: E402

from benchmarks.__main__ import app  # noqa: E402
from benchmarks.alpha_p import AlphaP, fit_alpha_p  # noqa: E402
from benchmarks.flow import N_CONTEXT, Chart, ConditionalFlow, FlowSampler  # noqa: E402
from benchmarks.flow_training import FlowNetwork, FlowRecipe  # noqa: E402
from benchmarks.lightings import LIGHTINGS, lighting  # noqa: E402
from benchmarks.rivals_command import _errors_wide  # noqa: E402
from benchmarks.tables import markdown  # noqa: E402
from full_geometry.geometry.points import EntrySample  # noqa: E402
from full_geometry.learning.model_errors import reference  # noqa: E402
from full_geometry.objects.objects import TranslucentObject  # noqa: E402
from full_geometry.transport.features import n_side  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

N_PATCHES = 24
XML = f"""<scene version="3.0.0">
  <integrator type="bssrdf"><float name="mm_per_unit" value="1"/></integrator>
  <emitter type="constant"/>
  <shape type="ply" id="bunny"><string name="filename" value="{BUNNY}"/><bsdf type="translucent">
    <string name="sigma_s" value="0.95,0.8,0.6"/><string name="sigma_a" value="0.05,0.2,0.4"/></bsdf></shape>
</scene>
"""


@pytest.fixture(scope="module")
def obj() -> TranslucentObject:
    return wax_bunny()


@pytest.fixture(scope="module")
def shaken(obj: TranslucentObject) -> AlphaP:
    """S = alpha p with random numbers: what it integrates to holds for any."""
    rng, n = np.random.default_rng(5), n_side(3)
    net = FlowNetwork(4, N_CONTEXT, (16,), 1)
    with torch.no_grad():
        net.transform.hyper[-1].bias.copy_(torch.randn(92, generator=torch.Generator().manual_seed(2)))
    points = random_patches(obj, N_PATCHES, rng, 0.3)
    sampler = FlowSampler(points, Chart(obj, points.frame, points.patches), ConditionalFlow(4, net.arrays()))
    own = (("A", "a", [n, 8, 1]), ("P", "p", [2 * n + N_CONTEXT, 8, 3]))
    weights = {name: array for layers in own for name, array in random_layers(rng, *layers, 0.3).items()}
    return AlphaP(obj, sampler, weights, (0.5, 0.3, 0.1))


@pytest.fixture
def scene_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bunny.xml").write_text(XML)
    return tmp_path / "bunny.xml"


def test_alpha_is_the_light_that_comes_back_from_everywhere(obj: TranslucentObject, shaken: AlphaP) -> None:
    n = 2**17
    exit = obj.random_points(generator(mi, 1, pass_seed(4))).gather(dr.zeros(mi.UInt32, n))
    entries = obj.random_points(generator(mi, n, pass_seed(5)))
    prepared = shaken.prepare(exit)
    S = np.array(shaken.S(prepared, entries), dtype=float) / np.array(shaken.scale)[:, None]
    values = S.mean(axis=0) * np.pi * obj.geometry.area
    alpha = np.array(prepared.alpha)[0]
    assert abs(values.mean() - alpha) < 4 * values.std() / np.sqrt(n)
    assert values.std() / np.sqrt(n) < 0.05 * alpha


@pytest.mark.slow
def test_a_little_training_brings_alpha_to_the_truth(obj: TranslucentObject) -> None:
    model = fit_alpha_p(obj, FlowRecipe(steps=160, chunk=2**13, batch=512, rate=8e-3))
    truth = reference(obj, 64, 512)
    alpha = np.array(model.prepare(truth.exits).alpha)
    wanted = (truth.truth.mean[:, :, 0] / np.array(model.scale)[:, None]).mean(axis=0)
    assert np.corrcoef(alpha, wanted)[0, 1] > 0.4  # of 64 exits: by chance less than once in a thousand
    assert abs(alpha.mean() / wanted.mean() - 1) < 0.15


@pytest.mark.parametrize("kind", LIGHTINGS)
def test_no_light_comes_from_below_the_surface(obj: TranslucentObject, kind: str) -> None:
    at = obj.random_points(generator(mi, 4096, pass_seed(6)))
    entry = EntrySample(at.p, at.n, at.n_out, mi.Float(1), dr.zeros(mi.UInt32, 4096))
    w, value = lighting(kind, obj).sample(entry, mi.Point2f(0.3, 0.6), mi.Bool(True))
    value, mu = np.array(value), np.array(dr.dot(w, at.n))
    assert np.all(value[mu <= 0] == 0) and np.all(value >= 0) and (value > 0).mean() > 0.1


@pytest.mark.parametrize(
    "bad, message",
    [
        (["--table", "images"], "table must be one of errors, samplers"),
        (["--seconds", "0"], "seconds must"),
        (["--samples", "1"], "samples must"),
    ],
)
def test_tables_refuse_bad_input_before_anything_is_traced(scene_file: Path, bad: list[str], message: str) -> None:
    run = CliRunner().invoke(app, ["rivals", "--scene", str(scene_file), *bad])
    assert run.exit_code != 0 and message in run.output


def test_a_table_of_errors_has_a_row_for_each_model() -> None:
    rows = [{"model": m, "channel": c, "light": "constant", "error": 0.1, "standard_error": 0.01, "ratio": 1.0}
            for m in ("a", "b") for c in (0, 1)]  # fmt: skip
    text = markdown(_errors_wide(pandas.DataFrame(rows)))
    assert text.splitlines()[2:] == ["| a | 10 ± 1 | 10 ± 1 |", "| b | 10 ± 1 | 10 ± 1 |"]
