"""Advantages and returns of a rollout (Schulman et al. 2016)."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Shaped

from cref_jax import config
from cref_jax.ppo import normalization
from cref_jax.ppo.records import Batch, Rollout, Statistics
from cref_jax.ppo.reductions import mean_over_devices, mean_valid


def prepare_batch(
    statistics: Statistics, rollout: Rollout, c: config.PPO, axis: str | None = None
) -> Batch:
    """Normalise the observations of a rollout and compute advantages and returns.

    An invalid step has advantage 0 and propagates none: the steps before it are treated as if the
    horizon had ended there.
    """
    clean = zero_invalid(rollout)
    advantage = gae(
        clean.reward,
        clean.value,
        clean.next_value,
        clean.terminated | ~clean.valid,
        clean.truncated,
        c.gamma,
        c.lam,
    )
    mean = lambda x: mean_over_devices(mean_valid(x, clean.valid, axis), axis)
    centred = advantage - mean(advantage)
    deviation = jnp.sqrt(mean(jnp.square(centred)))
    return Batch(
        obs=normalization.normalize(statistics.obs, clean.obs),
        critic_obs=normalization.normalize(statistics.critic_obs, clean.critic_obs),
        velocity=clean.velocity,
        action=clean.action,
        mean=clean.mean,
        log_std=clean.log_std,
        value=clean.value,
        advantage=centred / (deviation + 1e-8),
        returns=advantage + clean.value,
        begins=clean.begins,
        valid=clean.valid,
        carry=clean.carry,
        sight=clean.sight,
        twin=clean.twin,
        target=clean.target,
    )


def gae(
    reward: Float[Array, "T E"],
    value: Float[Array, "T E"],
    next_value: Float[Array, "T E"],
    terminated: Bool[Array, "T E"],
    truncated: Bool[Array, "T E"],
    gamma: float,
    lam: float,
) -> Float[Array, "T E"]:
    """Compute generalised advantage estimates (Schulman et al. 2016).

        d_t = r_t + gamma V(s'_t) [not terminated] - V(s_t)
        A_t = d_t + gamma lam A_{t+1} [neither terminated nor truncated]

    s'_t is the state after step t, before any reset. Nothing follows a fall, while an episode that
    was truncated is bootstrapped with the critic's value of its last state.
    """
    delta = reward + gamma * jnp.where(terminated, 0.0, next_value) - value
    decay = jnp.where(terminated | truncated, 0.0, gamma * lam)

    def backwards(
        later: Float[Array, " E"], step: tuple[Float[Array, " E"], Float[Array, " E"]]
    ) -> tuple[Float[Array, " E"], Float[Array, " E"]]:
        delta, decay = step
        advantage = delta + decay * later
        return advantage, advantage

    _, advantage = jax.lax.scan(backwards, jnp.zeros_like(delta[0]), (delta, decay), reverse=True)
    return advantage


def zero_invalid(rollout: Rollout) -> Rollout:
    """Replace the values of invalid samples with zeros."""

    def keep(x: Shaped[Array, "T E *n"]) -> Shaped[Array, "T E *n"]:
        valid = rollout.valid.reshape(rollout.valid.shape + (1,) * (x.ndim - 2))
        return jnp.where(valid, x, jnp.zeros_like(x))

    untouched = {name: getattr(rollout, name) for name in ("carry", "sight", "twin", "guide")}
    clean = jax.tree.map(keep, rollout._replace(carry=(), sight=(), twin=(), guide=()))
    return clean._replace(begins=rollout.begins, **untouched)
