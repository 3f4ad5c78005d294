"""S = alpha p, the paper's network and flow, and the tables of rivals: norms, inputs, stops, places.

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
pytest.importorskip("igl")

from coarse import coarse_ball  # noqa: E402
from waxen import BUNNY, WAX, random_layers, random_patches, wax_bunny  # noqa: E402

from figures.studies import paper_network as paper  # noqa: E402
from figures.studies.alpha_p import AlphaP, fit_alpha_p  # noqa: E402
from figures.studies.commands import _errors_wide, markdown  # noqa: E402
from figures.studies.flow import N_CONTEXT, Chart, ConditionalFlow, FlowSampler  # noqa: E402  # noqa: E402
from figures.studies.flow_training import LIGHTINGS, FlowNetwork, FlowRecipe, lighting  # noqa: E402
from figures.studies.paper_flow import incidence, irradiance, lit_incidence, mesh_arrays, on_surface, rmsd  # noqa: E402
from figures.studies.paper_network import measured_lights, paper_errors, random_lights  # noqa: E402
from full_geometry.learning.model_errors import reference  # noqa: E402
from full_geometry.models.storing import frame_of  # noqa: E402
from full_geometry.object.features import n_side  # noqa: E402
from halfspace_sss.cli import app as cli  # noqa: E402
from halfspace_sss.rendering.object.objects import TranslucentObject, object_of  # noqa: E402
from halfspace_sss.rendering.object.points import EntrySample, SurfacePoint  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

N_PATCHES = 24


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


def test_a_little_training_brings_alpha_to_the_truth(obj: TranslucentObject) -> None:
    model = fit_alpha_p(obj, FlowRecipe(steps=320, chunk=2**13, batch=512, rate=8e-3))
    truth = reference(obj, 64, 512)
    alpha = np.array(model.prepare(truth.exits).alpha)
    wanted = (truth.truth.mean[:, :, 0] / np.array(model.scale)[:, None]).mean(axis=0)
    assert np.corrcoef(alpha, wanted)[0, 1] > 0.4  # of 64 exits: by chance less than once in a thousand
    assert abs(alpha.mean() / wanted.mean() - 1) < 0.15


def test_the_papers_network_takes_5_and_8_for_each_sample() -> None:
    net = paper.PaperNetwork(7)
    linear = [m for m in net.layers if isinstance(m, torch.nn.Linear)]
    assert linear[0].in_features == 5 + 8 * 7 and [m.out_features for m in linear] == [256, 256, 256, 3]


def test_the_papers_network_learns_from_walks(obj: TranslucentObject) -> None:
    truth = reference(obj, 64, 512)
    recipe = paper.PaperRecipe(n=8, steps=100, batch=128, exits=512, reuse=8)
    net, steps = paper.fit_paper(obj, recipe)
    fresh = paper_errors(obj, paper.PaperNetwork(8), truth, repeats=4)
    assert steps > 10
    assert np.mean([e.error for e in paper_errors(obj, net, truth, repeats=4)]) < np.mean([e.error for e in fresh])


def test_the_papers_training_stops_where_the_error_has_stayed_small(
    obj: TranslucentObject, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "ENOUGH", 1e9)
    assert paper.fit_paper(obj, paper.PaperRecipe(n=2, exits=256, batch=32, reuse=64))[1] == paper.FOR_STEPS


def test_lights_scale_with_their_factor_and_lobes_look_along_their_axes() -> None:
    w = np.random.default_rng(0).standard_normal((4, 6, 3))
    w /= np.linalg.norm(w, axis=2, keepdims=True)
    constant, lobe = measured_lights(4, 3)[:2]
    assert np.allclose(constant(w), 1)
    assert np.allclose(lobe(np.ones((4, 1, 3)) / np.sqrt(3)), 1)
    assert np.all(random_lights(4, 3, np.random.default_rng(1))(w) >= 0)


def test_points_are_laid_onto_the_nearest_triangle(obj: TranslucentObject) -> None:
    vertices, faces = mesh_arrays(obj, frame_of(obj))
    centres = vertices[faces].mean(axis=1)
    chosen = np.random.default_rng(3).choice(len(faces), 200, replace=False)
    normals = np.cross(vertices[faces[chosen, 1]] - centres[chosen], vertices[faces[chosen, 2]] - centres[chosen])
    away = centres[chosen] + 1e-4 * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    laid = on_surface(away, vertices, faces)
    d = np.sum((laid - centres[chosen]) * normals, axis=1) / np.linalg.norm(normals, axis=1)
    assert np.abs(d).max() < 1e-9
    assert rmsd(centres, vertices, faces) < 1e-12 < 1e-5 < rmsd(away, vertices, faces)


class EvenS:
    """S = 1 above the horizons."""

    def prepare(self, exits: SurfacePoint) -> None:
        return None

    def S(self, prepared: None, at: SurfacePoint) -> object:
        return mi.Spectrum(dr.select((dr.dot(at.w, at.n) > 0) & (dr.dot(at.w, at.n_out) > 0), 1, 0))


def test_an_even_S_takes_pi_from_all_directions_also_below_interpolated_horizons(tmp_path: Path) -> None:
    ball = object_of(mi.load_dict(coarse_ball(tmp_path)), WAX)
    places = ball.random_places(generator(mi, 512, pass_seed(3)))
    assert np.array(dr.dot(places.n, places.n_out)).min() < 0.97
    assert np.allclose(incidence(EvenS(), places, places), np.pi, rtol=1e-5)


def test_the_light_of_a_scene_arrives_where_a_lamp_is_seen(tmp_path: Path) -> None:
    lamp = {"type": "sphere", "center": [0, 0, 6], "radius": 0.5, "emitter": {"type": "area", "radiance": 3.0}}
    lit = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": {"type": "diffuse"}}, "lamp": lamp})
    ball = object_of(mi.load_dict({"type": "sphere"}), WAX)
    places = ball.random_places(generator(mi, 4096, pass_seed(3)))
    E, z = irradiance(places, lit, (1,)), np.array(places.n)[2]
    assert np.all(E[z < 0] == 0) and np.all(E[z > 0.3] > 0)
    d = np.array([[0], [0], [6]]) - np.array(places.p)
    far = np.linalg.norm(d, axis=0)
    wanted = 3.0 * np.pi * 0.25 * (np.array(places.n) * d).sum(axis=0) / far**3  # of a ball that is seen whole
    ratio = E[z > 0.3] / wanted[z > 0.3]
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(len(ratio)) + 1e-3 and ratio.std() < 0.05
    assert np.allclose(lit_incidence(EvenS(), places, places, lit, (1,)), E, rtol=1e-5)


@pytest.mark.parametrize("kind", LIGHTINGS)
def test_no_light_comes_from_below_the_surface(obj: TranslucentObject, kind: str) -> None:
    at = obj.random_points(generator(mi, 4096, pass_seed(6)))
    entry = EntrySample(at.p, at.n, at.n_out, mi.Float(1), dr.zeros(mi.UInt32, 4096))
    w, value = lighting(kind, obj).sample(entry, mi.Point2f(0.3, 0.6), mi.Bool(True))
    value, mu = np.array(value), np.array(dr.dot(w, at.n))
    assert np.all(value[mu <= 0] == 0) and np.all(value >= 0) and (value > 0).mean() > 0.1


XML = f"""<scene version="3.0.0">
  <integrator type="bssrdf"><float name="mm_per_unit" value="1"/></integrator>
  <emitter type="constant"/>
  <shape type="ply" id="bunny"><string name="filename" value="{BUNNY}"/><bsdf type="translucent">
    <string name="sigma_s" value="0.95,0.8,0.6"/><string name="sigma_a" value="0.05,0.2,0.4"/></bsdf></shape>
</scene>
"""


@pytest.fixture
def scene_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HALFSPACE_SSS_WEIGHTS", str(tmp_path / "weights"))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bunny.xml").write_text(XML)
    return tmp_path / "bunny.xml"


def test_the_papers_network_is_trained_and_measured_by_the_commands(
    scene_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(paper, "EXITS", 32)
    monkeypatch.setattr(paper, "WALKS", 64)
    name = "full_geometry_paper"
    run = CliRunner().invoke(
        cli.app, ["train", "object", "--scene", str(scene_file), "--model", name, "--seconds", "1"]
    )
    assert run.exit_code == 0 and name in run.stdout, run.output
    run = CliRunner().invoke(cli.app, ["errors", "--scene", str(scene_file), "--model", name])
    assert run.exit_code == 0 and "constant" in run.stdout, run.output


@pytest.mark.parametrize(
    "bad, message",
    [
        (["--table", "images"], "table must be one of errors, samplers, base_models"),
        (["--seconds", "0"], "seconds must"),
        (["--samples", "1"], "samples must"),
    ],
)
def test_tables_refuse_bad_input_before_anything_is_traced(scene_file: Path, bad: list[str], message: str) -> None:
    run = CliRunner().invoke(cli.app, ["study", "rivals", "--scene", str(scene_file), *bad])
    assert run.exit_code != 0 and message in run.output


def test_a_table_of_errors_has_a_row_for_each_model() -> None:
    rows = [{"model": m, "channel": c, "light": "constant", "error": 0.1, "standard_error": 0.01, "ratio": 1.0}
            for m in ("a", "b") for c in (0, 1)]  # fmt: skip
    text = markdown(_errors_wide(pandas.DataFrame(rows), ["model"]))
    assert text.splitlines()[2:] == ["| a | 10 ± 1 | 10 ± 1 |", "| b | 10 ± 1 | 10 ± 1 |"]
