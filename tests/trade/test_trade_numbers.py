"""The arithmetic of the trade: unbiased squares, honest standard errors, the cheapest way, and its sentences."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from full_geometry.cli import trade
from full_geometry.integrators.gathering import PART, Gathered, Gathering
from full_geometry.trade import recommend
from full_geometry.trade.advice import advise
from full_geometry.trade.assessing import contenders, left_out, most_promising
from full_geometry.trade.automatic import decision_of, picked
from full_geometry.trade.denoised_walks import ErrorLaw, not_negative
from full_geometry.trade.results import Assessment, ObjectTrade, TechniqueTrade, samples_for
from full_geometry.trade.statistics import (
    FIREFLIES,
    Number,
    RadianceEstimate,
    mean_square,
    noise_of_parts,
    relative_variance,
    with_prior,
)
from full_geometry.trade.techniques import Job, Technique

SEEDS, EXITS, SAMPLES = 400, 48, 12


def _estimate(rng: np.random.Generator, mean: np.ndarray, sd: float) -> RadianceEstimate:
    values = mean[..., None] + sd * rng.standard_normal((*mean.shape, SAMPLES))
    found = RadianceEstimate(*mean.shape)
    found.add(values.sum(-1), (values**2).sum(-1), SAMPLES)
    return found


def _squares(off: float, sd: float) -> np.ndarray:
    rng, found = np.random.default_rng(3), []
    for _ in range(SEEDS):
        truth = 1 + 0.3 * rng.standard_normal((3, EXITS))
        found.append(mean_square([_estimate(rng, truth * (1 + off), sd)], [_estimate(rng, truth, 2 * sd)]))
    return np.array(found)


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_noise_puts_no_bias_into_a_square(off: float) -> None:
    found = _squares(off, 0.5)[:, 0]
    expected = off**2 * (1 + 0.3**2)
    assert abs(found.mean() - expected) < 4 * found.std() / math.sqrt(SEEDS)  # 4 standard errors


@pytest.mark.parametrize("off", [0.0, 0.1])
def test_standard_errors_are_the_spread_over_seeds(off: float) -> None:
    found = _squares(off, 0.5)
    assert 0.85 < np.mean(found[:, 1]) / found[:, 0].std() < 1.15


def test_the_variance_of_a_sample_is_relative_to_the_mean() -> None:
    rng = np.random.default_rng(4)
    flat = np.full((3, 2000), 2.0)
    value = relative_variance(_estimate(rng, flat, 0.6), _estimate(rng, flat, 0.1))
    assert abs(value.value - 0.09) < 4 * value.error


def test_fireflies_are_not_in_the_variance_of_a_sample() -> None:
    rng, found = np.random.default_rng(5), RadianceEstimate(1, 100)
    for _ in range(4):
        values = 2 + 0.6 * rng.standard_normal((1, 100, 500))
        values[0, rng.integers(0, 100, 3), 7] = 1e4  # of 50000, less than the share that is left out
        found.add(values.sum(-1), (values**2).sum(-1), 500)
        found.add_bright(values.reshape(1, -1), 500)
    assert 12 <= FIREFLIES * 200_000
    steady = relative_variance(found, found).value * found.mean.mean() ** 2
    assert steady == pytest.approx(0.36, rel=0.01)  # the standard error of 2e5 samples is 0.3 %
    assert found.sample_variance.mean() > 1000


def test_fireflies_of_walks_put_neither_bias_nor_noise_into_a_square() -> None:
    rng, found, naive, n = np.random.default_rng(8), [], [], 1250
    for _ in range(SEEDS // 2):
        values = rng.normal(0.98, 0.5, (1, EXITS, n))
        values[rng.random(values.shape) < 5e-5] = 400.0  # half of the share that counts as fireflies, 2 % of the light
        walks = RadianceEstimate(1, EXITS)
        walks.add(values.sum(-1), (values**2).sum(-1), n)
        walks.add_bright(values.reshape(1, -1), n)
        model = _estimate(rng, np.ones((1, EXITS)), 0.02)
        found.append(mean_square([model], [walks]))
        naive.append(((model.mean - walks.mean) ** 2 - model.variance - walks.variance).mean())
    values, errors = np.array(found).T
    assert abs(values.mean()) < 4 * values.std() / math.sqrt(len(values))  # 4 standard errors
    assert values.std() < 0.4 * np.std(naive)
    # two fireflies that meet at an exit look as light that belongs there, and raise the error: hence no mean
    assert 0.6 < np.median(errors) / values.std() < 1.4


def test_light_that_fireflies_moved_between_exits_is_within_the_error_of_a_square() -> None:
    rng, n, found = np.random.default_rng(10), 2500, []
    for _ in range(SEEDS // 4):
        values = rng.normal(0.8, 0.5, (1, EXITS, n))
        lit = values[:, : EXITS // 4]  # exits that a lamp reaches by rare paths, which carry a fifth of all light
        lit[rng.random(lit.shape) < 2e-4] = 4000.0
        walks = RadianceEstimate(1, EXITS)
        walks.add(values.sum(-1), (values**2).sum(-1), n)
        walks.add_bright(values.reshape(1, -1), n)
        radiance = np.full((1, EXITS), 0.8)
        radiance[:, : EXITS // 4] += 2e-4 * 4000.0
        found.append(mean_square([_estimate(rng, radiance, 0.02)], [walks]))
    values, errors = np.array(found).T
    assert values.mean() > 0.02  # light that lies at other exits looks as a bias
    assert np.mean(np.abs(values) < 3 * errors) > 0.95


def test_the_kept_noise_of_gathered_parts_is_half_that_of_light_and_a_part_of_that_of_the_transfer() -> None:
    rng, T, L = np.random.default_rng(9), np.full((30, 400), 1 / 400), np.ones((400, 1))

    def kept(of_transfer: float, of_light: float) -> float:
        parts = [Gathering(1), Gathering(2)]
        for part in parts:
            transfer = T * rng.normal(1, of_transfer, T.shape) if of_transfer else T
            light = L * rng.normal(1, of_light, L.shape) if of_light else L
            gathered = Gathered(*[None] * 5, matrix=transfer, light=light)
            part._found = [SimpleNamespace(gathered=gathered)]
        return parts[0].kept(parts[1], 0)

    assert kept(0.0, 0.3) == pytest.approx(0.5)
    assert kept(0.3, 0.0) == pytest.approx(PART)
    assert PART < kept(0.3, 0.3) < 0.5
    assert kept(0.0, 0.0) == 1.0
    part = Gathering(1)
    part._found = [SimpleNamespace(gathered=None)]  # of an object without orders from two on
    assert part.kept(part, 0) == 1.0


@pytest.mark.parametrize(("bias2", "bias2_error", "error"), [(0.0, 0.0, 0.1), (4e-4, 3e-4, 0.3), (-1e-3, 5e-4, 2.0)])
def test_as_many_samples_are_taken_as_keep_the_tolerance_one_standard_error_above_what_was_measured(
    bias2: float, bias2_error: float, error: float
) -> None:
    row = TechniqueTrade("neural", bias2, bias2_error, (1.0,), (0.0,), 1.0, error, 1e-6, 100)
    n, tolerance = samples_for(row, 0.05), 0.05
    bound = max(bias2, 0) + 1 / n + math.hypot(bias2_error, error / n)
    assert bound == pytest.approx(tolerance**2, rel=1e-9)
    assert samples_for(row, 0.01) == math.inf or bias2_error == 0


def _law(rng: np.random.Generator) -> ErrorLaw:
    """By 60 blocks of six parts of 2 to 64 samples: e² = 0.01 n^-0.6, with noise that all parts share."""
    n, share = np.array([2, 4, 8, 16, 32, 64]), 60**-0.5
    e2 = 0.01 * n**-0.6
    values = e2 * (1 + 0.5 * share * rng.standard_normal()) + 2e-3 * share * rng.standard_normal()
    values += 2e-4 * share * rng.standard_normal(6)
    covariance = share**2 * (4e-6 * np.ones((6, 6)) + 4e-8 * np.eye(6) + 0.25 * np.outer(e2, e2))
    return ErrorLaw.of(n, values, covariance, 10.0, Number(0.0, 0.0))


def test_the_error_of_denoised_walks_is_told_for_more_samples_than_were_taken() -> None:
    rng, n = np.random.default_rng(12), 256
    values, errors = np.array([_law(rng).denoised(n) for _ in range(SEEDS)]).T
    expected = 0.01 * n**-0.6
    off = (values - expected) / errors
    assert abs(values.mean() - expected) < 0.15 * expected  # the power is known to 0.12 before, e² of n = 64 to a fifth
    assert errors.mean() < 0.3 * expected and off.std() < 1.2


def test_a_square_that_noise_put_below_zero_is_told_as_what_it_may_be() -> None:
    for t in (-30.0, -5.0, 0.0, 2.0):
        x = np.linspace(0, 8 + max(t, 0), 200_001)
        weights = np.exp(-0.5 * (x - t) ** 2 + 0.5 * min(t, 0) ** 2)
        mean = (weights * x).sum() / weights.sum()
        spread = np.sqrt((weights * (x - mean) ** 2).sum() / weights.sum())
        assert not_negative(Number(3 * t, 3.0)) == pytest.approx((3 * mean, 3 * spread), rel=0.05)


def test_a_second_look_is_at_what_may_be_the_cheapest() -> None:
    dear, wrong = _way("neural", 0.01, 0.01, 1e-3), _way("lambert", 0.3, 0.01, 1e-9)
    doubtful = _way("better_dipole", 0.05, 0.2, 1e-7)
    found = _assessment(dear, wrong, doubtful, TechniqueTrade("full_geometry", refusal="it must be trained")).objects[0]
    assert contenders(found, 0.1) == ["better_dipole"]


def _way(name: str, bias: float, error: float, cost: float, **more) -> TechniqueTrade:
    return TechniqueTrade(name, bias**2, error**2, (1.0,), (0.0,), 1.0, 0.0, cost, 100, **more)


def _assessment(*ways: TechniqueTrade, radiance: float = 1.0) -> Assessment:
    ways = (_way("path_traced", 0.0, 0.0, 1e-5), *ways)
    return Assessment((ObjectTrade("ball", (30.0, 40.0), 0.5, 100.0, (radiance,), ways),), 1.0, 0.0, 0)


CHEAP, GOOD = _way("lambert", 0.2, 0.01, 1e-7), _way("neural", 0.01, 0.01, 2e-6)


@pytest.mark.parametrize(("tolerance", "way"), [(0.5, "lambert"), (0.1, "neural"), (0.011, "path_traced")])
def test_the_cheapest_way_that_keeps_the_tolerance_is_recommended(tolerance: float, way: str) -> None:
    assert recommend(_assessment(CHEAP, GOOD), tolerance=tolerance).objects[0].way == way


def test_a_square_that_noise_put_far_below_zero_keeps_no_tolerance_below_its_standard_error() -> None:
    lucky = TechniqueTrade("standard_dipole", -1.0, 0.1, (1.0,), (0.0,), 1.0, 0.0, 1e-9, 100)
    assert lucky.bias == 0.0 and lucky.bias_bound == pytest.approx(math.sqrt(1.645 * 0.1))
    assert recommend(_assessment(lucky), tolerance=0.3).objects[0].way == "path_traced"


def test_walks_with_sampled_light_are_told_as_exact_where_they_are_denoised_too() -> None:
    assert trade._row(_way("path_traced, denoised", 0.0, 0.0, 1e-5))[1] == "exact"


def test_a_bias_that_noise_hides_is_told_as_a_bound_and_never_as_0() -> None:
    lucky = TechniqueTrade("standard_dipole", -1e-3, 1e-4, (1.0,), (0.0,), 1.0, 0.0, 1e-9, 100)
    (walks, row), found = _assessment(lucky).objects[0].ways, _assessment(lucky)
    assert lucky.told_bias == "< 1.3" and trade._row(row)[1] == "< 1.3" and trade._row(walks)[1] == "exact"
    why = {option.way: option.why for option in recommend(found, tolerance=0.011).objects[0].options}
    assert "< 1.3 % off" in why["standard_dipole"]
    assert picked(found.objects[0], 0.05).sentence == (
        "object 'ball': standard_dipole, < 1.3 % off, the tolerance is 5 %"
    )


def test_every_way_gets_one_sentence() -> None:
    refused = TechniqueTrade("full_geometry", refusal="it must be trained")
    doubtful = _way("better_dipole", 0.05, 0.2, 1e-7)
    found = recommend(_assessment(CHEAP, GOOD, doubtful, refused), tolerance=0.1).objects[0]
    why = {option.way: option.why for option in found.options}
    assert why["neural"].startswith("neural is the cheapest that keeps 0.1 (30 to 40 mean free paths across)")
    assert why["lambert"] == "lambert is 20 ± 0.03 % off, the tolerance is 10 %"
    assert "cannot be measured" in why["better_dipole"]
    assert "times as long (exact)" in why["path_traced"]
    assert why["full_geometry"] == "full_geometry: it must be trained"
    assert len(why) == len(found.options) == 5


def test_walks_are_advised_to_stop_by_the_error_of_the_picture_too() -> None:
    walks, model = (recommend(_assessment(CHEAP), tolerance=tolerance).objects[0] for tolerance in (0.02, 0.4))
    assert walks.options[0].why.endswith(
        f"--spp {walks.options[0].spp}, or --target-error 0.02, which stops by the error of the picture"
    )
    assert model.way == "lambert" and "--target-error" not in model.options[0].why


def test_a_training_counts_once() -> None:
    trained = _way("full_geometry", 0.001, 0.001, 1e-9, training=60.0)
    found = _assessment(GOOD, trained)
    assert recommend(found, tolerance=0.05).objects[0].way == "neural"
    assert recommend(found, tolerance=0.05, images=10_000).objects[0].way == "full_geometry"


def test_a_limit_of_time_names_the_least_error_where_nothing_keeps_the_tolerance() -> None:
    found = recommend(_assessment(CHEAP, GOOD), tolerance=0.02, images=1000, seconds=0.2).objects[0]
    assert found.way == "lambert"
    assert found.options[0].why.startswith("no technique keeps 0.02 in 0.2 s; lambert comes nearest")


def test_a_dark_object_takes_the_fastest_way() -> None:
    found = recommend(_assessment(CHEAP, GOOD, radiance=0.0)).objects[0]
    assert found.way == "lambert"
    assert "no light comes from it" in found.options[0].why


def test_several_objects_share_an_integrator() -> None:
    one = _assessment(CHEAP, GOOD).objects[0]
    other = _assessment(_way("neural", 0.5, 0.01, 1e-7)).objects[0]
    found = advise(Assessment((one, other), 1.0, 0.0, 0), Job(0.1))
    assert [o.way for o in found.objects] == ["neural", "path_traced"]
    assert found.integrator == "path_traced"
    assert "all objects together: path_traced" in str(found)


def test_auto_takes_the_cheapest_that_keeps_and_says_when_walks_are_better() -> None:
    found = _assessment(CHEAP, GOOD).objects[0]
    assert picked(found, 0.5).model == "lambert"
    assert picked(found, 0.1).model == "neural"
    least = picked(_assessment(CHEAP).objects[0], 0.1)
    assert least.model == "lambert" and "translucent_walk would be better" in least.sentence
    assert least.seconds == math.inf and not least.keeps


def test_auto_takes_no_model_whose_error_may_be_above_the_tolerance() -> None:
    doubtful = TechniqueTrade("better_dipole", 0.09**2, 0.03**2, (1.0,), (0.0,), 1.0, 0.0, 1e-9, 100)
    assert picked(_assessment(doubtful).objects[0], 0.1).keeps
    assert not picked(_assessment(doubtful).objects[0], 0.094).keeps  # 0.09² + 0.03² is 0.0949²
    assert decision_of(advise(_assessment(doubtful), Job(0.094))).walks == Technique.of("path_traced")


def test_auto_takes_gathered_light_only_where_it_is_asked_for_and_counts_its_preparation() -> None:
    gathered = _way("neural, gathered", 0.01, 0.01, 1e-8, preparation=4.0)
    found = _assessment(GOOD, gathered).objects[0]  # 100 pixels, variance 1
    spp = math.ceil(samples_for(GOOD, 0.1))
    assert picked(found, 0.1).seconds == pytest.approx(100 * spp * 2e-6)
    assert picked(found, 0.1, "gathered").seconds == pytest.approx(4.0 + 100 * spp * 1e-8)
    assert picked(found, 0.1, "gathered").sentence.startswith("object 'ball': neural, gathered, < 1.6 % off")


DENOISED = "path_traced, precomputed, denoised"


@pytest.mark.parametrize(
    ("ways", "walks", "light", "spp"),
    [
        ([GOOD], None, "sampled", 103),
        ([CHEAP], "path_traced", "sampled", 100),
        ([GOOD, ("path_traced, precomputed", 0.0, 0.0, 1e-7)], "path_traced, precomputed", "precomputed", 100),
        ([GOOD, ("better_dipole, corrected", 0.0, 0.0, 1e-7)], None, "corrected", 100),
        ([GOOD, TechniqueTrade(DENOISED, 0.0, 0.0, (1.0,), (0.0,), 0.04, 0.0, 1e-7, 100, power=0.5)], DENOISED,
         "precomputed", 16),
    ],
)  # fmt: skip
def test_auto_of_the_command_takes_the_cheapest_of_all_ways(
    ways: list, walks: str | None, light: str, spp: int
) -> None:
    found = _assessment(*(each if isinstance(each, TechniqueTrade) else _way(*each) for each in ways))
    told = decision_of(advise(found, Job(0.1)))
    assert (told.walks, told.light, told.spp) == (walks and Technique.of(walks), light, spp)
    assert "the cheapest that keeps 10 %" in told.why


def test_auto_walks_with_sampled_light_where_nothing_is_known_to_keep_the_tolerance() -> None:
    blurred = _way("path_traced", 0.2, 0.01, 1e-5)
    found = ObjectTrade("ball", (30.0, 40.0), 0.5, 100.0, (1.0,), (blurred,))
    told = decision_of(advise(Assessment((found,), 1.0, 0.0, 0), Job(0.1)))
    assert told[1:] == ("sampled", None, "path_traced, light sampled, as nothing is known to keep 10 %")


def test_corrected_light_is_looked_at_by_its_chance() -> None:
    found = _assessment(_way("better_dipole", 0.3, 0.01, 1e-6), TechniqueTrade("neural", refusal="no")).objects[0]
    corrected = Technique.of("better_dipole, corrected")
    assert left_out(found, corrected, Job(0.1, 100_000), 4.0) == ""
    assert left_out(found, corrected, Job(0.02, 100_000), 4.0).endswith("is so right: ask for it by its name")
    assert "not measured" in left_out(found, corrected, Job(0.1), 4.0)  # walks take a tenth of a second


def test_a_bias_that_contradicts_what_was_known_is_told_as_measured() -> None:
    assert with_prior(Number(3e-3, 1e-3), 1e-4) == (3e-3, 1e-3)
    assert with_prior(Number(2e-4, 5e-5), 1e-4) == (2e-4, 5e-5)
    agreed = with_prior(Number(1e-4, 1e-4), 1e-4)
    assert agreed == pytest.approx((0.5e-4, 1e-4 / 2**0.5))


@pytest.mark.parametrize(
    "way",
    [
        "path_traced",
        "path_traced, precomputed",
        "path_traced, denoised",
        "path_traced, precomputed, denoised",
        "neural",
        "neural, gathered",
        "neural, corrected",
    ],
)
def test_a_way_comes_back_by_its_name(way: str) -> None:
    assert Technique.of(way).name == way


@pytest.mark.parametrize(
    "unknown",
    ["lambert, gathered", "lambert, corrected", "neural, collected", "neural, precomputed", "path_traced, gathered",
     "neural, denoised"],
)  # fmt: skip
def test_a_way_that_does_not_exist_is_refused(unknown: str) -> None:
    with pytest.raises(ValueError, match="light of"):
        Technique.of(unknown)


@pytest.mark.parametrize(
    ("way", "flags"),
    [("path_traced", "--model path_traced --light sampled"), ("neural, gathered", "--model neural --light gathered"),
     ("path_traced, precomputed", "--model path_traced --light precomputed"), ("lambert", "--model lambert"),
     ("path_traced, precomputed, denoised", "--model path_traced --light precomputed --denoise")],
)  # fmt: skip
def test_the_flags_of_a_way_ask_for_that_way(way: str, flags: str) -> None:
    assert Technique.of(way).flags == flags


def test_precomputed_walks_serve_all_objects_where_they_are_the_cheapest() -> None:
    walks = _way("path_traced, precomputed", 0.003, 0.001, 1e-7, preparation=0.5)
    found = recommend(_assessment(GOOD, walks), tolerance=0.02, images=1000)
    assert found.integrator == found.objects[0].way == "path_traced, precomputed"
    assert "--model path_traced --light precomputed" in str(found)


def test_a_bias_is_told_by_two_parts_of_walks_without_their_noise() -> None:
    rng, found, single = np.random.default_rng(11), [], []
    off, own, kept = 0.1, 0.2, 0.15
    for _ in range(SEEDS):
        truth = 1 + 0.3 * rng.standard_normal((3, EXITS))
        light = [truth * (1 + own * rng.standard_normal(truth.shape)) for _ in range(2)]  # of precomputed light
        walks = [_estimate(rng, each, 0.5) for each in light]
        parts = [_estimate(rng, truth * (1 + off) + own * rng.standard_normal(truth.shape), 0.1) for _ in range(2)]
        found.append(mean_square(parts, walks, kept))
        single.append(mean_square([_estimate(rng, truth * (1 + off), 0.5)], walks))
    for numbers, expected in ((found, off**2 * (1 + 0.3**2) + kept * own**2), (single, off**2 * (1 + 0.3**2))):
        values, errors = np.array(numbers).T
        assert abs(values.mean() - expected) < 4 * values.std() / math.sqrt(SEEDS)  # 4 standard errors
        assert 0.85 < errors.mean() / values.std() < 1.15


def test_the_noise_of_precomputed_light_is_told_by_two_parts_and_is_no_bias() -> None:
    rng, off = np.random.default_rng(3), 0.05
    L = 1 + rng.random((1, 2000))
    one, two, walks = (_estimate(rng, L * (1 + k * rng.standard_normal(L.shape)), 0.1) for k in (off, off, 0))
    noise = noise_of_parts((one, two), walks)
    assert noise.error < 0.1 * noise.value
    assert noise.value == pytest.approx(off**2 * np.mean(L**2) / np.mean(L) ** 2, abs=4 * noise.error)
    bias2 = mean_square((one, two), [walks])
    assert abs(bias2.value) < 4 * bias2.error < 0.2 * noise.value


def test_a_record_comes_back_as_it_was() -> None:
    found = _assessment(CHEAP, GOOD)
    assert Assessment.from_record(found.record()) == found


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tolerance": 0.0}, "tolerance must be a number in"),
        ({"images": 0}, "images must be a whole number >= 1"),
        ({"seconds": -1.0}, "seconds must be a number in"),
    ],
)
def test_bad_input_is_refused(given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        recommend(_assessment(GOOD), **given)


@pytest.mark.parametrize(
    ("tolerance", "images", "seconds", "reason"),
    [
        (0.1, 10_000, 4.0, ""),
        (0.1, 1, 4.0, "before its light is gathered"),
        (0.005, 10_000, 4.0, "the tolerance is 0.5 %"),
        (0.1, 10_000, 0.15, "ask for it by its name"),
    ],
)
def test_light_is_gathered_for_an_assessment_only_where_it_may_win(
    tolerance: float, images: int, seconds: float, reason: str
) -> None:
    found = _assessment(_way("neural", 0.01, 0.001, 2e-6)).objects[
        0
    ]  # at least 2.1 s of gathering, of two parts 0.26 s
    why = left_out(found, Technique.of("neural, gathered"), Job(tolerance, images), seconds)
    assert why.endswith(reason) and bool(why) == bool(reason)


def test_the_light_of_the_model_is_gathered_by_which_the_job_is_expected_to_end_first() -> None:
    ways = [Technique.of("neural, gathered"), Technique.of("better_dipole, gathered")]
    close = _assessment(_way("neural", 0.02, 0.03, 4e-6), _way("better_dipole", 0.03, 0.03, 2e-6)).objects
    apart = _assessment(_way("neural", 0.02, 0.01, 4e-6), _way("better_dipole", 0.1, 0.01, 2e-6)).objects
    dear = _assessment(_way("neural", 0.02, 0.01, 4e-6), _way("better_dipole", 0.01, 0.01, 2e-6, training=1e4)).objects
    assert most_promising(close, ways, Job(0.05, 10)) == ways[1]
    assert most_promising(apart, ways, Job(0.05, 10_000)) == ways[0]
    assert most_promising(dear, ways, Job(0.05, 10_000)) == ways[0]


def test_of_the_noise_of_gathered_light_what_a_render_keeps_counts_as_bias() -> None:
    rng, found = np.random.default_rng(6), []
    off, own, kept = 0.1, 0.2, 0.15
    for _ in range(SEEDS):
        truth = np.ones((3, EXITS))
        parts = [_estimate(rng, 1 + off + own * rng.standard_normal((3, EXITS)), 0.1) for _ in range(2)]
        found.append(mean_square(parts, [_estimate(rng, truth, 0.5)], kept))
    values, errors = np.array(found).T
    expected = off**2 + kept * own**2
    assert abs(values.mean() - expected) < 4 * values.std() / math.sqrt(SEEDS)  # 4 standard errors
    assert 0.85 < errors.mean() / values.std() < 1.15
