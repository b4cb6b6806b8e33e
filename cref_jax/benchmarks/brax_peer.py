"""brax's PPO on this environment, as a baseline for the learner of this package."""

import functools

import jax
from brax.training.agents.ppo import networks, train

from cref_jax import config
from cref_jax.env.brax_env import BraxEnv, mend_brax, wrap
from cref_jax.system import parallel

ITERATIONS = 4  # in each of two parts; the first includes compilation


def measure_samples_per_second(c: config.Config) -> float:
    """Measure brax's PPO with the same number of robots, horizon, epochs and minibatches.

    Its networks have the hidden layers of our action head and critic but no memory, so that its
    update is lighter. The configuration must be that of a blind policy.
    """
    mend_brax()
    rates: list[float] = []
    robots = BraxEnv(c, threads=max(parallel.cores() // jax.device_count(), 1))  # per device
    train.train(
        robots,
        num_timesteps=2 * ITERATIONS * c.run.num_envs * c.ppo.horizon,
        num_envs=c.run.num_envs,
        episode_length=robots.episode_length,
        wrap_env_fn=wrap,
        unroll_length=c.ppo.horizon,
        batch_size=c.run.num_envs // c.ppo.minibatches,
        num_minibatches=c.ppo.minibatches,
        num_updates_per_batch=c.ppo.epochs,
        normalize_observations=True,
        num_evals=3,
        run_evals=False,
        network_factory=functools.partial(
            networks.make_ppo_networks,
            policy_hidden_layer_sizes=tuple(c.network.actor),
            value_hidden_layer_sizes=tuple(c.network.critic),
            value_obs_key="privileged_state",
        ),
        progress_fn=lambda _, metrics: rates.append(float(metrics.get("training/sps", 0.0))),
    )
    return rates[-1]
