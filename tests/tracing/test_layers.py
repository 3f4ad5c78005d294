"""Layers against published tables, discrete ordinates, and what energy and the half-space demand.

Fixed seeds; a z-test fails at 4 standard errors (two-sided 6e-5 each), the table's own uncertainty included.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from traced import check_spread, z

from halfspace_sss import Layers, Medium, bssrdf, trace
from halfspace_sss.physics.fresnel import F_r


def per_cm(mu_a: float, mu_s: float, g: float, n: float) -> Medium:
    return Medium(mu_s / 10, mu_a / 10, g, n)


VAN_DE_HULST = Layers([per_cm(10, 90, 0.75, 1.0)], [0.2])
GIOVANELLI = Layers([per_cm(10, 90, 0.0, 1.5)])
OBLIQUE_1 = Layers([Medium.from_albedo(0.99, 1.0, 0.0, 1.0)], [1.0])
OBLIQUE_4 = Layers([Medium.from_albedo(0.99, 1.0, 0.5, 1.0)], [4.0])
THREE = Layers([per_cm(1, 100, 0.9, 1.37), per_cm(1, 10, 0.0, 1.37), per_cm(2, 10, 0.7, 1.37)], [1.0, 1.0, 2.0])
STEP = Layers([Medium(20.0, 2.0, 0.7, 1.3), Medium(20.0, 1.0, 0.9, 1.4)], [0.1])

# layers, mu_i, walks, rows (measure, order, value, uncertainty); of the relative standard error asked 0.5 % at most
PUBLISHED = {
    "van de Hulst 1980 and MCML 2 (Wang, Jacques and Zheng 1995), slab": (VAN_DE_HULST, 1.0, 2_000_000, [
        ("reflectance", "total", 0.09739, 5e-6), ("transmittance", "total", 0.66096, 5e-6),
        ("reflectance", "total", 0.0972139, 2.34e-4), ("transmittance", "scattered", 0.526031, 3.66e-4),
        ("transmittance", "unscattered", 0.134936, 3.42e-4),
    ]),
    "Giovanelli 1955, half-space, with the 0.04 that the plane mirrors": (GIOVANELLI, 1.0, 1_000_000, [
        ("reflectance", "total", 0.2600 - 0.04, 5e-5),
    ]),
    "van de Hulst 1980, oblique, optical thickness 1": (OBLIQUE_1, 0.5, 1_000_000, [
        ("reflectance", "total", 0.48652, 5e-6), ("transmittance", "total", 0.49163, 5e-6),
    ]),
    "van de Hulst 1980, oblique, optical thickness 4": (OBLIQUE_4, 0.5, 1_000_000, [
        ("reflectance", "total", 0.61996, 5e-6), ("transmittance", "total", 0.30605, 5e-6),
    ]),
    "MCML (Wang, Jacques and Zheng 1995), three layers": (THREE, 1.0, 1_000_000, [
        ("reflectance", "total", 0.2375, 4e-4), ("transmittance", "total", 0.0965, 3e-4),
        ("transmittance", "scattered", 0.0962202, 1.9e-4),
    ]),
    "Virtual Photonics MCCL, index step 1.3 to 1.4": (STEP, 1.0, 1_000_000, [
        ("reflectance", "total", 0.1049, 2e-4),
    ]),
}  # fmt: skip


@pytest.mark.parametrize("source", PUBLISHED)
def test_published_reflectance_and_transmittance_come_out(source: str) -> None:
    layers, mu_i, n_paths, rows = PUBLISHED[source]
    run = trace(layers, mu_i, n_paths, 301)
    for measure, order, value, uncertainty in rows:
        if order == "scattered":
            samples = run._transmitted[:, 1:].sum(axis=1)
            found = samples.mean(), samples.std(ddof=1) / math.sqrt(len(samples))
        else:
            found = getattr(run, measure)(order)
        assert found[1] < 5e-3 * found[0]
        assert abs(z(found, (value, uncertainty))) < 4, (measure, order)


# (albedo, optical thickness, g) from the top, and mu_i
MATCHED = [
    ([(0.9, 1.0, 0.0), (0.5, 2.0, 0.0)], 1.0),
    ([(0.5, 0.5, 0.8), (0.99, 4.0, 0.5)], 0.6),
    ([(0.99, 0.2, 0.0), (0.2, 0.3, 0.9), (0.95, 1.0, -0.4)], 0.9),
    ([(0.999, 8.0, 0.7), (0.6, 1.0, 0.0)], 0.5),
    ([(0.3, 0.1, 0.0), (0.99, 10.0, 0.8), (0.9, 3.0, 0.6)], 1.0),
    ([(0.8, 0.7, 0.5), (0.9, 0.7, -0.5), (0.7, 0.7, 0.2), (0.99, 0.7, 0.0)], 0.3),
    ([(0.95, 2.0, 0.9), (0.95, 2.0, 0.0), (0.95, 2.0, 0.9)], 0.8),
    ([(0.6, 0.05, 0.3), (0.98, 5.0, 0.85)], 0.15),
]


def discrete_ordinates(layers: list[tuple[float, float, float]], mu_i: float, streams: int) -> tuple[float, float]:
    """Reflectance and transmittance of matched layers from nanodisort."""
    nanodisort = pytest.importorskip("nanodisort")
    albedo, tau, g = (np.array(v) for v in zip(*layers))
    state = nanodisort.DisortState()
    state.nstr, state.nlyr, state.nmom, state.ntau = streams, len(layers), 400, 2
    state.usrtau = state.lamber = state.quiet = state.onlyfl = True
    state.usrang = state.planck = state.intensity_correction = state.old_intensity_correction = False
    state.fbeam, state.umu0, state.phi0, state.fisot, state.albedo = 1 / mu_i, mu_i, 0.0, 0.0, 0.0  # irradiance 1
    state.allocate()
    state.pmom = g[None] ** np.arange(state.nmom + 1)[:, None]
    state.dtauc, state.ssalb, state.utau = tau, albedo, np.array([0.0, tau.sum()])
    state.solve()
    return float(state.flup[0]), float(state.rfldir[1] + state.rfldn[1])


@pytest.mark.parametrize(("layers", "mu_i"), MATCHED)
def test_matched_layers_agree_with_discrete_ordinates(layers: list, mu_i: float) -> None:
    coarse, fine = (np.array(discrete_ordinates(layers, mu_i, n)) for n in (32, 64))
    media = [Medium.from_albedo(albedo, 2.0, g, 1.0) for albedo, _, g in layers]
    run = trace(Layers(media, [tau / 2 for _, tau, _ in layers]), mu_i, 400_000, 302)
    for found, truth, uncertainty in zip((run.reflectance(), run.transmittance()), fine, np.abs(fine - coarse)):
        assert found.standard_error < 0.01 * found.value
        assert abs(z(found, (truth, uncertainty))) < 4


@pytest.mark.parametrize("mu_i", [1.0, 0.3, "diffuse"])
@pytest.mark.parametrize("medium", [Medium.from_albedo(0.9, 2.0, 0.3, 1.4), Medium.from_albedo(0.99, 0.5, -0.5, 1.0)])
def test_layers_of_one_medium_are_its_half_space(medium: Medium, mu_i: float | str) -> None:
    R = trace(Layers([medium] * 3, [0.3, 1.0]), mu_i, 300_000, 303).reflectance()
    assert R.standard_error < 5e-3 * R.value and abs(z(R, (medium.reflectance(mu_i), 0.0))) < 4


def test_rings_of_one_medium_are_those_of_its_half_space() -> None:
    medium, radii = Medium.from_albedo(0.9, 2.0, 0.3, 1.4), [0.0, 0.2, 0.5, 1.0, 3.0]
    whole = trace(medium, 0.8, 400_000, 304, radii=radii)
    layered = trace(Layers([medium] * 2, [0.4]), 0.8, 400_000, 305, radii=radii)
    for order in ("single", "multiple"):
        assert np.all(np.abs(z(layered.exitance(order), whole.exitance(order))) < 4)
    assert np.allclose(layered.exitance_by_layer().value.sum(axis=0), layered.exitance().value, rtol=1e-12)


STACKS = [STEP, THREE, Layers([Medium(1.0, 0.1, 0.5, 1.6), Medium(3.0, 0.1, 0.8, 1.2)], [0.5, 2.0], eta_below=1.4)]


@pytest.mark.parametrize("mu_i", [1.0, 0.2, "diffuse"])
@pytest.mark.parametrize("layers", STACKS)
def test_what_enters_leaves_or_is_absorbed(layers: Layers, mu_i: float | str) -> None:
    run = trace(layers, mu_i, 100_000, 306)
    parts = [run._reflected.sum(axis=(1, 2)), run._transmitted.sum(axis=1), run._absorbed.sum(axis=1)]
    total = np.sum(parts, axis=0)
    mu = np.sqrt((np.arange(4096) + 0.5) / 4096) if mu_i == "diffuse" else np.array([mu_i])
    entered = float(np.mean(1 - F_r(mu, layers.eta)))
    assert abs(total.mean() - entered) < 4 * total.std(ddof=1) / math.sqrt(len(total)) + 2e-5
    assert np.allclose(run.reflectance_by_layer().value.sum(), run.reflectance().value, rtol=1e-12)


def test_clear_layers_reflect_and_pass_what_fresnels_formulas_say() -> None:
    """Two clear plates of 1.5 on 1.2, normal light: incoherent sums over the interfaces."""
    clear = [Medium(0.0, 1e-9, 0.0, eta) for eta in (1.5, 1.2)]
    run = trace(Layers(clear, [1.0, 2.0]), 1.0, 400_000, 307)
    R, T = np.array([F_r(1.0, 1.5), F_r(1.0, 1.2 / 1.5), F_r(1.0, 1 / 1.2)]), None
    above, through = R[0], 1 - R[0]
    for r in R[1:]:  # adding of interfaces
        above, through = above + through**2 * r / (1 - above * r), through * (1 - r) / (1 - above * r)
    R, T = run.reflectance("unscattered"), run.transmittance("unscattered")
    assert abs(z(R, (above - F_r(1.0, 1.5), 0.0))) < 4 and abs(z(T, (through, 0.0))) < 4
    assert run.reflectance("single").value == run.reflectance("multiple").value == 0


def test_swapped_incidence_of_a_slab_transmits_the_same() -> None:
    """Reciprocity: diffuse transmittance is the same from both sides."""
    media, thickness = [Medium(2.0, 0.3, 0.6, 1.5), Medium(4.0, 0.05, 0.0, 1.2)], [0.5, 0.8]
    there = trace(Layers(media, thickness), "diffuse", 300_000, 308).transmittance()
    back = trace(Layers(media[::-1], thickness[::-1]), "diffuse", 300_000, 309).transmittance()
    assert there.standard_error < 0.01 * there.value and abs(z(there, back)) < 4


def test_standard_errors_of_layers_are_the_spread_of_independent_runs() -> None:
    runs = [trace(THREE, 0.7, 8192, 700 + k, radii=[0.0, 1.0, 5.0]) for k in range(20)]
    for name in ("reflectance", "transmittance", "absorptance", "exitance", "transmitted_exitance"):
        check_spread(*zip(*(getattr(r, name)() for r in runs)))


def test_the_same_seed_gives_the_same_bits_of_layers() -> None:
    a, b, c = (trace(STEP, 1.0, 20_000, seed).reflectance_by_layer().value.tobytes() for seed in (1, 1, 2))
    assert a == b != c


def test_the_deepest_layer_of_light_that_never_meets_the_second_is_the_first() -> None:
    thick, radii = Layers([Medium(10.0, 1.0, 0.0, 1.4)] * 2, [100.0]), [0.0, 1.0]
    run = trace(thick, 1.0, 10_000, 310, radii=radii)
    assert run.reflectance_by_layer().value[1] == 0 and run.absorptance().value[1] == 0
    assert run.exitance_by_layer().value[0, 0] > 0


def test_a_relative_error_ends_a_run_of_layers_early() -> None:
    run = trace(VAN_DE_HULST, 1.0, 10**9, 1, relative_error=1e-3)
    R = run.reflectance()
    assert R.standard_error <= 1e-3 * R.value and run.n_paths < 2e7


def test_models_refuse_layers_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=f"medium must be one Medium for {name}, got Layers of 2"):
        bssrdf(name, STEP)


M = Medium(1.0, 0.1)
BAD = [
    (([], []), "media must be a list of one medium or more"),
    ((M, []), "media must be a list of one medium or more"),
    (([M, "skin"], [1.0]), "layer 2: medium must be a Medium or a Material, got 'skin'"),
    (([Medium([1.0, 2.0], 0.1), M], [1.0]), "layer 1: medium must have one channel"),
    (([M, Medium(1.0, 0.1, 0.0, 0.9)], [1.0]), "layer 2: eta must be >= 1, got 0.9"),
    (([M, M], [0.0]), "thickness of layer 1 must be finite and > 0"),
    (([M, M], [1.0, math.inf]), "thickness of layer 2 must be finite and > 0"),
    (([M, M], [math.nan]), "thickness of layer 1 must be finite and > 0"),
    (([M, M, M], [1.0]), "thickness must have 2 .* or 3 .* numbers for 3 media, got 1"),
    (([M, M], "thin"), "thickness must be numbers in mm"),
    (([M], [], 1.5), "eta_below must be left out below a semi-infinite layer, got 1.5"),
    (([M], [1.0], 0.0), "eta_below must be finite and > 0, got 0.0"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_layers_that_cannot_be_are_refused_in_a_sentence(arguments: tuple, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Layers(*arguments)


def test_what_was_not_asked_of_layers_is_refused() -> None:
    with pytest.raises(ValueError, match="directions must be left out for layers"):
        trace(STEP, directions=[(1.0, 0.0)])
    run = trace(STEP, 1.0, 256)
    with pytest.raises(ValueError, match="thickness must be given for the last layer"):
        run.transmittance()
    with pytest.raises(ValueError, match="radii must be given"):
        run.exitance()
    with pytest.raises(ValueError, match="order must be one of unscattered, single, multiple, total"):
        run.reflectance("all")


def test_a_clear_layer_is_one_that_hardly_scatters_and_refusals_say_so() -> None:
    """Of one index with the medium below it, it changes no more than noise."""
    wax = Medium(1.0, 0.01, 0.5, 1.4)
    bare = trace(Layers([wax], [2.0]), 1.0, 200_000, 311)
    under = trace(Layers([Medium(1e-9, 0.0, 0.0, 1.4), wax], [1.0, 2.0]), 1.0, 200_000, 312)
    assert abs(z(under.reflectance(), bare.reflectance())) < 4
    assert under.absorptance().value[0] == 0
    for sigma_s, g in ((0.0, 0.0), (1.0, 1.0)):
        with pytest.raises(ValueError, match="a clear layer is sigma_s = 1e-9, g = 0"):
            Medium(sigma_s, 0.0, g, 1.4)
