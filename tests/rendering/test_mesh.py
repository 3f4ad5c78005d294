"""Attributes of Mitsuba's meshes are read and written by `geometry.mesh` alone."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("halfspace_sss", "analytic_models", "full_geometry", "figures", "benchmarks")
HOME = "full_geometry/geometry/mesh.py"
PARAMETERS = {"vertex_positions", "vertex_normals", "vertex_texcoords"}
METHODS = {"has_flipped_normals", "face_indices", "vertex_position", "vertex_normal", "vertex_texcoord"}
FOR_3_10 = (
    "For Mitsuba 3.10: change POSITIONS, NORMALS and TEXCOORDS in geometry/mesh.py to its names (`positions`, ...), "
    "let is_flipped answer False for meshes, whose faces and normals are then turned when they are loaded, and raise "
    "the bounds in pyproject.toml."
)


def _touched(path: Path) -> list[str]:
    nodes = list(ast.walk(ast.parse(path.read_text())))
    keys = [node.slice for node in nodes if isinstance(node, ast.Subscript)]
    keys += [node.left for node in nodes if isinstance(node, ast.Compare)]
    found = [key.value for key in keys if isinstance(key, ast.Constant) and key.value == "faces"]
    found += [node.value for node in nodes if isinstance(node, ast.Constant) and node.value in PARAMETERS]
    return found + [node.attr for node in nodes if isinstance(node, ast.Attribute) and node.attr in METHODS]


@pytest.mark.parametrize("package", PACKAGES)
def test_one_module_knows_the_attributes_of_meshes(package: str) -> None:
    paths = {str(path.relative_to(ROOT)): path for path in (ROOT / package).rglob("*.py")}
    touched = {name: found for name, path in paths.items() if name != HOME and (found := _touched(path))}
    assert paths and not touched, f"use full_geometry.geometry.mesh in place of {touched}. {FOR_3_10}"


def test_that_module_is_seen_to_touch_them() -> None:
    assert METHODS <= set(_touched(ROOT / HOME))


def test_versions_that_rename_them_are_excluded() -> None:
    bounds = re.findall(r'"(?:mitsuba|drjit)>=[\d.]+,<([\d.]+)"', (ROOT / "pyproject.toml").read_text())
    assert sorted(bounds) == ["1.6", "3.10"], FOR_3_10


def test_a_mesh_is_read_as_it_was_filled(rgb: None) -> None:
    import mitsuba as mi

    from full_geometry.geometry import mesh

    corners, faces = np.array([[0, 0, 0], [2, 0, 0], [0, 2, 0], [0, 0, 2]], float), np.array([[0, 2, 1], [0, 1, 3]])
    made = mi.Mesh("two", 4, 2, has_vertex_normals=True)
    mesh.fill(made, corners, faces)
    mesh.set_vertex_normals(made, np.tile([0.0, 0.6, 0.8], (4, 1)))
    assert np.array_equal(mesh.face_vertices(made), faces) and np.array_equal(mesh.vertex_positions(made), corners)
    assert np.allclose(mesh.vertex_normals(made), [0.0, 0.6, 0.8]) and not mesh.is_flipped(made)
    assert np.array_equal(mesh.face_corners(made)[1], corners[faces[:, 1]])
    vertices = mesh.vertices_of(made, mi.UInt32([1, 0]))
    assert np.array_equal(np.array(mesh.positions_at(made, vertices)[2]), corners[[3, 1]].T)
    assert np.allclose(np.array(mesh.normals_at(made, vertices)[0])[:, 0], [0.0, 0.6, 0.8])
    cube = mi.load_dict({"type": "cube", "flip_normals": True})
    assert mesh.is_flipped(cube) and [key for key, _ in mesh.attributes(cube)] == [mesh.TEXCOORDS]
    assert not mesh.has_faces(mi.load_dict({"type": "sphere"}))
