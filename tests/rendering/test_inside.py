"""Walks in objects with something inside, against Mitsuba's volume path tracer, which knows the media on either side.

In its scenes an inner shape has the medium around it as its `exterior`. Means of images are compared in each channel.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from rendered import independent

mi = pytest.importorskip("mitsuba")

from benchmarks.mitsuba_media import medium, with_media  # noqa: E402
from halfspace_sss.physics.fresnel import F_r  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

WIDEST_Z = 4.0
LARGEST_ERROR = 0.015  # of the mean of an image: what a comparison could still miss
RUNS, PIXELS, UNIT = 8, 6, 3.0
MEDIUM = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4}


def _wax(**more: Any) -> dict:
    return {"type": "translucent", **MEDIUM, **more}


def _scene(inside: dict, light: dict, wax: dict | None = None) -> dict:
    """A sphere of 3 to 7 mean free paths."""
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene", "integrator": {"type": "translucent_walk", "mm_per_unit": UNIT},
        "sensor": {"type": "perspective", "fov": 12.0, "to_world": view, "film": film},
        "wax": {"type": "sphere", "bsdf": wax or _wax()}, **light, **inside,
    }  # fmt: skip


def _around(surface: dict) -> Any:
    return medium(mi.load_dict(surface).spec, UNIT)


def _theirs(scene: dict, holders: dict[str, str]) -> Any:
    """The scene for `volpathmis`; `holders` names the object around each inner shape whose medium changes."""
    held = {name: {**scene[name], "exterior": _around(scene[holder]["bsdf"])} for name, holder in holders.items()}
    return with_media({**scene, **held}, UNIT, {"type": "volpathmis", "max_depth": -1, "rr_depth": 64})


def _means(scene: Any, spp: int, seed: int, runs: int = RUNS) -> np.ndarray:
    """In float64: sums of what few pixels hold."""
    return independent(scene, runs, spp, seed).mean(axis=(1, 2))


def _agree(found: np.ndarray, wanted: np.ndarray, known_to: float = LARGEST_ERROR) -> None:
    mean = wanted.mean(axis=0)
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (found, wanted)))
    assert np.abs((found.mean(axis=0) - mean) / error).max() < WIDEST_Z
    assert (error < known_to * mean).all()


def _ball(radius: float, at: tuple = (0, 0, 0), **more: Any) -> dict:
    return {"type": "sphere", "radius": radius, "center": list(at), **more}


SKY = {"light": {"type": "constant"}}
BLACK = {"type": "diffuse", "reflectance": 0.0}
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
AIR = {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.4}
FROSTED = {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.4, "alpha": 0.4}
SEED = {"type": "translucent", "sigma_s": "4,2,1", "sigma_a": ".5,.1,.02", "g": 0.0, "eta": 1.2}

INSIDE: dict[str, Callable[[], tuple[dict, dict[str, str]]]] = {
    "nearly filled by black": lambda: ({"stone": _ball(0.9, bsdf=BLACK)}, {}),
    "coloured stone": lambda: ({"stone": _ball(0.5, (0.1, 0.2, 0.3), bsdf=GREY)}, {}),
    "frosted glass": lambda: ({"glass": _ball(0.6, (0, 0, 0.3), bsdf=FROSTED)}, {"glass": "wax"}),
    "stone in a bubble": lambda: (
        {"air": _ball(0.7, bsdf=AIR), "stone": _ball(0.4, (0, 0.1, 0.1), bsdf=GREY)},
        {"air": "wax"},
    ),
    "second medium": lambda: ({"seed": _ball(0.6, (0, 0.1, 0.3), bsdf=SEED)}, {"seed": "wax"}),
    "stone in a second medium": lambda: (
        {"seed": _ball(0.7, bsdf=SEED), "stone": _ball(0.3, (0, 0, 0.2), bsdf=GREY)},
        {"seed": "wax"},
    ),
    "instance": lambda: (
        {
            "group": {"type": "shapegroup", "part": _ball(0.5, bsdf=GREY)},
            "one": {
                "type": "instance",
                "to_world": mi.ScalarTransform4f().translate([0.1, 0.2, 0.3]),
                "of": {"type": "ref", "id": "group"},
            },
        },
        {},
    ),
    "stick": lambda: (
        {
            "stick": {
                "type": "cylinder",
                "p0": [0, 0, 0],
                "p1": [1, 1, 1],
                "radius": 0.3,
                "bsdf": {"type": "twosided", "b": GREY},
            }
        },
        {},
    ),  # fmt: skip
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in INSIDE if kind not in ("second medium",)])
def test_walks_agree_with_the_volume_path_tracer_of_mitsuba(kind: str) -> None:
    """What is left out, is inside of others."""
    inside, holders = INSIDE[kind]()
    scene = _scene(inside, SKY)
    _agree(_means(mi.load_dict(scene), 384, 1), _means(_theirs(scene, holders), 384, 1001))


def test_an_even_sky_stays_even_over_objects_nested_four_deep_that_absorb_nothing() -> None:
    def clear(sigma_s: str, eta: float) -> dict:
        return {"type": "translucent", "sigma_s": sigma_s, "sigma_a": "0,0,0", "g": 0.2, "eta": eta}

    inside = {
        "a": _ball(0.7, bsdf=clear("2,1,3", 1.2)), "b": _ball(0.4, bsdf=clear("5,2,1", 0.8)),
        "c": _ball(0.2, bsdf=clear("1,9,1", 1.3)),
        "stone": _ball(0.1, bsdf={"type": "diffuse", "reflectance": 1.0}),
    }  # fmt: skip
    means = _means(mi.load_dict(_scene(inside, SKY, clear("1,2,3", 1.4))), 64, 1, 16)
    error = means.std(axis=0, ddof=1) / np.sqrt(16)
    assert (np.abs(means.mean(axis=0) - 1) < WIDEST_Z * error).all() and (error < LARGEST_ERROR).all()


LED = {"type": "area", "radiance": {"type": "rgb", "value": [30.0, 20.0, 10.0]}}
PLACE = (0.2, 0.1, 0.3)

LIGHTS: dict[str, Callable[[], tuple[dict, dict[str, str]]]] = {
    "led in a bubble": lambda: (
        {"air": _ball(0.8, bsdf=AIR), "led": _ball(0.3, PLACE, bsdf=BLACK, emitter=LED)}, {"air": "wax"}
    ),
    "glowing stone in a second medium": lambda: (
        {"seed": _ball(0.8, bsdf=SEED), "stone": _ball(0.3, PLACE, bsdf=GREY, emitter=LED)}, {"seed": "wax"}
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", LIGHTS)
def test_emitters_inside_are_seen_as_by_the_volume_path_tracer_of_mitsuba(kind: str) -> None:
    inside, holders = LIGHTS[kind]()
    scene = _scene(inside, {})
    _agree(_means(mi.load_dict(scene), 512, 1), _means(_theirs(scene, holders), 512, 1001), 0.02)


def _lamp(at: tuple = PLACE) -> dict:
    return {"lamp": {"type": "point", "position": list(at), "intensity": {"type": "rgb", "value": [3.0, 2.0, 1.0]}}}


WHITE = {"type": "diffuse", "reflectance": 1.0}
AROUND: dict[str, tuple[Callable[[], dict], float, float]] = {  # what there is, eta, cosine of the last ray that misses
    "in nothing that is there": (lambda: {"null": _ball(0.3, (0, 0, 0.4), bsdf={"type": "null"})}, 1.4, -1.0),
    "above a white stone": (
        lambda: {"stone": _ball(0.5, (0, 0, -0.2), bsdf=WHITE)},
        1.0,
        -np.sqrt(1 - (0.5 / 0.7) ** 2),
    ),
}


def _unscattered(at: float, sigma_t: float, eta: float, lowest: float) -> float:
    """Share of the light of a point at a distance from the centre of a unit sphere that leaves without an event.

    Along each ray, which meets the boundary under the same angle again and again at chords of length c,
    e^(-sigma_t d) (1 - F) / (1 - F e^(-sigma_t c)); none is left of rays below a cosine, which meet a stone.
    """
    nodes, weights = np.polynomial.legendre.leggauss(400)
    nodes, weights = 0.5 * ((1 - lowest) * nodes + 1 + lowest), 0.5 * (1 - lowest) * weights
    d = -at * nodes + np.sqrt(1 - at**2 * (1 - nodes**2))
    mu = (d + at * nodes).clip(1e-9, 1)
    F = F_r(mu, 1 / eta)
    return float(np.sum(weights / 2 * np.exp(-sigma_t * d) * (1 - F) / (1 - F * np.exp(-sigma_t * 2 * mu))))


def _all_around(nodes: np.ndarray, width: float) -> dict:
    """Cameras by the cosine of their directions with z, whose images stand beside each other."""
    film = {"type": "hdrfilm", "width": 4 * len(nodes), "height": 4, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    sensors = {"type": "batch", "film": film}
    for k, mu in enumerate(nodes):
        eye = [8 * np.sqrt(1 - mu * mu), 0, 8 * mu]
        view = mi.ScalarTransform4f().look_at(eye, [0, 0, 0], [0, 1, 0]).scale(0.5 * width)
        sensors[f"sensor{k}"] = {"type": "orthographic", "to_world": view}
    return sensors


@pytest.mark.slow
@pytest.mark.parametrize("kind", AROUND)
def test_all_light_of_a_point_light_in_a_medium_without_absorption_leaves_it(kind: str) -> None:
    """The mean over directions of the integral of radiance across each is the intensity; no camera sees a point."""
    nodes, weights = np.polynomial.legendre.leggauss(5)
    width, (around, eta, lowest) = 2.2, AROUND[kind]
    scene = _scene({**around(), **_lamp((0, 0, 0.5))}, {}, _wax(sigma_a=0.0, sigma_s=1.0, eta=eta))
    loaded = mi.load_dict({**scene, "sensor": _all_around(nodes, width)})
    images = np.array([np.array(mi.render(loaded, spp=2048, seed=run), dtype=float) for run in range(RUNS)])
    images = images.reshape(RUNS, 4, len(nodes), 4, 3).mean(axis=(1, 3))
    found = width**2 * np.einsum("k,rkc->rc", weights / 2, images)
    scattered = 1 - _unscattered(0.5, 1.0 * UNIT, eta, lowest)
    _agree(found, np.tile(scattered * np.array([3.0, 2.0, 1.0]), (RUNS, 1)))


@pytest.mark.slow
def test_lamps_outside_are_found_by_chance_and_for_empty_objects_beside_by_connections() -> None:
    inside, holders = INSIDE["second medium"]()
    inside["beside"] = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, 2]).scale(0.2),
                        "bsdf": _wax()}  # fmt: skip
    lamp = {"light": _ball(1.6, (1.5, 3, 2.5), emitter={"type": "area", "radiance": 10.0})}
    scene = _scene(inside, lamp)
    # the lamp is connected with, and has an eighth of the noise
    _agree(_means(mi.load_dict(scene), 256, 1), _means(_theirs(scene, holders), 2048, 1001), 0.02)


@pytest.mark.slow
def test_a_medium_that_varies_has_a_stone_inside() -> None:
    grid = np.random.default_rng(5).uniform(0.5, 2.0, (4, 4, 4, 1)).astype(np.float32)
    at = mi.ScalarTransform4f().translate(-1).scale(2)
    wax = {"type": "translucent", "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(grid), "to_world": at},
           "albedo": "0.95,0.9,0.7", "eta": 1.4}  # fmt: skip
    scene = _scene({"stone": _ball(0.5, (0.1, 0.2, 0.3), bsdf=GREY)}, SKY, wax)
    _agree(_means(mi.load_dict(scene), 512, 1), _means(_theirs(scene, {}), 512, 1001))


def test_a_stone_that_is_moved_between_renders_is_seen_where_it_is() -> None:
    scene = mi.load_dict(_scene({"stone": _ball(0.5, (0, 0, 5), bsdf=BLACK)}, SKY))
    before = mi.render(scene, spp=16, seed=1)
    parameters = mi.traverse(scene)
    parameters["stone.to_world"] = mi.Transform4f().scale(0.5)
    parameters.update()
    moved = np.array(mi.render(scene, spp=16, seed=1))
    fresh = np.array(mi.render(mi.load_dict(_scene({"stone": _ball(0.5, bsdf=BLACK)}, SKY)), spp=16, seed=1))
    np.testing.assert_allclose(moved, fresh, rtol=1e-3)
    assert np.abs(moved - np.array(before)).max() > 0.05


@pytest.mark.parametrize(
    ("inside", "wax", "message"),
    [
        ({"stone": _ball(0.5)}, {"orders": "multiple"}, "orders must be 'total' of objects .*'multiple'.*'stone'"),
        ({"seed": _ball(0.5, bsdf={**SEED, "orders": "single"})}, {}, "orders must be 'total' of objects .*'single'"),
        (
            {"pane": {"type": "disk", "bsdf": AIR}},
            {},
            "refracting inclusions of an object must be closed, got .*'pane'",
        ),
    ],
    ids=["orders", "orders inside", "open glass"],
)
@pytest.mark.filterwarnings("ignore:object .* is not closed")
def test_what_walks_cannot_know_is_refused_by_name(inside: dict, wax: dict, message: str) -> None:
    scene = mi.load_dict(_scene(inside, SKY, _wax(**wax)))
    with pytest.raises(ValueError, match=message):
        scene.integrator().render(scene, spp=1)
