"""Media that vary in space as `full_geometry` learns them: the way to the first event, identity, images, objects.

Ratios of means are held to the stated error of the model and four standard errors of the images.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from rendered import independent

dr = pytest.importorskip("drjit")
mi = pytest.importorskip("mitsuba")
pytest.importorskip("torch")

import full_geometry  # noqa: E402
from full_geometry.geometry.points import SurfacePoint  # noqa: E402
from full_geometry.learning.model_errors import LIGHTS, compare, modelled, reference, transport_of  # noqa: E402
from full_geometry.learning.network_fitting import Recipe  # noqa: E402
from full_geometry.learning.training import Trained, train  # noqa: E402
from full_geometry.objects.objects import TranslucentObject, object_of  # noqa: E402
from full_geometry.scenes.scene_files import load_objects, load_scene  # noqa: E402
from full_geometry.transport import storing  # noqa: E402
from full_geometry.transport.exit_pairs import EntryProposals  # noqa: E402
from full_geometry.transport.features import first_event, flight  # noqa: E402
from full_geometry.transport.one_object import HalfSpace  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
QUICK = Recipe(width=32, depth=2, batch=512, chunk=2**14, reuse=2)
CHUNKS, PASSES = 5, 6
RNG = np.random.default_rng(3)
DENSITY = 8.0 ** -RNG.random((4, 4, 4, 1))
ALBEDO = 0.9 + 0.095 * RNG.random((4, 4, 4, 3))


def grid(values: np.ndarray, to_world, **more) -> dict:
    volume = mi.VolumeGrid(np.asarray(values, dtype=np.float32))
    return {"type": "gridvolume", "grid": volume, "raw": True, "to_world": to_world, **more}


def bunny(turn: float = 0.0, shift: float = 0.0, slip: float = 0.0, density: np.ndarray = DENSITY, **more) -> dict:
    """About 5 mean free paths of a mean extinction across, its grids moved with it, or slipped by a length."""
    at = mi.ScalarTransform4f().translate([shift, 0, 0]).rotate([0.6, 0.8, 0], turn).scale(0.4)
    box = at.translate([-1.2 + slip, -0.1, -1.0]).scale([2.4, 2.4, 2.0])
    media = {"sigma_t": grid(density, box), "albedo": grid(ALBEDO, box), "scale": 5.0, "eta": 1.4, **more}
    surface = {"type": "translucent", "model": "full_geometry", "orders": "multiple", "reflection": False, **media}
    return {"type": "ply", "filename": str(BUNNY), "to_world": at, "bsdf": surface}


def objects(mm_per_unit: float = 1.0, **found) -> dict:
    return {"type": "scene", "integrator": {"type": "bssrdf", "mm_per_unit": mm_per_unit}, **found}


def varying_object(**found) -> TranslucentObject:
    return object_of(load_objects(objects(bunny=bunny(**found))), None)


@pytest.fixture(scope="module")
def trained(folder: Path) -> Trained:
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    return train(load_objects(objects(bunny=bunny())), chunks=CHUNKS, recipe=QUICK, folder=folder)


def constant(rows: list) -> np.ndarray:
    return np.array([row.error for row in rows if row.light == LIGHTS[0]])


def test_a_march_gives_the_transmittance_and_the_way_of_light_in_layers() -> None:
    layers = np.array([0.4, 3.0, 0.2, 1.0])
    at = mi.ScalarTransform4f().scale([4, 4, 4])
    medium = {"sigma_t": grid(layers.reshape(4, 1, 1, 1), at), "albedo": 0.9, "eta": 1.4}
    cube = {"type": "cube", "to_world": at.translate([0.5, 0.5, 0.5]).scale(0.5)}
    scene = {"cube": {**cube, "bsdf": {"type": "translucent", **medium}}}
    obj = object_of(load_objects(objects(**scene)), None)
    starts, lengths = np.array([0.0, 0.3, 1.0, 2.2]), np.array([4.0, 2.0, 0.5, 1.7])
    o = mi.Point3f(np.stack([0 * starts + 2, 0 * starts + 2, starts]))
    T, inner = flight(obj, o, mi.Vector3f(0, 0, 1), mi.Float(lengths), obj.sigma_t)
    for k, (start, length) in enumerate(zip(starts, lengths)):
        s = np.linspace(0, length, 20001)
        sigma_t = np.interp(start + s, np.arange(4) + 0.5, layers)
        way = np.append(0, np.cumsum(0.5 * (sigma_t[1:] + sigma_t[:-1]) * np.diff(s)))
        assert np.array(T)[0, k] == pytest.approx(np.exp(-way[-1]), abs=0.01)
        assert np.array(inner)[0, k] == pytest.approx(np.trapezoid(s * sigma_t * np.exp(-way), s), rel=0.05)


def test_a_grid_of_one_value_gives_the_first_event_of_the_homogeneous_medium() -> None:
    plain = {"sigma_t": "2.0", "scale": 1.0, "albedo": "0.9, 0.8, 0.7"}
    same = varying_object(density=np.full((2, 2, 2, 1), 0.4), albedo="0.9, 0.8, 0.7")
    known = varying_object(**plain)
    at = known.random_points(generator(mi, 2048, pass_seed(4)))
    a, b = first_event(same, at), first_event(known, at)
    assert np.allclose(np.array(a.P), np.array(b.P), atol=2e-3)
    assert np.allclose(np.array(a.y), np.array(b.y), atol=2e-3)


@pytest.mark.slow
def test_training_halves_the_error_of_the_half_space_in_a_medium_that_varies(trained: Trained) -> None:
    obj = trained.model.object
    proposals = EntryProposals(obj, HalfSpace(obj, "better_dipole"))
    truth = reference(obj, 128, 1024)
    plane = compare(modelled(transport_of(obj, "better_dipole"), proposals, truth.exits, 1024), truth.truth)
    assert np.all(constant(trained.errors) < 0.5 * constant(plane))


def S_of(model, points: list[SurfacePoint]) -> np.ndarray:
    exits, entries = points
    return np.array(model.S(model.prepare(exits), entries))


@pytest.mark.slow
def test_an_object_moved_with_its_grids_is_the_same_one(trained: Trained, folder: Path) -> None:
    moved = varying_object(turn=40.0, shift=3.0)
    again = storing.load(storing.find_weights(moved, folder), moved).model
    rng = generator(mi, 4096, pass_seed(7))
    points = [trained.model.object.random_points(rng) for _ in range(2)]
    turn = mi.Transform4f().translate([3, 0, 0]).rotate([0.6, 0.8, 0], 40)
    a, b = S_of(trained.model, points), S_of(again, [SurfacePoint(*(turn @ v for v in point[:4])) for point in points])
    seen = a > 1e-3 * a.max()
    assert np.median(np.abs(b[seen] / a[seen] - 1)) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"density": DENSITY[::-1]}, "must be trained for full_geometry"),
        ({"slip": 0.3}, "medium must vary in the object as trained, got grids placed"),
        ({"scale": 5.1}, "medium must vary in the object as trained|size_in_mfp of the medium"),
        ({"sigma_t": 5.0, "albedo": 0.95, "scale": 0.5}, "must be trained for full_geometry"),
    ],
    ids=["voxels", "place", "scale", "homogeneous"],
)
def test_weights_of_another_medium_are_refused(trained: Trained, folder: Path, changed: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        storing.find_weights(varying_object(**changed), folder)


def test_errors_refuse_a_model_of_a_medium_that_varies_as_renders_do() -> None:
    with pytest.raises(ValueError, match="must be the same everywhere for neural_shape, got one that varies"):
        transport_of(varying_object(), "neural_shape")


def halves(shown: dict, model: str, mm_per_unit: float, spp: int = 128) -> np.ndarray:
    """Mean of the left and of the right half of the picture in every pass under an even sky, (passes, 2, channels)."""
    box = load_objects(objects(**shown)).bbox()
    centre, size = np.array(box.center()), float(np.linalg.norm(np.array(box.extents())))
    at = mi.ScalarTransform4f().look_at((centre + [0, 0.3 * size, 2 * size]).tolist(), centre.tolist(), [0, 1, 0])
    film = {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}}
    plugin = "translucent_walk" if model == "path_traced" else "bssrdf"
    scene = {
        "type": "scene",
        "integrator": {"type": plugin, "max_depth": -1, "hide_emitters": True, "mm_per_unit": mm_per_unit},
        "light": {"type": "constant"}, **shown,
        "sensor": {"type": "perspective", "fov": 28.0, "to_world": at, "film": film},
    }  # fmt: skip
    loaded = load_scene(scene, model)
    return independent(loaded, PASSES, spp).reshape(PASSES, 16, 2, 12, -1)[..., :3].mean(axis=(1, 3))


def agree(shown: dict, trained: Trained, mm_per_unit: float = 1.0) -> None:
    found, walked = (halves(shown, model, mm_per_unit) for model in ("full_geometry", "path_traced"))
    ratio = found.mean(axis=0) / walked.mean(axis=0)
    errors = np.hypot(*(v.std(axis=0, ddof=1) / np.sqrt(PASSES) / v.mean(axis=0) for v in (found, walked)))
    stated = constant(trained.errors)
    assert np.all(np.abs(ratio - 1) < stated + 4 * errors), (ratio, stated)
    assert np.all(stated < 0.12) and np.all(errors < 0.02)


@pytest.mark.slow
def test_an_image_has_the_light_of_walks_within_the_stated_error(trained: Trained) -> None:
    agree({"bunny": bunny()}, trained)


@pytest.mark.slow
def test_nobody_is_told_of_means_where_the_medium_is_learnt(trained: Trained) -> None:
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        load_scene(objects(bunny=bunny()))
    assert not any("varies in space" in str(warning.message) for warning in found)
