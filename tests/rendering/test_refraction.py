"""Rays through the boundary of a body, against Snell's law and Fresnel's equations in plain NumPy."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from rendered import surface

import full_geometry

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

from full_geometry.integrators import specular_connections  # noqa: E402
from full_geometry.integrators.specular_connections import refracted_connection  # noqa: E402
from halfspace_sss.physics.fresnel import F_t, mu_external  # noqa: E402

ETA, RADIUS, N = 1.4, 2.0, 400


def ball_of(unit: float, shape: dict | None = None):
    """A ball, or another shape, in units of so many mm."""
    shape = {**(shape or {"type": "sphere", "radius": RADIUS / unit}), "bsdf": surface()}
    integrator = {"type": "bssrdf", "mm_per_unit": unit}
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sky": {"type": "constant"}, "s": shape})
    return scene.integrator().prepare(scene)[0]


@pytest.fixture
def ball():
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    return ball_of(1.0)


def directions(seed: int) -> np.ndarray:
    d = np.random.default_rng(seed).standard_normal((3, N))
    return d / np.linalg.norm(d, axis=0)


def points(seed: int, nearest: float) -> np.ndarray:
    """Inside the ball, some close below its surface."""
    return directions(seed) * RADIUS * np.random.default_rng(seed).uniform(nearest, 0.98, N)


def where(found, valid) -> np.ndarray:
    return np.array(found)[..., np.array(valid)]


def snell(d: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Sine of the angle outside times the unit vector along the surface, ETA times that inside."""
    return ETA * (d - n * (d * n).sum(axis=0))


class Passage(NamedTuple):
    """Rays that leave the ball: point, direction outside, transmittance, length inside, whether they do."""

    p: np.ndarray
    w: np.ndarray
    T: np.ndarray
    length: np.ndarray
    valid: np.ndarray


def leave(p: np.ndarray, d: np.ndarray) -> Passage:
    """Rays from p along d, in closed form."""
    b = (p * d).sum(axis=0)
    length = -b + np.sqrt(b * b + RADIUS**2 - (p * p).sum(axis=0))
    n = (p + length * d) / RADIUS
    along = snell(d, n)
    outer = np.sqrt(np.maximum(1 - (along * along).sum(axis=0), 0))
    return Passage(RADIUS * n, along + n * outer, F_t(outer, ETA), length, outer > 0)


def test_cosines_of_snells_law_agree_with_those_of_the_models() -> None:
    d = directions(2)
    out = leave(points(1, 0.0), d)
    n = out.p / RADIUS
    inner, outer = (d * n).sum(axis=0)[out.valid], (out.w * n).sum(axis=0)[out.valid]
    assert 50 < out.valid.sum() < N - 20
    np.testing.assert_allclose(outer, mu_external(inner, ETA), atol=1e-6)


def test_a_connection_is_a_ray_that_leaves_towards_its_target(ball) -> None:
    p, target = points(3, 0.7), directions(4) * 8
    met = refracted_connection(ball, mi.Point3f(p), mi.Point3f(target), mi.Bool(True))
    out, valid = leave(p, np.array(met.d, dtype=np.float64)), np.array(met.valid)
    assert valid.sum() > N // 4 and out.valid[valid].all()
    for name, within in (("p", 2e-4), ("w", 1e-3), ("T", 2e-3), ("length", 2e-4)):
        np.testing.assert_allclose(where(getattr(met, name), valid), getattr(out, name)[..., valid], atol=within)
    to = np.array(mi.Point3f(target) - met.p)
    missed = np.linalg.norm(np.cross(to, np.array(met.w), axis=0), axis=0) / np.linalg.norm(to, axis=0)
    assert missed[np.array(met.valid)].max() < 1.1e-3


def test_the_density_of_a_connection_is_how_its_target_spreads(ball) -> None:
    """Solid angle inside over area across the ray at the target, by moving the direction inside."""
    p, target = points(5, 0.7), directions(6) * 8
    met = refracted_connection(ball, mi.Point3f(p), mi.Point3f(target), mi.Bool(True))
    e_1, e_2 = mi.coordinate_system(met.d)
    h, columns = 1e-3, []
    for e in (e_1, e_2):
        ends = []
        for sign in (1, -1):
            d = np.array(met.d, dtype=np.float64) + sign * h * np.array(e, dtype=np.float64)
            out, w = leave(p, d / np.linalg.norm(d, axis=0)), np.array(met.w, dtype=np.float64)
            t = ((target - out.p) * w).sum(axis=0) / (out.w * w).sum(axis=0)  # to the plane across the ray
            ends.append(out.p + out.w * t)
        columns.append((ends[0] - ends[1]) / (2 * h))
    area = np.linalg.norm(np.cross(*columns, axis=0), axis=0)
    density, valid = np.array(met.density), np.array(met.valid)
    steep = np.array(met.T) > 0.9  # near the critical angle differences say nothing
    chosen = valid & steep & (area > 0.1)
    assert chosen.sum() > 50
    ratio = density[chosen] * area[chosen]
    assert np.median(np.abs(ratio - 1)) < 5e-3 and np.quantile(np.abs(ratio - 1), 0.9) < 0.05


def test_connections_are_the_same_in_any_unit_of_length(ball) -> None:
    p, target, unit = points(3, 0.7), directions(4) * 8, 1e7
    found = []
    for obj, u in ((ball, 1.0), (ball_of(unit), unit)):
        met = refracted_connection(obj, mi.Point3f(p / u), mi.Point3f(target / u), mi.Bool(True))
        found.append((np.array(met.valid), np.array(met.density) / u**2))
    valid = found[0][0] & found[1][0]
    assert valid.sum() > N // 4 and (found[0][0] != found[1][0]).mean() < 0.01  # by rounding
    ratio = found[1][1][valid] / found[0][1][valid]
    assert np.quantile(np.abs(ratio - 1), 0.9) < 1e-3


def octahedron(path, uv: bool) -> dict:
    """One with normals as round as a ball's."""
    corners, lines = RADIUS * np.concatenate([np.eye(3), -np.eye(3)]), []
    for x, y, z in corners:
        lines += [f"v {x} {y} {z}", f"vn {x / RADIUS} {y / RADIUS} {z / RADIUS}"]
        lines += [f"vt {0.3 * x} {x + z - y}"] if uv else []
    for flip in np.ndindex(2, 2, 2):
        face = [k + 3 * f for k, f in enumerate(flip)][:: 1 if sum(flip) % 2 == 0 else -1]
        lines.append("f " + " ".join(f"{c + 1}/{c + 1 if uv else ''}/{c + 1}" for c in face))
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path)}


def test_uv_of_a_mesh_change_no_connection(ball, tmp_path) -> None:
    """Mitsuba has derivatives of points by uv, but those of normals by barycentric coordinates."""
    p, target, found = 0.3 * points(3, 0.0), directions(4) * 8, []
    for uv in (False, True):
        obj = ball_of(1.0, octahedron(tmp_path / f"{uv}.obj", uv))
        assert obj.geometry.shape.has_vertex_texcoords() == uv
        met = refracted_connection(obj, mi.Point3f(p), mi.Point3f(target), mi.Bool(True))
        found.append((np.array(met.valid), np.array(met.density)))
    valid = found[0][0] & found[1][0]
    assert valid.sum() > N // 4 and (found[0][0] == found[1][0]).all()
    np.testing.assert_allclose(found[0][1][valid], found[1][1][valid], rtol=1e-3)


def test_a_connection_by_one_reflection_leaves_towards_its_target_and_knows_how_that_spreads(ball) -> None:
    """Against rays in closed form, from random starts; the density as in the test above."""
    p, target = points(5, 0.7), directions(6) * 8
    start = mi.Vector3f(directions(7))
    met = specular_connections.connect(
        ball, mi.Point3f(p), mi.Point3f(target), start, mi.Bool(True), specular_connections.OTHERS, mi.Bool(True)
    )
    valid, d, h = np.array(met.valid), np.array(met.d, dtype=np.float64), 1e-4

    def twice(d: np.ndarray) -> tuple[Passage, np.ndarray, np.ndarray]:
        first = leave(p, d / np.linalg.norm(d, axis=0))
        n, w = first.p / RADIUS, d / np.linalg.norm(d, axis=0)
        second = leave(first.p, w - 2 * n * (w * n).sum(axis=0))
        return second, first.length + second.length, 1 - first.valid * first.T

    out, length, R = twice(d)
    assert valid.sum() > N // 20 and out.valid[valid].all()
    to = target - out.p
    missed = np.linalg.norm(np.cross(to, out.w, axis=0), axis=0) / np.linalg.norm(to, axis=0)
    assert missed[valid].max() < 2e-3
    np.testing.assert_allclose(where(met.length, valid), length[valid], atol=1e-3)
    np.testing.assert_allclose(where(met.T, valid), (R * out.T)[valid], atol=5e-3)
    columns = []
    for e in mi.coordinate_system(met.d):
        ends = []
        for sign in (1, -1):
            moved = twice(d + sign * h * np.array(e, dtype=np.float64))[0]
            t = ((target - moved.p) * out.w).sum(axis=0) / (moved.w * out.w).sum(axis=0)
            ends.append(moved.p + moved.w * t)
        columns.append((ends[0] - ends[1]) / (2 * h))
    area = np.linalg.norm(np.cross(*columns, axis=0), axis=0)
    chosen = valid & (area > 0.1) & (out.T > 0.5)
    ratio = np.array(met.density)[chosen] * area[chosen]
    assert chosen.sum() > 10 and np.median(np.abs(ratio - 1)) < 0.01


def test_nothing_connects_where_nothing_is_asked_for(ball) -> None:
    p, target = points(3, 0.7), directions(4) * 8
    assert not dr.any(refracted_connection(ball, mi.Point3f(p), mi.Point3f(target), mi.Bool(False)).valid)
