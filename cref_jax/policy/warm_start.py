"""A new training that begins as a trained policy."""

import jax.numpy as jnp

from cref_jax import ppo
from cref_jax.policy.trained import TrainedPolicy


def begin_as(fresh: ppo.TrainState, policy: TrainedPolicy) -> ppo.TrainState:
    """Return the state of a new training whose actor begins as this policy's."""
    seen = policy.train.statistics.obs
    statistics = fresh.statistics.obs.replace(
        mean=seen.mean,
        std=seen.std,
        summed_variance=policy.samples * jnp.square(seen.std),
        count=fresh.statistics.obs.count + policy.samples,
    )
    return fresh.replace(
        params=fresh.params._replace(actor=policy.train.params.actor),
        statistics=fresh.statistics._replace(obs=statistics),
    )
