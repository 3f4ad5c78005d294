"""The walk inside objects: energy, agreement with Mitsuba's volume path tracer and with the half-space, orders."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rendered import independent

from benchmarks.mitsuba_media import with_media
from halfspace_sss import Medium
from halfspace_sss.physics.fresnel import F_r
from halfspace_sss.tracing.tracer import trace

pytestmark = pytest.mark.usefixtures("rgb")

mi = pytest.importorskip("mitsuba")

WIDEST_Z = 4.4  # two-sided 1e-5, for a few hundred comparisons
WIDEST_Z_OF_RUNS = 6.0  # Student's t with about 10 degrees of freedom
LARGEST_ERROR = 0.05  # of the mean of an image
COLOURED = {"sigma_s": "0.5,1.0,2.0", "sigma_a": "0.01,0.1,0.5"}


def _scene(surface: dict, light: dict | None = None, shape: dict | None = None, **integrator: Any) -> dict:
    """An object of about 10 units, from the front, in 8 x 8 pixels."""
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "component_format": "float32",
            "pixel_format": "rgb"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([0, 0, 50], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "translucent_walk", "light": "sampled", **integrator},
        "sensor": {"type": "perspective", "fov": 20.0, "to_world": view, "film": film},
        "light": light or {"type": "constant"},
        "object": {**(shape or {"type": "sphere", "radius": 10.0}), "bsdf": {"type": "translucent", **surface}},
    }


def _lamp() -> dict:
    """A lamp large enough to be found by chance."""
    return {"type": "sphere", "center": [35, 20, 20], "radius": 18.0, "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [10, 9, 8]}}}  # fmt: skip


def _cube() -> dict:
    return {"type": "cube", "to_world": mi.ScalarTransform4f().scale(5).rotate([1, 1, 0], 30)}


def _runs(scene: Any, runs: int, spp: int, seed: int) -> np.ndarray:
    return independent(scene, runs, spp, seed)


def _z(a: np.ndarray, b: np.ndarray | float) -> np.ndarray:
    """Differences of the means over runs, per quarter of the image and channel, in standard errors."""

    def quarters(x: np.ndarray) -> np.ndarray:
        return x.reshape(len(x), 2, 4, 2, 4, -1).mean(axis=(2, 4)).reshape(len(x), -1)

    a, variance = quarters(a), 0.0
    if isinstance(b, np.ndarray):
        b = quarters(b)
        b, variance = b.mean(axis=0), b.var(axis=0, ddof=1) / len(b)
    error = np.sqrt(a.var(axis=0, ddof=1) / len(a) + variance)
    return (a.mean(axis=0) - b) / error


def _agree(a: np.ndarray, b: np.ndarray, known_to: float = LARGEST_ERROR) -> None:
    """Quarters and whole images agree, and not by noise alone: the whole is known to a share of itself."""
    assert np.abs(_z(a, b)).max() < WIDEST_Z_OF_RUNS
    whole = [x.mean(axis=(1, 2, 3), keepdims=True) for x in (a, b)]
    z, error = ((whole[0].mean() - whole[1].mean()), np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in whole)))
    assert abs(z) < WIDEST_Z_OF_RUNS * error
    assert error < known_to * whole[1].mean()


def test_a_medium_without_absorption_is_invisible_in_uniform_light() -> None:
    surface = {"sigma_s": "2.19,2.62,3.0", "sigma_a": 0.0, "eta": 1.5}
    images = _runs(mi.load_dict(_scene(surface)), 16, 16, 1)
    assert np.abs(_z(images, 1.0)).max() < WIDEST_Z
    assert abs(images.mean() - 1) < 0.01


@pytest.mark.parametrize(
    ("surface", "shape", "uniform"),
    [
        ({"material": "marble"}, None, True),
        pytest.param({**COLOURED, "g": 0.7, "eta": 1.3}, None, False, marks=pytest.mark.slow),
        ({**COLOURED, "g": -0.5, "eta": 1.0}, "cube", False),
        ({"sigma_s": 0.05, "sigma_a": "0.01,0.01,0.05", "g": 0.9, "eta": 1.5}, "cube", False),
        pytest.param({**COLOURED, "g": 0.3, "eta": 1.5, "b": "rough"}, None, False, marks=pytest.mark.slow),
    ],
    ids=["marble", "forward", "matched cube", "thin cube", "rough"],
)
def test_images_agree_with_the_volume_path_tracer_of_mitsuba(surface: dict, shape: Any, uniform: bool) -> None:
    if "b" in surface:
        surface = {**surface, "b": {"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.0, "alpha": 0.3}}
    scene = _scene(surface, None if uniform else _lamp(), _cube() if shape else None, mm_per_unit=1.2)
    theirs = with_media(scene, 1.2, {"type": "volpathmis", "max_depth": -1, "rr_depth": 1000})
    spp = 32 if uniform else 128
    _agree(_runs(mi.load_dict(scene), 6, 2 * spp, 1), _runs(theirs, 6, 2 * spp, 1001))


def test_a_large_flat_box_shows_the_reflectance_of_the_half_space() -> None:
    medium = Medium(1.0, 0.05, 0.5, 1.4)
    box = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 0, -200]).scale([400, 400, 200])}
    scene = _scene({"sigma_s": 1.0, "sigma_a": 0.05, "g": 0.5, "eta": 1.4}, shape=box)
    mu = 0.6
    far = [50 * np.sqrt(1 - mu * mu), 0, 50 * mu]
    scene["sensor"]["to_world"] = mi.ScalarTransform4f().look_at(far, [0, 0, 0], [0, 1, 0])
    scene["sensor"]["fov"] = 0.1
    images = _runs(mi.load_dict(scene), 16, 64, 1)
    expected = trace(medium, mu, n_paths=2**20).reflectance()
    value, error = images.mean(axis=(1, 2, 3)), expected.standard_error
    z = (value.mean() - expected.value - F_r(mu, 1.4)) / np.hypot(value.std(ddof=1) / 4, error)
    assert abs(z) < WIDEST_Z


def _top_of_ball(away: float, mu: float, light: dict, **surface: Any) -> dict:
    """The top of a ball of 1000 mean free paths radius, which lies at z = `away`, from close by."""
    ball = {"type": "sphere", "radius": 1000.0, "center": [0, 0, away - 1000]}
    medium = {"sigma_s": "0.99,0.75,0.3", "sigma_a": "0.01,0.25,0.7", "eta": 1.4, "reflection": False}
    scene = _scene({**medium, **surface}, light, ball)
    eye = [50 * np.sqrt(1 - mu * mu), 0, away + 50 * mu]
    scene["sensor"]["to_world"] = mi.ScalarTransform4f().look_at(eye, [0, 0, away], [0, 1, 0])
    scene["sensor"]["fov"] = 0.1
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("orders", ["single", "multiple"])
def test_a_large_ball_far_from_the_origin_shows_the_reflectance_of_the_half_space(orders: str) -> None:
    images = _runs(mi.load_dict(_top_of_ball(1000.0, 0.6, {"type": "constant"}, orders=orders)), 16, 512, 1)
    for c, (s, a) in enumerate(((0.99, 0.01), (0.75, 0.25), (0.3, 0.7))):
        expected = trace(Medium(s, a, 0.0, 1.4), 0.6, n_paths=2**20).reflectance(orders)
        value = images[..., c].mean(axis=(1, 2))
        error = np.hypot(value.std(ddof=1) / 4, expected.standard_error)
        assert abs(value.mean() - expected.value) < WIDEST_Z_OF_RUNS * error
        assert error < 0.012 * expected.value


@pytest.mark.slow
def test_light_that_joins_bring_does_not_depend_on_the_origin_of_the_scene() -> None:
    sun = {"type": "directional", "direction": [0.5, 0.3, -0.8], "irradiance": 3.0}
    near, far = (
        _runs(mi.load_dict(_top_of_ball(away, 0.6, sun)), 6, 512, seed) for away, seed in ((100.0, 1), (5000.0, 101))
    )
    _agree(far, near, 0.01)


def test_single_and_multiple_scattering_add_up_to_the_total() -> None:
    surface = {**COLOURED, "g": 0.3, "eta": 1.3}
    single, multiple, total = (
        _runs(mi.load_dict(_scene({**surface, "orders": orders, "reflection": False}, _lamp())), 6, 256, seed)
        for orders, seed in (("single", 1), ("multiple", 100), ("total", 200))
    )
    _agree(single + multiple, total)
    assert 0.02 < single.mean() / total.mean() < 0.9


def _small_lamp() -> dict:
    """A lamp that walks from the camera hardly ever hit."""
    view = mi.ScalarTransform4f().look_at([20, 30, 40], [0, 0, 0], [0, 1, 0]).scale(2)
    return {"type": "rectangle", "to_world": view, "emitter": {"type": "area", "radiance": 300.0},
            "bsdf": {"type": "diffuse", "reflectance": 0.0}}  # fmt: skip


@pytest.mark.slow
def test_connections_bring_the_light_that_chance_brings_with_less_noise() -> None:
    surface = {"sigma_s": 0.5, "sigma_a": 0.02, "eta": 1.5, "reflection": False, "orders": "multiple"}
    joined, left_to_chance = (
        _runs(mi.load_dict(_scene(surface, _small_lamp(), _cube(), connection_share=share)), 6, 2 * spp, 1)
        for share, spp in ((0.5, 64), (0.0, 1024))
    )
    _agree(joined, left_to_chance, known_to=0.1)
    assert 64 * np.median(joined.var(axis=0)) < 0.05 * 1024 * left_to_chance.var(axis=0).mean()


@pytest.mark.slow
@pytest.mark.parametrize("lit", ["lamp", "point"])
def test_directions_bring_light_through_a_rough_boundary_that_chance_brings_with_less_noise(lit: str) -> None:
    """Phase functions whose forward peak looks away from the emitter rarely scatter towards it."""
    rough = {"type": "roughdielectric", "int_ior": 1.4, "ext_ior": 1.0, "alpha": 0.4}
    surface = {"sigma_t": 1.0, "albedo": 0.95, "g": 0.8, "eta": 1.4, "b": rough, "reflection": False}
    light = {"type": "point", "position": [20.0, 30.0, 40.0], "intensity": 1e4} if lit == "point" else _small_lamp()
    directed, left_to_chance = (
        _runs(mi.load_dict(_scene(surface, light, connection_share=share)), 8, spp, 1)
        for share, spp in ((0.5, 64), (0.0, 1024))
    )
    _agree(directed, left_to_chance, known_to=0.03)
    assert 64 * directed.var(axis=0).mean() < 0.25 * 1024 * left_to_chance.var(axis=0).mean()


@pytest.mark.slow
def test_a_point_light_is_seen_as_a_small_lamp_of_the_same_power() -> None:
    surface = {"sigma_s": 0.5, "sigma_a": 0.02, "eta": 1.0, "orders": "multiple"}
    place, radius = [20.0, 30.0, 40.0], 0.5
    lamp = {"type": "sphere", "center": place, "radius": radius, "emitter": {"type": "area", "radiance": 100.0}}
    point = {"type": "point", "position": place, "intensity": 100.0 * np.pi * radius**2}
    a, b = (_runs(mi.load_dict(_scene(surface, light)), 6, 256, seed) for light, seed in ((lamp, 1), (point, 100)))
    _agree(a, b)


def test_normals_that_point_inwards_change_nothing() -> None:
    sphere = {"type": "sphere", "radius": 10.0}
    surface = {**COLOURED, "eta": 1.5}
    a = _runs(mi.load_dict(_scene(surface, shape=sphere)), 8, 32, 1)
    b = _runs(mi.load_dict(_scene(surface, shape={**sphere, "flip_normals": True})), 8, 32, 100)
    _agree(a, b)


def test_objects_of_different_media_stand_in_one_scene() -> None:
    scene = _scene({**COLOURED, "eta": 1.5}, shape={"type": "sphere", "radius": 4.0, "center": [-5, 0, 0]})
    other = {"type": "translucent", "sigma_s": 1.0, "sigma_a": "1,0.1,0.01", "g": 0.5, "eta": 1.3}
    scene["other"] = {"type": "sphere", "radius": 4.0, "center": [5, 0, 0], "bsdf": other}
    theirs = with_media(scene, 1.0, {"type": "volpathmis", "max_depth": -1, "rr_depth": 1000})
    _agree(_runs(mi.load_dict(scene), 6, 128, 1), _runs(theirs, 6, 128, 100))


def test_a_mono_variant_renders_one_channel_of_the_colours() -> None:
    colours = _runs(mi.load_dict(_scene({**COLOURED, "eta": 1.3})), 6, 128, 1)[..., 1:2]
    mi.set_variant("llvm_ad_mono")
    grey = _runs(mi.load_dict(_scene({"sigma_s": 1.0, "sigma_a": 0.1, "eta": 1.3})), 6, 128, 100)[..., :1]
    _agree(colours, grey)


@pytest.mark.parametrize(
    ("key", "value"), [("mm_per_unit", 0.0), ("mm_per_unit", np.inf), ("max_depth", 0), ("connection_share", 1.5)]
)
def test_parameters_out_of_range_are_refused(key: str, value: float) -> None:
    with pytest.raises(RuntimeError, match=f"{key} must be .* got {value}"):
        mi.load_dict({"type": "translucent_walk", key: value})


def test_media_that_mitsuba_cannot_express_are_refused() -> None:
    with pytest.raises(ValueError, match="orders must be 'total'.*'single'"):
        with_media(_scene({"material": "marble", "orders": "single"}), 1.0)
    with pytest.raises(ValueError, match="g must be the same"):
        with_media(_scene({**COLOURED, "g": "0,0.5,0.5"}), 1.0)
    around = _scene({"material": "marble"})
    around["object"]["bsdf"] = {"type": "twosided", "inside": around["object"]["bsdf"]}
    with pytest.raises(ValueError, match="translucent must stand in no other BSDF .*, got twosided of 'object'"):
        with_media(around, 1.0)
