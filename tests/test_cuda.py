"""What runs on CUDA besides renders, against LLVM or NumPy: the tracer, models, networks, fits."""

from __future__ import annotations

import numpy as np
import pytest
from on_cuda import CUDA, LLVM, both, on, why_not

import halfspace_sss
from halfspace_sss import Medium, trace

pytestmark = pytest.mark.skipif(bool(why_not()), reason=why_not())

NETWORKS = ("neural", "neural_material", "neural_paper")  # in half precision on CUDA
MEDIA = {"wax": Medium(1.0, 0.2, 0.3, 1.4), "isotropic, matched": Medium(0.7, 0.3, 0.0, 1.0)}
PATHS = 2**19


@pytest.mark.parametrize("mu_i", [0.6, "diffuse"])
@pytest.mark.parametrize("medium", MEDIA)
def test_the_tracer_agrees_with_that_on_llvm_and_repeats_for_a_seed(medium: str, mu_i: float | str) -> None:
    found, again, there = (
        trace(MEDIA[medium], mu_i, PATHS, seed=seed, backend=backend)
        for seed, backend in ((1, "cuda"), (1, "cuda"), (2, "llvm"))
    )
    for order in ("single", "multiple", "total"):
        a, b = found.reflectance(order), there.reflectance(order)
        assert abs(a.value - b.value) <= 4 * np.hypot(a.standard_error, b.standard_error)
        assert a.value == again.reflectance(order).value
    assert 0 < found.reflectance().standard_error < 2e-3


def test_rings_and_directions_of_the_tracer_agree_with_those_on_llvm() -> None:
    given = {"directions": [(0.9, 0.0), (0.4, 2.0)], "radii": [0.1, 0.5, 2.0]}
    found, there = (trace(MEDIA["wax"], 0.6, PATHS, seed=k, backend=b, **given) for k, b in ((1, "cuda"), (2, "llvm")))
    for what in ("angular_reflectance", "exitance"):
        a, b = getattr(found, what)(), getattr(there, what)()
        assert np.all(np.abs(a.value - b.value) <= 4.5 * np.hypot(a.standard_error, b.standard_error))


def test_every_model_gives_the_value_of_numpy(name: str, queries: object) -> None:
    import drjit as dr

    medium = MEDIA["wax"]
    query = [v.astype(np.float32) for v in queries(2000, medium)]
    model = halfspace_sss.bssrdf(name, medium)
    wanted, S = model.eval(*(v.astype(np.float64) for v in query)), model.eval(*map(dr.cuda.Float, query)).numpy()
    if name in NETWORKS:
        off = np.abs(np.log(np.maximum(S, 1e-30) / np.maximum(wanted, 1e-30)))[wanted > 1e-6 * wanted.max()]
        assert np.median(off) < 5e-3 and np.quantile(off, 0.99) < 0.1
        S = model.eval(*map(dr.cuda.Float64, query)).numpy()
        # double precision by loops: 1.3e-5 off on an H100, half precision would be 100 times that
        assert np.allclose(S, wanted, rtol=1e-4, atol=1e-9 * wanted.max())
    else:
        off = np.abs(S - wanted)
        worst = np.argmax(off - 1e-3 * wanted)
        assert np.allclose(S, wanted, rtol=1e-3, atol=1e-6 * wanted.max()), (S[worst], wanted[worst])


def test_scenes_that_do_not_belong_together_are_refused() -> None:
    def ask() -> None:
        import mitsuba as mi

        from full_geometry.geometry.shape import check_together, scene_of

        world, other = (
            mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "floor": {"type": "rectangle"}})
            for _ in range(2)
        )
        check_together(world, [scene_of([shape], world) for shape in world.shapes()])
        with pytest.raises(RuntimeError, match="must be traced by one kernel"):
            check_together(world, [scene_of(other.shapes())])

    on(CUDA, ask)


def test_a_fit_on_the_gpu_is_that_on_the_cpu_and_goes_on_there(tmp_path: object) -> None:
    torch = pytest.importorskip("torch")
    if not torch.cuda.is_available():
        pytest.skip("torch sees no GPU")
    from full_geometry.learning.network_fitting import ObjectFit, Recipe
    from full_geometry.transport.exit_pairs import AlbedoSamples, Pairs
    from full_geometry.transport.features import n_pair, n_side

    n_in, n = 2 * n_side(1) + n_pair(1), 4096
    rng = np.random.default_rng(1)

    def pairs() -> Pairs:
        even = AlbedoSamples(
            np.abs(rng.standard_normal((n_side(1), n))).astype(np.float32), np.full((2, n), 0.2, np.float32)
        )
        features = rng.standard_normal((n_in, n)).astype(np.float32)
        return Pairs(features, rng.random((1, n), dtype=np.float32), n, None, even)

    walks, proposals = pairs(), pairs()

    def fit() -> ObjectFit:
        found = ObjectFit(n_in, 1, 1.4, Recipe(width=16, depth=2, batch=512, reuse=2), 3)
        found.set_scale(walks)
        found.use(walks, proposals, 16, np.random.default_rng(2))
        return found

    there, here = both(fit)
    assert there.device.type == "cuda" and here.device.type == "cpu" and there.step == here.step == 16
    for name, value in here.arrays().items():
        assert np.allclose(there.arrays()[name], value, atol=2e-3 * max(np.abs(value).max(), 0.05))
    there.save(tmp_path / "state", 1, [])
    fresh = on(LLVM, lambda: ObjectFit(n_in, 1, 1.4, Recipe(width=16, depth=2, batch=512, reuse=2), 4))
    assert fresh.load(tmp_path / "state") == (1, [])
    assert all(np.array_equal(fresh.arrays()[name], value) for name, value in there.arrays().items())
