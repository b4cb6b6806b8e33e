"""Intervals, against worked numbers, an oracle and their meaning."""

import math

import numpy as np
import pytest
from scipy import stats

from cref_jax.evaluation import intervals
from cref_jax.evaluation.intervals import Rate, wilson


def test_the_interval_of_eighty_one_of_two_hundred_and_sixty_three():
    # Newcombe 1998, table I of the companion paper: 81/263 gives 0.2553 to 0.3662
    rate = wilson(81, 263)
    assert rate.value == pytest.approx(0.3080, abs=5e-5)
    assert (rate.low, rate.high) == pytest.approx((0.2553, 0.3662), abs=5e-5)


@pytest.mark.parametrize(("k", "n"), [(0, 20), (1, 29), (15, 148), (97, 100), (1997, 2000), (7, 7)])
def test_it_is_the_score_interval(k, n):
    found = stats.binomtest(k, n).proportion_ci(0.95, method="wilson")
    assert wilson(k, n)[1:] == pytest.approx((found.low, found.high), abs=1e-6)


def test_no_failure_does_not_mean_certainty_and_no_trial_means_nothing():
    assert wilson(10, 10).high == 1.0 and wilson(10, 10).low == pytest.approx(0.7225, abs=1e-4)
    assert wilson(0, 10).low == 0.0
    assert math.isnan(wilson(0, 0).value) and wilson(0, 0)[1:] == (0.0, 1.0)


@pytest.mark.parametrize(
    ("a", "b", "low", "high"),
    [  # Newcombe 1998, method 10, examples (a), (b), (e) and (h) of table II
        ((56, 70), (48, 80), 0.0524, 0.3339),
        ((9, 10), (3, 10), 0.1705, 0.8090),
        ((5, 56), (0, 29), -0.0381, 0.1926),
        ((10, 10), (0, 10), 0.6075, 1.0000),
    ],
)
def test_the_interval_of_a_difference(a, b, low, high):
    found = intervals.difference(wilson(*a), wilson(*b))
    assert (found.low, found.high) == pytest.approx((low, high), abs=5e-5)


def test_a_difference_is_significant_where_zero_lies_outside():
    assert intervals.is_significant(intervals.difference(wilson(56, 70), wilson(48, 80)))
    assert not intervals.is_significant(intervals.difference(wilson(5, 56), wilson(0, 29)))
    assert not intervals.is_significant(Rate(0.0, 0.0, 0.0))


def test_the_interval_of_a_mean_covers_it_as_often_as_it_says():
    rng, shares, n = np.random.default_rng(0), np.array([0.98, 0.9, 0.5, 0.75]), 100
    covered = 0
    for _ in range(2000):
        mean = intervals.mean([wilson(int(k), n) for k in rng.binomial(n, shares)])
        covered += mean.low <= shares.mean() <= mean.high
    assert 0.93 < covered / 2000 < 0.97  # four standard deviations are 0.02


def test_the_mean_of_one_rate_is_itself():
    assert intervals.mean([wilson(3, 9)]) == pytest.approx(wilson(3, 9))


@pytest.mark.parametrize("count", range(2, intervals.MOST_VALUES + 1))
def test_the_mean_of_a_few_values_has_students_interval(count):
    values = [0.5 + 0.1 * (-1) ** k * k for k in range(count)]
    found = intervals.mean_of_few(values)
    low, high = stats.t.interval(0.95, count - 1, np.mean(values), stats.sem(values))
    assert found == pytest.approx((np.mean(values), low, high), abs=1e-4)
    assert intervals.mean_of_few(values[:1]) is None
