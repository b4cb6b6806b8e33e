"""brax trains the environment, and sees what `env.step` gives."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers import training
from brax.training.agents.ppo import networks, train

from cref_jax import config
from cref_jax.env import environment
from cref_jax.env.brax_env import BraxEnv, mend_brax, wrap

C = config.override(
    config.Config(),
    {
        "terrain": {"name": "gap", "levels": 3, "lane_width": 1.0},
        "episode": {"bank_size": 4, "length": 0.2},  # s: ten control steps
    },
)
ROBOTS = 4
OBSERVED = {"state": 45, "privileged_state": 45 + 3 + 64 + 153}


@pytest.fixture(scope="module")
def robots() -> BraxEnv:
    return BraxEnv(C, engine="mujoco", threads=2)


@pytest.fixture(scope="module")
def wrapped(robots):
    """Return reset and step of four robots."""
    four = wrap(robots, episode_length=10)
    return jax.jit(four.reset), jax.jit(four.step)


def keys():
    return jax.random.split(jax.random.PRNGKey(0), ROBOTS)  # the old kind of key, as brax has them


def test_it_tells_its_sizes(robots):
    assert robots.observation_size == {name: (size,) for name, size in OBSERVED.items()}
    assert robots.action_size == 12 and robots.episode_length == 10
    assert robots.backend == "mujoco" and robots.unwrapped is robots


def test_a_robot_starts_at_one_of_the_levels_of_the_start(robots):
    state = jax.vmap(robots.reset)(jax.random.split(jax.random.PRNGKey(1), 64))
    assert sorted(set(np.asarray(state.pipeline_state.level).tolist())) == [0, 1, 2]
    assert not state.done.any() and not state.reward.any()


def test_brax_sees_what_the_environment_gives(robots, wrapped):
    reset, step = wrapped
    ours = jax.jit(jax.vmap(partial(environment.step, robots.world)))
    state = reset(keys())
    inner, total = state.pipeline_state, np.zeros(ROBOTS)
    for k in range(1, 13):
        action = jnp.sin(k + jnp.arange(ROBOTS * 12.0)).reshape(ROBOTS, 12)
        state, (inner, outcome) = step(state, action), ours(inner, action)
        close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
        close(state.obs["state"], outcome.observation.proprioception)
        close(state.obs["privileged_state"], outcome.observation.privileged)
        close(state.reward, outcome.reward)
        close(state.pipeline_state.body.qpos, inner.body.qpos)
        # nobody falls within 0.2 s; after ten steps the episode is cut and the next one begins
        total = np.where(k == 11, 0.0, total) + np.asarray(outcome.reward)
        np.testing.assert_array_equal(outcome.ending.truncated, k == 10)
        np.testing.assert_array_equal(state.done, float(k == 10))
        np.testing.assert_array_equal(state.info["truncation"], float(k == 10))
        np.testing.assert_array_equal(state.info["steps"], (k - 1) % 10 + 1)
        np.testing.assert_array_equal(state.pipeline_state.step, k % 10)
        close(state.info["episode_metrics"]["sum_reward"], total)


def test_a_failure_is_done_and_not_truncated(wrapped):
    reset, step = wrapped
    state = reset(keys())
    body = state.pipeline_state.body
    fallen = body._replace(qpos=body.qpos.at[1, 3:7].set(jnp.array([0.7, 0.7, 0.0, 0.0])))
    state = state.replace(pipeline_state=state.pipeline_state.replace(body=fallen))
    after = step(state, jnp.zeros((ROBOTS, 12)))
    np.testing.assert_array_equal(after.done, [0.0, 1.0, 0.0, 0.0])
    assert not after.info["truncation"].any()
    np.testing.assert_array_equal(after.pipeline_state.step, [1, 0, 1, 1])


@pytest.mark.slow
def test_under_braxs_own_wrappers_a_robot_goes_back_to_its_first_state(robots):
    theirs = training.wrap(robots, episode_length=3)
    first = jax.jit(theirs.reset)(keys())
    step, state = jax.jit(theirs.step), first
    for k in range(1, 4):
        state = step(state, jnp.zeros((ROBOTS, 12)))
        np.testing.assert_array_equal(state.info["truncation"], float(k == 3))
    np.testing.assert_array_equal(state.obs["state"], first.obs["state"])
    np.testing.assert_array_equal(state.pipeline_state.body.qpos, first.pipeline_state.body.qpos)


def test_what_the_configuration_decides_cannot_be_set_twice(robots):
    with pytest.raises(ValueError, match="episode_length must be 10"):
        wrap(robots, episode_length=1000)
    with pytest.raises(ValueError, match="in the configuration"):
        wrap(robots, episode_length=10, action_repeat=2)


@pytest.mark.slow
def test_braxs_ppo_trains_it(robots):
    mend_brax()
    seen = []
    _, params, _ = train.train(
        robots,
        num_timesteps=80,
        num_envs=ROBOTS,
        episode_length=robots.episode_length,
        wrap_env_fn=wrap,
        unroll_length=10,
        batch_size=2,
        num_minibatches=2,
        num_updates_per_batch=1,
        normalize_observations=True,
        num_evals=2,
        num_eval_envs=ROBOTS,
        network_factory=partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=(16,),
            value_hidden_layer_sizes=(16,),
            value_obs_key="privileged_state",
        ),
        progress_fn=lambda step, metrics: seen.append((step, metrics)),
    )
    assert [step for step, _ in seen] == [0, 80]
    for _, metrics in seen:
        assert metrics["eval/avg_episode_length"] == 10.0
        parts = [value for name, value in metrics.items() if name.startswith("eval/episode_rew")]
        assert np.isfinite(parts).all() and metrics["eval/episode_reward"] > 0.0
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))
