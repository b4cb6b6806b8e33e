"""What is said of robots that were told to stand, walk and stop: traces made by hand."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax import config, ppo
from cref_jax.env import observations
from cref_jax.env.observations import Observation
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


def test_a_trace_has_the_motion_in_the_robots_frame_and_the_command_until_the_stop(
    world, robots, monkeypatch
):
    heard = []

    def step_policy(world, train, walking):
        heard.append((walking.env.command, walking.observation.proprioception))
        qpos = walking.env.body.qpos.at[:, :2].add(1.0)
        body = walking.env.body._replace(qpos=qpos)
        none = jnp.zeros((8, 2), bool)
        outcome = SimpleNamespace(
            ending=SimpleNamespace(terminated=walking.env.command[:, 0] == 0.0),
            measures=SimpleNamespace(touchdown=none, airborne=~none),
        )
        return walking.replace(env=walking.env.replace(body=body)), None, outcome

    monkeypatch.setattr(command_suite.rollout, "step_policy", step_policy)
    # it faces left, and moves by 0.3 m/s ahead while it turns by 0.7 rad/s
    half = np.sqrt(0.5)
    body = robots.body._replace(
        qpos=robots.body.qpos.at[:, 3:7].set(jnp.array([half, 0.0, 0.0, half])),
        qvel=jnp.zeros_like(robots.body.qvel).at[:, :6].set(jnp.array([0, 0.3, 0, 0.1, 0.2, 0.7])),
    )
    obs = Observation(jnp.full((8, 45), 9.0), jnp.zeros((8, 1)), jnp.zeros((8, 3)))
    start = command_suite.rollout.Robots(robots.replace(body=body), obs, (), jnp.zeros(8, bool))
    commands = jnp.tile(jnp.array([0.6, 0.1, -0.2]), (8, 1))
    record = command_suite._record_trace.__wrapped__
    with jax.disable_jit():
        seen = record(world, ppo.TrainState(*5 * [None]), start, commands, jnp.full(8, 2), 3)
    np.testing.assert_allclose(seen.velocity, np.tile([0.3, 0.0, 0.7], (3, 8, 1)), atol=1e-6)
    np.testing.assert_allclose(np.diff(seen.position, axis=0), 1.0, atol=1e-6)
    np.testing.assert_array_equal(seen.fallen[:, 0], [False, False, True])
    assert np.asarray(seen.airborne).all() and not np.asarray(seen.touchdown).any()
    for k, (command, told) in enumerate(heard):
        wanted = [0.6, 0.1, -0.2] if k < 2 else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(command[0], wanted, atol=1e-6)
        where = observations.slices(12)["command"]
        np.testing.assert_allclose(told[0, where], wanted, atol=1e-6)
        assert (np.delete(told[0], np.r_[where]) == 9.0).all()


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
