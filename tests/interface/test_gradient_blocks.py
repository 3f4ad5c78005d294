"""Derivatives by torch in blocks: the same numbers bit for bit, in bounded memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch

import halfspace_sss
from halfspace_sss import Medium
from halfspace_sss.arrays import library
from halfspace_sss.interface import model as gradient_blocks

MEDIUM = Medium(1.8075, 0.6025, 0.0, 1.3)
RGB = Medium([1.0, 2.0, 0.5], [0.1, 0.01, 0.2], 0.3, 1.4)
N = 1500


@pytest.fixture
def gradients(queries, monkeypatch):
    """`gradients(model, n_bytes)`: S and its derivatives by all arguments, and into how many blocks they were split."""

    def of(model, n_bytes: int, n: int = N) -> tuple:
        monkeypatch.setattr(gradient_blocks, "BLOCK_BYTES", n_bytes)
        shaped = [v.reshape(3, -1) for v in queries(n, model.medium)]
        args = [torch.from_numpy(v).requires_grad_() for v in shaped]
        S = model.eval(*args)
        joined = S.grad_fn.next_functions[0][0]
        S.backward(torch.linspace(0.5, 1.5, S.numel(), dtype=S.dtype).reshape(S.shape))
        return S.detach(), [a.grad for a in args], joined

    return of


@pytest.mark.slow
def test_values_and_derivatives_of_blocks_are_those_of_the_whole(name, gradients):
    model = halfspace_sss.bssrdf(name, MEDIUM)
    n = 5 * gradient_blocks.PROBE + 28
    S, derivatives, _ = gradients(model, 1 << 40, n)
    in_blocks, by_blocks, joined = gradients(model, 1, n)
    assert len(joined.next_functions) == 6
    assert torch.equal(S, in_blocks)
    for one, other in zip(derivatives, by_blocks):
        assert (one is None and other is None) or torch.equal(one, other)


@pytest.mark.slow
def test_blocks_of_a_medium_with_channels_are_joined(gradients):
    model = halfspace_sss.bssrdf("photon_beam_diffusion", RGB)
    (S, derivatives, _), (in_blocks, by_blocks, _) = gradients(model, 1 << 40), gradients(model, 1)
    assert S.shape == (3, N // 3, 3) and torch.equal(S, in_blocks)
    assert all(torch.equal(one, other) for one, other in zip(derivatives[:3], by_blocks[:3]))


@pytest.mark.slow
def test_a_block_holds_as_many_queries_as_the_graph_of_the_model_allows(gradients):
    counts = {}
    for name in ("better_dipole", "forward_scattering_dipole"):
        *_, joined = gradients(halfspace_sss.bssrdf(name, MEDIUM), 1 << 21, N // 2)
        counts[name] = len(joined.next_functions)
    assert counts["better_dipole"] <= 2 < 10 < counts["forward_scattering_dipole"]


def test_second_derivatives_go_through_blocks(monkeypatch):
    model = halfspace_sss.bssrdf("directional_dipole", MEDIUM)
    r, second = torch.linspace(0.1, 3, 400, dtype=torch.float64, requires_grad=True), []
    for n_bytes in (1 << 40, 1):
        monkeypatch.setattr(gradient_blocks, "BLOCK_BYTES", n_bytes)
        first = torch.autograd.grad(model.eval(r, 0.8, 0.2, 0.7, 0.4).sum(), r, create_graph=True)[0]
        second.append(torch.autograd.grad(first.sum(), r)[0])
    assert torch.equal(*second) and second[0].abs().min() > 0


def test_transforms_of_functions_and_forward_derivatives_are_answered_at_once(monkeypatch):
    monkeypatch.setattr(gradient_blocks, "BLOCK_BYTES", 1)
    model = halfspace_sss.bssrdf("directional_dipole", MEDIUM)
    r = torch.linspace(0.1, 3, 400, dtype=torch.float64, requires_grad=True)

    def S(r):
        return model.eval(r, 0.8, 0.2, 0.7, 0.4)

    expected = torch.autograd.grad(S(r).sum(), r)[0]
    assert torch.equal(torch.func.grad(lambda r: S(r).sum())(r.detach()), expected)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(r, torch.ones_like(r))
        tangent = torch.autograd.forward_ad.unpack_dual(S(dual)).tangent
    np.testing.assert_allclose(tangent.detach(), expected, rtol=1e-12)


def test_vmap_maps_values_and_derivatives_of_every_model(name):
    model = halfspace_sss.bssrdf(name, MEDIUM)
    r = torch.linspace(0.1, 3, 5, dtype=torch.float64)

    def S(r):
        return model.eval(r, 0.8, 0.2, 0.7, 0.4).sum()

    torch.testing.assert_close(torch.func.vmap(S)(r), torch.stack([S(v) for v in r]))
    slopes = torch.stack([torch.func.grad(S)(v) for v in r])
    torch.testing.assert_close(torch.func.vmap(torch.func.grad(S))(r), slopes)


def test_what_depends_on_further_tensors_keeps_their_derivatives(monkeypatch):
    monkeypatch.setattr(gradient_blocks, "BLOCK_BYTES", 1)
    strength = torch.tensor(2.0, requires_grad=True)
    r = torch.linspace(0.1, 3, 400, requires_grad=True)
    value = gradient_blocks.recorded_in_blocks(library(r), lambda r: strength * r * r, (r,))
    value.sum().backward()
    assert strength.grad == pytest.approx(float((r.detach() ** 2).sum()), rel=1e-6)


MEMORY = """
import resource, torch, halfspace_sss
torch.set_num_threads(1)
model = halfspace_sss.bssrdf("forward_scattering_dipole", halfspace_sss.Medium(1.8075, 0.6025, 0.0, 1.3))

def differentiate(n):
    query = [torch.rand(n, dtype=torch.float64, requires_grad=True) for _ in range(5)]
    model.eval(*query).sum().backward()

differentiate(100)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
differentiate(9_000)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in kB on Linux")
def test_derivatives_take_bounded_memory():
    """In MiB; recorded as a whole it is 525."""
    run = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True, check=True)
    assert float(run.stdout) < 400
