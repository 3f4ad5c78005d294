"""The paper's network and flow: inputs, stops, places, light that arrives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
dr = pytest.importorskip("drjit")
torch = pytest.importorskip("torch")
pytest.importorskip("zuko")
pytest.importorskip("igl")

from coarse import coarse_ball  # noqa: E402
from waxen import WAX, wax_bunny  # noqa: E402

from benchmarks.published import paper_network as paper  # noqa: E402
from benchmarks.published.paper_flow import incidence, irradiance, lit_incidence, mesh_arrays, on_surface, rmsd  # noqa: E402
from benchmarks.published.paper_network import measured_lights, random_lights  # noqa: E402
from full_geometry.geometry.points import SurfacePoint  # noqa: E402
from full_geometry.learning.model_errors import compare, reference  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.transport.storing import frame_of  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")


@pytest.fixture(scope="module")
def obj() -> TranslucentObject:
    return wax_bunny()


def test_the_papers_network_takes_5_and_8_for_each_sample() -> None:
    net = paper.PaperNetwork(7)
    linear = [m for m in net.layers if isinstance(m, torch.nn.Linear)]
    assert linear[0].in_features == 5 + 8 * 7 and [m.out_features for m in linear] == [256, 256, 256, 3]


@pytest.mark.slow
def test_the_papers_network_learns_from_walks(obj: TranslucentObject) -> None:
    truth = reference(obj, 64, 512)
    recipe = paper.PaperRecipe(n=8, steps=100, batch=128, exits=512, reuse=8)
    net, steps = paper.fit_paper(obj, recipe)
    learnt, fresh = (
        [e.error for e in compare(paper.estimate(obj, n, truth.exits, "walks", 4), truth.truth)]
        for n in (net, paper.PaperNetwork(8))
    )
    assert steps > 10 and np.mean(learnt) < np.mean(fresh)


@pytest.mark.slow
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
