"""Where walks leave an object: energy, the half-space, orders, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from halfspace_sss import Medium
from halfspace_sss.physics import single_scattering
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.tracing.tracer import trace

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

N = 2**17
WIDEST_Z = 4.4  # two-sided 1e-5


def _media(shape: dict, mm_per_unit: float = 1.0, **surface: object):
    from full_geometry.walk.media import WalkMedia

    scene = {"type": "scene", "object": {**shape, "bsdf": {"type": "translucent", **surface}}}
    return WalkMedia.of(mi.load_dict(scene), mm_per_unit)


def _slab() -> dict:
    """A box whose top, z = 0, is a half-space to walks that begin at the origin."""
    return {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, -500]).scale([2000, 2000, 500])}


def _start(mu: float, n: int = N):
    """Walks that enter at the origin with the cosine mu."""
    from full_geometry.geometry.points import SurfacePoint

    w = np.repeat([[np.sqrt(1 - mu * mu)], [0.0], [mu]], n, axis=1)
    up = np.repeat([[0.0], [0.0], [1.0]], n, axis=1)
    return SurfacePoint(mi.Point3f(np.zeros((3, n))), mi.Normal3f(up), mi.Normal3f(up), mi.Vector3f(w))


def _on_sphere(radius: float, n: int, diffuse: bool = False):
    """Random points of a sphere about the origin; directions within 70 degrees of its normals, or by the cosine."""
    from full_geometry.geometry.points import SurfacePoint

    rng = np.random.default_rng(3)
    up = rng.standard_normal((3, n))
    up /= np.linalg.norm(up, axis=0)
    w = rng.standard_normal((3, n))
    w = (1.0 if diffuse else 1.05) * up + w / np.linalg.norm(w, axis=0)
    w /= np.linalg.norm(w, axis=0)
    return SurfacePoint(mi.Point3f(radius * up), mi.Normal3f(up), mi.Normal3f(up), mi.Vector3f(w)), (up * w).sum(axis=0)


def _exits(*arguments: object, **options: object):
    from full_geometry.walk.random_walk import exits

    return exits(*arguments, **options)


def _check_mean(values: np.ndarray, expected: float, error: float = 0.0) -> None:
    z = (values.mean() - expected) / np.hypot(values.std() / np.sqrt(len(values)), error)
    assert abs(z) < WIDEST_Z, (values.mean(), expected, z)


def test_without_absorption_all_that_enters_a_sphere_leaves_it() -> None:
    media = _media({"type": "sphere", "radius": 5.0}, sigma_s="0.5,1,2", sigma_a=0.0, g=0.3, eta=1.5)
    start, mu = _on_sphere(5.0, N)
    out = _exits(media, 0, start, 1)
    left = np.array(out.left)
    assert left.mean() > 0.9999
    entered = 1 - F_r(mu, 1.5)
    for channel in np.array(out.T):
        _check_mean(channel - entered, 0.0)


def test_exits_lie_on_the_surface_with_directions_that_point_away_from_it() -> None:
    media = _media({"type": "sphere", "radius": 5.0}, sigma_s="0.5,1,2", sigma_a=0.01, eta=1.5)
    out = _exits(media, 0, _on_sphere(5.0, 4096)[0], 1)
    left = np.array(out.left)
    x, n, w = (np.array(a)[:, left] for a in (out.at.p, out.at.n_out, out.at.w))
    assert np.allclose(np.linalg.norm(x, axis=0), 5, atol=1e-3)
    assert np.allclose(n, x / 5, atol=1e-3)
    assert np.all((n * w).sum(axis=0) > 0)


def test_exits_of_a_large_slab_carry_the_reflectance_of_the_half_space() -> None:
    media = _media(_slab(), sigma_s="1,0.8,0.3", sigma_a="0.01,0.2,0.7", g=0.5, eta=1.4)
    throughput = np.array(_exits(media, 0, _start(0.6), 2).T)
    for values, (s, a) in zip(throughput, ((1.0, 0.01), (0.8, 0.2), (0.3, 0.7))):
        expected = trace(Medium(s, a, 0.5, 1.4), 0.6, n_paths=2**19).reflectance()
        _check_mean(values, expected.value, expected.standard_error)


@pytest.mark.parametrize(("radius", "away"), [(1000.0, 0.0), (5.0, 100.0)], ids=["large", "small and far away"])
def test_a_ball_of_many_mean_free_paths_reflects_diffuse_light_as_the_half_space(radius: float, away: float) -> None:
    """Rounding of positions, or what keeps rays clear of the surface, must not lay walks deeper."""
    scale = 1000 / radius  # mean free paths in a scene unit
    colours = {"sigma_s": "0.99,0.75,0.3", "sigma_a": "0.01,0.25,0.7", "g": "0,0.3,0", "eta": 1.4}
    media = _media({"type": "sphere", "radius": radius, "center": [away, 0, 0]}, scale, **colours)
    start, _ = _on_sphere(radius, N, diffuse=True)
    start = start._replace(p=mi.Point3f(start.p + mi.Vector3f(away, 0, 0)))
    out = _exits(media, 0, start, 9)
    order = np.array(out.order)
    for values, s, a, g in zip(np.array(out.T), (0.99, 0.75, 0.3), (0.01, 0.25, 0.7), (0.0, 0.3, 0.0)):
        plane = trace(Medium(s, a, g, 1.4), "diffuse", 200_000, 5)
        for name, kept in (("single", order == 1), ("multiple", order > 1)):
            expected = plane.reflectance(name)
            # the last part is the curvature of the ball
            error = np.hypot(expected.standard_error, 1e-3 / WIDEST_Z * expected.value)
            _check_mean(values * kept, expected.value, error)


def test_walks_count_their_scattering_events() -> None:
    media = _media(_slab(), sigma_s="1,0.8,0.3", sigma_a="0.01,0.2,0.7", g=0.5, eta=1.4)
    out = _exits(media, 0, _start(0.6), 3)
    once = np.array(out.order) == 1
    for values, (s, a) in zip(np.array(out.T), ((1.0, 0.01), (0.8, 0.2), (0.3, 0.7))):
        _check_mean(values * once, single_scattering.reflectance(Medium(s, a, 0.5, 1.4), 0.6))


def test_a_visitor_sees_every_scattering_event() -> None:
    import drjit as dr

    from full_geometry.walk.random_walk import ExitVisitor, walk_from

    n = 4096
    media = _media({"type": "sphere", "radius": 2.0}, sigma_s="1,0.8,0.3", sigma_a="0.01,0.2,0.7", g=0.5, eta=1.4)
    start, events = _on_sphere(2.0, n)[0], dr.zeros(mi.UInt32, n)

    class Counter(ExitVisitor):
        def event(self, walk: Any, record: Any, event: Any) -> tuple[Any, Any]:
            dr.scatter_add(events, mi.UInt32(1), record)
            return walk, record

    out = _exits(media, 0, start, 7)
    walk_from(media, 0, start, Counter.of(n), 7)
    left = np.array(out.left)
    assert np.array_equal(np.array(events)[left], np.array(out.order)[left])


def test_an_object_of_multiple_scattering_has_no_exits_of_lower_orders() -> None:
    sphere = {"type": "sphere", "radius": 1.0}
    out = _exits(_media(sphere, sigma_s=1.0, sigma_a=0.1, orders="multiple"), 0, _on_sphere(1.0, 4096)[0], 4)
    assert np.array(out.order)[np.array(out.left)].min() == 2


def test_a_walk_whose_direction_is_below_the_surface_never_enters() -> None:
    start = _start(0.6, 8)
    start = start._replace(w=-start.w)
    out = _exits(_media(_slab(), sigma_s=1.0, sigma_a=0.1), 0, start, 5)
    assert not np.array(out.left).any()
    assert not np.array(out.T).any()


def test_each_object_of_a_scene_has_exits_of_its_own() -> None:
    from full_geometry.walk.media import WalkMedia

    def ball(x: float, eta: float, sigma_a: float) -> dict:
        surface = {"type": "translucent", "sigma_s": 1.0, "sigma_a": sigma_a, "eta": eta}
        return {"type": "sphere", "center": [x, 0, 0], "radius": 2.0, "bsdf": surface}

    scene = {"type": "scene", "a": ball(20, 1.2, 0.5), "b": ball(0, 1.5, 0.0), "c": ball(-20, 1.4, 0.5)}
    media = WalkMedia.of(mi.load_dict(scene), 1.0)
    start, mu = _on_sphere(2.0, 2**14)
    middle = [k for k, obj in enumerate(media.objects) if abs(obj.scene.bbox().center().x) < 1]
    throughput = np.array(_exits(media, middle[0], start, 8).T)
    assert np.mean(np.abs(throughput - (1 - F_r(mu, 1.5)))) < 1e-4  # rounding lets a walk escape now and then


def test_a_rough_boundary_lets_walks_in_and_out() -> None:
    rough = {"type": "roughdielectric", "int_ior": 1.3, "ext_ior": 1.0, "alpha": 0.05}
    out = _exits(_media(_slab(), sigma_s=1.0, sigma_a=0.5, eta=1.3, b=rough), 0, _start(0.9), 6)
    expected = trace(Medium(1.0, 0.5, 0.0, 1.3), 0.9, n_paths=2**18).reflectance()
    assert np.array(out.T)[0].mean() == pytest.approx(expected.value, rel=0.02)


def test_numbers_of_objects_and_lengths_that_do_not_fit_are_refused() -> None:
    media = _media(_slab(), sigma_s=1.0, sigma_a=0.5)
    with pytest.raises(ValueError, match=r"k must be a whole number in \[0, 0\], got 1"):
        _exits(media, 1, _start(0.6, 8), 1)
    start = _start(0.6, 8)
    start = start._replace(n=mi.Normal3f(0, 0, 1))
    with pytest.raises(ValueError, match=r"p, n, n_out and w of the starts must be of one length, got \[8, 1, 8, 8\]"):
        _exits(media, 0, start, 1)
