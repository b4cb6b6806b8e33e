"""Which foot bears when, of contacts that are written down by hand."""

import numpy as np
import pytest

from cref_jax.evaluation import gait_pattern

PERIOD = 0.02  # s


def feet(left, right):
    """Return who is in the air at each step, from strings with a dot for a step in the air."""
    return np.stack([[mark == "." for mark in foot] for foot in (left, right)], axis=1)


def test_bars_stride_and_shares_of_a_walk():
    # left: down 0-2, up 3-4, down 5-7, up 8-9, down 10-11; touchdowns at steps 5 and 10
    # right: up 0-1, down 2-8, up 9, down 10-11; touchdowns at 2 and 10
    found = gait_pattern.describe(feet("___..___..__", ".._______.__"), PERIOD)
    assert found["seconds"] == 0.24
    left, right = found["contacts"]
    assert left == [[0.0, 0.06], [0.1, 0.16], [0.2, 0.24]]
    assert right == [[0.04, 0.18], [0.2, 0.24]]
    assert found["stride_s"] == pytest.approx((5 + 8) / 2 * PERIOD)
    assert found["airborne"] == [pytest.approx(4 / 12, abs=1e-4), 0.25]


def test_who_stands_has_no_stride():
    found = gait_pattern.describe(feet("____", "____"), PERIOD)
    assert found["stride_s"] is None and found["airborne"] == [0.0, 0.0]
    assert found["contacts"] == [[[0.0, 0.08]], [[0.0, 0.08]]]


def test_the_bars_end_after_some_seconds_and_the_shares_are_of_the_whole_walk():
    steps = round(gait_pattern.SECONDS / PERIOD)
    found = gait_pattern.describe(feet("_" * steps + "." * steps, "_" * 2 * steps), PERIOD)
    assert found["contacts"][0] == [[0.0, gait_pattern.SECONDS]]
    assert found["airborne"] == [0.5, 0.0]
