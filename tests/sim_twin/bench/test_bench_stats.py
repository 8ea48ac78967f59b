import numpy as np
import pytest

from sim_twin.bench.stats import mcnemar, wilson


def test_wilson_gives_the_textbook_interval():
    # Newcombe 1998, table I: 81 of 263
    low, high = wilson(81, 263)
    assert (low, high) == pytest.approx((0.2553, 0.3662), abs=1e-4)


def test_wilson_stays_inside_0_to_1_at_the_ends():
    assert wilson(0, 10)[0] == 0.0
    assert wilson(0, 10)[1] == pytest.approx(0.2775, abs=1e-4)
    assert wilson(10, 10)[1] == 1.0
    assert wilson(0, 0) == (0.0, 1.0)


def test_wilson_refuses_more_successes_than_trials():
    with pytest.raises(ValueError, match="11 successes in 10"):
        wilson(11, 10)


def test_mcnemar_counts_only_where_the_two_differ():
    first = np.array([1] * 10 + [0] * 2 + [1] * 50 + [0] * 50, dtype=bool)
    second = np.array([0] * 10 + [1] * 2 + [1] * 50 + [0] * 50, dtype=bool)
    test = mcnemar(first, second)
    assert (test.only_first, test.only_second) == (10, 2)
    assert test.p == pytest.approx(2 * 79 / 4096)  # 2 · (C(12,0) + C(12,1) + C(12,2)) / 2¹²


def test_mcnemar_of_equals_finds_no_difference():
    assert mcnemar(np.ones(5, bool), np.ones(5, bool)).p == 1.0


def test_mcnemar_refuses_what_is_not_paired():
    with pytest.raises(ValueError, match="paired"):
        mcnemar(np.ones(5), np.ones(6))
