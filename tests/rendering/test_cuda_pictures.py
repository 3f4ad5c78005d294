"""Pictures by OptiX against the same ones on LLVM: two objects over a floor, each of which has a scene of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from on_cuda import CUDA, LOST, agree, both, on, why_not

from halfspace_sss import Medium

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())

BUNNY = Path(__file__).parents[2] / "figures" / "assets" / "bunny.ply"
WAX = {"sigma_s": "0.95,0.8,0.6", "sigma_a": "0.05,0.2,0.4", "eta": 1.4}
MEDIUM = Medium([0.95, 0.8, 0.6], [0.05, 0.2, 0.4], 0.0, 1.4)
SPP, SEEDS = 128, ((3,), (4,))
HALF = 5e-3  # of a mean, for networks in half precision
MODELS = {"path_traced": 0.0, "better_dipole": 0.0, "neural": HALF, "neural_shape": HALF, "full_geometry": HALF}


def bunny(**more: object) -> dict:
    """About 4 mean free paths across."""
    import mitsuba as mi

    at = mi.ScalarTransform4f().translate([4.5, 0, 0]).scale(0.4)
    return {"type": "ply", "filename": str(BUNNY), "to_world": at, **more}


def scene(model: str, **integrator: object) -> dict:
    """A ball, which need not be learnt, and a bunny of another medium over a floor, under a sky and a lamp."""
    import mitsuba as mi

    walks, learnt = model == "path_traced", model == "full_geometry"
    ball = {**WAX, "sigma_s": 1.5, "model": "better_dipole" if walks or learnt else model}
    at = mi.ScalarTransform4f()
    film = {"type": "hdrfilm", "width": 24, "height": 16, "rfilter": {"type": "box"}, "component_format": "float32"}
    return {
        "type": "scene",
        "integrator": {"type": "translucent_walk" if walks else "bssrdf", "max_depth": 4, **integrator},
        "sensor": {"type": "perspective", "fov": 35.0, "film": film,
                   "to_world": at.look_at([2.0, 6.0, 14.0], [2.0, 1.5, 0.0], [0, 1, 0])},
        "sky": {"type": "constant", "radiance": 0.5},
        "lamp": {"type": "sphere", "center": [2, 10, 4], "radius": 2.0, "emitter": {"type": "area", "radiance": 8.0}},
        "floor": {"type": "rectangle", "to_world": at.translate([0, -0.05, 0]).rotate([1, 0, 0], -90).scale(12.0)},
        "ball": {"type": "sphere", "center": [0, 2, 0], "radius": 2.0, "bsdf": {"type": "translucent", **ball}},
        "bunny": bunny(bsdf={"type": "translucent", **WAX, "model": "better_dipole" if walks else model}),
    }  # fmt: skip


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory):
    """A folder with what CUDA has learnt of the bunny, and its errors."""
    pytest.importorskip("torch")
    from full_geometry import Recipe, train
    from halfspace_sss.neural import store

    folder = tmp_path_factory.mktemp("weights")
    recipe = Recipe(width=24, depth=2, batch=1024, chunk=2**15, reuse=4)

    def learn() -> list:
        import mitsuba as mi

        return train(mi.load_dict(bunny()), MEDIUM, chunks=6, recipe=recipe, folder=folder).errors

    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(store.ENVIRONMENT_VARIABLE, str(folder))
        yield folder, on(CUDA, learn)


@pytest.mark.parametrize("model", MODELS)
def test_two_objects_over_a_floor_look_as_on_llvm(
    model: str, request: pytest.FixtureRequest, capfd: pytest.CaptureFixture
) -> None:
    if model == "full_geometry":
        request.getfixturevalue("weights")

    def render(seed: int) -> np.ndarray:
        import mitsuba as mi

        return np.array(mi.render(mi.load_dict(scene(model)), spp=SPP, seed=seed), dtype=float)

    agree(*both(render, *SEEDS), MODELS[model])
    assert LOST not in capfd.readouterr().err


def test_errors_of_what_cuda_learnt_are_the_same_by_both(weights: tuple) -> None:
    from full_geometry import errors

    folder, at_the_end = weights

    def judge() -> list:
        import mitsuba as mi

        return errors(mi.load_dict(bunny()), MEDIUM, folder=folder, exits=64, walks=2048, samples=1024)

    for there, here in zip(*both(judge)):
        print(there, here)
        assert (there.channel, there.light) == (here.channel, here.light)
        assert abs(there.error - here.error) <= 4 * np.hypot(there.standard_error, here.standard_error)
        assert abs(there.ratio - here.ratio) < 0.02
    assert max(row.error for row in at_the_end if row.light == "constant") < 0.2


def test_a_medium_that_absorbs_nothing_is_unseen_under_even_light() -> None:
    def render() -> np.ndarray:
        import mitsuba as mi

        whole = scene("path_traced", max_depth=-1, rr_depth=1000)
        for name in ("ball", "bunny"):
            whole[name]["bsdf"] = {"type": "translucent", "sigma_s": 1.0 if name == "ball" else 2.0, "sigma_a": 0.0}
        whole |= {"sky": {"type": "constant", "radiance": 1.0}}
        for name in ("floor", "lamp"):
            del whole[name]
        return np.array(mi.render(mi.load_dict(whole), spp=SPP, seed=1), dtype=float)

    agree(on(CUDA, render), np.ones((16, 24, 3)), 1e-5)


DERIVED = {
    "sky": ("better_dipole", "sky.radiance.value"),
    "ball": ("better_dipole", "ball.bsdf.albedo"),
    "bunny": ("neural", "bunny.bsdf.albedo"),
}


@pytest.mark.parametrize("of", DERIVED)
def test_derivatives_of_a_picture_are_those_on_llvm(of: str) -> None:
    model, key = DERIVED[of]

    def slope(seed: int) -> np.ndarray:
        import drjit as dr
        import mitsuba as mi

        loaded = mi.load_dict(scene(model))
        parameters = mi.traverse(loaded)
        value = type(parameters[key])(parameters[key])
        dr.enable_grad(value)
        dr.set_grad(value, 1.0)
        parameters[key] = value
        dr.forward_to(parameters[key], flags=dr.ADFlag.ClearEdges)
        parameters.update()
        return np.array(loaded.integrator().render_forward(loaded, parameters, 0, seed, SPP), dtype=float)

    found, there = both(slope, *SEEDS)
    agree(found, there, MODELS[model])
    assert np.abs(there).max() > 0
