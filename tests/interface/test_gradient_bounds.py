"""Derivatives of every model by every argument at the bounds of the arguments."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import halfspace_sss
from halfspace_sss import Medium
from halfspace_sss.backend import array_types

NAMES = ("r", "mu_i", "phi_i", "mu_o", "phi_o")
MIDDLE = {"r": 0.7, "mu_i": 0.6, "phi_i": 1.1, "mu_o": 0.8, "phi_o": 2.0}
BOUNDS = {
    "r": (0.0, 1e-6, 30.0, 1e5),
    "mu_i": (0.0, 1e-6, 1.0),
    "phi_i": (-np.pi, 0.0, 0.5 * np.pi, np.pi),
    "mu_o": (0.0, 1e-6, 1.0),
    "phi_o": (-np.pi, 0.0, 0.5 * np.pi, np.pi),
}
BOTH = [
    {"mu_i": 1.0, "mu_o": 1.0},
    {"mu_i": 1.0, "mu_o": 1.0, "r": 0.0},
    {"mu_i": 0.0, "mu_o": 0.0},
    {"r": 0.0, "mu_i": 0.0},
]
QUERIES = [{**MIDDLE, name: v} for name, values in BOUNDS.items() for v in values] + [{**MIDDLE, **at} for at in BOTH]
MEDIA = [(0.0, 1.4), (0.9, 0.9), (0.9, 1.0), (1.0, 1.4)]  # albedo and eta


def models_of(name: str, g: float = 0.3) -> list:
    found = []
    for albedo, eta in MEDIA:
        try:
            found.append(halfspace_sss.bssrdf(name, Medium.from_albedo(albedo, 1.0, g, eta)))
        except ValueError:
            assert eta < 1 or albedo == 0, "but for an index below 1 or no scattering every model answers"
    return found


def by_torch(model, queries: list[dict], kind: torch.dtype = torch.float64) -> np.ndarray:
    """Derivatives, (arguments, queries); 0 by what a model does not depend on."""
    args = [torch.tensor([q[name] for q in queries], dtype=kind, requires_grad=True) for name in NAMES]
    model.eval(*args).sum().backward()
    return np.stack([np.zeros(len(queries)) if a.grad is None else a.grad.numpy() for a in args])


def test_derivatives_at_the_bounds_of_all_arguments_are_finite(name):
    for model in models_of(name):
        for kind in (torch.float64, torch.float32):
            assert np.isfinite(by_torch(model, QUERIES, kind)).all(), model.medium


def test_torch_differentiates_with_respect_to_the_medium(name):
    """By sigma_s (per channel), sigma_a and g; the two networks of single media, whose weights are fixed, refuse."""
    r = torch.tensor([[0.3], [1.0], [4.0]], dtype=torch.float64)
    numbers = ([1.0, 2.0], 0.1, 0.3)

    def S(*coefficients) -> torch.Tensor:
        return halfspace_sss.bssrdf(name, Medium(*coefficients, 1.4)).eval(r, [0.9, 0.4], 0.2, 0.8, 0.3)

    tensors = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in numbers]
    if name in ("neural_material", "neural_paper"):
        with pytest.raises(ValueError, match=f"medium of {name} must be of numbers"):
            S(*tensors)
        return
    torch.testing.assert_close(S(*tensors).detach(), S(*numbers), rtol=1e-6, atol=0)  # weights of numbers are float32
    assert torch.autograd.gradcheck(S, tensors, eps=1e-5, atol=1e-9, rtol=1e-5, fast_mode=True)
    with pytest.raises(ValueError, match="a medium with derivatives is asked with torch tensors"):
        halfspace_sss.bssrdf(name, Medium(*tensors, 1.4)).eval(0.3, 0.9, 0.2, 0.8, 0.3)


def test_dr_jit_has_the_derivatives_of_torch_backwards(name):
    if name == "neural_paper":
        pytest.skip("computes in double precision, in which Dr.Jit does not differentiate layers")
    dr = pytest.importorskip("drjit")
    kind, model = array_types("llvm").ad.Float, halfspace_sss.bssrdf(name, Medium.from_albedo(0.9, 1.0, 0.3, 1.4))
    queries = [{**MIDDLE, "r": r, "mu_i": mu} for r, mu in ((0.3, 0.9), (1.0, 0.5), (4.0, 0.2))]
    args = [kind([q[key] for q in queries]) for key in NAMES]
    dr.enable_grad(args)
    dr.backward(model.eval(*args))
    expected = by_torch(model, queries)
    found = np.stack([dr.grad(a).numpy() for a in args])
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_no_queries_have_no_answers_in_dr_jit(name):
    """As in NumPy; arrays of one beside an empty one are numbers."""
    Float, model = array_types("llvm").Float, halfspace_sss.bssrdf(name, Medium.from_albedo(0.9, 1.0, 0.3, 1.4))
    none = Float([])
    answers = [
        model.eval(none, 0.9, 0.1, Float(0.8), 0.5), model.pdf_position(none, none, 0.5),
        model.pdf_direction(none, 0.1, 0.2, 0.3, 0.4), *model.sample_position(0.5, (none, none)),
        *model.sample_direction(0.1, 0.2, 0.3, (none, none)),
    ]  # fmt: skip
    assert [len(each) for each in answers] == [0] * 9


@pytest.mark.parametrize("which", ["mu_i", "mu_o"])
def test_derivatives_at_normal_incidence_are_the_one_sided_ones(which, name):
    """Across the plane of the other direction; elsewhere S falls as the sine, of infinite derivative by the cosine."""
    if name == "neural_paper":
        pytest.skip("knows the sine in every plane")
    phi = {"phi_i": 0.5 * np.pi, "phi_o": 0.0} if which == "mu_i" else {"phi_i": 0.0, "phi_o": 0.5 * np.pi}
    h = 1e-4
    steps = [{**MIDDLE, **phi, which: 1 - k * h} for k in range(5)]
    for model in models_of(name):
        S = model.eval(*(np.array([q[n] for q in steps]) for n in NAMES))
        expected = -np.dot([-25 / 12, 4, -3, 4 / 3, -1 / 4], S) / h
        found = by_torch(model, steps[:1])[NAMES.index(which), 0]
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-6 * S[0])
