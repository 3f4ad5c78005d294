"""The objects of the figures: closed meshes, the same by seed, media in range, and the flame where it belongs."""

from __future__ import annotations

import functools

import numpy as np
import pytest

pytest.importorskip("mitsuba")
igl = pytest.importorskip("igl")

import mitsuba as mi  # noqa: E402

from benchmarks.modelling import meshes, objects  # noqa: E402
from benchmarks.published import meat  # noqa: E402, F401  # an object more
from figures.computing import scans as scenes  # noqa: E402

LOW, HIGH = 32, 64
CELLS = 24


@pytest.fixture(scope="module")
def varying() -> dict[str, objects.Varying]:
    return {name: objects.make_varying(name, LOW, CELLS) for name in objects.MODELS}


@pytest.fixture(scope="module")
def made(varying: dict) -> dict[str, meshes.Mesh]:
    return {**{name: each.mesh for name, each in varying.items()}, "candle": candle(0).wax}


@pytest.fixture(scope="module")
def media(varying: dict) -> dict[str, objects.Grid]:
    return {name: each.grid for name, each in varying.items()}


@functools.cache
def candle(seed: int) -> objects.Candle:
    return objects.make_candle(LOW, seed)


def vertices(name: str, seed: int) -> np.ndarray:
    if name == "candle":
        return (candle(seed) if seed else objects.make_candle(LOW)).wax.vertices
    return objects.make_varying(name, LOW, 8, seed).mesh.vertices


def sphere(p: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=-1) - 1.0


BALL = meshes.Box((-1.2, -1.2, -1.2), (1.2, 1.2, 1.2))


def test_the_mesh_of_a_sphere_has_its_volume() -> None:
    assert meshes.surface(sphere, BALL, 48).volume == pytest.approx(4 / 3 * np.pi, rel=5e-3)


def test_a_surface_through_corners_of_the_grid_has_no_degenerate_triangle() -> None:
    found = meshes.surface(lambda p: np.abs(p).max(axis=-1) - 0.9, meshes.Box((-1.2,) * 3, (1.2,) * 3), 16)
    assert found.areas.min() > 0 and found.volume == pytest.approx(1.8**3, rel=0.05)


def test_a_surface_that_reaches_the_edge_of_its_box_is_refused() -> None:
    with pytest.raises(ValueError, match="box must hold the surface"):
        meshes.surface(sphere, meshes.Box((-1.2, -0.9, -1.2), (1.2, 1.2, 1.2)), 16)


def test_a_mesh_with_a_hole_is_refused() -> None:
    ball = meshes.surface(sphere, BALL, 8)
    with pytest.raises(ValueError, match="share each edge"):
        meshes.Mesh(ball.vertices, ball.faces[1:])


def test_a_mesh_wound_inwards_is_refused() -> None:
    ball = meshes.surface(sphere, BALL, 8)
    with pytest.raises(ValueError, match="volume must be > 0"):
        meshes.Mesh(ball.vertices, ball.faces[:, ::-1])


def test_a_mesh_with_a_triangle_without_area_is_refused() -> None:
    ball = meshes.surface(sphere, BALL, 8)
    vertices = ball.vertices.copy()
    vertices[ball.faces[0, 0]] = vertices[ball.faces[0, 1]]
    with pytest.raises(ValueError, match="areas of triangles"):
        meshes.Mesh(vertices, ball.faces)


def test_a_resolution_below_the_least_is_refused() -> None:
    with pytest.raises(ValueError, match="resolution must be a whole number >= 8"):
        objects.make_varying("meat", 4)


def test_an_unknown_object_is_refused() -> None:
    with pytest.raises(ValueError, match="object must be one of"):
        objects.make_varying("teapot")


@pytest.mark.parametrize("chosen", ["candle", *objects.MODELS])
def test_points_inside_and_outside_are_told_apart_by_the_winding_of_the_mesh(chosen: str, made: dict) -> None:
    found = made[chosen]
    rng = np.random.default_rng(3)
    points = rng.uniform(found.vertices.min(0) - 2, found.vertices.max(0) + 2, (400, 3))
    winding = igl.winding_number(found.vertices, found.faces.astype(np.int64), points)
    assert np.abs(winding - np.round(winding)).max() < 1e-6 and {0, 1} == set(np.round(winding))


@pytest.mark.parametrize("chosen", ["candle", *objects.MODELS])
def test_an_object_is_the_same_for_the_same_seed_and_another_for_another(chosen: str, made: dict) -> None:
    first, again, other = made[chosen].vertices, vertices(chosen, 0), vertices(chosen, 1)
    assert np.array_equal(first, again) and (first.shape != other.shape or not np.array_equal(first, other))


@pytest.mark.parametrize("chosen", ["candle", *objects.MODELS])
def test_another_resolution_changes_the_volume_by_less_than_2_percent(chosen: str, made: dict) -> None:
    fine = objects.make_candle(HIGH).wax if chosen == "candle" else objects.make_varying(chosen, HIGH, 8).mesh
    assert made[chosen].volume == pytest.approx(fine.volume, rel=0.02)


@pytest.mark.parametrize("seed", (0, 1))
def test_the_flame_lies_inside_the_convex_hull_of_the_candle_but_outside_of_the_wax(seed: int) -> None:
    from scipy.spatial import Delaunay

    found = candle(seed)
    assert (Delaunay(found.wax.vertices[::5]).find_simplex(found.flame.vertices) >= 0).all()
    winding = igl.fast_winding_number(found.wax.vertices, found.wax.faces.astype(np.int64), found.flame.vertices)
    assert np.abs(winding).max() < 0.1


def test_the_wick_does_not_touch_the_wax() -> None:
    found = candle(0)
    drips = objects._drips(0)
    assert objects.wax_distance(found.wick.vertices, 0, drips).min() > 0.02


@pytest.mark.parametrize("chosen", objects.MODELS)
def test_a_grid_holds_no_value_beyond_those_of_its_tissues(chosen: str, media: dict) -> None:
    found = media[chosen]
    known = objects.MODELS[chosen][0](0).tissues(np.zeros((1, 3)))
    tissues = [objects.tissue(t).medium for t in known]
    low, high = (pick([m.sigma_t[0] for m in tissues]) for pick in (min, max))
    assert low * (1 - 1e-5) <= found.sigma_t.min() and found.sigma_t.max() <= high * (1 + 1e-5)
    for k in range(3):
        albedos = [m.albedo[k] for m in tissues]
        channel = found.albedo[..., k]
        assert min(albedos) - 1e-5 <= channel.min() and channel.max() <= max(albedos) + 1e-5
        assert channel.max() - channel.min() > 1e-4


def test_a_grid_volume_of_mitsuba_gives_the_values_at_their_places(media: dict, tmp_path) -> None:
    mi.set_variant("llvm_ad_rgb")
    found = media["meat"]
    medium = found.write(tmp_path, "meat")
    volume = mi.load_dict(medium["albedo"])
    low, high = np.array(found.box.low), np.array(found.box.high)
    k = np.array([5, 4, 7])  # x, y, z
    at = low + (k + 0.5) / np.array(found.sigma_t.shape[::-1]) * (high - low)
    it = mi.Interaction3f()
    it.p = mi.Point3f(*at.tolist())
    assert np.allclose(np.array(volume.eval(it)).ravel(), found.albedo[k[2], k[1], k[0]], atol=1e-4)


def test_a_ply_file_holds_the_mesh_that_mitsuba_is_given(made: dict, tmp_path) -> None:
    mi.set_variant("llvm_ad_rgb")
    file = made["candle"].write_ply(tmp_path / "candle.ply")
    shapes = mi.load_dict({"type": "ply", "filename": str(file)}), made["candle"].mitsuba("candle")
    for key in ("vertex_positions", "faces", "vertex_normals"):
        a, b = (np.array(mi.traverse(shape)[key], dtype=float) for shape in shapes)
        assert np.allclose(a, b, atol=1e-5)


@pytest.mark.parametrize("chosen", scenes.ENVIRONMENTS)
def test_an_environment_has_no_negative_pixel(chosen: str) -> None:
    mi.set_variant("llvm_ad_rgb")
    assert np.array(scenes.environment(chosen)["bitmap"]).min() >= 0
