"""Light of lamps that leaves a slab straight from an event, against quadrature over the directions that see them."""

from __future__ import annotations

import numpy as np
import pytest
from rendered import direction

from halfspace_sss.physics.fresnel import F_t
from halfspace_sss.physics.medium import eval_hg

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

from full_geometry.objects.small_emitters import SmallEmitters  # noqa: E402
from full_geometry.walk.emitter_connections import Departure, EmitterDirections, find_directions  # noqa: E402
from full_geometry.walk.media import WalkMedia  # noqa: E402
from full_geometry.walk.random_walk import Event  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

WIDEST_Z = 4.4  # two-sided 1e-5
LANES, GRID = 2**17, 1200
ETA, G, DEPTH = 1.4, 0.7, 0.8
SIGMA_T = np.array([0.7, 1.0, 1.5])
ALONG = direction(25.0, 0.8)  # of arrival at the event
LAMPS = [(np.array([1.6, 0.2, 2.5]), 0.9, 5.0), (np.array([-0.7, 1.5, 2.2]), 0.8, 8.0)]  # centre, radius, radiance


def directions() -> EmitterDirections:
    """Over a slab whose top is z = 0."""
    at = mi.ScalarTransform4f()
    sigma_s, sigma_a = (",".join(f"{x:.9g}" for x in part * SIGMA_T) for part in (0.5, 0.5))
    bsdf = {"type": "translucent", "sigma_s": sigma_s, "sigma_a": sigma_a, "g": G, "eta": ETA}
    slab = {"type": "cube", "to_world": at.translate([0, 0, -25]).scale([60, 60, 25]), "bsdf": bsdf}
    lamps = {
        f"lamp_{k}": {"type": "sphere", "center": c.tolist(), "radius": r, "emitter": {"type": "area", "radiance": L}}
        for k, (c, r, L) in enumerate(LAMPS)
    }
    scene = mi.load_dict({"type": "scene", "slab": slab, **lamps})
    media = WalkMedia.of(scene, 1.0)
    return find_directions(scene, media, SmallEmitters.of(scene), 1.0)


def event(media: WalkMedia, lanes: int) -> Event:
    k = dr.full(mi.Int32, 0, lanes)
    p = mi.Point3f(dr.full(mi.Float, 0, lanes), 0, -DEPTH)
    return Event(p, mi.Vector3f(*ALONG.tolist()), k, media.coefficients(k, p))


def upwards() -> tuple[np.ndarray, float]:
    """Directions (3, n) inside that leave, and the solid angle of each."""
    low = np.sqrt(1 - 1 / ETA**2)
    mu = low + (1 - low) * (np.arange(GRID) + 0.5) / GRID
    phi = 2 * np.pi * (np.arange(GRID) + 0.5) / GRID
    mu, phi = (x.ravel() for x in np.meshgrid(mu, phi))
    sine = np.sqrt(1 - mu * mu)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), mu]), 2 * np.pi * (1 - low) / GRID**2


def light_along(d: np.ndarray, lamp: tuple) -> np.ndarray:
    """eta² p(along.d) e^(-sigma_t z / mu) F_t L where the refracted ray meets the lamp, (3, n)."""
    centre, radius, radiance = lamp
    sine = ETA * d[:2]
    mu_o = np.sqrt(np.maximum(1 - (sine**2).sum(axis=0), 0))
    w = np.concatenate([sine, mu_o[None]])
    to = centre[:, None] - np.stack([d[0], d[1], 0 * d[0]]) * (DEPTH / d[2])
    misses = (to**2).sum(axis=0) - (to * w).sum(axis=0) ** 2
    value = ETA**2 * eval_hg(ALONG @ d, G) * F_t(mu_o, ETA) * radiance * (misses < radius**2)
    return value * np.exp(-SIGMA_T[:, None] * DEPTH / d[2])


@pytest.mark.slow
def test_sampled_directions_and_chance_share_the_light_of_lamps_between_them() -> None:
    """What sampled directions bring is what the weights of directions drawn by chance, in (0, 1), leave to it."""
    found, (d, solid) = directions(), upwards()
    at = event(found.media, d.shape[1])
    way = Departure(at.p, at.along, mi.Vector3f(d), at.object)
    whole = left = 0.0
    for k, lamp in enumerate(LAMPS):
        value = light_along(d, lamp)
        chance = np.array(found.share(dr.full(mi.Int32, k, d.shape[1]), way, mi.Bool(True)))
        assert ((chance > 0) & (chance < 1)).all()
        whole, left = whole + solid * value.sum(axis=1), left + solid * (value * (1 - chance)).sum(axis=1)
    L = np.array(found.light(event(found.media, LANES), generator(mi, LANES, pass_seed(1)))[0])
    mean, error = L.mean(axis=1), L.std(axis=1, ddof=1) / np.sqrt(LANES)
    assert np.abs((mean - left) / np.hypot(error, 1e-3 * left)).max() < WIDEST_Z  # of the quadrature: the lamps' rims
    assert (error < 0.005 * left).all() and (left < 0.8 * whole).all()


def test_directions_to_lamps_are_guessed_so_well_that_little_is_left_to_chance() -> None:
    found = directions()
    at = event(found.media, 1)
    for k, (centre, _, _) in enumerate(LAMPS):
        d, _, valid = found._guess(at.p, at.object, mi.UInt32(k), at.m, mi.Bool(True))
        d = np.array(d, dtype=np.float64)[:, 0]
        w = np.array([*(ETA * d[:2]), np.sqrt(1 - ETA**2 * (d[:2] ** 2).sum())])
        to = centre - np.array([d[0], d[1], 0]) * (DEPTH / d[2])
        assert valid[0] and np.linalg.norm(np.cross(w, to)) < 0.05 * np.linalg.norm(to)
