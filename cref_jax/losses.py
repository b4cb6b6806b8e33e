"""What PPO minimises, from records that know nothing of robots (Schulman et al. 2017).

Samples that are not `valid` count in no loss, whatever they hold.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, Shaped

from cref_jax import config, gaussian, readout
from cref_jax.readout import Readout


class Prediction(Protocol):
    """What an actor says: a Gaussian over actions, and what it takes its velocity for."""

    mean: Float[Array, "T E J"]
    log_std: Float[Array, " J"]
    velocity: Float[Array, "T E V"]
    feature: Float[Array, "T E D"]  # that the mean is read off; only a readout looks at it


# (params, carry, obs [T, E, O], begins [T, E], sight) -> (carry, prediction)
Actor = Callable[[PyTree, PyTree, Array, Array, PyTree], tuple[PyTree, Prediction]]


class Mirror(NamedTuple):
    """A symmetry of the world: what its mirror image senses, sees and does. Each undoes itself."""

    obs: Callable[[Array], Array]  # raw, [..., O]
    frames: Callable[[Array], Array]
    sight: Callable[[PyTree], PyTree]
    action: Callable[[Array], Array]  # [..., J]


class Networks(NamedTuple):
    """The two functions that are trained. They take normalised observations."""

    actor: Actor
    # (params, critic_obs [T, E, S]) -> value [T, E]
    critic: Callable[[PyTree, Array], Array]
    mirror: Mirror | None = None  # the symmetry that the actor is taught, if any


class Params(NamedTuple):
    """What the optimiser changes."""

    actor: PyTree
    critic: PyTree
    readout: Readout | None = None  # of the last M of the critic's observations


class Batch(NamedTuple):
    """What the loss looks at: a rollout normalised, judged and free of invalid numbers."""

    obs: Float[Array, "T E O"]
    critic_obs: Float[Array, "T E S"]
    velocity: Float[Array, "T E V"]
    action: Float[Array, "T E J"]
    mean: Float[Array, "T E J"]
    log_std: Float[Array, "T E J"]
    value: Float[Array, "T E"]
    advantage: Float[Array, "T E"]  # mean 0 and deviation 1 over the valid samples
    returns: Float[Array, "T E"]
    begins: Bool[Array, "T E"]
    valid: Bool[Array, "T E"]
    carry: PyTree[Float[Array, "E ?H"]]
    sight: PyTree[Shaped[Array, "?K E *?n"]] = None
    twin: PyTree[Float[Array, "E ?H"]] = None
    twin_obs: Float[Array, "T E O"] | None = None  # what it senses


class Losses(NamedTuple):
    """Unweighted parts of the loss of one minibatch, and how the step went."""

    surrogate: Float[Array, "*n"]
    value: Float[Array, "*n"]
    velocity: Float[Array, "*n"]  # m^2/s^2
    readout: Float[Array, "*n"]  # in variances of what is read out
    asymmetry: Float[Array, "*n"]  # of the mean action, squared
    entropy: Float[Array, "*n"]  # nats
    kl: Float[Array, "*n"]  # nats, of the behaviour policy from the present one
    clipped: Float[Array, "*n"]  # share of samples whose ratio is outside the clip range
    gradient_norm: Float[Array, "*n"] | float = 0.0  # before clipping
    learning_rate: Float[Array, "*n"] | float = 0.0
    skipped: Float[Array, "*n"] | float = 0.0  # 1 where the gradient was not finite


def loss(
    params: Params, batch: Batch, c: config.PPO, networks: Networks, axis: str | None = None
) -> tuple[Float[Array, ""], Losses]:
    """Return the weighted loss of a minibatch, and its parts; `axis` is as in `mean_valid`."""
    mean = lambda x: mean_valid(x, batch.valid, axis)
    _, policy = networks.actor(params.actor, batch.carry, batch.obs, batch.begins, batch.sight)
    value = networks.critic(params.critic, batch.critic_obs)
    new = gaussian.log_prob(batch.action, policy.mean, policy.log_std)
    old = gaussian.log_prob(batch.action, batch.mean, batch.log_std)
    ratio = jnp.exp(jnp.where(batch.valid, new - old, 0.0))
    divergence = gaussian.kl(batch.mean, batch.log_std, policy.mean, policy.log_std)
    error = jnp.sum(jnp.square(policy.velocity - batch.velocity), axis=-1)
    misread = jnp.zeros_like(value)
    if params.readout is not None:
        misread = readout.error(params.readout, policy.feature, batch.critic_obs)
    askew = jnp.zeros_like(value)
    if networks.mirror is not None:
        askew = asymmetry(params.actor, batch, policy.mean, networks.actor, networks.mirror)
    parts = Losses(
        surrogate=mean(surrogate(ratio, batch.advantage, c.clip)),
        value=mean(value_error(value, batch.value, batch.returns, c.value_clip)),
        velocity=mean(error),
        readout=mean(misread),
        asymmetry=mean(askew),
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
        - c.entropy_weight * parts.entropy
    )
    return total, jax.lax.stop_gradient(parts)


def asymmetry(
    params: PyTree, batch: Batch, mean: Float[Array, "T E J"], actor: Actor, mirror: Mirror
) -> Float[Array, "T E"]:
    """Return the mean over joints of (mu(o) - M mu(M o))^2, M the mirror (Yu et al. 2018, Eq. 4).

    The actor in the mirror remembers what it has seen there: a memory cannot be mirrored.
    """
    seen = mirror.sight(batch.sight)
    _, twin = actor(params, batch.twin, batch.twin_obs, batch.begins, seen)
    return jnp.mean(jnp.square(mean - mirror.action(twin.mean)), axis=-1)


def surrogate(
    ratio: Float[Array, "T E"], advantage: Float[Array, "T E"], clip: float
) -> Float[Array, "T E"]:
    """Return -min(r A, clip(r, 1 - clip, 1 + clip) A), the pessimistic policy loss."""
    return -jnp.minimum(ratio * advantage, jnp.clip(ratio, 1.0 - clip, 1.0 + clip) * advantage)


def value_error(
    value: Float[Array, "T E"],
    old: Float[Array, "T E"],
    returns: Float[Array, "T E"],
    clip: float,
) -> Float[Array, "T E"]:
    """Return the squared error of V, or of V held within `clip` of the old one if that is worse."""
    held = old + jnp.clip(value - old, -clip, clip)
    return jnp.maximum(jnp.square(value - returns), jnp.square(held - returns))


def mean_valid(
    x: Float[Array, "T E"], valid: Bool[Array, "T E"], axis: str | None = None
) -> Float[Array, ""]:
    """Return the mean over the valid samples, 0 if there are none.

    With an `axis`, what `agreed` makes the mean over the samples of all devices.
    """
    count = agreed(jnp.sum(valid).astype(x.dtype), axis)
    return jnp.sum(jnp.where(valid, x, 0.0)) / jnp.where(count > 0.0, count, 1.0)


def agreed(x: PyTree, axis: str | None) -> PyTree:
    """Return the mean over the devices."""
    return x if axis is None else jax.lax.pmean(x, axis)
