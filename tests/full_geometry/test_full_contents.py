"""Objects with something inside: their walks, first events and low orders, whom weights belong to, images.

z-tests are at 4 standard errors (two-sided 6e-5), with fixed seeds.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rendered import independent

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

import full_geometry  # noqa: E402
from benchmarks.mitsuba_media import medium, with_media  # noqa: E402
from full_geometry.geometry.points import ObjectModel, SurfacePoint, refract_in  # noqa: E402
from full_geometry.geometry.sensors import camera_rays  # noqa: E402
from full_geometry.integrators.walk_paths import FirstExits  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.learners import ObjectLearner  # noqa: E402
from full_geometry.learning.model_errors import EVEN_SKY, errors_of  # noqa: E402
from full_geometry.learning.network_fitting import Recipe  # noqa: E402
from full_geometry.learning.training import Trained, train  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.trade import assess  # noqa: E402
from full_geometry.transport import prepare  # noqa: E402
from full_geometry.transport.exit_pairs import trace_exits  # noqa: E402
from full_geometry.transport.features import first_event  # noqa: E402
from full_geometry.transport.half_space import half_space_model  # noqa: E402
from full_geometry.transport.storing import find_weights, identify, weights_name  # noqa: E402
from full_geometry.walk.media import WalkMedia  # noqa: E402
from halfspace_sss.neural import store as known_weights  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

WIDEST_Z, N, UNIT = 4.0, 2**16, 3.0
QUICK, CHUNKS, RUNS = Recipe(width=24, depth=2, batch=512, chunk=2**13, reuse=4), 12, 12
SKY = {"light": {"type": "constant"}}


def wax(**more: Any) -> dict:
    """3 to 7 mean free paths in a scene unit."""
    return {"type": "translucent", "sigma_s": "1,1.5,2", "sigma_a": ".02,.1,.3", "g": 0.3, "eta": 1.4,
            "model": "full_geometry", **more}  # fmt: skip


def ball(radius: float, at: tuple = (0, 0, 0), **more: Any) -> dict:
    return {"type": "sphere", "radius": radius, "center": list(at), **more}


BLACK = {"type": "diffuse", "reflectance": 0.0}
GREY = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.9, 0.5, 0.2]}}
SEED = {"type": "translucent", "sigma_s": "4,2,1", "sigma_a": ".5,.1,.02", "g": 0.0, "eta": 1.2}
AT = (0.1, 0.2, 0.3)

INSIDE: dict[str, Callable[[], dict]] = {
    "stone": lambda: {"stone": ball(0.5, AT, bsdf=GREY)},
    "second medium": lambda: {"seed": ball(0.5, AT, bsdf=SEED)},
    "stone in a second medium": lambda: {"seed": ball(0.7, bsdf=SEED), "stone": ball(0.3, (0, 0, 0.2), bsdf=GREY)},
}


def scene(
    inside: dict,
    integrator: str = "bssrdf",
    light: dict = SKY,
    unit: float = UNIT,
    reflection: bool = False,
    **more: Any,
) -> dict:
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    view = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": integrator, "mm_per_unit": unit, "max_depth": -1, **more},
        "sensor": {"type": "perspective", "fov": 20.0, "to_world": view, "film": film},
        "wax": ball(1.0, bsdf=wax(reflection=reflection)), **inside, **light,
    }  # fmt: skip


def seen(loaded: mi.Scene, spp: int) -> SurfacePoint:
    """Where rays of the camera meet the object, which fills the picture."""
    rays = camera_rays(loaded.sensors()[0], spp, (3, 4))[0]
    return FirstExits.of(loaded, WalkMedia.of(loaded, UNIT), rays).start


def images(loaded: mi.Scene, spp: int, runs: int = RUNS) -> np.ndarray:
    return independent(loaded, runs, spp).mean(axis=(1, 2))


def agree(found: np.ndarray, wanted: np.ndarray, known_to: float) -> None:
    """Means of rows, and that they are known well enough to tell."""
    mean = wanted.mean(axis=0)
    error = np.hypot(*(v.std(axis=0, ddof=1) / np.sqrt(len(v)) for v in (found, wanted)))
    assert np.all(np.abs(found.mean(axis=0) - mean) < WIDEST_Z * error), (found.mean(axis=0), mean, error)
    assert np.all(error < known_to * mean), error / mean


@pytest.mark.parametrize("kind", INSIDE)
def test_walks_from_exits_bring_the_light_of_the_image_of_walks(kind: str) -> None:
    loaded = mi.load_dict(scene(INSIDE[kind](), "translucent_walk"))
    T = np.array(trace_exits(object_of(loaded, None), seen(loaded, 512), (5,), fewest=0).T, dtype=float)
    agree(T.T, images(loaded, 64), 0.015)


def test_what_is_neither_scattered_nor_meets_anything_inside_leaves_unscattered() -> None:
    wax_ball = object_of(mi.load_dict(scene(INSIDE["second medium"](), unit=0.3)), None)
    at = wax_ball.random_points(generator(mi, N, pass_seed(1)))
    walked = np.array(trace_exits(wax_ball, at, (2,), fewest=0, most=0).T)
    exact = np.array(refract_in(at, wax_ball.media[0].eta)[1] * (1 - first_event(wax_ball, at).P))
    error = (walked - exact).std(axis=1) / np.sqrt(N)
    z = (walked - exact).mean(axis=1) / error
    assert np.all(np.abs(z) < WIDEST_Z) and np.all(error < 0.02 * exact.mean()), (z, error / exact.mean())


class Nothing:
    """S = 0, of what all orders from two on and all paths that meet something inside have."""

    orders, checksums, alpha, is_delta = "multiple", (), None, False

    def prepare(self, out: Any, active: Any) -> None:
        return None

    def S(self, exit: Any, at: Any, active: Any) -> Any:
        return mi.Spectrum(0)


LIGHTING = {"sky": SKY, "lamp": {"light": ball(2.0, (3, 1.5, 1.5), emitter={"type": "area", "radiance": 1.0})}}


@pytest.mark.slow
@pytest.mark.parametrize("light", LIGHTING)
def test_orders_below_two_of_images_are_those_of_walks_that_meet_nothing_inside(
    light: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def nothing(obj: Any, inside: Any, settings: Any) -> ObjectModel:
        found = half_space_model("better_dipole", obj.geometry, obj.media, settings)
        return ObjectModel(Nothing(), found.proposals)

    monkeypatch.setattr(prepare, "_model_of", nothing)
    loaded = mi.load_dict(scene(INSIDE["second medium"](), light=LIGHTING[light], unit=1.0))
    ends = trace_exits(object_of(loaded, None), seen(loaded, 8192), (5,), fewest=0, most=1)
    lit = mi.Spectrum(1)
    if light == "lamp":
        si = loaded.ray_intersect(mi.Ray3f(ends.at.p + 1e-3 * ends.at.n, ends.at.w))
        lit = dr.select(si.is_valid() & (dr.max(ends.T) > 0), si.emitter(loaded).eval(si), 0)
    agree(images(loaded, 128), np.array(ends.T * lit, dtype=float).T, 0.03)


# ---- Whom weights belong to ----------------------------------------------------------------------------------------

CUBE = {"type": "cube", "bsdf": GREY}
EDITS: dict[str, Callable[[], dict]] = {
    "nothing": dict,
    "smaller": lambda: {"stone": ball(0.49, AT, bsdf=GREY)},
    "a little off": lambda: {"stone": ball(0.5, (0.101, 0.2, 0.3), bsdf=GREY)},
    "mirrored": lambda: {"stone": ball(0.5, (-0.1, 0.2, 0.3), bsdf=GREY)},
    "black": lambda: {"stone": ball(0.5, AT, bsdf=BLACK)},
    "inside out": lambda: {"stone": ball(0.5, AT, bsdf=GREY, flip_normals=True)},
    "of a medium": lambda: {"stone": ball(0.5, AT, bsdf=SEED)},
    "of another medium": lambda: {"stone": ball(0.5, AT, bsdf={**SEED, "sigma_a": ".3,.1,.02"})},
    "a cube": lambda: {"stone": {**CUBE, "to_world": mi.ScalarTransform4f().translate(list(AT)).scale(0.3)}},
    "two": lambda: {"stone": ball(0.5, AT, bsdf=GREY), "other": ball(0.2, (-0.5, 0, 0), bsdf=GREY)},
}


def identity_of(inside: dict) -> Any:
    return identify(object_of(mi.load_dict(scene(inside)), None))


def test_weights_belong_to_what_lies_inside_at_its_place() -> None:
    trained = identity_of(INSIDE["stone"]())
    others = {name: identity_of(inside()) for name, inside in EDITS.items()}
    for name, other in others.items():
        moved = name in ("smaller", "a little off", "mirrored")
        wanted = "moved and turned only" if moved else "inclusions must be .*, as trained, got"
        with pytest.raises(ValueError, match=wanted):
            trained.pose(other)
        assert (trained.digest() == other.digest()) <= moved, name
    assert len({weights_name(each) for each in (trained, *others.values())}) == 1 + len(EDITS)


@pytest.mark.slow
def test_work_of_a_training_is_not_gone_on_with_after_a_thing_inside_has_moved(monkeypatch, tmp_path: Path) -> None:
    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(training._ObjectTraining, "_plan", stop)
    small = Recipe(width=8, depth=1, batch=64, chunk=2**9, reuse=1)

    def train(inside: dict) -> None:
        with pytest.raises(KeyboardInterrupt):
            full_geometry.train(mi.load_dict(scene(inside)), chunks=2, recipe=small, folder=tmp_path, work=tmp_path)

    train(INSIDE["stone"]())
    train(INSIDE["stone"]())
    with pytest.raises(ValueError, match="work must come from the same object.*moved and turned only"):
        train(EDITS["a little off"]())


def test_things_inside_are_known_in_any_order_and_under_any_name() -> None:
    a, b = ball(0.3, (0.5, 0, 0), bsdf=GREY), ball(0.3, (-0.5, 0.1, 0), bsdf=GREY)
    seed = ball(0.2, (0, 0.6, 0), bsdf={**SEED, "model": "full_geometry"})
    one, other = identity_of({"a": a, "b": b, "c": seed}), identity_of({"x": seed, "y": b, "z": a})
    assert weights_name(one) == weights_name(other)
    one.pose(other)


def test_an_object_that_is_moved_and_turned_with_what_lies_inside_is_the_same() -> None:
    def placed(turn: Any) -> Any:
        stone = {**CUBE, "to_world": turn @ mi.ScalarTransform4f().translate(list(AT)).scale(0.3)}
        outer = {"type": "cube", "to_world": turn, "bsdf": wax()}
        return identify(object_of(mi.load_dict({**scene({"stone": stone}), "wax": outer}), None))

    turn = mi.ScalarTransform4f().translate([3, 1, 2]).rotate([0.6, 0.8, 0], 40)
    here, there = placed(mi.ScalarTransform4f()), placed(turn)
    assert here.digest() == there.digest()
    R, t = here.pose(there)
    np.testing.assert_allclose(R, np.array(turn.matrix, dtype=float)[:3, :3], atol=1e-4)
    np.testing.assert_allclose(t, [3, 1, 2], atol=1e-4)


def varying() -> dict:
    grid = mi.VolumeGrid(np.random.default_rng(5).uniform(0.5, 2.0, (4, 4, 4, 1)).astype(np.float32))
    return {"type": "translucent", "sigma_t": {"type": "gridvolume", "grid": grid}, "albedo": 0.9, "eta": 1.4}


def hair() -> dict:
    """Along the x axis."""
    with tempfile.NamedTemporaryFile("w", suffix=".txt", delete=False) as file:
        file.write("".join(f"{x} 0 0 0.05\n" for x in np.linspace(-0.5, 0.5, 5)))
    return {"type": "bsplinecurve", "filename": file.name, "bsdf": BLACK}


DELTA = "inclusions of 'wax' must be opaque and no mirror, or translucent, to be learnt, .* the shape 'thing' with a "
REFUSED: dict[str, tuple[Callable[[], dict], str]] = {
    "glass": (lambda: ball(0.3, bsdf={"type": "dielectric", "int_ior": 1.5, "ext_ior": 1.4}), DELTA + "SmoothDiel"),
    "frosted": (lambda: ball(0.3, bsdf={"type": "roughdielectric", "int_ior": 1.5, "ext_ior": 1.4}), DELTA + "RoughD"),
    "mirror": (lambda: ball(0.3, bsdf={"type": "conductor"}), DELTA + "SmoothCond"),
    "varnish": (lambda: ball(0.3, bsdf={"type": "plastic"}), DELTA + "SmoothPlastic"),
    "twosided mirror": (lambda: ball(0.3, bsdf={"type": "twosided", "b": {"type": "conductor"}}), DELTA + "TwoSided"),
    "mask": (lambda: ball(0.3, bsdf={"type": "mask", "opacity": 0.5, "b": BLACK}), DELTA + "MaskBSDF"),
    "varying": (lambda: ball(0.3, bsdf=varying()), "media inside 'wax' must be homogeneous to be learnt, .* 'thing'"),
    "led": (lambda: ball(0.1, emitter={"type": "area"}), "must be empty for .*, got the shape 'thing' inside"),
    "lamp": (lambda: {"type": "point"}, "must be empty for .*, got the emitter 'thing' inside object 'wax'"),
    "curve": (hair, "must be meshes or have a transformation to be learnt, got the BSplineCurve 'thing'"),
    "wick": (lambda: ball(0.3, (0, 1, 0), bsdf=BLACK), "must be empty for .*, got the shape 'thing' partly inside"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_what_cannot_be_learnt_is_refused_by_name_before_anything_is_traced(kind: str) -> None:
    thing, message = REFUSED[kind]
    loaded = mi.load_dict(scene({"thing": thing()}))
    for ask in (lambda: object_of(loaded, None), lambda: ObjectLearner().untrained(loaded), lambda: render(loaded)):
        with pytest.raises(ValueError, match=message):
            ask()


def render(loaded: mi.Scene, spp: int = 1) -> np.ndarray:
    return np.array(loaded.integrator().render(loaded, spp=spp, seed=7))


def test_orders_of_objects_with_something_inside_and_objects_in_others_are_refused_by_name() -> None:
    loaded = mi.load_dict(scene(INSIDE["second medium"]()))
    with pytest.raises(ValueError, match="object must be one of wax, got 'seed'"):
        object_of(loaded, None, None, "seed")
    assert ObjectLearner().untrained(loaded) == ["wax"]
    for model in ("neural", "better_dipole", "neural_shape"):
        with pytest.raises(ValueError, match=f"empty for the model '{model}', got the shape 'seed' inside"):
            ObjectLearner().errors(loaded, [model])


def test_a_thing_inside_one_of_two_objects_of_one_surface_is_inside_that_one_alone() -> None:
    shared = {"type": "ref", "id": "shared"}
    apart = {"shared": wax(), "wax": ball(1.0, bsdf=shared), "other": ball(1.0, (3, 0, 0), bsdf=shared)}
    loaded = mi.load_dict({**scene(INSIDE["stone"]()), **apart})
    held = {name: object_of(loaded, None, None, name).geometry.inclusions for name in ("wax", "other")}
    assert [shape.id() for shape in held["wax"].shapes] == ["stone"] and held["other"] is None


# ---- Trained: images, edits, errors and trade ----------------------------------------------------------------------


def both() -> dict:
    """About one axis, so that all views across it show as much of an object's error as all exits."""
    return {"stone": ball(0.4, (0, 0.45, 0), bsdf=GREY), "seed": ball(0.4, (0, -0.45, 0), bsdf=SEED)}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Of an object with a stone and a second medium inside."""
    folder = tmp_path_factory.mktemp("weights")
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(known_weights.ENVIRONMENT_VARIABLE, str(folder))
        yield train(mi.load_dict(scene(both())), chunks=CHUNKS, recipe=QUICK, folder=folder)


def untrainable(inside: dict, **more: Any) -> mi.Scene:
    return mi.load_dict(scene(inside, **more))


@pytest.mark.slow
@pytest.mark.parametrize("truth", ["translucent_walk", "volpathmis"])
def test_images_of_an_object_with_things_inside_have_the_light_of_walks(truth: str, trained: Trained) -> None:
    if truth == "volpathmis":
        described = scene(both(), reflection=True)
        described["seed"]["exterior"] = medium(mi.load_dict(described["wax"]["bsdf"]).spec, UNIT)
        walked = with_media(described, UNIT, {"type": "volpathmis", "max_depth": -1, "rr_depth": 64})
    else:
        walked = mi.load_dict(scene(both(), truth, reflection=True))
    mine, wanted = images(untrainable(both(), reflection=True), 64), images(walked, 64)
    known = errors_of(trained.model.object, {"": trained.model}, exits=256, walks=1024, samples=16, seed=3)[""]
    stated = np.array([row.error for row in known if row.light == EVEN_SKY])
    ratio = mine.mean(axis=0) / wanted.mean(axis=0)
    errors = [v.std(axis=0, ddof=1) / np.sqrt(len(v)) / v.mean(axis=0) for v in (mine, wanted)]
    assert np.all(np.abs(ratio - 1) < stated + WIDEST_Z * np.hypot(*errors)), (ratio, stated, np.hypot(*errors))
    assert np.all(stated < 0.1) and np.all(np.hypot(*errors) < 0.02), (stated, np.hypot(*errors))


@pytest.mark.slow
def test_an_edited_thing_inside_is_as_in_a_fresh_scene_or_refused(trained: Trained) -> None:
    loaded = untrainable(both())
    before, parameters = render(loaded), mi.traverse(loaded)
    edits = {
        "stone.bsdf.reflectance.value": mi.Color3f(0.1),
        "stone.to_world": mi.Transform4f().translate([0, 0.4, 0]).scale(0.4),
        "seed.bsdf.sigma_t": mi.Color3f(1.0),
    }
    for key, value in edits.items():
        old = type(value)(parameters[key])
        parameters[key] = value
        parameters.update()
        with pytest.raises(ValueError, match="object 'wax' must be trained for full_geometry"):
            render(loaded)
        parameters[key] = old
        parameters.update()
        np.testing.assert_array_equal(render(loaded), before)
    np.testing.assert_array_equal(render(untrainable(both())), before)
    with pytest.raises(ValueError, match="object 'wax' must be trained for full_geometry"):
        render(untrainable({}))
    assert find_weights(object_of(loaded, None)) == trained.path


@pytest.mark.slow
def test_derivatives_by_a_thing_inside_are_refused_by_name(trained: Trained) -> None:
    loaded = untrainable(both())
    parameters = mi.traverse(loaded)
    dr.enable_grad(parameters["stone.bsdf.reflectance.value"])
    with pytest.raises(ValueError, match="reflectance.value of the shape 'stone' inside an object must not have grad"):
        loaded.integrator().render_forward(loaded, parameters, spp=1)


@pytest.mark.slow
def test_errors_and_trade_know_the_models_that_take_what_lies_inside(trained: Trained) -> None:
    loaded = untrainable(both())
    assert {row.model for row in ObjectLearner().errors(loaded, exits=16)} == {"full_geometry"}
    found = assess(loaded, models=["neural", "full_geometry"], seconds=0.4, exits=32).objects[0]
    assert found.way("full_geometry").bias < 0.1 and not found.way("full_geometry").refusal
    assert "must be empty for the model 'neural', got the shape 'stone'" in found.way("neural").refusal
