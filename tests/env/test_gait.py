"""Touchdowns and liftoffs, counted by hand from the contacts of successive steps of 20 ms."""

import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax.env import gait

PERIOD = 0.02  # s


def walked(contacts: str, debounce: int):
    """Return (step, air time) of the left foot's touchdowns, and whether it was down at each step.

    `contacts` has an `x` for each step in which the foot touches; the right foot always does.
    """
    state, touchdowns, down = gait.standing_gait(), [], []
    for k, mark in enumerate(contacts):
        touching = jnp.array([mark == "x", True])
        state, swings = gait.update_gait(state, touching, PERIOD, debounce)
        down.append(bool(state.down[0]))
        assert not swings.touchdown[1] and float(swings.air_time[1]) == 0.0
        if swings.touchdown[0]:
            touchdowns.append((k, round(float(swings.air_time[0]), 3)))
    return touchdowns, down


@pytest.mark.parametrize(
    ("contacts", "debounce", "expected"),
    [
        # the last contact is at step 1, the next at step 7: 6 steps. Told one step later with 2
        ("xx.....xxx", 1, [(7, 0.12)]),
        ("xx.....xxx", 2, [(8, 0.12)]),
        # a scuff of one step in mid-swing divides the swing without debouncing, and not with it
        ("xx...x....xx", 1, [(5, 0.08), (10, 0.10)]),
        ("xx...x....xx", 2, [(11, 0.18)]),
        # a scuff of two steps is a touchdown of a short swing
        ("xx...xx....xx", 2, [(6, 0.08), (12, 0.10)]),
        # a bounce of one step is no liftoff
        ("xx....xx.xxx", 2, [(7, 0.10)]),
        ("xx.xxxx", 2, []),
        ("xxxxxx", 1, []),
    ],
)
def test_touchdowns_and_the_swings_that_they_end(contacts, debounce, expected):
    assert walked(contacts, debounce)[0] == expected


def test_a_foot_is_up_from_its_second_step_without_contact_to_its_second_with_it():
    # step:  0123456789
    _, down = walked("xx..x..xxx", 2)
    assert down == [True, True, True, False, False, False, False, False, True, True]


def test_air_time_grows_through_a_scuff_and_is_kept_after_the_touchdown():
    state = gait.standing_gait()
    for mark in "x..x..":
        state, _ = gait.update_gait(state, jnp.array([mark == "x", True]), PERIOD, 2)
    np.testing.assert_allclose(state.air_time, [5 * PERIOD, 0.0], rtol=1e-6)
    for _ in range(2):
        state, _ = gait.update_gait(state, jnp.ones(2, bool), PERIOD, 2)
    np.testing.assert_allclose(state.air_time, 0.0)
    np.testing.assert_allclose(state.last_air_time, [6 * PERIOD, 0.0], rtol=1e-6)
