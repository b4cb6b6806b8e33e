import numpy as np
import pytest

from cref_jax.env import stall

PERIOD = 0.5  # s, so that 10 s are 20 steps


def walk(*legs):
    """Return x at each step of a walk: (seconds, m/s), one leg after the other."""
    speeds = [v for seconds, v in legs for _ in range(round(seconds / PERIOD))]
    return np.concatenate([[0.0], np.cumsum(speeds) * PERIOD])


def test_a_robot_that_stands_stalls_after_ten_seconds():
    assert stall.stalled_at(walk((30.0, 0.0)), 0.5, PERIOD) == 20


def test_no_robot_stalls_sooner():
    assert stall.stalled_at(walk((9.5, 0.0)), 0.5, PERIOD) is None
    assert stall.stalled_at(walk((10.0, 0.0)), 0.5, PERIOD) == 20


@pytest.mark.parametrize(("share", "stalls"), [(0.29, True), (0.31, False), (1.0, False)])
def test_it_is_the_share_of_the_commanded_distance_that_counts(share, stalls):
    # 0.8 m/s for 10 s are 8 m, of which 0.3 are 2.4 m
    at = stall.stalled_at(walk((20.0, 0.8 * share)), 0.8, PERIOD)
    assert (at == 20) if stalls else (at is None)


def test_it_is_any_ten_seconds_that_count():
    # 1 m/s for 15 s (30 steps), then nothing: 3 m of 10 s have to be reached. After k steps of
    # standing the window holds 20 - k steps of walking, 0.5 m each: less than 3 m from k = 15 on.
    assert stall.stalled_at(walk((15.0, 1.0), (15.0, 0.0)), 1.0, PERIOD) == 45


def test_going_back_is_no_progress():
    # 1 m/s forward for 10 s, then back: after k steps back the window holds (20 - 2 k) * 0.5 m,
    # less than 3 m from k = 8 on
    assert stall.stalled_at(walk((10.0, 1.0), (10.0, -1.0)), 1.0, PERIOD) == 28


def test_who_is_told_to_stand_does_not_stall():
    assert stall.stalled_at(walk((30.0, 0.0)), 0.0, PERIOD) is None


def test_robots_are_judged_one_by_one():
    paths = [walk((30.0, 0.0)), walk((30.0, 0.5)), walk((10.0, 1.0), (20.0, -1.0))]
    speeds = np.array([0.5, 0.5, 1.0])
    found = stall.stalls(np.stack(paths, axis=1), speeds, PERIOD)
    np.testing.assert_array_equal(found, [20, 61, 28])
    for path, speed, at in zip(paths, speeds, found, strict=True):
        assert stall.stalled_at(path, float(speed), PERIOD) == (None if at == 61 else at)


def test_a_short_walk_has_no_stall():
    np.testing.assert_array_equal(stall.stalls(np.zeros((5, 2)), np.ones(2), PERIOD), [5, 5])
