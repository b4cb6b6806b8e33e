"""95 % confidence intervals of a success rate, of a difference and of a mean.

A rate has Wilson's score interval. The intervals of a difference and of a mean are built from it
(R. Newcombe, "Interval estimation for the difference between independent proportions", Statistics
in Medicine 17, 1998, method 10; for sums the same), so they hold near 0 and 1 as well. The
mean over a few seeds of one training has Student's t interval.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

Z = 1.959964  # standard deviations, half the central 95 % of a normal distribution
STUDENT = (12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622)
"""97.5 % quantiles of Student's distribution with 1, 2, ... degrees of freedom"""
MOST_VALUES = len(STUDENT) + 1  # of which a mean is taken


class Rate(NamedTuple):
    """A share between 0 and 1, or a difference of two, with its interval."""

    value: float
    low: float
    high: float


def wilson(successes: int, trials: int) -> Rate:
    """Compute the share of successes; without trials it is nan, in an interval from 0 to 1."""
    if trials == 0:
        return Rate(math.nan, 0.0, 1.0)
    share, extra = successes / trials, Z * Z / trials
    middle = (share + extra / 2.0) / (1.0 + extra)
    half = Z * math.sqrt(share * (1.0 - share) / trials + extra / (4.0 * trials)) / (1.0 + extra)
    low, high = max(0.0, middle - half), min(1.0, middle + half)  # exact at 0 and 1
    return Rate(share, low if successes else 0.0, high if successes < trials else 1.0)


def difference(a: Rate, b: Rate) -> Rate:
    """Compute a - b of two independent rates; it is significant if its interval excludes 0."""
    value = a.value - b.value
    return Rate(
        value,
        value - math.hypot(a.value - a.low, b.high - b.value),
        value + math.hypot(a.high - a.value, b.value - b.low),
    )


def mean(rates: Sequence[Rate]) -> Rate:
    """Compute the unweighted mean of independent rates."""
    value = sum(rate.value for rate in rates) / len(rates)
    return Rate(
        value,
        value - math.hypot(*(rate.value - rate.low for rate in rates)) / len(rates),
        value + math.hypot(*(rate.high - rate.value for rate in rates)) / len(rates),
    )


def is_significant(gap: Rate) -> bool:
    """Check whether the interval of a difference excludes zero."""
    return not gap.low <= 0.0 <= gap.high


def mean_of_few(values: Sequence[float]) -> Rate | None:
    """Compute the mean of independent values with Student's t interval; None for a single one.

    Raises:
        ValueError: there is none, or more than MOST_VALUES.
    """
    count = len(values)
    if not 1 <= count <= MOST_VALUES:
        raise ValueError(f"1 to {MOST_VALUES} values, not {count}")
    if count == 1:
        return None
    value = sum(values) / count
    variance = sum((x - value) ** 2 for x in values) / (count - 1)
    half = STUDENT[count - 2] * math.sqrt(variance / count)
    return Rate(value, value - half, value + half)
