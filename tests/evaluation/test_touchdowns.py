"""Touchdowns, medians and deviations of feet that are set down by hand."""

import numpy as np
import pytest

from cref_jax.evaluation import touchdowns
from cref_jax.evaluation.touchdowns import Touchdowns
from cref_jax.terrain import cross_section
from cref_jax.terrain.cross_section import DOWN, UP


def test_a_touchdown_follows_three_steps_in_the_air():
    left = [False, True, True, True, False, True, True, False]  # 0.06 s, then 0.04 s
    right = [True, True, True, False, False, False, True, True]  # from the beginning; none after
    steps, feet = touchdowns.find_touchdowns(np.stack([left, right], axis=1), 0.02)
    assert sorted(zip(steps.tolist(), feet.tolist(), strict=True)) == [(3, 1), (4, 0)]


def test_the_tread_is_the_depth_of_most():
    # level to 1 m, treads of 0.3, 0.3 and 0.5 m, then the landing
    heights = np.repeat([0.0, 0.2, 0.4, 0.6, 0.8], [10, 3, 3, 5, 10])
    stairs = cross_section.from_heights(heights, 0.1)
    assert touchdowns.tread_depth(stairs) == pytest.approx(0.3)


def test_median_and_deviation_by_direction_size_and_foot():
    # left, up 0.2 m: 5, 7, 12 cm have the median 7; deviations 2, 0, 5 the median 2
    # both feet with the right one's 21 cm: median 9.5; deviations 4.5, 2.5, 2.5, 11.5: 3.5
    found = Touchdowns(
        flight=np.array([UP, UP, UP, UP, DOWN]),
        size=np.array([0.2, 0.2, 0.2, 0.2, 0.1]),
        foot=np.array([0, 0, 0, 1, 1]),
        position=np.array([0.05, 0.07, 0.12, 0.21, -0.035]),
    )
    groups = touchdowns.summarize(found, 0.30)["groups"]
    rows = {(g["way"], g["size_m"], g["foot"]): g for g in groups}
    assert list(rows) == [
        *(("up", 0.2, foot) for foot in ("left", "right", "both")),
        *(("down", 0.1, foot) for foot in ("left", "right", "both")),
    ]
    numbers = lambda *key: [rows[key][name] for name in ("touchdowns", "median_m", "mad_m")]
    assert numbers("up", 0.2, "left") == [3, 0.07, 0.02]
    assert numbers("up", 0.2, "right") == [1, 0.21, 0.0]
    assert numbers("up", 0.2, "both") == [4, pytest.approx(0.095), pytest.approx(0.035)]
    assert numbers("down", 0.1, "left") == [0, None, None]
    assert numbers("down", 0.1, "right") == [1, -0.035, 0.0]


def test_the_histogram_reaches_a_half_sole_over_both_edges():
    # 50 bins of 1 cm from -10 to 40 cm: -3.5 cm is in the seventh, 29.5 cm in the fortieth
    found = Touchdowns(np.full(2, UP), np.full(2, 0.2), np.zeros(2, int), np.array([-0.035, 0.295]))
    made = touchdowns.summarize(found, 0.30)
    bins = made["groups"][0]["bins"]
    assert len(bins) == 50 and [k for k, n in enumerate(bins) if n] == [6, 39]
    assert (made["first_m"], made["bin_m"], made["tread_m"]) == (-0.1, 0.01, 0.3)
