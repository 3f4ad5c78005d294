"""Objects that were trained, in scenes: images against walks, what moves with them, and which are refused.

Ratios of means are held to the stated error of the model and four standard errors of the images.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from coarse import coarse_ball
from rendered import independent

from halfspace_sss import Medium

mi = pytest.importorskip("mitsuba")
torch = pytest.importorskip("torch")
import drjit as dr  # noqa: E402

import full_geometry  # noqa: E402
from full_geometry.learning import training  # noqa: E402
from full_geometry.learning.model_errors import (  # noqa: E402
    EVEN_SKY,
    LIGHTS,
    errors_of,
    reference,  # noqa: E402
)
from full_geometry.learning.network_fitting import ALPHA_HIDDEN, Recipe  # noqa: E402
from full_geometry.learning.training import Trained, train, trusted  # noqa: E402
from full_geometry.objects.objects import object_of  # noqa: E402
from full_geometry.scenes.scene_files import load_objects, load_scene  # noqa: E402
from full_geometry.transport import storing  # noqa: E402
from full_geometry.transport.exit_pairs import trace_exits  # noqa: E402
from full_geometry.transport.features import (  # noqa: E402
    Quadratic,
    first_event,  # noqa: E402
    n_side,
)
from full_geometry.transport.one_object import BOUND  # noqa: E402
from halfspace_sss.neural.store import load_weights, save_weights  # noqa: E402
from halfspace_sss.tracing.walk import generator, pass_seed  # noqa: E402

pytestmark = pytest.mark.usefixtures("rgb")

BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
QUICK = Recipe(width=32, depth=2, batch=512, chunk=2**14, reuse=2)
CHUNKS, PASSES = 6, 6
COLOURS = {"sigma_s": "0.95,0.8,0.6", "sigma_a": "0.05,0.2,0.4", "eta": 1.4}
WAX = Medium(np.array([0.95, 0.8, 0.6]), np.array([0.05, 0.2, 0.4]), 0.0, 1.4)
SURFACE = {"type": "translucent", **COLOURS, "model": "full_geometry", "orders": "multiple", "reflection": False}


@pytest.fixture(scope="module")
def trained(folder: Path) -> Trained:
    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    return train(mi.load_dict(bunny()), WAX, chunks=CHUNKS, recipe=QUICK, folder=folder)


def bunny(mirror: bool = False, turn: float = 0.0, shift: float = 0.0, flip: bool = False, **more) -> dict:
    """About 4 mean free paths across."""
    at = (
        mi.ScalarTransform4f()
        .translate([shift, 0, 0])
        .rotate([0, 1, 0], turn)
        .scale([-0.4 if mirror else 0.4, 0.4, 0.4])
    )
    return {"type": "ply", "filename": str(BUNNY), "flip_normals": flip, "to_world": at, **more}


def scene(objects: dict, model: str, **integrator) -> dict:
    """Objects under an even sky, alone in the picture."""
    box = load_objects({"type": "scene", **objects}).bbox()
    centre, size = np.array(box.center()), float(np.linalg.norm(np.array(box.extents())))
    at = mi.ScalarTransform4f().look_at((centre + [0, 0.3 * size, 2 * size]).tolist(), centre.tolist(), [0, 1, 0])
    film = {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}}
    plugin = "translucent_walk" if model == "path_traced" else "bssrdf"
    return {
        "type": "scene", "integrator": {"type": plugin, "max_depth": -1, "hide_emitters": True, **integrator},
        "light": {"type": "constant"}, **objects,
        "sensor": {"type": "perspective", "fov": 28.0, "to_world": at, "film": film},
    }  # fmt: skip


def halves(objects: dict, model: str, spp: int = 128) -> np.ndarray:
    """Mean of the left and of the right half of the picture in every pass, (passes, 2, channels)."""
    loaded = load_scene(scene(objects, model), model)
    return independent(loaded, PASSES, spp).reshape(PASSES, 16, 2, 12, -1)[..., :3].mean(axis=(1, 3))


def agree(objects: dict, trained: Trained, spp: int = 32) -> None:
    """Both halves have the light of walks, up to the stated error; the half-space has not."""
    found, walked = (halves(objects, model, spp) for model in ("full_geometry", "path_traced"))
    stated = np.array([row.error for row in trained.errors if row.light == LIGHTS[0]])
    ratio = found.mean(axis=0) / walked.mean(axis=0)
    errors = [v.std(axis=0, ddof=1) / np.sqrt(PASSES) / v.mean(axis=0) for v in (found, walked)]
    assert np.all(np.abs(ratio - 1) < stated + 4 * np.hypot(*errors)), (ratio, stated)
    assert np.all(stated < 0.1) and np.all(np.hypot(*errors) < 0.02), errors


@pytest.mark.slow
def test_an_image_has_the_light_of_walks_within_the_stated_error(trained: Trained) -> None:
    agree({"bunny": bunny(bsdf=SURFACE)}, trained)


@pytest.mark.slow
def test_other_numbers_of_samples_need_no_new_kernel(trained: Trained) -> None:
    loaded = load_scene(scene({"bunny": bunny(bsdf=SURFACE)}, "full_geometry"), "full_geometry")
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for spp in (5, 7):
            dr.kernel_history_clear()
            np.array(mi.render(loaded, spp=spp))
    kernels = dr.kernel_history([dr.KernelType.JIT])
    assert kernels and all(kernel["cache_hit"] and not kernel["cache_disk"] for kernel in kernels)


@pytest.mark.slow
def test_a_coarse_ball_with_vertex_normals_has_the_light_of_walks(folder: Path, tmp_path: Path) -> None:
    """Without what enters or leaves below the horizon of its interpolated normals 2.7 % were missing."""
    ball = {**coarse_ball(tmp_path), "to_world": mi.ScalarTransform4f().scale(4.0)}
    train(mi.load_dict(ball), WAX, chunks=8, recipe=QUICK, folder=folder)
    objects = {"ball": {**ball, "bsdf": SURFACE}}
    samples = {"full_geometry": 64, "path_traced": 512}  # the model has a tenth of the noise still
    found, walked = (halves(objects, model, spp).mean(axis=1) for model, spp in samples.items())
    errors = [v.std(axis=0, ddof=1) / np.sqrt(PASSES) / v.mean(axis=0) for v in (found, walked)]
    ratio = found.mean(axis=0) / walked.mean(axis=0)
    assert np.all(np.abs(ratio - 1) < 0.01 + 3 * np.hypot(*errors)) and np.all(np.hypot(*errors) < 0.004), (
        ratio,
        errors,
    )


@pytest.mark.slow
def test_the_half_space_misses_that_light_by_more(trained: Trained) -> None:
    objects = {"bunny": bunny(bsdf=SURFACE)}
    plane, walked = (halves(objects, model).mean(axis=0) for model in ("better_dipole", "path_traced"))
    stated = max(row.error for row in trained.errors if row.light == LIGHTS[0])
    assert np.all(np.abs(plane / walked - 1) > 2 * stated)


@pytest.mark.slow
def test_two_objects_of_one_mesh_are_both_known_moved_and_turned_inside_out(trained: Trained) -> None:
    shared = {"type": "ref", "id": "wax"}
    one, two = bunny(shift=-2.5, bsdf=shared), bunny(shift=2.5, turn=130.0, flip=True, bsdf=shared)
    agree({"wax": {**SURFACE, "id": "wax"}, "one": one, "two": two}, trained)


@pytest.mark.slow
def test_another_object_beside_it_keeps_its_own_model(trained: Trained) -> None:
    ball = {"type": "sphere", "center": [5, 0, 0], "radius": 1.0, "bsdf": {**SURFACE, "model": "better_dipole"}}
    loaded = load_scene(scene({"bunny": bunny(bsdf=SURFACE), "ball": ball}, "mixed"))
    found = {b.geometry.shape.id(): b.transport for b in loaded.integrator().prepare(loaded)}
    assert type(found["bunny"]).__name__ == "FullGeometry"
    assert type(found["ball"].transport).__name__ == "HalfSpaceTransport"


@pytest.mark.slow
def test_the_mirrored_object_is_another_one(trained: Trained) -> None:
    mirrored = {"bunny": bunny(mirror=True, bsdf=SURFACE)}
    with pytest.raises(ValueError, match="must be trained for full_geometry"):
        load_scene(scene(mirrored, "full_geometry"))


def test_objects_with_the_same_surface_are_not_merged(tmp_path: Path) -> None:
    text = "".join(
        f'<shape type="ply" id="{name}"><string name="filename" value="{BUNNY}"/><ref id="wax"/></shape>'
        for name in ("one", "two")
    )
    surface = '<bsdf type="translucent" id="wax"><string name="material" value="marble"/></bsdf>'
    (tmp_path / "two.xml").write_text(f'<scene version="3.0.0">{surface}{text}</scene>')
    assert sorted(s.id() for s in load_objects(tmp_path / "two.xml").shapes()) == ["one", "two"]


def test_objects_that_mitsuba_merged_are_refused_by_what_they_are(folder: Path) -> None:
    both = {name: bunny(bsdf=SURFACE) for name in ("one", "two")}
    loaded = mi.load_dict(scene(both, "full_geometry"), optimize=True)
    with pytest.raises(ValueError, match="object without an id .Mitsuba merges meshes of one surface"):
        loaded.integrator().prepare(loaded)


def refused(objects: dict, message: str, folder: Path) -> None:
    """Refused by what learns and by what renders, before either has traced anything."""
    whole = scene(objects, "full_geometry")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # sizes that are beside the point
        with pytest.raises(ValueError, match=message):
            train(load_objects(whole), folder=folder)
        with pytest.raises(ValueError, match=message):
            load_scene(whole)


@pytest.mark.slow
def test_a_rough_boundary_is_refused(trained: Trained, folder: Path) -> None:
    rough = {"type": "roughdielectric", "alpha": 0.2, "int_ior": 1.4, "ext_ior": 1.0}
    refused({"bunny": bunny(bsdf={**SURFACE, "boundary": rough})}, "boundary of object 'bunny' must be smooth", folder)


def test_an_instance_is_refused(folder: Path) -> None:
    group = {"type": "shapegroup", "inner": {"type": "sphere", "bsdf": SURFACE}}
    objects = {"group": group, "copy": {"type": "instance", "inner": {"type": "ref", "id": "group"}}}
    with pytest.raises(ValueError, match="object must not be an instance to be learnt, got 'copy'"):
        train(load_objects({"type": "scene", **objects}), object="copy", folder=folder)


def test_a_medium_that_nowhere_scatters_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="medium must scatter in at least one channel"):
        train(mi.load_dict({"type": "sphere"}), Medium(0.0, 1.0), folder=folder)


def test_a_mesh_with_a_hole_is_warned_of_in_a_sentence() -> None:
    shape = mi.load_dict(bunny())
    parameters = mi.traverse(shape)
    parameters["faces"] = np.array(parameters["faces"])[: 3 * (shape.face_count() - 2000)]
    parameters.update()
    with pytest.warns(UserWarning, match="is not closed: .* light that enters or leaves at the gap is lost"):
        object_of(shape, WAX)


def test_vertex_normals_against_their_faces_give_the_same_exits() -> None:
    from full_geometry.learning.model_errors import reference

    upright, turned = (mi.load_dict({"type": "ply", "filename": str(BUNNY)}) for _ in range(2))
    parameters = mi.traverse(turned)
    parameters["vertex_normals"] = -parameters["vertex_normals"]
    parameters.update()
    wax = Medium(np.array([0.95, 0.8, 0.6]), np.array([0.05, 0.2, 0.4]), 0.0, 1.4)
    known = [reference(object_of(shape, wax, 2.0), exits=64, walks=512).truth.mean for shape in (upright, turned)]
    alike = np.isclose(*known, rtol=1e-4, atol=1e-5)
    # by rounding a walk at the edge of two faces may end in either: of one exit at most
    assert np.count_nonzero(~alike.all(axis=(0, 2))) <= 1


def test_pieces_that_are_wound_differently_are_refused() -> None:
    cube = mi.traverse(mi.load_dict({"type": "cube"}))
    corners, faces = (np.array(cube[key]).reshape(-1, 3) for key in ("vertex_positions", "faces"))
    both = mi.Mesh("both", 2 * len(corners), 2 * len(faces))
    parameters = mi.traverse(both)
    parameters["vertex_positions"] = np.concatenate([corners, corners + [5, 0, 0]]).ravel().astype(np.float32)
    parameters["faces"] = np.concatenate([faces, faces[:, ::-1] + len(corners)]).ravel().astype(np.uint32)
    parameters.update()
    with pytest.raises(ValueError, match="must all point to the same side to be learnt, got pieces"):
        object_of(both, WAX)


@pytest.mark.slow
def test_weights_of_another_version_are_left_aside_by_name(trained: Trained, tmp_path: Path) -> None:
    for path in (trained.path, trained.path.with_suffix(".json")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    record = tmp_path / trained.path.with_suffix(".json").name
    record.write_text(record.read_text().replace('"format": ', '"format": 9'))
    with pytest.raises(ValueError, match=f"must be trained for full_geometry.*{trained.path.name}.*format must be"):
        storing.find_weights(trained.model.object, tmp_path)


@pytest.mark.slow
def test_a_scene_of_another_unit_is_another_object(trained: Trained) -> None:
    with pytest.raises(ValueError, match="size_in_mfp of the medium"):
        load_scene(scene({"bunny": bunny(bsdf=SURFACE)}, "full_geometry", mm_per_unit=1.1))


# ---- Directional albedo under uniform illumination: its error, its file, its images ----------------


@pytest.mark.slow
def test_orders_below_two_and_the_others_agree_with_walks(trained: Trained) -> None:
    obj, n = trained.model.object, 2**18
    at = obj.random_points(generator(mi, n, pass_seed(3)))
    T = [trace_exits(obj, at, (4,), fewest=fewest).T for fewest in (0, 2)]
    few, more = (np.array(v) for v in trained.model.alpha(at))
    walked = np.array(T[0] - T[1]), np.array(T[1])
    for learnt, walk in zip((few, more), walked):
        error = (learnt - walk).std(axis=1) / np.sqrt(n)
        assert np.all(np.abs((learnt - walk).mean(axis=1)) <= 4 * error + 0.01 * walk.mean(axis=1))
    P = np.array(first_event(obj, at).P)
    assert np.all(more >= 0) and np.all(more <= P + 1e-5)


@pytest.mark.slow
def test_S_of_training_and_of_images_know_the_same_of_even_light(trained: Trained) -> None:
    obj, n = trained.model.object, 4096
    run = training._ObjectTraining(obj, QUICK, 0, None, None)
    networks, generator_ = run.fitting.average, torch.Generator().manual_seed(1)
    with torch.no_grad():
        for p in networks.parameters():
            p.normal_(std=0.2, generator=generator_)
    arrays = run.arrays()
    arrays[storing.ENDS] = 0.01 * np.random.default_rng(2).standard_normal(arrays[storing.ENDS].shape)
    model = storing.assemble(obj, run.frame, run.base, arrays).model
    rng = generator(mi, n, pass_seed(6))
    exits, entries = obj.random_points(rng), obj.random_points(rng)
    pairs = run.source._columns(exits, entries, mi.Float(1) + 0 * entries.p.x)
    with torch.no_grad():
        joined = networks["alpha"].joined(torch.from_numpy(pairs.features))
        g = BOUND * np.arctanh(networks["S"](joined).numpy() / BOUND)
    ends = [[mi.Float(v) for v in side] for side in np.split(pairs.features[: 2 * n_side(3)], 2)]
    h = sum(np.array([v.numpy() for v in Quadratic(arrays[storing.ENDS], n_side(3))(side)]) for side in ends)
    f = BOUND * np.tanh((g + h) / BOUND)
    assert h.std() > 0.02 and f.std() > 0.1 and len(joined) == len(pairs.features) + 2 * ALPHA_HIDDEN[-1]
    S = np.array(model.S(model.prepare(exits), entries))
    assert np.allclose(S, pairs.values * np.exp(f), rtol=0.02, atol=1e-4 * S.max())  # weights in half precision


@pytest.mark.slow
@pytest.mark.parametrize("missing", [storing.TRUSTED, storing.TURNS, storing.ENDS])
def test_weights_of_before_it_was_known_are_refused_by_name(trained: Trained, missing: str, tmp_path: Path) -> None:
    arrays, record = load_weights(trained.path, storing.KIND)
    path = tmp_path / trained.path.name
    save_weights(path, storing.KIND, {k: v for k, v in arrays.items() if k != missing}, record)
    obj = object_of(mi.load_dict(bunny()), WAX)
    with pytest.raises(ValueError, match=f"must hold {missing}.*to be trained again"):
        storing.find_weights(obj, tmp_path)
    with pytest.raises(ValueError, match="to be trained again"):
        storing.load(path, obj)


@pytest.mark.slow
def test_only_what_is_wrong_in_a_channel_is_left_to_other_estimates(trained: Trained) -> None:
    model, alpha = trained.model, trained.model.alpha
    truth = reference(model.object, 128, 512, 5)

    def judged(order: int, channel: int) -> np.ndarray:
        last = f"a_{len(alpha.weights) // 2 - 1}"
        bias = alpha.weights[last].copy()
        bias[3 * order + channel] += 1.0
        wrong = replace(alpha, weights={**alpha.weights, last: bias})
        found = trusted(replace(model, alpha=wrong), truth, trained.errors, 512, (6,))
        few, more = (np.array(v) for v in replace(wrong, trusted=found)(truth.exits))
        assert np.all((few > 0).any(axis=1) == (found[0] > 0)) and np.all(more[found[1] == 0] == 0)
        return found

    assert judged(0, 2).tolist() == [[1, 1, 0], [1, 1, 1]]
    assert judged(1, 0).tolist() == [[1, 1, 1], [0, 1, 1]]


@pytest.mark.slow
def test_errors_of_images_of_an_even_sky_are_those_of_alpha_where_it_is_trusted_and_of_S_elsewhere(
    trained: Trained,
) -> None:
    model = trained.model

    def rows(known: list[float]) -> dict[str, list[tuple]]:
        alpha = replace(model.alpha, trusted=np.array([[1.0, 1.0, 1.0], known]))
        found = errors_of(model.object, {"it": replace(model, alpha=alpha)}, exits=64, walks=1024, samples=512)["it"]
        return {kind: [row[2:] for row in found if row.light == kind] for kind in (EVEN_SKY, *LIGHTS)}

    by_alpha, by_S = rows([1.0, 0.0, 1.0]), rows([0.0, 0.0, 0.0])
    assert by_S[EVEN_SKY] == by_S["constant"] == by_alpha["constant"]
    changed = [a != b for a, b in zip(by_alpha[EVEN_SKY], by_S[EVEN_SKY])]
    assert changed == [True, False, True]
    assert all(abs(by_alpha[EVEN_SKY][c][0] - by_S[EVEN_SKY][c][0]) < 0.1 for c in (0, 2))


class _WithoutAlbedo:
    """S of a transport that knows no directional albedo."""

    alpha = None

    def __init__(self, transport: Any) -> None:
        self._transport = transport

    def __getattr__(self, name: str) -> Any:
        return getattr(self._transport, name)


@pytest.mark.slow
def test_an_even_sky_has_the_same_light_and_a_fifth_of_the_variance(trained: Trained) -> None:
    view = mi.ScalarTransform4f().look_at([0, 2, 9], [-0.2, 1.9, 0], [0, 1, 0]).scale(1.0)
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}}
    surface = {"type": "translucent", **COLOURS, "model": "full_geometry"}
    scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "bssrdf"}, "sky": {"type": "constant"},
        "bunny": bunny(bsdf=surface), "sensor": {"type": "orthographic", "to_world": view, "film": film},
    })  # fmt: skip
    means, variances = [], []
    for knows in (True, False):
        if not knows:
            for body in scene.integrator().prepare(scene):
                object.__setattr__(body, "transport", _WithoutAlbedo(body.transport))
        runs = independent(scene, 8, 32)
        means.append(runs.mean(axis=(0, 1, 2)))
        variances.append(runs.var(axis=0, ddof=1).mean())
    error = np.sqrt(sum(variances) / 8) / 16
    worst = max(row.error for row in trained.errors if row.light == LIGHTS[0])
    assert np.all(np.abs(means[0] - means[1]) < 4 * error + worst * means[1])
    assert variances[0] < 0.2 * variances[1]
