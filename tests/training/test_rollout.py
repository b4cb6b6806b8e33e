"""Where the environment meets the learner: what is collected is what the update will see."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import small_world

from cref_jax import config, depth, ppo
from cref_jax.config import Config
from cref_jax.env import environment
from cref_jax.training import iteration, rollout

E, T = 4, 12


def small(variant: str) -> Config:
    """Return a small network on short episodes, so that some end within a horizon."""
    return config.override(
        small_world.C,
        {
            "run": {"num_envs": E},
            "ppo": {"horizon": T, "minibatches": 2},
            "episode": {"length": 0.3},
            "network": {
                "variant": variant,
                "token": 8,
                "heads": 2,
                "lstm": 8,
                "gru": 8,
                "actor": [8],
                "critic": [8],
            },
        },
    )


def two_horizons(variant: str):
    """Return the world, the learner, and two successive horizons with the robots before each."""
    world = small_world.world().replace(config=small(variant))
    c = world.config
    state = jax.jit(iteration.initial_state)(world)
    nets = rollout.networks(c.network, world.physics.robot.num_joints)
    collect = jax.jit(lambda w, r, k: rollout.collect(w, nets, state.train, r, k))
    first_keys, second_keys = jax.random.split(jax.random.key(1), (2, E))
    middle, first, _ = collect(world, state.robots, first_keys)
    last, second, _ = collect(world, middle, second_keys)
    return world, nets, state.train, (state.robots, middle, last), (first, second)


@pytest.fixture(scope="module")
def seeing():
    return two_horizons("full")


def test_the_update_recomputes_the_actions_that_were_taken(seeing):
    _, nets, train, _, horizons = seeing
    actor = jax.jit(nets.functions.actor)
    for r in horizons:
        assert r.begins[1:].any(), "an episode must begin inside of the horizon"
        assert not r.sight.seen.all() and r.sight.seen.any()
        obs = ppo.normalize(train.statistics.obs, r.obs)
        _, out = actor(train.params.actor, r.carry, obs, r.begins, r.sight)
        np.testing.assert_allclose(out.mean, r.mean, atol=1e-6)


def test_a_teacher_without_camera_recomputes_its_actions_from_heights():
    _, nets, train, (before, _, _), horizons = two_horizons("hpl_teacher")
    assert before.feed is None and before.memory.features is None
    act = jax.jit(nets.functions.actor)
    for r in horizons:
        assert r.begins[1:].any() and r.sight.shape == (T, E, 21 * 11)
        obs = ppo.normalize(train.statistics.obs, r.obs)
        _, out = act(train.params.actor, r.carry, obs, r.begins, r.sight)
        np.testing.assert_allclose(out.mean, r.mean, atol=1e-6)
        # 100 times as high, since they hardly count at the start of a training
        _, steep = act(train.params.actor, r.carry, obs, r.begins, 100.0 * r.sight)
        assert np.abs(steep.mean - r.mean).max() > 1e-5


def test_frames_come_at_20_hz_and_each_is_stored_once(seeing):
    world, _, _, robots, horizons = seeing
    steps = np.concatenate([np.asarray(r.sight.held[:, 0]) for r in horizons])
    # 12 steps are 0.24 s; with 20 frames a second a step in 2.5 brings one: after steps 3, 5, 8, 10
    fresh = [n for n in range(1, 2 * T) if n != T and steps[n] != steps[n - 1]]
    period = world.config.physics.control_period
    due = [n for n in range(2 * T) if bool(depth.is_due(jnp.int32(n), config.Camera(), period))]
    assert fresh == [n for n in due if n not in (0, T)]
    assert {b - a for a, b in itertools.pairwise(due)} == {2, 3}
    for r in horizons:
        assert r.sight.held.max() < len(r.sight.frames)
    # the frame at hand at the end of a horizon is the first of the next
    np.testing.assert_array_equal(horizons[1].sight.frames[0], robots[1].feed.frame)


def test_a_frame_shows_the_robot_one_control_step_before(seeing):
    world, _, _, (before, _, _), _ = seeing
    state = before
    period = world.config.physics.control_period
    advance = jax.jit(rollout.env_step)
    expose = jax.jit(jax.vmap(environment.depth_image, in_axes=(None, 0)))
    came = 0
    for _ in range(8):
        action = jnp.zeros((E, state.env.action.shape[-1]))
        after, _ = advance(world, state, state.memory, action)
        assert bool(after.feed.fresh) == bool(
            depth.is_due(after.feed.clock, config.Camera(), period)
        )
        images = lambda robots: robots.feed.images(world.config.network)
        shown = expose(world, state.env) if after.feed.fresh else images(state)
        np.testing.assert_allclose(images(after), shown, atol=3e-4)  # half a unit of 16 bits
        came += int(after.feed.fresh)
        state = after
    assert came == 3


def test_a_new_episode_has_seen_nothing_until_its_first_frame(seeing):
    _, _, _, _, (first, _) = seeing
    seen, begins = np.asarray(first.sight.seen), np.asarray(first.begins)
    held = np.asarray(first.sight.held[:, 0])
    assert not seen[begins].any()
    for t in range(1, T):
        fresh = held[t] != held[t - 1]
        expected = (seen[t - 1] | fresh) & ~begins[t]
        np.testing.assert_array_equal(seen[t], expected)


def test_what_is_kept_between_horizons_has_no_features_in_it(seeing):
    _, _, _, (_, middle, _), _ = seeing
    assert not any(np.any(x) for x in jax.tree.leaves(middle.memory.features))


def test_a_blind_policy_has_no_camera():
    _, _, _, (before, after, _), (first, _) = two_horizons("blind")
    assert before.feed is None and after.feed is None and first.sight is None
    assert before.memory.features is None


def test_sixteen_bits_are_enough_for_a_frame():
    metres = np.linspace(0.0, 3.0, 10_001)
    stored = np.float16(metres / 3.0 - 0.5).astype(np.float64)
    assert np.abs((stored + 0.5) * 3.0 - metres).max() < 4e-4


def test_changing_one_robot_changes_no_other(seeing):
    _, nets, train, (before, _, _), _ = seeing
    act = jax.jit(lambda r: rollout.apply_policy(nets, train, r)[1].mean)
    moved = before.replace(
        observation=jax.tree.map(lambda x: x.at[0].add(1.0), before.observation),
        feed=dataclasses.replace(
            before.feed,
            frame=before.feed.frame.at[0].set(0.1),
            seen=jnp.ones(E, bool),
            fresh=jnp.ones((), bool),
        ),
    )
    same = moved.replace(observation=before.observation)
    assert np.abs(act(moved) - act(same))[0, 0].max() > 0
    np.testing.assert_array_equal(act(moved)[0, 1:], act(same)[0, 1:])
