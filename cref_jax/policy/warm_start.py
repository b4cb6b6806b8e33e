"""Start of a new training from a trained policy."""

import jax.numpy as jnp

from cref_jax import ppo
from cref_jax.policy.trained import TrainedPolicy


def start_from_policy(fresh: ppo.TrainState, policy: TrainedPolicy) -> ppo.TrainState:
    """Start a new training from the policy's actor and observation statistics."""
    trained, obs = policy.train.statistics.obs, fresh.statistics.obs
    variance = jnp.maximum(jnp.square(trained.std) - obs.std_eps, 0.0)
    statistics = obs.replace(
        mean=trained.mean,
        std=trained.std,
        summed_variance=float(policy.samples) * variance,  # int32 holds too few
        count=obs.count + policy.samples,
    )
    return fresh.replace(
        params=fresh.params._replace(actor=policy.train.params.actor),
        statistics=fresh.statistics._replace(obs=statistics),
    )
