"""Perceptrons in Dr.Jit: against NumPy, in parts as a whole, and in half precision."""

from __future__ import annotations

import numpy as np
import pytest

from halfspace_sss.backend import prepare_llvm

pytest.importorskip("drjit")
prepare_llvm()

import drjit as dr  # noqa: E402
from drjit.llvm.ad import Float, Float16, Float64  # noqa: E402

from halfspace_sss.neural import perceptron  # noqa: E402
from halfspace_sss.neural.perceptron import Perceptron, relu  # noqa: E402

SIZES, SPLIT, N = (7, 16, 12, 3), 4, 500
ROUNDING = {np.float32: 2e-6, np.float16: 1e-2}  # of outputs of order one


def layers(seed: int = 3) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    found = {}
    for k, (i, j) in enumerate(zip(SIZES, SIZES[1:])):
        found |= {f"W_{k}": rng.standard_normal((j, i)) / np.sqrt(i), f"b_{k}": 0.3 * rng.standard_normal(j)}
    return found


def inputs(seed: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((SIZES[0], N)).astype(np.float32)


def by_numpy(weights: dict, x: np.ndarray, activation: object) -> np.ndarray:
    for k in range(len(SIZES) - 1):
        x = weights[f"W_{k}"] @ (activation(x) if k else x) + weights[f"b_{k}"][:, None]
    return x


def hard(x: np.ndarray) -> np.ndarray:
    return x * np.clip(x / 6 + 0.5, 0, 1)


@pytest.mark.parametrize(("more", "activation"), [({}, hard), ({"activation": relu}, lambda x: np.maximum(x, 0))])
def test_outputs_are_those_of_numpy(more: dict, activation: object) -> None:
    weights, x = layers(), inputs()
    found = Perceptron.named(weights, "W", "b", **more)([Float(row) for row in x])
    assert np.allclose(np.array(found), by_numpy(weights, x, activation), atol=ROUNDING[np.float32])


def test_loops_in_double_precision_give_what_cooperative_vectors_give() -> None:
    weights, x = layers(), inputs()
    net = Perceptron.named(weights, "W", "b", splits=[SPLIT])
    single, double = ([kind(row) for row in x] for kind in (Float, Float64))
    kept = net.first(0, double[:SPLIT], biased=True)
    found = net.rest(net.activation(net.first(1, double[SPLIT:]) + kept))
    assert all(dr.type_v(v) == dr.VarType.Float64 for v in found)
    assert np.allclose(np.array(found), by_numpy(weights, x.astype(float), hard), atol=1e-13)
    assert np.allclose(np.array(found), np.array(Perceptron.named(weights, "W", "b")(single)), atol=2e-6)


def test_loops_in_single_precision_as_on_cuda_give_what_cooperative_vectors_give(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    weights, x = layers(), [Float(row) for row in inputs()]
    cooperative = np.array(Perceptron.named(weights, "W", "b")(x))
    monkeypatch.setattr(perceptron, "cooperative", perceptron._listed)
    net = Perceptron.named(weights, "W", "b")
    found = net(x)
    assert not perceptron._is_cooperative(net.first(0, x)) and dr.type_v(found[0]) == dr.VarType.Float32
    assert np.allclose(np.array(found), cooperative, atol=ROUNDING[np.float32])


@pytest.mark.parametrize("kind", [Float, Float64])
def test_one_input_and_one_output_are_taken_in_any_precision(kind: type) -> None:
    weights = {"W_0": np.full((3, 1), 0.5), "b_0": np.zeros(3), "W_1": np.ones((1, 3)), "b_1": np.full(1, 0.25)}
    (found,) = Perceptron.named(weights, "W", "b", activation=relu)([kind([1, 2, -1])])
    assert type(found) is kind and np.allclose(found.numpy(), [1.75, 3.25, 0.25])


def test_parts_of_the_first_layer_make_the_whole() -> None:
    weights, x = layers(), [Float(row) for row in inputs()]
    whole, net = Perceptron.named(weights, "W", "b"), Perceptron.named(weights, "W", "b", splits=[SPLIT])
    kept = net.numbers(net.first(0, x[:SPLIT], biased=True))
    found = net.rest(net.activation(net.first(1, x[SPLIT:]) + net.vector(kept)))
    assert np.allclose(np.array(found), np.array(whole(x)), atol=ROUNDING[np.float32])


def test_layers_in_half_precision_give_single_precision_up_to_their_rounding() -> None:
    net, x = Perceptron.named(layers(), "W", "b"), inputs()
    single, half = (net([kind(row) for row in x]) for kind in (Float, Float16))
    assert all(dr.type_v(v) == dr.VarType.Float32 for v in half)
    off = np.abs(np.array(half) - np.array(single)).max()
    assert 0 < off < ROUNDING[np.float16]


def test_one_layer_has_no_activation() -> None:
    weights, x = layers(), inputs()
    (found, *_) = Perceptron([weights["W_0"]], [weights["b_0"]])([Float(row) for row in x])
    assert np.allclose(np.array(found), weights["W_0"][0] @ x + weights["b_0"][0], atol=ROUNDING[np.float32])


@pytest.mark.parametrize("far", [1e3, 1e6, np.inf])
def test_inputs_out_of_all_bounds_leave_outputs_in_half_precision_finite(far: float) -> None:
    x = [Float16(row) for row in inputs()]
    x[2], x[5] = (Float16(Float(np.full(N, v, np.float32))) for v in (far, -far))
    assert np.isfinite(np.array(Perceptron.named(layers(), "W", "b")(x))).all()
