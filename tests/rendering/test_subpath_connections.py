"""What connections bring to an event in a slab, against single scattering there, by quadrature of its formula."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from rendered import direction, sun
from scipy.special import exp1

from halfspace_sss.physics.fresnel import F_r, mu_internal
from halfspace_sss.physics.medium import eval_hg

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

from full_geometry.objects.small_emitters import SmallEmitters  # noqa: E402
from full_geometry.walk import emitter_connections  # noqa: E402
from full_geometry.walk.emitter_connections import STEEPEST, SubpathConnections, find_connections  # noqa: E402
from full_geometry.walk.media import WalkMedia  # noqa: E402
from full_geometry.walk.random_walk import Event  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

WIDEST_Z = 4.4  # two-sided 1e-5
LANES = 2**18
HEIGHT = 50.0  # of the slab, whose top is z = 0
SIGMA_T, ALBEDO = np.array([0.7, 1.0, 1.5]), np.array([0.9, 0.5, 0.2])
MATCHED = 1 + 1e-6  # index of a boundary that hardly refracts; through 1 light goes straight to events
ALONG = direction(130.0, 0.4)  # of arrival at the event


class Beam(NamedTuple):
    """Parallel light inside the slab: its direction and its irradiance across that at the event."""

    d: np.ndarray
    E: np.ndarray


def connections_of(lights: dict, g: float = 0.0, eta: float = MATCHED, albedo: Any = ALBEDO, height: float = HEIGHT,
             share: float = 1.0, shape: dict | None = None) -> SubpathConnections:  # fmt: skip
    """Of lights over a wide slab."""
    sigma_s, sigma_a = (",".join(f"{x:.9g}" for x in part) for part in (albedo * SIGMA_T, (1 - albedo) * SIGMA_T))
    at = mi.ScalarTransform4f()
    slab = {"type": "cube", "to_world": at.translate([0, 0, -height / 2]).scale([60, 60, height / 2])}
    bsdf = {"type": "translucent", "sigma_s": sigma_s, "sigma_a": sigma_a, "g": g, "eta": eta}
    scene = mi.load_dict({"type": "scene", "slab": {**(shape or slab), "bsdf": bsdf}, **lights})
    return find_connections(scene, WalkMedia.of(scene, 1.0), SmallEmitters.of(scene), share)


def slab_of_normal(path: Path, n: np.ndarray) -> dict:
    """The wide slab, with the shading normal n on its top and geometric ones elsewhere."""
    lines = [f"v {x} {y} {z}" for z in (-HEIGHT, 0) for x, y in ((-60, -60), (60, -60), (60, 60), (-60, 60))]
    sides = [("1 4 3 2", [0, 0, -1]), ("5 6 7 8", n), ("1 2 6 5", [0, -1, 0]), ("2 3 7 6", [1, 0, 0]),
             ("3 4 8 7", [0, 1, 0]), ("4 1 5 8", [-1, 0, 0])]  # fmt: skip
    for k, (corners, normal) in enumerate(sides, 1):
        a, b, c, d = (f"{corner}//{k}" for corner in corners.split())
        lines += [f"vn {normal[0]} {normal[1]} {normal[2]}", f"f {a} {b} {c}", f"f {a} {c} {d}"]
    path.write_text("\n".join(lines))
    return {"type": "obj", "filename": str(path)}


def brought(connections: SubpathConnections, depth: float, lanes: int = LANES) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error, per channel, of what connections bring to an event at a depth."""
    k = dr.full(mi.Int32, 0, lanes)
    p = mi.Point3f(dr.full(mi.Float, 0, lanes), 0, -depth)
    event = Event(p, mi.Vector3f(*ALONG.tolist()), k, connections.media.coefficients(k, p))
    L = np.array(connections.light(event, generator(mi, lanes, pass_seed(1)))[0])
    return L.mean(axis=1), L.std(axis=1, ddof=1) / np.sqrt(lanes)


def about_the_event(n: int = 96) -> tuple[np.ndarray, np.ndarray]:
    """Directions (n, n, 3) and their solid angles (n, n)."""
    x, weights = np.polynomial.legendre.leggauss(n)
    halves = np.concatenate([(x - 1) / 2, (x + 1) / 2])  # the rays that meet the top, and those that do not
    phi = 2 * np.pi * (np.arange(n) + 0.5) / n
    c, s = halves[:, None], np.sqrt(1 - halves**2)[:, None]
    u = np.stack(np.broadcast_arrays(s * np.cos(phi), s * np.sin(phi), c), axis=-1)
    return u, np.broadcast_to(np.tile(weights, 2)[:, None] * np.pi / n, u.shape[:2])


def scattered(beams: list[Beam], depth: float, g: float, albedo: np.ndarray = ALBEDO, height: float = HEIGHT):
    """Radiance of single scattering that an event turns by, per channel:

    sigma_s ∫ p(along.u) p(-u.d) ∫ E(q) e^(-sigma_t R) dR dw_u, with q = p + R u and E(q) = E e^(-sigma_t R u_z / d_z)
    """
    u, solid = about_the_event()
    reach = np.where(u[..., 2] > 0, depth, height - depth) / np.abs(u[..., 2])
    total = np.zeros(3)
    for d, E in beams:
        phases = eval_hg(u @ ALONG, g) * eval_hg(-u @ d, g)
        rate = 1 + u[..., 2] / d[2]
        for c, sigma in enumerate(SIGMA_T):
            along_u = -np.expm1(-sigma * rate * reach) / rate  # sigma_t times the integral over R
            total[c] += albedo[c] * E[c] * np.sum(solid * phases * along_u)
    return total


def refracted(theta: float, phi: float, depth: float, eta: float = 1.0, height: float = HEIGHT) -> list[Beam]:
    """The beams that light of irradiance 1 across its direction makes in the slab: the ones down and the ones up."""
    mu_i = np.cos(np.radians(theta))
    mu, F = float(mu_internal(mu_i, eta)), float(F_r(np.float64(mu_i), eta))
    down = -np.array([np.sqrt(1 - mu * mu) * np.cos(phi), np.sqrt(1 - mu * mu) * np.sin(phi), mu])
    T = np.exp(-SIGMA_T / mu)
    enters = mu_i / mu * (1 - F) / (1 - F**2 * T ** (2 * height))
    return [Beam(down, enters * T**depth), Beam(down * [1, 1, -1], enters * F * T ** (2 * height - depth))]


def agree(found: tuple[np.ndarray, np.ndarray], wanted: np.ndarray, known_to: float = 0.015) -> None:
    mean, error = found
    assert np.abs((mean - wanted) / error).max() < WIDEST_Z
    assert (error < known_to * wanted).all()


@pytest.mark.parametrize(
    ("g", "theta", "depth"), [(0.0, 0.0, 1.0), (0.0, 60.0, 0.1), (0.6, 40.0, 2.0), (-0.5, 75.0, 0.5)]
)
def test_connections_bring_light_that_scatters_once_on_its_way_to_the_event(
    g: float, theta: float, depth: float
) -> None:
    connections = connections_of({"sun": sun(theta, 0.9)}, g)
    agree(brought(connections, depth), scattered(refracted(theta, 0.9, depth), depth, g))


def test_light_from_above_is_met_in_closed_form() -> None:
    """E1(t) + e^(-t) (ln t + gamma + ln 2), at the optical depth t, times albedo / (8 pi) for isotropic scattering."""
    t = SIGMA_T * 0.8
    wanted = ALBEDO / (8 * np.pi) * (exp1(t) + np.exp(-t) * (np.log(t) + np.euler_gamma + np.log(2)))
    np.testing.assert_allclose(scattered(refracted(0.0, 0.0, 0.8), 0.8, 0.0), wanted, rtol=1e-3)
    agree(brought(connections_of({"sun": sun(0.0, 0.0)}), 0.8), wanted)


@pytest.mark.parametrize(("eta", "theta"), [(1.5, 78.0), (0.8, 52.0)])
def test_connections_follow_the_light_that_the_boundary_reflects(eta: float, theta: float) -> None:
    """A thin slab, in which beams go up and down, of a medium that hardly scatters, so that nothing scatters twice."""
    depth, height, albedo = 0.2, 0.25, np.array([1e-4, 2e-4, 3e-4])
    beams = refracted(theta, 0.9, depth, eta, height)
    wanted = scattered(beams, depth, 0.4, albedo, height)
    assert (scattered(beams[1:], depth, 0.4, albedo, height) > 0.05 * wanted).all()
    connections = connections_of({"sun": sun(theta, 0.9)}, 0.4, eta, albedo, height)
    agree(brought(connections, depth), wanted, known_to=0.025)


@pytest.mark.parametrize("theta, tilt", [(35.0, 20.0), (80.0, 15.0)], ids=["above", "below its horizon"])
def test_shading_normals_bend_the_light_and_geometric_ones_hold_its_width(theta, tilt, tmp_path) -> None:
    """E (1 - F) cos_i / cos_t about the shading normal n of the top, along the ray that it refracts.

    Of light from below the horizon of n that is the one of the opposite direction.
    """
    eta, depth, g, w = 1.4, 0.6, 0.3, direction(theta, 0.9)
    n = direction(tilt, 0.9 + np.pi)
    mu_i, side = abs(float(w @ n)), np.sign(w @ n)
    mu, F = float(mu_internal(mu_i, eta)), float(F_r(np.float64(mu_i), eta))
    d = (mu_i / eta - mu) * n - side * w / eta
    beam = Beam(d, mu_i / mu * (1 - F) * np.exp(SIGMA_T * depth / d[2]))
    albedo = 1e-4 * ALBEDO
    connections = connections_of(
        {"sun": sun(theta, 0.9)}, g, eta, albedo, shape=slab_of_normal(tmp_path / "slab.obj", n)
    )
    agree(brought(connections, depth), scattered([beam], depth, g, albedo), known_to=0.02)


@pytest.mark.slow
def test_connections_bring_the_light_of_a_point_that_comes_steeply() -> None:
    depth, g, intensity, lamp = 0.7, 0.3, 200.0, np.array([0.3, 0.2, 0.3])
    connections = connections_of({"lamp": {"type": "point", "position": lamp.tolist(), "intensity": intensity}}, g)
    u, solid = about_the_event()
    t = (np.arange(300) + 0.5) / 300
    R, dR = 8 * t * t, 16 * t / 300  # beyond which little comes
    q = R[:, None, None, None] * u - [0, 0, depth]
    way = q - lamp
    far, straight = np.linalg.norm(way, axis=-1), -lamp - [0, 0, depth]
    reaches = (q[..., 2] < 0) & (way @ straight > STEEPEST * far * np.linalg.norm(straight))
    down = np.where(reaches, -way[..., 2] / far, 1)
    value = np.where(reaches, intensity / far**2, 0) * eval_hg(u @ ALONG, g) * eval_hg((way * -u).sum(axis=-1) / far, g)
    weights, lengths = dR[:, None, None] * solid * value, R[:, None, None] - q[..., 2] / down
    wanted = [a * sigma * np.sum(weights * np.exp(-sigma * lengths)) for a, sigma in zip(ALBEDO, SIGMA_T)]
    agree(brought(connections, depth, 4 * LANES), np.array(wanted), known_to=0.006)


def test_lights_add_up_whatever_the_share_of_events_that_are_connected() -> None:
    lights = {"a": sun(20.0, 0.9), "b": {**sun(60.0, 3.0), "irradiance": 3.0}}
    beams = refracted(20.0, 0.9, 0.6) + [Beam(d, 3 * E) for d, E in refracted(60.0, 3.0, 0.6)]
    agree(brought(connections_of(lights, share=0.4), 0.6), scattered(beams, 0.6, 0.0), known_to=0.02)


def test_light_behind_another_object_is_not_brought() -> None:
    screen = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, 5]).scale(100)}
    mean, _ = brought(connections_of({"sun": sun(30.0, 0.0), "screen": screen}), 0.5)
    assert (mean == 0).all()


def test_connections_cover_the_rays_that_come_steeply_from_an_emitter_that_looks_small() -> None:
    def lamp(x: float, z: float, radius: float) -> dict:
        return {"type": "sphere", "center": [x, 0, z], "radius": radius, "emitter": {"type": "area"}}

    connections = connections_of({"a": lamp(0.0, 10.0, 1.0), "b": lamp(20.0, 13.0, 12.5), "sky": {"type": "constant"}})
    assert len(connections.small.emitters) == 2
    small, large, none = 0, 1, -1
    pivot = mi.Point3f(0, 0, -1)

    def covered(k: int, y: list, w: list) -> bool:
        return bool(connections.covers(mi.Int32(k), mi.Point3f(y), dr.normalize(mi.Vector3f(w)), pivot)[0])

    assert covered(small, [0, 0, 9], [0, 0, 1]) and covered(small, [0, 0, 9], [1.5, 0, 1])
    assert not covered(small, [0, 0, 9], [2, 0, 1])  # 63 degrees from the direction to the emitter
    assert not covered(small, [0, 0, 9], [0, 0, -1])  # arrives from beyond the event
    assert not covered(large, [20, 0, 2], [20, 0, 11])  # looks larger than half its distance
    assert not covered(none, [0, 0, 9], [0, 0, 1])


def test_scenes_without_small_emitters_or_smooth_objects_have_no_connections() -> None:
    assert connections_of({"sky": {"type": "constant"}}) is None
    assert connections_of({"sun": sun(0.0, 0.0)}, share=0.0) is None


@pytest.mark.parametrize("unit", [1e-7, 1e7])
def test_events_on_a_ray_are_drawn_the_same_in_any_unit_of_length(unit: float) -> None:
    """Also where the ray passes the event by a thousandth of the way to it."""
    d, across = (mi.Vector3f(*v) for v in ([0.6, 0, 0.8], [0, 1, 0]))
    found = []
    for u in (1.0, unit):
        far, near = np.array([0.5, 3.0, 3.0]) * u, np.array([0.1, 1e-3, 3e-3]) * u
        event = SimpleNamespace(p=mi.Point3f(d * mi.Float(far) + across * mi.Float(near)))
        t, inverse = emitter_connections._on_ray(SimpleNamespace(o=mi.Point3f(0), d=d), event, mi.Float(0.5))
        found.append((np.array(t) / u, np.array(inverse) * u))
    np.testing.assert_allclose(*found, rtol=1e-3)
