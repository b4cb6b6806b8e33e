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
    """Return the rollout with advantages and returns, normalised.

    An invalid step has the advantage 0 and passes none on: the steps before it are judged as if the
    horizon had ended with them.
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
        obs=normalization.normalise(statistics.obs, clean.obs),
        critic_obs=normalization.normalise(statistics.critic_obs, clean.critic_obs),
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
    """Return the generalised advantage estimates (Schulman et al. 2016).

        d_t = r_t + gamma V(s'_t) [not terminated] - V(s_t)
        A_t = d_t + gamma lam A_{t+1} [neither terminated nor truncated]

    s'_t is the state that step t led to, before any reset. So nothing comes after a fall, while an
    episode that was only cut off is worth what the critic expects of its last state.
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
    """Return the rollout with zeros in place of the numbers of invalid samples."""

    def keep(x: Shaped[Array, "T E *n"]) -> Shaped[Array, "T E *n"]:
        valid = rollout.valid.reshape(rollout.valid.shape + (1,) * (x.ndim - 2))
        return jnp.where(valid, x, jnp.zeros_like(x))

    apart = {name: getattr(rollout, name) for name in ("carry", "sight", "twin")}
    clean = jax.tree.map(keep, rollout._replace(carry=(), sight=(), twin=()))
    return clean._replace(begins=rollout.begins, **apart)
