"""The contract that every model keeps, one clause a test, each over the one list of models."""

from __future__ import annotations

import re
import subprocess
import sys

import numpy as np
import pytest
from scipy.stats import chisquare

import halfspace_sss
from analytic_models.standard_dipole import StandardDipole
from halfspace_sss import Medium, registry
from halfspace_sss.backend import array_types

MEDIA = [
    Medium(1.8075, 0.6025, 0.0, 1.3),
    Medium.from_albedo(0.99, 2.0, 0.5, 1.5),
    Medium.from_albedo(0.3, 5.0, 0.8, 1.0),
    Medium.from_albedo(0.95, 0.5, 0.3, 0.8),
]
RGB = Medium([1.0, 2.0, 0.5], [0.1, 0.01, 0.2], [0.0, 0.5, 0.8], 1.4)
SIGNIFICANCE = 1e-4  # that a right sampler fails anywhere: Bonferroni over all chi-square tests of this file
N_CHI_SQUARE = len(MEDIA) * (1 + len(halfspace_sss.models()))


def same(a, b, rtol: float, floor: float = 1e-30) -> None:
    """Equal to rtol wherever b is above `floor` of its peak."""
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    relevant = b > floor * b.max()
    assert relevant.any()
    np.testing.assert_allclose(a[relevant], b[relevant], rtol=rtol)


@pytest.fixture(params=range(len(MEDIA)))
def medium(request, name) -> Medium:
    """Each of the media that the model accepts."""
    try:
        halfspace_sss.bssrdf(name, MEDIA[request.param])
    except ValueError as error:
        pytest.skip(f"refused: {error}")
    return MEDIA[request.param]


def test_a_model_declares_what_it_is(name):
    model = halfspace_sss.bssrdf(name, MEDIA[0])
    assert model.name == name and model.orders in ("multiple", "total")
    assert isinstance(model.reciprocal, bool) and model.source


def test_values_are_finite_and_not_negative(name, medium, queries):
    S = halfspace_sss.bssrdf(name, medium).eval(*queries(4000, medium))
    assert np.isfinite(S).all() and (S >= 0).all() and S.max() > 0


def test_clamping_cuts_off_negative_values_and_nothing_else(name, medium, queries):
    model, query = halfspace_sss.bssrdf(name, medium), queries(1000, medium)
    np.testing.assert_array_equal(model.eval(*query), np.maximum(model.eval_unclamped(*query), 0.0))


@pytest.mark.parametrize("c", [1e-3, 7.3, 1e3])
def test_scaling_the_medium_scales_the_lengths(name, medium, queries, c):
    """S(r; c sigma) = c² S(c r; sigma)."""
    r, *directions = queries(500, medium)
    scaled = halfspace_sss.bssrdf(name, medium.scaled(c)).eval(r / c, *directions)
    same(scaled, c**2 * halfspace_sss.bssrdf(name, medium).eval(r, *directions), 1e-9)


def test_mirrored_azimuths_give_the_same_value_or_not_as_declared(name, medium, queries):
    model = halfspace_sss.bssrdf(name, medium)
    r, mu_i, phi_i, mu_o, phi_o = queries(500, medium)
    mirrored, S = model.eval(r, mu_i, -phi_i, mu_o, -phi_o), model.eval(r, mu_i, phi_i, mu_o, phi_o)
    if model.mirror_invariant:
        same(mirrored, S, 1e-9)
    else:
        assert not np.allclose(mirrored, S, rtol=1e-3)


def test_reciprocity_is_kept_or_broken_as_declared(name, medium, queries):
    """Swapping x_i and x_o turns the axis x_i -> x_o round, hence the half turns."""
    model = halfspace_sss.bssrdf(name, medium)
    r, mu_i, phi_i, mu_o, phi_o = queries(1000, medium)
    there = model.eval(r, mu_i, phi_i, mu_o, phi_o)
    back = model.eval(r, mu_o, phi_o + np.pi, mu_i, phi_i + np.pi)
    if model.reciprocal:
        same(back, there, 1e-9)
    else:
        relevant = there > 1e-6 * there.max()
        assert np.abs(back / np.where(relevant, there, 1) - 1)[relevant].max() > 0.01


@pytest.mark.parametrize(
    ("library", "precision"),
    [("numpy", np.float32), *((library, kind) for library in ("torch", "drjit") for kind in (np.float32, np.float64))],
)
def test_every_array_library_and_precision_gives_the_same_value(name, medium, queries, library, precision):
    query = [x.astype(precision) for x in queries(500, medium)]
    model = halfspace_sss.bssrdf(name, medium)
    expected = model.eval(*(x.astype(np.float64) for x in query))
    if library == "torch":
        torch = pytest.importorskip("torch")
        S = model.eval(*map(torch.as_tensor, query)).numpy()
    elif library == "drjit":
        types = array_types("llvm")
        S = model.eval(*map(types.Float if precision is np.float32 else types.Float64, query)).numpy()
    else:
        S = model.eval(*query)
    assert S.dtype == precision
    same(S, expected, 1e-3 if precision is np.float32 else 1e-9)


def test_a_scalar_query_gives_a_scalar(name):
    S = halfspace_sss.bssrdf(name, MEDIA[0]).eval(0.5, 0.9, 0.1, 0.8, 0.2)
    assert np.ndim(S) == 0 and S > 0


def test_arguments_broadcast(name, queries):
    model = halfspace_sss.bssrdf(name, MEDIA[0])
    r, mu_i = np.array([[0.1], [0.5]]), np.array([0.3, 0.6, 1.0])
    S = model.eval(r, mu_i, 0.4, 0.9, -0.2)
    assert S.shape == (2, 3)
    same(S[1, 2], model.eval(0.5, 1.0, 0.4, 0.9, -0.2), 1e-12)


def test_the_channel_axis_is_last(name, queries):
    query = [x.reshape(10, 4) for x in queries(40, RGB)]
    S = halfspace_sss.bssrdf(name, RGB).eval(*query)
    assert S.shape == (10, 4, 3)
    for k in range(3):
        same(S[..., k], halfspace_sss.bssrdf(name, RGB.channel(k)).eval(*query), 1e-10)


def test_sampled_positions_have_a_channel_axis_too(name):
    model = halfspace_sss.bssrdf(name, RGB)
    u = np.random.default_rng(1).random((2, 50))
    sample = model.sample_position(0.7, tuple(u))
    assert sample.r.shape == sample.phi.shape == sample.pdf.shape == (50, 3)
    for k in range(3):
        pdf = halfspace_sss.bssrdf(name, RGB.channel(k)).pdf_position(sample.r[:, k], sample.phi[:, k], 0.7)
        np.testing.assert_allclose(sample.pdf[:, k], pdf, rtol=1e-9)


def grid(edges: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """n midpoints in each bin, one bin a row, and their spacing."""
    step = np.diff(edges)[:, None] / n
    return edges[:-1, None] + step * (np.arange(n) + 0.5), step


def position_probabilities(model, mu_o: float, log_edges: np.ndarray, phi_edges: np.ndarray) -> np.ndarray:
    """∫ pdf r dr dphi over bins uniform in ln r and phi."""
    x, dx = grid(log_edges, 400)
    phi, dphi = grid(phi_edges, 4)
    r = np.exp(x) / model.medium.sigma_t
    pdf = model.pdf_position(r[:, None, :, None], phi[None, :, None, :], mu_o)
    return (pdf * (r * r * dx)[:, None, :, None] * dphi[None, :, None, :]).sum(axis=(2, 3))


def direction_probabilities(model, given: tuple, mu_edges: np.ndarray, phi_edges: np.ndarray) -> np.ndarray:
    mu, dmu = grid(mu_edges, 200)
    phi, dphi = grid(phi_edges, 4)
    pdf = model.pdf_direction(mu[:, None, :, None], phi[None, :, None, :], *given)
    return (pdf * dmu[:, None, :, None] * dphi[None, :, None, :]).sum(axis=(2, 3))


def agrees(counts: np.ndarray, probability: np.ndarray, n: int) -> None:
    """Chi-square over the bins that expect 10 or more, the others taken together with what lies outside."""
    kept = n * probability > 10
    observed = np.append(counts[kept], n - counts[kept].sum())
    expected = np.append(n * probability[kept], n * (1 - probability[kept].sum()))
    if expected[-1] < 10:  # all but nothing is left over
        observed, expected = observed[:-1], expected[:-1] * observed[:-1].sum() / expected[:-1].sum()
    assert chisquare(observed, expected, sum_check=False).pvalue > SIGNIFICANCE / N_CHI_SQUARE


def test_position_samples_follow_their_density(name, medium):
    model, n, mu_o = halfspace_sss.bssrdf(name, medium), 100_000, 0.6
    sample = model.sample_position(mu_o, tuple(np.random.default_rng(7).random((2, n))))
    np.testing.assert_allclose(sample.pdf, model.pdf_position(sample.r, sample.phi, mu_o), rtol=1e-9)
    log_edges, phi_edges = np.linspace(np.log(1e-3), np.log(30), 16), np.linspace(0, 2 * np.pi, 7)
    values = np.log(medium.sigma_t * sample.r), np.mod(sample.phi, 2 * np.pi)
    counts = np.histogram2d(*values, bins=(log_edges, phi_edges))[0]
    agrees(counts, position_probabilities(model, mu_o, log_edges, phi_edges), n)


@pytest.mark.parametrize("medium", MEDIA[:1] + MEDIA[2:], ids=lambda m: f"eta {m.eta:g}")
def test_direction_samples_follow_their_density(medium):
    """Once, with any model: directions are drawn by the interface."""
    model, n = halfspace_sss.bssrdf("better_dipole", medium), 400_000
    given = (0.7 / medium.sigma_t, 0.6, 0.4)
    sample = model.sample_direction(*given, tuple(np.random.default_rng(8).random((2, n))))
    np.testing.assert_allclose(sample.pdf, model.pdf_direction(sample.mu_i, sample.phi_i, *given), rtol=1e-9)
    mu_edges, phi_edges = np.linspace(0, 1, 11), np.linspace(0, 2 * np.pi, 9)
    counts = np.histogram2d(sample.mu_i, np.mod(sample.phi_i, 2 * np.pi), bins=(mu_edges, phi_edges))[0]
    agrees(counts, direction_probabilities(model, given, mu_edges, phi_edges), n)


def test_densities_of_positions_integrate_to_one(name, medium):
    model, turn = halfspace_sss.bssrdf(name, medium), np.array([0, 2 * np.pi])
    everywhere = np.linspace(np.log(1e-9), np.log(1e12), 200)
    assert position_probabilities(model, 0.6, everywhere, turn).sum() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("medium", MEDIA[:1] + MEDIA[2:], ids=lambda m: f"eta {m.eta:g}")
def test_densities_of_directions_integrate_to_one(medium):
    model, turn = halfspace_sss.bssrdf("better_dipole", medium), np.array([0, 2 * np.pi])
    given = (0.7 / medium.sigma_t, 0.6, 0.4)
    assert direction_probabilities(model, given, np.linspace(0, 1, 41), turn).sum() == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(
    ("argument", "value", "bound"),
    [(0, -1.0, "[0, inf]"), (0, np.inf, "[0, inf]"), (1, 1.5, "[0, 1]"), (1, -0.25, "[0, 1]"), (2, np.inf, "finite"),
     (3, np.nan, "[0, 1]"), (3, 2.0, "[0, 1]"), (4, np.nan, "finite")],
)  # fmt: skip
def test_a_bad_query_is_refused_with_name_bound_and_value(name, argument, value, bound):
    query = [0.5, 0.9, 0.1, 0.8, 0.2]
    query[argument] = np.array([query[argument], value])
    with pytest.raises(ValueError) as error:
        halfspace_sss.bssrdf(name, MEDIA[0]).eval(*query)
    message = str(error.value)
    assert ("r", "mu_i", "phi_i", "mu_o", "phi_o")[argument] in message
    assert bound in message and repr(float(value)) in message


def test_a_bad_medium_is_refused(name):
    with pytest.raises(ValueError, match="medium must be a Medium, got dict"):
        halfspace_sss.bssrdf(name, {"sigma_s": 1})


def test_for_medium_keeps_the_model(name):
    model = halfspace_sss.bssrdf(name, MEDIA[0])
    other = model.for_medium(MEDIA[1])
    assert type(other) is type(model) and other.medium == MEDIA[1]


DEFINE = "class Twice(StandardDipole):\n    name = 'twice'\n    version = {}\n"


@pytest.fixture
def define(monkeypatch):
    """`define(version, **scope)`: the class of a cell of a notebook, in a registry of its own."""
    monkeypatch.setattr(registry, "_registered", {})

    def run(version: int, **scope: str) -> type:
        names = {"StandardDipole": StandardDipole, "__name__": "__main__", **scope}
        exec(DEFINE.format(version), names)
        return names["Twice"]

    return run


def test_a_class_that_is_defined_again_takes_the_place_of_the_old_one(define):
    for version in (1, 2):
        halfspace_sss.register_model(define(version))
    assert halfspace_sss.models().count("twice") == 1
    assert halfspace_sss.bssrdf("twice", MEDIA[0]).version == 2


def test_another_class_of_the_same_name_is_refused(define):
    halfspace_sss.register_model(define(1))
    with pytest.raises(ValueError, match="model name must be new, got 'twice', which is registered already"):
        halfspace_sss.register_model(define(2, __name__="other_module"))
    assert halfspace_sss.bssrdf("twice", MEDIA[0]).version == 1


def test_an_installed_model_is_not_replaced(define):
    with pytest.raises(ValueError, match="model name must be new, got 'standard_dipole'"):
        halfspace_sss.register_model(StandardDipole)


JOIN = """
import sys, pytest, halfspace_sss
from analytic_models.standard_dipole import StandardDipole
halfspace_sss.register_model(type("Joined", (StandardDipole,), {"name": "joined"}))
sys.exit(pytest.main([sys.argv[1], "--collect-only", "-q", "-o", "addopts=", "-p", "no:cacheprovider"]))
"""


def test_joining_the_list_puts_a_model_under_every_test():
    run = subprocess.run([sys.executable, "-c", JOIN, __file__], capture_output=True, text=True, check=True)
    counts = [len(re.findall(rf"[\[-]{name}[\]-]", run.stdout)) for name in ("joined", *halfspace_sss.models())]
    assert counts[0] > 50 and len(set(counts)) == 1, counts
