"""Losses of PPO, independent of robots (Schulman et al. 2017).

Samples that are not `valid` enter no loss.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from cref_jax import config
from cref_jax.ppo import auxiliary, gaussian, reductions
from cref_jax.ppo.records import Actor, Batch, Losses, Mirror, Networks, Params


def loss(
    params: Params, batch: Batch, c: config.PPO, networks: Networks, axis: str | None = None
) -> tuple[Float[Array, ""], Losses]:
    """Compute the weighted loss of a minibatch and its parts; `axis` as in `mean_valid`."""
    mean = lambda x: reductions.mean_valid(x, batch.valid, axis)
    _, policy = networks.actor(params.actor, batch.carry, batch.obs, batch.begins, batch.sight)
    value = networks.critic(params.critic, batch.critic_obs)
    new = gaussian.log_prob(batch.action, policy.mean, policy.log_std)
    old = gaussian.log_prob(batch.action, batch.mean, batch.log_std)
    ratio = jnp.exp(jnp.where(batch.valid, new - old, 0.0))
    divergence = gaussian.kl(batch.mean, batch.log_std, policy.mean, policy.log_std)
    error = jnp.sum(jnp.square(policy.velocity - batch.velocity), axis=-1)
    misread = jnp.zeros_like(value)
    if params.readout is not None:
        misread = auxiliary.readout_error(params.readout, policy.feature, batch.critic_obs)
    askew = jnp.zeros_like(value)
    if networks.mirror is not None:
        askew = asymmetry_error(params.actor, batch, policy.mean, networks.actor, networks.mirror)
    apart = jnp.zeros_like(value)
    if batch.target is not None:
        own, fixed = jax.lax.stop_gradient((policy.mean, policy.log_std))
        # who has no teacher is where it should be; to explore more is not to imitate better
        target = jnp.where(jnp.isnan(batch.target), own, batch.target)
        apart = gaussian.kl_of_means(target, policy.mean, fixed)
    parts = Losses(
        surrogate=mean(surrogate_loss(ratio, batch.advantage, c.clip)),
        value=mean(value_error(value, batch.value, batch.returns, c.value_clip)),
        velocity=mean(error),
        readout=mean(misread),
        asymmetry=mean(askew),
        teacher_kl=mean(apart),
        entropy=gaussian.entropy(policy.log_std),
        kl=mean(divergence),
        clipped=mean((jnp.abs(ratio - 1.0) > c.clip).astype(ratio.dtype)),
    )
    total = (
        parts.surrogate
        + c.value_weight * parts.value
        + c.estimator_weight * parts.velocity
        + c.readout_weight * parts.readout
        + c.mirror_weight * parts.asymmetry
        + c.imitation_weight * parts.teacher_kl
        - c.entropy_weight * parts.entropy
    )
    return total, jax.lax.stop_gradient(parts)


def asymmetry_error(
    params: PyTree, batch: Batch, mean: Float[Array, "T E J"], actor: Actor, mirror: Mirror
) -> Float[Array, "T E"]:
    """Compute the mean over joints of (mu(o) - M mu(M o))^2, M the mirror (Yu et al. 2018, Eq. 4).

    The mirrored actor has its own memory of mirrored inputs: a memory cannot be mirrored.
    """
    sight = mirror.sight(batch.sight)
    _, twin = actor(params, batch.twin, batch.twin_obs, batch.begins, sight)
    return jnp.mean(jnp.square(mean - mirror.action(twin.mean)), axis=-1)


def surrogate_loss(
    ratio: Float[Array, "T E"], advantage: Float[Array, "T E"], clip: float
) -> Float[Array, "T E"]:
    """Compute -min(r A, clip(r, 1 - clip, 1 + clip) A), the pessimistic policy loss."""
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def value_error(
    value: Float[Array, "T E"],
    old: Float[Array, "T E"],
    returns: Float[Array, "T E"],
    clip: float,
) -> Float[Array, "T E"]:
    """Compute the squared error of V, or of V clipped to within `clip` of the old one if larger."""
    clipped = old + jnp.clip(value - old, -clip, clip)
    return jnp.maximum(jnp.square(value - returns), jnp.square(clipped - returns))
