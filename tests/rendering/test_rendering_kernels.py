"""Kernels are compiled once for what differs in numbers only, and scenes go when nobody holds them."""

from __future__ import annotations

import gc
import warnings

import numpy as np
import pytest

import halfspace_sss

mi = pytest.importorskip("mitsuba")
import drjit as dr  # noqa: E402

from full_geometry.transport import any_shape  # noqa: E402

pytestmark = pytest.mark.usefixtures("little_light")


@pytest.fixture(autouse=True)
def _variant():
    import full_geometry

    mi.set_variant("llvm_ad_rgb")
    full_geometry.register()
    gc.collect()


@pytest.fixture(autouse=True)
def _few_walks(monkeypatch):
    """Of what `neural_shape` is calibrated by."""
    monkeypatch.setattr(any_shape, "WALKS", (2**12, 2**12))
    monkeypatch.setattr(any_shape, "PAIRS", (2**12, 2**12))


def loaded(material: str, model: str, mm_per_unit: float = 3.0, crop: tuple[int, ...] = (0, 0, 4, 4), light: str = ""):
    from full_geometry.scenes.scene_files import load_scene

    view = mi.ScalarTransform4f().look_at([3, 4, 9], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 12, "height": 12}
    film |= dict(zip(("crop_offset_x", "crop_offset_y", "crop_width", "crop_height"), crop))
    description = {
        "type": "scene", "integrator": {"type": "bssrdf", "mm_per_unit": mm_per_unit}, "light": {"type": "constant"},
        "object": {"type": "cube", "bsdf": {"type": "translucent", "material": material}},
        "sensor": {"type": "perspective", "to_world": view, "film": film},
    }  # fmt: skip
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_scene(description, model, settings={"light": light} if light else {})


def largest_kernel(scene, spp: int = 1) -> str:
    """Hash of the largest kernel of a render."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        np.array(mi.render(scene, spp=spp))
        return max(dr.kernel_history([dr.KernelType.JIT]), key=lambda kernel: kernel["operation_count"])["hash"]


OTHERS = [*halfspace_sss.models(), "neural_shape", "path_traced"]
DAILY = [model if model == "better_dipole" else pytest.param(model, marks=pytest.mark.slow) for model in OTHERS]


@pytest.mark.parametrize("model", DAILY)
def test_a_kernel_serves_other_materials_units_and_numbers_of_samples(model):
    """Of another index, too; walks have a kernel of their own where light is scattered evenly, as in all of these."""
    kernels = set()
    # numbers of samples that are powers of two, or less than 4, have kernels of their own in Mitsuba
    for material, mm_per_unit, spp in (("potato", 3.0, 5), ("marble", 3.0, 5), ("apple", 6.0, 7)):
        gc.collect()
        kernels.add(largest_kernel(loaded(material, model, mm_per_unit), spp))
    assert len(kernels) == 1


@pytest.mark.parametrize("model", ["better_dipole", "path_traced"])
def test_a_kernel_serves_other_crops_of_a_film(model):
    kernels = set()
    for crop in ((1, 2, 4, 4), (2, 3, 5, 3), (3, 1, 7, 9)):
        gc.collect()
        kernels.add(largest_kernel(loaded("potato", model, crop=crop), 5))
    assert len(kernels) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("model", "light"), [("better_dipole", "gathered"), ("path_traced", "precomputed")])
def test_a_scene_again_compiles_nothing_wherever_numpy_has_put_its_numbers(model, light):
    hashes, kept = [], []
    for k in range(3):
        kept.append([np.empty(100 + 37 * k + j, np.uint8) for j in range(8)])  # so that other memory is free
        gc.collect()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            scene = loaded("potato", model, light=light)
            np.array(mi.render(scene, spp=4, seed=k))
            hashes.append({kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])})
        del scene
    # the second image may still find the registry of the first
    assert len(hashes[0]) > 10 and not hashes[2] - (hashes[0] | hashes[1])


def _ball(rng: np.random.Generator, light: str = "sampled", side: int = 4):
    """Walks in a ball of random size and medium, under a sky, lamp and point."""
    view = mi.ScalarTransform4f().look_at([3, 4, 19], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": side, "height": side, "rfilter": {"type": "box"}}
    wax = {"type": "translucent", "sigma_t": rng.uniform(0.5, 4), "albedo": rng.uniform(0.3, 0.99)}
    lamp = {"type": "sphere", "center": [4, 5, 9], "radius": rng.uniform(0.3, 0.6), "emitter": {"type": "area"}}
    return mi.load_dict({
        "type": "scene", "integrator": {"type": "translucent_walk", "light": light}, "sky": {"type": "constant"},
        "ball": {"type": "sphere", "radius": rng.uniform(2, 4), "bsdf": wax}, "lamp": lamp,
        "bulb": {"type": "point", "position": [-rng.uniform(4, 6), 5, 9]},
        "sensor": {"type": "perspective", "to_world": view, "film": film},
    })  # fmt: skip


def _of_size(rng: np.random.Generator, light: str = "sampled") -> dict[str, int]:
    """Operations by hash of all kernels of `_ball`."""
    scene = _ball(rng, light)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        np.array(mi.render(scene, spp=4))
        return {kernel["hash"]: kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT])}


def test_walks_in_objects_of_other_sizes_need_no_other_kernel():
    """Each would stay in the process, 1 to 1.5 MB of it."""
    rng = np.random.default_rng(1)
    first, *others = (_of_size(rng) for _ in range(3))
    assert set().union(*others) <= set(first)


def test_one_kernel_traces_paths_of_the_image_and_those_that_tell_its_glints():
    """The largest kernel of an image: it takes seconds to compile on a GPU."""
    operations = sorted(_of_size(np.random.default_rng(1), "precomputed").values())
    assert operations[-2] < 0.9 * operations[-1]


def test_glints_of_all_channels_are_traced_at_once_in_films_of_all_sizes():
    from full_geometry.integrators.glints import Glints, glint_light, glints_of
    from full_geometry.precomputed.unscattered_light import ImageSamples

    found = []
    for side in (4, 6):
        gc.collect()
        scene = _ball(np.random.default_rng(1), "precomputed", side)
        sensor, tracer = scene.sensors()[0], scene.integrator().tracer(scene, 0, ImageSamples(16, 16))
        glints = Glints(mi.UInt32(1, 2), mi.Point2f(0, [0.2, 0.4]), mi.Point2f(1, [0.6, 0.8]), mi.Float(1))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True), dr.suspend_grad():
            dr.kernel_history_clear()
            dr.eval(glint_light(tracer, sensor, glints, 0, (0, 4)))
            glints_of(tracer, sensor, 2)
            kernels = dr.kernel_history([dr.KernelType.JIT])
        found.append([kernel["hash"] for kernel in kernels if 1000 < kernel["operation_count"] < 4000])
        del scene, tracer
    # two halves of a pixel and a search, which goes on in a pixel of the larger one
    assert [len(each) for each in found] == [3, 4] and set(found[0]) == set(found[1])


def test_the_mean_over_channels_is_that_of_numbers():
    from full_geometry.geometry.points import channel_mean

    assert np.array(channel_mean(mi.Color3f(1, 2, 6))) == pytest.approx([3])
    assert np.array(channel_mean(mi.Color1f(mi.Float(4, 5)))) == pytest.approx([4, 5])


@pytest.mark.parametrize("model", ["standard_dipole", "path_traced"])
def test_a_rendered_scene_is_freed_with_its_last_name(model):
    """Its objects then give their numbers back."""
    numbers = []
    for _ in range(3):
        gc.collect()
        scene = loaded("potato", model)
        np.array(mi.render(scene, spp=1))
        numbers.append(int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(scene.shapes()[0]))[0]))
        del scene
    assert len(set(numbers)) == 1


def test_no_garbage_is_collected_while_walks_are_recorded(monkeypatch):
    """What it frees of earlier scenes gave a kernel the same function twice, of which LLVM ended the process."""
    collects = []
    monkeypatch.setattr(
        "full_geometry.integrators.translucent_walk._render", lambda *_: collects.append(gc.isenabled())
    )
    walk = mi.load_dict({"type": "translucent_walk", "light": "sampled"})
    walk.render(loaded("potato", "better_dipole"), spp=1, develop=False)
    assert collects == [False] and gc.isenabled()
