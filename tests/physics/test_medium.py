"""The medium: what derives from its four numbers, and what it refuses."""

import math

import numpy as np
import pytest

import halfspace_sss
from halfspace_sss import Medium

SCALAR = dict(sigma_s=2.0, sigma_a=0.5, g=0.25, eta=1.4)
DERIVED = {
    "sigma_t": 2.5, "mfp": 0.4, "albedo": 0.8, "sigma_s_prime": 1.5, "sigma_t_prime": 2.0, "albedo_prime": 0.75,
}  # fmt: skip


@pytest.mark.parametrize("quantity", DERIVED)
def test_derived_quantities_of_a_scalar_medium_are_numbers(quantity):
    value = getattr(Medium(**SCALAR), quantity)
    assert isinstance(value, float) and value == pytest.approx(DERIVED[quantity], rel=1e-15)


@pytest.mark.parametrize("quantity", DERIVED)
def test_derived_quantities_of_channels_are_those_of_each_channel(quantity):
    medium = Medium([2.0, 1.0], [0.5, 0.1], [0.25, -0.3], 1.4)
    each = [getattr(medium.channel(k), quantity) for k in range(2)]
    np.testing.assert_array_equal(getattr(medium, quantity), each)


def test_one_coefficient_per_channel_makes_all_per_channel():
    medium = Medium([1.0, 2.0, 3.0], 0.1, 0.5)
    assert medium.n_channels == 3 and medium.sigma_a.shape == medium.g.shape == (3,)


def test_a_scalar_medium_has_no_channel_count_but_channel_zero():
    medium = Medium(**SCALAR)
    assert medium.n_channels is None and medium.channel(0) == medium


def test_channel_arrays_cannot_be_written():
    with pytest.raises(ValueError, match="read-only"):
        Medium([1.0, 2.0], 0.1).sigma_s[0] = 3.0


def test_arrays_given_are_copied():
    sigma_s = np.array([1.0, 2.0])
    medium = Medium(sigma_s, 0.1)
    sigma_s[0] = 9.0
    assert medium.sigma_s[0] == 1.0


def test_from_albedo_keeps_albedo_and_extinction():
    medium = Medium.from_albedo([0.3, 1.0], 2.0, g=0.5, eta=1.2)
    np.testing.assert_allclose(medium.albedo, [0.3, 1.0], rtol=1e-15)
    np.testing.assert_allclose(medium.sigma_t, 2.0, rtol=1e-15)
    assert medium.eta == 1.2 and medium.sigma_a[1] == 0


def test_media_scatter_evenly_and_have_the_index_1_3_unless_it_is_said_otherwise():
    for medium in (Medium(0.5, 1.5), Medium.from_albedo(0.25, 2.0), Medium.from_reduced(0.5, 1.5)):
        assert medium == Medium(0.5, 1.5, 0.0, 1.3)


def test_from_reduced_keeps_the_reduced_scattering():
    medium = Medium.from_reduced(1.5, 0.2, g=0.9)
    assert medium.sigma_s_prime == pytest.approx(1.5, rel=1e-15)
    assert medium.sigma_a == 0.2


def test_in_mfp_has_unit_extinction_and_the_same_albedo():
    medium = Medium([2.0, 1.0], [0.5, 0.1], 0.3, 1.4)
    np.testing.assert_allclose(medium.in_mfp().sigma_t, 1.0, rtol=1e-15)
    np.testing.assert_allclose(medium.in_mfp().albedo, medium.albedo, rtol=1e-15)


def test_scaled_multiplies_both_coefficients_and_nothing_else():
    medium = Medium(**SCALAR).scaled(3.0)
    assert (medium.sigma_s, medium.sigma_a, medium.g, medium.eta) == (6.0, 1.5, 0.25, 1.4)


def test_a_medium_of_tensors_has_the_texts_of_its_numbers_and_equals_no_other():
    torch = pytest.importorskip("torch")
    sigma_s = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
    medium, other, numbers = Medium(sigma_s, 0.1), Medium(sigma_s, 0.1), Medium([1.0, 2.0], 0.1)
    assert medium.detached() == numbers and numbers.detached() is numbers
    assert str(medium) == str(numbers) and medium._repr_html_() == numbers._repr_html_()
    assert medium == medium and medium != other and numbers != medium and len({medium, other, numbers, medium}) == 3
    for made in (Medium.from_reduced(sigma_s, 0.1), Medium.from_albedo(sigma_s / 4, 2.0), medium.scaled(2).in_mfp()):
        (slope,) = torch.autograd.grad(made.channel(1).albedo, sigma_s)
        assert slope[0] == 0 < slope[1]
    for refused in (
        {"eta": sigma_s[0]},
        {"sigma_s": -sigma_s},
        {"sigma_s": [sigma_s[0], sigma_s[1]]},
        {"sigma_a": 0 * sigma_s},
    ):
        with pytest.raises(ValueError, match=f"{next(iter(refused))} must be"):
            Medium(**{"sigma_s": 1.0, "sigma_a": 0.1, **refused})
    for lost in (medium.reflectance, lambda: halfspace_sss.trace(medium.channel(0), 10)):
        with pytest.raises(ValueError, match="medium must be of numbers"):
            lost()


def test_equal_media_are_equal_and_hash_alike():
    assert Medium(**SCALAR) == Medium(**SCALAR) != Medium(**{**SCALAR, "g": 0.0})
    assert hash(Medium(**SCALAR)) == hash(Medium(**SCALAR))
    assert Medium(**SCALAR) != 3
    assert Medium(1.0, 0.0, -0.0) == Medium(1.0, 0.0, 0.0) and len({Medium(1.0, 0.0, -0.0), Medium(1.0, 0.0, 0.0)}) == 1


@pytest.mark.parametrize("sigma_s", [-1.5, np.float64(-1.5), np.float32(-1.5), [2.0, -1.5], np.array([2.0, -1.5])])
def test_messages_show_plain_numbers(sigma_s):
    with pytest.raises(ValueError, match=r"got -1\.5$"):
        Medium(sigma_s, 0.1)


@pytest.mark.parametrize("albedo", [0.0, 1 - 1e-7, 1.0])
def test_extreme_albedos_are_accepted(albedo):
    assert Medium.from_albedo(albedo, 1.0).albedo == pytest.approx(albedo, abs=1e-15)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sigma_s": -1.0}, r"sigma_s must be finite and >= 0 \(1/mm\), got .*-1"),
        ({"sigma_s": math.nan}, "sigma_s must be finite .*nan"),
        ({"sigma_s": math.inf}, "sigma_s must be finite .*inf"),
        ({"sigma_a": -0.5}, "sigma_a must be finite and >= 0 .*-0.5"),
        ({"sigma_a": [0.1, -2.0]}, "sigma_a must be .*-2"),
        ({"g": 1.0}, r"g must be in the open interval \(-1, 1\), got .*1"),
        ({"g": -1.0}, r"g must be in the open interval \(-1, 1\), got .*-1"),
        ({"g": math.nan}, "g must be .*nan"),
        ({"eta": 0.0}, r"eta must be in \[0.01, 100\], got .*0"),
        ({"eta": -1.3}, r"eta must be in \[0.01, 100\], got .*-1.3"),
        ({"eta": math.inf}, r"eta must be in \[0.01, 100\], got .*inf"),
        ({"eta": [1.3, 1.4]}, r"eta must be one number for all channels, got shape \(2,\)"),
        ({"sigma_s": "red"}, "sigma_s must be a number or a sequence of numbers, got 'red'"),
        ({"sigma_s": None}, "sigma_s must be a number .* got None"),
        ({"eta": "1.3"}, "eta must be a number .* got '1.3'"),
        ({"sigma_s": [[1.0]]}, r"sigma_s must be a scalar or one value per channel, got shape \(1, 1\)"),
        ({"sigma_s": []}, "sigma_s must have at least one channel"),
        (
            {"sigma_s": [1.0, 2.0], "sigma_a": [1.0, 2.0, 3.0]},
            r"sigma_s, sigma_a and g must have the same number of channels, got \(2,\), \(3,\), \(\)",
        ),
        ({"sigma_s": 1e-20, "sigma_a": 0.0}, r"sigma_t = .* must be in \[1e-18, 1e[+]18\] \(1/mm\), got 1e-20"),
        ({"sigma_s": [1.0, 1e19]}, r"sigma_t = .* must be in \[1e-18, 1e[+]18\] \(1/mm\), got 1e[+]19"),
        ({"sigma_s": 0.0, "sigma_a": 0.0}, "sigma_t = sigma_s [+] sigma_a must be .*, got 0.0; a clear layer is"),
        ({"sigma_a": 10**400}, "sigma_a must be a number .* got 1000"),
    ],
)
def test_bad_coefficients_are_refused_with_name_bound_and_value(change, message):
    with pytest.raises(ValueError, match=message):
        Medium(**{**SCALAR, **change})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: Medium.from_albedo(1.1, 1.0), r"albedo must be in \[0, 1\], got .*1.1"),
        (lambda: Medium.from_albedo(-0.1, 1.0), r"albedo must be in \[0, 1\], got .*-0.1"),
        (lambda: Medium.from_albedo(0.5, 0.0), "sigma_t must be finite and > 0 .*0"),
        (lambda: Medium.from_reduced(-1.0, 0.1), "sigma_s_prime must be finite and >= 0 .*-1"),
        (lambda: Medium.from_reduced(1.0, 0.1, g=1.0), "g must be in the open interval .*1"),
        (lambda: Medium(**SCALAR).scaled(0.0), "factor must be finite and > 0, got .*0"),
        (lambda: Medium(**SCALAR).scaled("a"), "factor must be a number .*'a'"),
        (lambda: Medium(**SCALAR).scaled([1.0, 2.0]), r"factor must be one number, got shape \(2,\)"),
        (lambda: Medium.from_albedo([0.1, 0.2], [1, 2, 3]), "albedo and sigma_t must have the same number of channels"),
        (lambda: Medium.from_reduced([1, 2], 0.1, g=[0.1] * 3), "sigma_s_prime and g must have the same number"),
        (lambda: Medium(**SCALAR).channel(1), r"channel must be a whole number in \[0, 0\], got 1"),
        (lambda: Medium([1.0, 2.0], 0.1).channel(-1), r"channel must be a whole number in \[0, 1\], got -1"),
        (lambda: Medium([1.0, 2.0], 0.1).channel(0.5), r"channel must be a whole number in \[0, 1\], got 0.5"),
    ],
)
def test_bad_arguments_of_its_makers_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
