import numpy as np
import pytest
from scipy.stats import binom

from hal.base.errors import InvalidValueError
from sim_twin.benchmark.results.stats import mcnemar, paired_difference, wilson
from tests.support.errors import raises


def test_wilson_gives_the_textbook_interval():
    # Newcombe 1998, table I: 81 of 263
    low, high = wilson(81, 263)
    assert (low, high) == pytest.approx((0.2553, 0.3662), abs=1e-4)


def test_wilson_stays_inside_0_to_1_at_the_ends():
    assert wilson(0, 10)[0] == 0.0
    assert wilson(0, 10)[1] == pytest.approx(0.2775, abs=1e-4)
    assert wilson(10, 10)[1] == 1.0
    assert wilson(0, 0) == (0.0, 1.0)


@pytest.mark.integration
def test_wilson_equals_the_formula():
    z = 1.959964  # 97.5 % quantile of the normal distribution
    for trials in (1, 7, 81, 243):
        k = np.arange(trials + 1)
        rate, scale = k / trials, 1 + z * z / trials
        centre = (rate + z * z / (2 * trials)) / scale
        half = z * np.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials)) / scale
        expected = np.clip(np.stack([centre - half, centre + half], axis=1), 0.0, 1.0)
        np.testing.assert_allclose([wilson(int(n), trials) for n in k], expected, atol=1e-7)


def test_wilson_rejects_more_successes_than_trials():
    with raises(InvalidValueError, "invalid_counts") as caught:
        wilson(11, 10)
    assert all(part in str(caught.value) for part in ("11 of 10", "0 to 10", "same rows"))


def test_mcnemar_counts_only_where_the_two_differ():
    first = np.array([1] * 10 + [0] * 2 + [1] * 50 + [0] * 50, dtype=bool)
    second = np.array([0] * 10 + [1] * 2 + [1] * 50 + [0] * 50, dtype=bool)
    test = mcnemar(first, second)
    assert (test.only_first, test.only_second) == (10, 2)
    assert test.p == pytest.approx(2 * 79 / 4096)  # 2 · (C(12,0) + C(12,1) + C(12,2)) / 2¹²


def test_mcnemar_of_equals_finds_no_difference():
    assert mcnemar(np.ones(5, bool), np.ones(5, bool)).p == 1.0


@pytest.mark.parametrize(("b", "c"), [(1, 0), (5, 5), (12, 3), (20, 6), (0, 30)])
def test_mcnemar_equals_twice_the_binomial_tail(b, c):
    assert mcnemar(*pairs(4, b, c, 9)).p == pytest.approx(min(1.0, 2 * binom.cdf(min(b, c), b + c, 0.5)), rel=1e-12)


def test_mcnemar_rejects_unpaired_methods():
    with raises(InvalidValueError, "unpaired"):
        mcnemar(np.ones(5), np.ones(6))


def pairs(both: int, only_first: int, only_second: int, neither: int) -> tuple[np.ndarray, np.ndarray]:
    first = np.repeat([1, 1, 0, 0], [both, only_first, only_second, neither])
    second = np.repeat([1, 0, 1, 0], [both, only_first, only_second, neither])
    return first.astype(bool), second.astype(bool)


def test_the_difference_of_two_methods_is_in_its_interval_and_antisymmetric():
    first, second = pairs(40, 20, 6, 15)
    low, high = paired_difference(first, second)
    assert low < 14 / 81 < high
    assert low > 0  # McNemar: p = 0.009
    assert paired_difference(second, first) == pytest.approx((-high, -low))


def test_methods_that_agree_have_the_narrower_interval():
    agreeing = np.diff(paired_difference(*pairs(40, 8, 0, 33)))[0]
    at_odds = np.diff(paired_difference(*pairs(20, 28, 20, 13)))[0]
    assert agreeing < 0.6 * at_odds


@pytest.mark.integration
def test_the_interval_holds_the_true_difference_about_as_often_as_it_says():
    rng = np.random.default_rng(0)
    chances = np.array([0.45, 0.20, 0.08, 0.27])
    held = 0
    for _ in range(600):
        low, high = paired_difference(*pairs(*rng.multinomial(81, chances)))
        held += low <= 0.12 <= high
    assert 0.925 < held / 600 < 0.985


def test_a_difference_of_no_scenarios_is_rejected():
    with raises(InvalidValueError, "no_scenarios"):
        paired_difference(np.zeros(0, bool), np.zeros(0, bool))
