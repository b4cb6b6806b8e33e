"""What an iteration keeps and counts besides what PPO learns."""

import dataclasses
import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world
from tiny_policy import SMALL

from cref_jax import config
from cref_jax.env import environment
from cref_jax.env.state import Ending
from cref_jax.training import iteration, randomization_ramp, rollout


def test_a_deviation_below_the_least_is_raised_to_it():
    world = small_world.world().replace(config=dataclasses.replace(small_world.C, network=SMALL))
    train = jax.jit(iteration.initial_state)(world).train
    stds = np.where(np.arange(12) < 6, 0.13, 0.4).astype(np.float32)
    actor = {"params": {**train.params.actor["params"], "log_std": jnp.log(stds)}}
    train = train.replace(params=train.params._replace(actor=actor))
    raised = iteration.raise_deviations(train, dataclasses.replace(SMALL, min_std=0.25))
    found = np.exp(raised.params.actor["params"]["log_std"])
    np.testing.assert_allclose(found, np.where(np.arange(12) < 6, 0.25, 0.4), rtol=1e-6)
    assert iteration.raise_deviations(train, SMALL) is train


def test_the_samples_of_a_teacher_of_billions_are_counted():
    c = config.override(small_world.C, {"run": {"num_envs": 8192}, "network": {"variant": "hpl"}})
    log = jax.jit(lambda k: iteration._stage_samples(c, k))
    found = log(jnp.int32(19_000))  # of 20,000 iterations 18,000 are the teacher's
    assert float(found["train/teacher_samples"]) == pytest.approx(18_000 * 8192 * 24)
    assert float(found["train/student_samples"]) == pytest.approx(1000 * 8192 * 24, rel=1e-5)


def test_the_log_of_three_robots_over_two_steps_worked_by_hand():
    no = np.zeros((2, 3), bool)
    tilted, finished = no.copy(), no.copy()
    tilted[0, 0], finished[1, 1] = True, True  # robot 2 walks on
    ending = Ending(
        tilted=tilted, low=no, hit=no, dropped=no, unstable=no, stalled=no, finished=finished,
        timeout=no,
    )  # fmt: skip
    touchdown = np.zeros((2, 3, 2), bool)
    touchdown[0, 0], touchdown[1, 1, 0] = True, True
    distance = np.full((2, 3, 2), 0.5)
    distance[0, 0] = 0.1, np.inf
    distance[1, 1] = 0.3
    measures = environment.Measures(
        terms={}, speed_error=no + 0.2, forward_speed=no + 0.4, forward_command=no + 0.6,
        airborne=touchdown, touchdown=touchdown, foothold_distance=distance, progress=no + 1.0,
        commanded=no + 1.0, steps=np.array([[50, 99, 7], [1, 100, 8]]), pushed=no,
        kind=np.tile([0, 1, 1], (2, 1)), level=no + 0, rank=np.array([[4, 5, 8], [3, 6, 8]]),
    )  # fmt: skip
    trace = rollout.Trace(
        no + 1.0, ending, measures, np.array([[1.0, 2.0, 4.0], [1.0, 2.0, np.nan]])
    )
    log = iteration._episode_log(jax.tree.map(jnp.asarray, trace), ("flat", "gap", "slope"), 0.02)
    expected = {
        "episode/length_s": 1.5,  # of 50 and of 100 steps
        "episode/ended": 2.0,
        "episode/fell": 1.0,
        "episode/falls_per_minute": 60.0 / (6 * 0.02),  # one in six steps
        "foothold/distance": 0.2,  # of 0.1 and 0.3 m
        "foothold/empty": 1 / 3,
        "walk/airborne": 3 / 12,
        "teacher_kl/mean": 10 / 5,  # robot 2 has no teacher in the second step
        "level/flat": 3.5,
        "level/gap": 6.75,
        "level/slope": 0.0,  # nobody is there
        "fell/flat": 1.0,
        "fell/gap": 0.0,
        "teacher_kl/gap": 8 / 3,
    }
    assert {k: float(log[k]) for k in expected} == pytest.approx(expected)


@pytest.mark.parametrize("ramp", [True, False])
def test_the_first_episodes_are_randomised_as_much_as_the_ramp_says(ramp):
    world = small_world.world()
    c = config.override(small_world.C, {"randomisation": {"enabled": True, "ramp": ramp}})
    keys = jax.random.split(jax.random.key(0), 28)
    robots = jax.jit(rollout.start)(world.replace(config=c), keys)
    assert bool((robots.env.dynamics.payload == 0.0).all()) == ramp
    assert bool((robots.env.joint_offset == 0.0).all()) == ramp
    np.testing.assert_array_equal(robots.env.spread.mass, np.full(28, 0.0 if ramp else 1.0))
    assert math.isfinite(float(robots.env.body.qpos.sum()))


def test_some_robots_stay_undisturbed_or_are_pushed_alone_while_the_others_meet_everything():
    world = small_world.world()
    shares = {"enabled": True, "undisturbed": 0.3, "pushed_alone": 0.3}
    c = config.override(small_world.C, {"randomisation": shares})
    world = world.replace(config=c)
    count = 5 * len(world.lanes.turns)
    undisturbed, pushed = randomization_ramp.deal_parts(c.randomisation, world.lanes, count)
    others = ~undisturbed & ~pushed
    assert undisturbed.any() and pushed.any() and others.any()
    keys = jax.random.split(jax.random.key(0), count)
    robots = jax.jit(rollout.start)(world, keys)
    np.testing.assert_array_equal(robots.env.dynamics.payload != 0.0, others)
    np.testing.assert_array_equal(robots.env.spread.pushes, np.where(undisturbed, 0.0, 1.0))
    later = rollout.with_randomization(world, robots, jnp.float32(0.25)).env.spread
    np.testing.assert_array_equal(later.pushes, np.where(undisturbed, 0.0, 0.25))
    np.testing.assert_array_equal(later.noise, np.where(others, 0.25, 0.0))


@pytest.mark.parametrize("enabled", [True, False])
def test_the_share_of_the_randomisation_is_logged_where_there_is_some(enabled):
    world, mesh = small_world.world(), iteration.make_mesh()
    c = dataclasses.replace(small_world.C, network=SMALL)
    c = config.override(c, {"run": {"num_envs": 28}, "randomisation": {"enabled": enabled}})
    world = world.replace(config=c)
    chunk = partial(iteration.chunk, mesh=mesh, iterations=1)
    _, log = jax.eval_shape(chunk, world, iteration.state_shapes(world, mesh))
    assert ("train/randomisation" in log) == enabled
