"""Every emitter plugin of Mitsuba, by walks and models, against what rays find by chance.

No ray finds a delta light or a sun: their references are spheres of the same flux, seen under 0.15 radians, and a sky
without the sun. References look for no emitter (`connection_share` 0); walks that do are held against Mitsuba's volume
path tracer in `test_translucent_walk.py`. Every comparison states its orders, and the error that it could still miss.
"""

from __future__ import annotations

import gc
import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from rendered import independent

mi = pytest.importorskip("mitsuba")

import drjit as dr  # noqa: E402

from full_geometry import register  # noqa: E402
from full_geometry.objects.small_emitters import SmallEmitters, check_emitters  # noqa: E402
from full_geometry.trade import recommend  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
WIDEST_Z = 4.0
LARGEST_ERROR = 0.02  # of the mean of an image: what a comparison could still miss
RUNS, PIXELS = 12, 6
PLACE, RADIANS = np.array([1.5, 3.0, 2.5]), 0.15
FAR = 300.0
WAYS = ("translucent_walk", "sampled"), ("translucent_walk", "precomputed"), ("bssrdf", "sampled")


def _looking(origin: np.ndarray) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f().look_at(np.asarray(origin).tolist(), [0, 0, 0], [0, 1, 0])


def _ball(place: np.ndarray, irradiance: np.ndarray | float, radians: float = RADIANS) -> dict:
    """A sphere of light that brings an irradiance to the origin."""
    sine = np.sin(radians)
    radiance = (np.ones(3) * irradiance / (np.pi * sine**2)).tolist()
    return {"type": "sphere", "center": place.tolist(), "radius": float(sine * np.linalg.norm(place)),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": radiance}}}  # fmt: skip


def _irradiance(emitter: dict, place: np.ndarray) -> np.ndarray:
    """What a delta light brings to the origin."""
    light = mi.load_dict({"type": "scene", "emitter": emitter}).emitters()[0]
    _, E = light.sample_direction(dr.zeros(mi.Interaction3f), mi.Point2f(0.5))
    return np.ravel(np.array(E, dtype=float))


def _sky(**more: float) -> dict:
    return {"type": "sunsky", "sun_direction": [0.3, 0.6, 0.742], **more}


def _sun_as_ball() -> dict:
    """The sky without its sun, and a ball in its place."""
    small = SmallEmitters.of(mi.load_dict({"type": "scene", "sky": _sky()}))
    k = dr.full(mi.UInt32, 0, 4096)
    u = mi.Point2f(*np.random.default_rng(1).random((2, 4096)).astype(np.float32))
    _, _, light = small.sample(k, dr.zeros(mi.Interaction3f, 4096), u)
    place = FAR * np.array(small.suns[0].direction)
    return {"sky": _sky(sun_scale=0.0), "ball": _ball(place, np.array(light, dtype=float).mean(axis=1))}


def _texels(hot: float) -> mi.Bitmap:
    texels = np.full((64, 128, 3), 0.3, dtype=np.float32)
    texels[20, 50] = hot
    return mi.Bitmap(texels)


def _spot(kind: str) -> dict:
    at = {"to_world": _looking(PLACE)}
    if kind == "projector":
        return {"type": kind, **at, "fov": 40.0, "irradiance": {"type": "rgb", "value": [2.5, 3.0, 3.5]}}
    return {"type": kind, **at, "cutoff_angle": 40.0, "beam_width": 30.0, "intensity": 6.0}


EMITTERS: dict[str, Callable[[], dict]] = {
    "area": lambda: _ball(PLACE, 1.0),
    "constant": lambda: {"type": "constant"},
    "envmap": lambda: {"type": "envmap", "bitmap": _texels(300.0)},
    "point": lambda: {"type": "point", "position": PLACE.tolist(), "intensity": 10.0},
    "spot": lambda: _spot("spot"),
    "projector": lambda: _spot("projector"),
    "directional": lambda: {"type": "directional", "to_world": _looking(PLACE)},
    "sunsky": _sky,
}
DISTANCES = {"area": 1.0, "point": 1.0, "spot": 1.0, "projector": 1.0, "directional": FAR}  # of a ball like it


def _lights(kind: str) -> dict:
    return {"light": EMITTERS[kind]()}


def _flux(kind: str) -> np.ndarray | float:
    """What the emitter brings to the origin, if a ball is like it."""
    return 1.0 if kind == "area" else _irradiance(EMITTERS[kind](), DISTANCES[kind] * PLACE)


def _scene(integrator: dict, lights: dict, **surface: str) -> dict:
    """A sphere of 3 to 7 mean free paths, which reflects and passes what enters."""
    medium = {"sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4, "reflection": False}
    film = {"type": "hdrfilm", "width": PIXELS, "height": PIXELS, "rfilter": {"type": "box"}, "pixel_format": "rgb",
            "component_format": "float32"}  # fmt: skip
    view = mi.ScalarTransform4f().look_at([0, 0, 8], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"mm_per_unit": 3.0, **integrator},
        "sensor": {"type": "perspective", "fov": 12.0, "to_world": view, "film": film},
        "object": {"type": "sphere", "bsdf": {"type": "translucent", **medium, **surface}},
        **lights,
    }


def _means(scene: dict, spp: int, seed: int, runs: int = RUNS) -> np.ndarray:
    scene = mi.load_dict(scene)
    return independent(scene, runs, spp, seed).mean(axis=(1, 2))


def _walked(lights: dict, orders: str, fewer: int = 1) -> np.ndarray:
    """Means of images by walks that look for no emitter."""
    chance = {"type": "translucent_walk", "light": "sampled", "connection_share": 0.0}
    scene = _scene(chance, lights, orders=orders)
    return _means(scene, (3 * 2**13 if orders == "single" else 2**12) // fewer, 1001)


@cache
def _walked_by_a_ball(distance: float, orders: str) -> np.ndarray:
    return _walked({"ball": _ball(distance * PLACE, 1.0)}, orders)


def _reference(kind: str, orders: str) -> np.ndarray:
    """Light is linear in what the emitter brings: emitters at one place share walks."""
    if kind in DISTANCES:
        return _walked_by_a_ball(DISTANCES[kind], orders) * _flux(kind)
    if kind == "constant":
        return _walked(_lights(kind), orders, 64)  # every ray finds it
    if kind == "envmap":
        return _walked(_lights(kind), orders, 2)
    return _walked(_sun_as_ball() if kind == "sunsky" else _lights(kind), orders)


def _agree(found: np.ndarray, wanted: np.ndarray, known_to: float = LARGEST_ERROR) -> None:
    mean = wanted.mean(axis=0)
    error = np.hypot(*(x.std(axis=0, ddof=1) / np.sqrt(len(x)) for x in (found, wanted)))
    assert np.abs((found.mean(axis=0) - mean) / error).max() < WIDEST_Z
    assert (error < known_to * mean).all()


def _slowly(*kinds: str) -> list:
    return [kind if kind == "constant" else pytest.param(kind, marks=pytest.mark.slow) for kind in kinds]


KINDS = ("area", "constant", "envmap", "point", "directional", "sunsky")  # a spot and a projector are sampled as points


@pytest.mark.parametrize("kind", _slowly(*(kind for kind in EMITTERS if kind not in ("directional", "envmap"))))
def test_walks_find_the_light_of_every_emitter(kind: str) -> None:
    """All orders. The sun and its sky are found as a directional light and a map of the sky are."""
    scene = _scene({"type": "translucent_walk"}, _lights(kind))
    _agree(_means(scene, 2**8, 1, RUNS // 2), _reference(kind, "total"))  # a third of the noise of the reference


@pytest.mark.parametrize("kind", _slowly("area", "constant", "point", "sunsky"))
def test_the_single_order_beside_models_is_that_of_walks_for_emitters_of_each_kind(kind: str) -> None:
    scene = _scene({"type": "bssrdf"}, _lights(kind), orders="single", model="better_dipole")
    _agree(_means(scene, 2**10, 201), _reference(kind, "single"))  # one image of 120 has a firefly of a point light


def _same_light_otherwise(kind: str) -> dict:
    """Emitters of other plugins or sizes that bring the same light: those of models are sampled, whatever they are."""
    if kind == "area":
        return {"ball": _ball(PLACE, 1.0, 0.05)}
    if kind == "constant":
        radiance = {"type": "area", "radiance": 1.0}
        return {"dome": {"type": "sphere", "radius": FAR, "flip_normals": True, "emitter": radiance}}
    if kind == "envmap":
        return _sun_of_texels(EMITTERS[kind]())
    return _sun_as_ball() if kind == "sunsky" else {"ball": _ball(DISTANCES[kind] * PLACE, _flux(kind))}


def _sun_of_texels(sky: dict) -> dict:
    """The even sky, and a ball for the flux of what is brighter, by a sum over directions."""
    emitter = mi.load_dict({"type": "scene", "sky": sky}).emitters()[0]
    n = 512
    mu, phi = np.meshgrid((np.arange(n) + 0.5) / n * 2 - 1, (np.arange(2 * n) + 0.5) / n * np.pi, indexing="ij")
    w = np.stack([np.sqrt(1 - mu**2) * np.cos(phi), mu, np.sqrt(1 - mu**2) * np.sin(phi)]).reshape(3, -1)
    si = dr.zeros(mi.SurfaceInteraction3f, w.shape[1])
    si.wi = mi.Vector3f(-w)
    more = np.array(emitter.eval(si), dtype=float)[0] - 0.3
    E = w @ more * (2 * np.pi / n / n)
    flux = float(np.linalg.norm(E))
    return {"sky": {"type": "constant", "radiance": 0.3}, "ball": _ball(FAR * E / flux, flux, 0.02)}


def _model_finds_all_light(kind: str, model: str) -> None:
    """The light of a model is linear in what arrives; what the model itself is off by cancels."""
    surface = {"orders": "multiple", "model": model}
    found, wanted = (
        _means(_scene({"type": "bssrdf"}, lights, **surface), 2**8, seed)
        for lights, seed in ((_lights(kind), 1), (_same_light_otherwise(kind), 1001))
    )
    _agree(found, wanted)


@pytest.mark.parametrize("kind", _slowly(*KINDS))
def test_models_of_the_half_space_find_the_light_of_emitters_of_each_kind(kind: str) -> None:
    """Orders from two on."""
    _model_finds_all_light(kind, "neural")


TOGETHER = [("point", "constant", "bssrdf", "multiple"), *(pytest.param(*each, marks=pytest.mark.slow) for each in (
    ("directional", "constant", "bssrdf", "single"), ("spot", "envmap", "translucent_walk", "total"),
))]  # fmt: skip


@pytest.mark.parametrize(("one", "other", "integrator", "orders"), TOGETHER)
def test_light_of_two_emitters_is_the_sum_of_that_of_each(one: str, other: str, integrator: str, orders: str) -> None:
    # light of delta lights beside another emitter was that of two of them in orders from two on
    lights = [EMITTERS[kind]() for kind in (one, other)]
    scenes = [{"first": lights[0]}, {"second": lights[1]}, {"first": lights[0], "second": lights[1]}]
    found = [
        _means(_scene({"type": integrator}, each, orders=orders, model="better_dipole"), 2**7, 500 * k)
        for k, each in enumerate(scenes)
    ]
    _agree(found[2], found[0] + found[1])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Iterator[np.ndarray]:
    """What a short training of the sphere may be off by under even light, of each channel, by its own error."""
    pytest.importorskip("torch")
    from full_geometry.learning import training
    from full_geometry.learning.model_errors import LIGHTS
    from full_geometry.learning.network_fitting import Recipe

    mi.set_variant("llvm_ad_rgb")
    register()
    folder = tmp_path_factory.mktemp("weights")
    recipe = Recipe(width=32, depth=2, batch=512, chunk=2**14, reuse=2)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HALFSPACE_SSS_WEIGHTS", str(folder))
        patch.setattr(training, "WALKS", 512)
        patch.setattr(training, "SAMPLES", 128)
        shape = mi.load_dict(_scene({"type": "bssrdf"}, {"sky": {"type": "constant"}}, orders="multiple"))
        found = training.train(shape, None, chunks=5, recipe=recipe, folder=folder)
        yield np.array([row.error + 2 * row.standard_error for row in found.errors if row.light == LIGHTS[0]])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["point", "sunsky"])
def test_models_of_an_object_find_the_light_of_a_delta_light_and_of_a_sun(kind: str, trained: np.ndarray) -> None:
    """Orders from two on. The light of an even sky is learnt beside S, and held to walks below."""
    _model_finds_all_light(kind, "full_geometry")


@pytest.mark.slow
def test_models_of_an_object_have_the_light_of_walks_within_their_error(trained: np.ndarray) -> None:
    """Orders from two on, under an even sky."""
    scene = _scene({"type": "bssrdf"}, {"sky": {"type": "constant"}}, orders="multiple", model="full_geometry")
    found, walked = _means(scene, 2**8, 1), _reference("constant", "multiple")
    ratio = found.mean(axis=0) / walked.mean(axis=0)
    noise = [x.std(axis=0, ddof=1) / np.sqrt(len(x)) / x.mean(axis=0) for x in (found, walked)]
    assert (np.abs(ratio - 1) < trained + WIDEST_Z * np.hypot(*noise)).all()
    assert (trained < 0.1).all() and (np.hypot(*noise) < LARGEST_ERROR).all()


@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_emitters_that_path_tracers_cannot_find_are_named(integrator: str) -> None:
    lamp = {"type": "rectangle", "to_world": _looking(PLACE), "emitter": {"type": "directionalarea"}}
    scene = mi.load_dict(_scene({"type": integrator}, {"lamp": lamp}, model="better_dipole"))
    with pytest.warns(UserWarning, match="light of a DirectionalArea is left out"):
        assert np.array(mi.render(scene, spp=1)).max() == 0


@pytest.mark.parametrize("light", ["sampled", "gathered"])
def test_models_refuse_emitters_that_are_never_sampled(light: str) -> None:
    lamp = {"type": "rectangle", "to_world": _looking(PLACE), "emitter": {"type": "area", "sampling_weight": 0.0}}
    lights = {"lamp": lamp, "sky": {"type": "constant"}}
    scene = mi.load_dict(_scene({"type": "bssrdf", "light": light}, lights, model="better_dipole"))
    with pytest.raises(ValueError, match="sampling_weight must be > 0 for bssrdf, got 0 of emitter"):
        mi.render(scene, spp=1)


@pytest.mark.usefixtures("little_light")
@pytest.mark.parametrize(("integrator", "light"), WAYS)
def test_a_bulb_so_far_that_its_density_overflows_leaves_no_nan(integrator: str, light: str) -> None:
    lamp = {"type": "area", "radiance": 3e7}
    bulb = {"type": "sphere", "center": [0.0, 50.0, 20.0], "radius": 0.005, "emitter": lamp}
    wall = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2])}
    lights = {"bulb": bulb, "wall": wall, "sky": {"type": "constant", "radiance": 0.5}}
    scene = mi.load_dict(_scene({"type": integrator, "light": light}, lights))
    with pytest.warns(UserWarning, match="0.002 radians at least, got 9.*e-05 from object 'object': its light is lost"):
        image = np.array(mi.render(scene, spp=16, seed=1))
    assert np.isfinite(image).all()
    assert image.mean() > 0


@pytest.mark.usefixtures("little_light")
def test_paths_of_one_vertex_show_no_lamp_in_a_mirror() -> None:
    lamp = {"type": "sphere", "center": [1, 2, 5], "radius": 0.3, "emitter": {"type": "area", "radiance": 90.0}}
    walk = {"type": "translucent_walk", "light": "precomputed"}
    found = [
        _means(_scene({**walk, "max_depth": depth}, {"lamp": lamp}, reflection=True), 64, 1, 1) for depth in (1, 2)
    ]
    assert found[0].max() == 0
    assert found[1].min() > 0


@pytest.mark.parametrize("turned", [0.0, 180.0], ids=["copies", "back to back"])
@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_lamps_on_each_other_are_refused_by_name(integrator: str, turned: float) -> None:
    at = _looking(PLACE)
    lamps = {name: {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area"}}
             for name, to_world in {"one": at, "other": at.rotate([0, 1, 0], turned)}.items()}  # fmt: skip
    scene = mi.load_dict(_scene({"type": integrator}, lamps, model="better_dipole"), optimize=False)
    with pytest.raises(ValueError, match="lamps must be apart by more than .*'(one|other)' on the shape '(one|other)'"):
        mi.render(scene, spp=1)


def test_lamps_that_cross_in_one_box_are_taken() -> None:
    at = mi.ScalarTransform4f().translate(PLACE.tolist())
    lamps = {name: {"type": "rectangle", "to_world": at.rotate([0, 1, 0], turn), "emitter": {"type": "area"}}
             for name, turn in {"one": 45.0, "other": -45.0}.items()}  # fmt: skip
    check_emitters(mi.load_dict({"type": "scene", **lamps}))


@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_emitters_that_fail_in_symbolic_loops_are_refused_by_name(integrator: str) -> None:
    scene = mi.load_dict(_scene({"type": integrator}, {"sky": {"type": "timed_sunsky"}}, model="better_dipole"))
    with pytest.raises((RuntimeError, ValueError)) as refused:
        mi.render(scene, spp=1)
    assert "got timed_sunsky" in str(refused.value.__cause__ or refused.value)


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        (
            "sky",
            "to_world of emitter 'sky' must turn it, and axes of rotations have the length 1, got scales from 1.19",
        ),
        ("ball", "to_world of object 'object' must not stretch it, .* got scales from 1 to 2"),
    ],
)
@pytest.mark.parametrize("integrator", ["translucent_walk", "bssrdf"])
def test_skies_and_spheres_that_are_stretched_are_refused(integrator: str, kind: str, message: str) -> None:
    at, even = mi.ScalarTransform4f(), mi.Bitmap(np.ones((4, 8, 3), dtype=np.float32))
    sky = {"type": "envmap", "bitmap": even, "to_world": at.rotate([1, 1, 0], 40) if kind == "sky" else at}
    scene = _scene({"type": integrator}, {"sky": sky}, model="lambert")
    scene["object"] = {**scene["object"], **({"to_world": at.scale([1, 1, 2])} if kind == "ball" else {})}
    with pytest.raises((RuntimeError, ValueError)) as refused:
        mi.render(mi.load_dict(scene), spp=1)
    assert re.search(message, str(refused.value.__cause__ or refused.value))
    del scene, refused
    gc.collect()  # calls of emitters go to all that live, and this one fails in them


def _shape(name: str) -> dict:
    at = mi.ScalarTransform4f()
    if name == "cube":
        return {"type": "cube", "to_world": at.rotate([1, 1, 0], 30).scale(0.7)}
    return {"type": "ply", "filename": str(BUNNY), "to_world": at.scale(0.2).translate([0, -4.8, 0])}


def _under_a_point_light(shape: str) -> dict:
    scene = _scene({"type": "translucent_walk", "mm_per_unit": 10.0}, _lights("point"))
    scene["object"] |= _shape(shape)
    return scene


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["cube", "bunny"])
def test_light_that_is_blurred_under_a_point_light_is_stated_and_nothing_is_called_exact(shape: str) -> None:
    """All orders; the object is tens of mean free paths across."""
    scene = mi.load_dict(_under_a_point_light(shape))
    advice = recommend(scene, tolerance=0.05, assess_seconds=1.0, models=["lambert"])
    assert advice.objects[0].way == "path_traced" and "exact" not in str(advice)
    traced = advice.assessment.objects[0].traced
    # a machine that is busy takes few samples in the time, and then the bound is of noise alone
    assert 0 < traced.bias_bound and traced.bias2 - 3 * traced.bias2_error < 0.01**2


@pytest.mark.slow
def test_walks_in_a_cube_under_a_point_light_are_within_a_percent_of_a_ball_of_light() -> None:
    """All orders, as above; of a smaller sphere `test_walks_find_the_light_of_every_emitter` knows it."""
    ball = {"light": _ball(PLACE, _flux("point"), 0.05)}
    lamp = _under_a_point_light("cube")
    found, wanted = (_means(scene, 2**8, 1).mean(axis=1) for scene in (lamp, lamp | ball))  # by the same random numbers
    apart, mean = found - wanted, wanted.mean()
    assert apart.std(ddof=1) / np.sqrt(len(apart)) < 0.005 * mean
    assert abs(apart.mean() / mean) < 0.01
