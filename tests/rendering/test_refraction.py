"""Rays through the boundary of a body, against Snell's law and Fresnel's equations in plain NumPy."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import surface

import halfspace_sss.rendering as rendering

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

from halfspace_sss.physics.fresnel import F_t, mu_external  # noqa: E402
from halfspace_sss.rendering.paths.refraction import leave, refracted_connection  # noqa: E402

ETA, RADIUS, N = 1.4, 2.0, 400


@pytest.fixture
def ball():
    mi.set_variant("llvm_ad_rgb")
    rendering.register()
    shape = {"type": "sphere", "radius": RADIUS, "bsdf": surface()}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "bssrdf"}, "sky": {"type": "constant"}, "s": shape})
    return scene.integrator().prepare(scene)[0]


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


def test_a_ray_leaves_by_snells_law_with_fresnels_transmittance(ball) -> None:
    p, d = points(1, 0.0), directions(2)
    out = leave(ball, mi.Point3f(p), mi.Vector3f(d), mi.Bool(True))
    b = (p * d).sum(axis=0)
    length = -b + np.sqrt(b * b + RADIUS**2 - (p * p).sum(axis=0))
    n = (p + length * d) / RADIUS
    c, passes = (d * n).sum(axis=0), np.linalg.norm(snell(d, n), axis=0) < 1
    np.testing.assert_array_equal(np.array(out.valid), passes)
    assert 50 < passes.sum() < N - 20
    np.testing.assert_allclose(where(out.length, out.valid), length[passes], atol=1e-4)
    np.testing.assert_allclose(where(out.p, out.valid), RADIUS * n[:, passes], atol=1e-4)
    w = where(out.w, out.valid)
    np.testing.assert_allclose(np.linalg.norm(w, axis=0), 1, atol=1e-5)
    np.testing.assert_allclose(w - n[:, passes] * (w * n[:, passes]).sum(axis=0), snell(d, n)[:, passes], atol=2e-4)
    inner = c[passes]
    outer = np.sqrt(np.maximum(1 - ETA**2 * (1 - inner**2), 0))
    np.testing.assert_allclose(where(out.T, out.valid), F_t(outer, ETA), atol=2e-3)
    np.testing.assert_allclose(outer, mu_external(inner, ETA), atol=1e-6)


def test_a_connection_is_a_ray_that_leaves_towards_its_target(ball) -> None:
    p, target = points(3, 0.7), directions(4) * 8
    met = refracted_connection(ball, mi.Point3f(p), mi.Point3f(target), mi.Bool(True))
    out = leave(ball, mi.Point3f(p), met.d, met.valid)
    assert np.array(met.valid).sum() > N // 4 and np.array(out.valid | ~met.valid).all()
    for name in ("p", "w", "T", "length"):
        np.testing.assert_allclose(
            where(getattr(met, name), met.valid), where(getattr(out, name), met.valid), atol=2e-4
        )
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
            out = leave(ball, mi.Point3f(p), dr.normalize(met.d + sign * h * e), met.valid)
            t = dr.dot(mi.Point3f(target) - out.p, met.w) / dr.dot(out.w, met.w)  # to the plane across the ray
            ends.append(out.p + out.w * t)
        columns.append(np.array((ends[0] - ends[1]) / (2 * h)))
    area = np.linalg.norm(np.cross(*columns, axis=0), axis=0)
    density, valid = np.array(met.density), np.array(met.valid)
    steep = np.array(met.T) > 0.9  # near the critical angle differences say nothing
    chosen = valid & steep & (area > 0.1)
    assert chosen.sum() > 50
    ratio = density[chosen] * area[chosen]
    assert np.median(np.abs(ratio - 1)) < 5e-3 and np.quantile(np.abs(ratio - 1), 0.9) < 0.05


def test_light_that_grazes_from_within_finds_no_way_out(ball) -> None:
    p = mi.Point3f(0, 0, 0.999 * RADIUS)
    assert not dr.any(leave(ball, p, mi.Vector3f(1, 0, 0), mi.Bool(True)).valid)
    assert not dr.any(leave(ball, p, mi.Vector3f(0, 0, 1), mi.Bool(False)).valid)
