"""What is said of robots that were told to stand, walk and stop: traces made by hand."""

import numpy as np
import pytest

from cref_jax import config
from cref_jax.evaluation import command_suite
from cref_jax.evaluation.command_suite import CommandTrace

PERIOD = 0.02  # s
STEPS = 500  # 10 s


def trace(speed, steps=(), fell_at=None, air=(0.0, 0.0)) -> CommandTrace:
    """Return one robot that walks ahead at `speed` [T] m/s and steps at these control steps."""
    ahead = np.broadcast_to(np.asarray(speed, float), STEPS)
    position = np.stack([np.cumsum(ahead) * PERIOD, np.zeros(STEPS)], axis=-1)
    touchdown, airborne = np.zeros((STEPS, 1, 2), bool), np.zeros((STEPS, 1, 2), bool)
    touchdown[list(steps), 0, 0] = True
    for foot, share in enumerate(air):
        airborne[100 : 100 + round(share * 400), 0, foot] = True
    fallen = np.zeros((STEPS, 1), bool)
    if fell_at is not None:
        fallen[fell_at:] = True
    velocity = np.stack([ahead, np.zeros(STEPS), np.zeros(STEPS)], axis=-1)
    return CommandTrace(position[:, None], velocity[:, None], touchdown, airborne, fallen)


def together(*traces) -> CommandTrace:
    return CommandTrace(*(np.concatenate(parts, axis=1) for parts in zip(*traces, strict=True)))


def test_who_stands_stays_within_5_cm_and_takes_no_step_after_2_s():
    seen = together(
        trace(0.004, steps=[20, 99]),  # 4 cm in 10 s; its steps are in the first 2 s
        trace(0.004, steps=[100]),
        trace(0.006),  # 6 cm
        trace(0.0, fell_at=480),
    )
    found = command_suite.summarize_command(seen, command_suite.STAND, PERIOD)
    assert (found["trials"], found["fell"], found["stood"], found["still"]) == (4, 1, 2, 2)
    assert found["drift_m"] == pytest.approx(0.04, abs=1e-3)


def test_the_error_is_that_of_the_mean_velocity_after_2_s():
    speed = np.where(np.arange(STEPS) < 100, 0.0, 0.5)
    seen = together(trace(speed, air=(0.4, 0.3)), trace(speed + 0.2), trace(9.0, fell_at=300))
    found = command_suite.summarize_command(seen, (0.6, 0.0, 0.0), PERIOD)
    np.testing.assert_allclose(found["velocity"], [0.6, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found["error"], [0.1, 0.0, 0.0], atol=1e-9)
    np.testing.assert_allclose(found["airborne"], [0.2, 0.15], atol=1e-9)
    assert "stood" not in found


def test_a_robot_stops_where_it_is_at_the_end():
    # 0.6 m/s until 0.5 s after it is told to stop at 5 s: 30 cm
    speed = np.where(np.arange(STEPS) < 275, 0.6, 0.0)  # in steps of which the 250th is the first
    found = command_suite.summarize_stop(trace(speed), PERIOD)
    assert found["distance_m"] == pytest.approx(0.3, abs=1e-9) and found["fell"] == 0


@pytest.mark.parametrize(("asked", "length"), [(8.0, 16.0), (20.0, 20.0)])
def test_nobody_comes_to_the_lanes_end_in_a_trial(world, asked, length):
    c = config.override(world.config, {"terrain": {"lane_length": asked}})
    flat = command_suite._flat_world(c, world.physics)
    assert flat.lanes.length == pytest.approx(length)
    fastest = 1.3 * max(vx for vx, _, _ in command_suite.GRID) * command_suite.SECONDS
    assert 1.0 + fastest < flat.lanes.end - flat.config.episode.lane_end


def test_when_all_have_fallen_there_are_no_numbers():
    seen = trace(0.3, fell_at=10)
    found = {"commands": [command_suite.summarize_command(seen, command_suite.STAND, PERIOD)]}
    found["stop"] = command_suite.summarize_stop(seen, PERIOD)
    assert found["commands"][0]["velocity"] is None and found["stop"]["distance_m"] is None
    assert command_suite.to_table(found).row_count == 1
    assert "0 of 1 within 5 cm" in command_suite.describe(found)
