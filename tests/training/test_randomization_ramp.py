"""How much is randomised, by the falls of before."""

import dataclasses

import jax.numpy as jnp
import pytest
import small_world

from cref_jax import config
from cref_jax.training import randomization_ramp

C = dataclasses.replace(config.Randomisation(), ramp=True, ramp_falls=(2.0, 4.0), ramp_step=0.1)


def after(
    falls: float, iterations: int, start: randomization_ramp.Ramp | None = None
) -> randomization_ramp.Ramp:
    state = start or randomization_ramp.initial_ramp(C)
    for _ in range(iterations):
        state = randomization_ramp.update_ramp(state, jnp.float32(falls), C)
    return state


def test_it_begins_with_nothing_and_without_a_ramp_with_everything():
    assert float(randomization_ramp.initial_ramp(C).share) == 0.0
    off = config.Randomisation()
    state = randomization_ramp.update_ramp(
        randomization_ramp.initial_ramp(off), jnp.float32(99.0), off
    )
    assert float(state.share) == 1.0


@pytest.mark.parametrize(
    ("falls", "iterations", "share"),
    [
        # the mean begins at 3 and is 0.9^k (3 - falls) + falls: below 2 after 11 iterations of 0.5
        # (0.5 + 2.5 * 0.9^k < 2 from k = 5 on)
        (0.5, 4, 0.0),
        (0.5, 5, 0.1),
        (0.5, 8, 0.4),
        (0.5, 99, 1.0),
        (3.0, 99, 0.0),
        (9.0, 99, 0.0),
    ],
)
def test_few_falls_raise_it(falls, iterations, share):
    assert float(after(falls, iterations).share) == pytest.approx(share)


def test_many_falls_lower_it_and_in_between_it_stays():
    high = after(0.5, 20)  # the mean is 0.5 + 2.5 * 0.9^20 = 0.80
    share = float(high.share)
    # 9 a minute: 9 - 8.2 * 0.9^k > 4 from k = 5 on
    assert float(after(9.0, 4, high).share) < share + 0.31
    assert float(after(9.0, 30, high).share) < share
    calm = after(3.0, 60, after(9.0, 10, high))
    assert float(after(3.0, 50, calm).share) == float(calm.share)


@pytest.mark.parametrize(
    ("undisturbed", "pushed", "of_five"),  # multiples of the golden ratio: 0, .62, .24, .85, .47
    [
        (0.0, 0.0, (0, 0)),
        (0.4, 0.0, (2, 0)),
        (0.4, 0.1, (2, 1)),
        (0.0, 0.9, (0, 5)),
        (1.0, 0.0, (5, 0)),
    ],
)
def test_the_same_robots_of_each_turn_of_kinds_meet_less(undisturbed, pushed, of_five):
    lanes = small_world.world().lanes
    turns = len(lanes.turns)
    c = dataclasses.replace(C, undisturbed=undisturbed, pushed_alone=pushed)
    for dealt, expected in zip(
        randomization_ramp.deal_parts(c, lanes, 5 * turns), of_five, strict=True
    ):
        assert [int(dealt[first::turns].sum()) for first in range(turns)] == turns * [expected]
