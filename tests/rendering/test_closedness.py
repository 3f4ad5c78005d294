"""Whether a mesh is closed is told by its edges, wherever it stands."""

from __future__ import annotations

import warnings

import mitsuba as mi
import numpy as np
import pytest

from full_geometry.geometry.shape import Geometry, analyse_shape, faces_of

pytestmark = pytest.mark.usefixtures("rgb")


def _mesh(vertices: np.ndarray, faces: np.ndarray) -> mi.Mesh:
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(np.ravel(vertices).astype(np.float32))
    parameters["faces"] = mi.UInt32(np.ravel(faces).astype(np.uint32))
    parameters.update()
    return mesh


def _ball(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball of n x 2 n quadrangles, of which those at the poles have no length on one side."""
    theta, phi = np.meshgrid(
        np.linspace(0, np.pi, n + 1), np.linspace(0, 2 * np.pi, 2 * n, endpoint=False), indexing="ij"
    )
    sine = np.sin(theta)
    sine[[0, -1]] = 0
    vertices = np.stack([sine * np.cos(phi), sine * np.sin(phi), np.cos(theta)], axis=-1).reshape(-1, 3)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(n), np.arange(2 * n), indexing="ij"))
    a, b, c, d = (2 * n * (i + x) + (j + y) % (2 * n) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def _surveyed(vertices: np.ndarray, faces: np.ndarray, to: str = "error") -> Geometry:
    with warnings.catch_warnings():
        warnings.simplefilter(to)
        return analyse_shape(_mesh(vertices, faces))


PLACES = [np.zeros(3), *10.0 ** np.arange(1, 5)[:, None] * [[1, -0.3, 0.7], [0, 1, 0], [-0.2, 0.1, 1], [1, 1, 1]]]


@pytest.mark.parametrize("size", [1.0, 2.5])
def test_a_closed_mesh_is_closed_wherever_it_stands(size: float) -> None:
    """Up to where a face is a few steps of float32."""
    vertices, faces = _ball(24)
    for at in PLACES:
        found = _surveyed(size * vertices + at, faces)
        assert found.closed and found.upright


def test_a_die_is_closed_at_ten_metres_from_the_origin() -> None:
    """Where of 2842 rays one passed through an edge."""
    t = mi.ScalarTransform4f()
    die = {"type": "cube", "to_world": t.translate([1e4, 0, 0]).rotate([0, 0, 1], 30).scale(2.5)}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert analyse_shape(mi.load_dict(die)).closed


def test_a_mesh_without_one_of_its_faces_is_open_and_with_an_edge_of_four_faces_closed() -> None:
    vertices, faces = _ball(24)
    assert not faces_of(_mesh(vertices, np.delete(faces, 600, axis=0)), "ball").closed
    assert not _surveyed(vertices, faces[: len(faces) // 2], "ignore").closed
    box, sides = np.array(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), dtype=float).reshape(3, 8).T, []
    for k in range(3):
        for end in (0, 1):
            a, b, c, d = np.flatnonzero(box[:, k] == end)[[0, 1, 3, 2]]
            sides += [[a, b, c], [a, c, d]] if (end == 1) == (k != 1) else [[a, c, b], [a, d, c]]
    two = np.concatenate([box, box + [1, 1, 0]]), np.concatenate([sides, np.array(sides) + 8])  # share an edge
    assert _surveyed(*two).closed


def test_a_mesh_whose_faces_touch_without_sharing_edges_is_looked_at_with_rays() -> None:
    """One side of a square prism is of three triangles, with a corner in the middle of an edge of its neighbour."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1],
                         [0.5, 0, 1]])  # fmt: skip
    faces = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 8], [1, 5, 8], [0, 8, 4], [1, 2, 6], [1, 6, 5],
                      [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7]])  # fmt: skip
    assert not faces_of(_mesh(vertices, faces), "prism").closed
    assert _surveyed(vertices, faces).closed


@pytest.mark.parametrize("kind", ["rectangle", "disk"])
@pytest.mark.parametrize("side", [0, 180])
def test_walks_refuse_a_sheet_whichever_side_it_shows(kind: str, side: float) -> None:
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], side + 20).scale(5)
    sheet = {"type": kind, "to_world": to_world, "bsdf": {"type": "translucent", "material": "marble"}}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "translucent_walk"}, "sheet": sheet,
                          "sky": {"type": "constant"}, "cam": {"type": "perspective"}})  # fmt: skip
    with pytest.raises(ValueError, match="must have an inside for translucent_walk, got object 'sheet', which 100 %"):
        with pytest.warns(UserWarning, match="is not closed"):
            scene.integrator().render(scene, spp=1)
