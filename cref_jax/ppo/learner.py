"""Proximal policy optimisation for recurrent policies (Schulman et al. 2017).

Independent of robots. The input is a rollout, one record [T, E, ...], the output a train state.
Time is never split: a minibatch is a subset of environments over the whole horizon, started from
their stored memory. Samples that are not `valid` enter no loss and no statistic.
"""

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cref_jax import config
from cref_jax.ppo import advantages, normalization
from cref_jax.ppo.losses import loss
from cref_jax.ppo.records import Batch, Losses, Networks, Params, Rollout, Statistics, TrainState
from cref_jax.ppo.reductions import mean_over_devices

_RATE_FACTOR = 1.5  # per adaptation of the learning rate; assumed: the usual factor
_KL_BAND = 2.0  # the rate is kept while the KL is within this factor of its target; assumed: usual
_NEVER = 2**31 - 1  # bad gradients in a row before one is applied; the caller decides to stop


def initial_state(params: Params, obs_size: int, critic_obs_size: int, c: config.PPO) -> TrainState:
    """Create the state before the first iteration."""
    empty = normalization.initial_statistics
    return TrainState(
        params=params,
        average=params.actor,
        opt_state=optimizer(c).init(params),
        statistics=Statistics(obs=empty(obs_size), critic_obs=empty(critic_obs_size)),
        iteration=jnp.zeros((), jnp.int32),
    )


def optimizer(c: config.PPO) -> optax.GradientTransformationExtraArgs:
    """Build Adam on clipped gradients, with the learning rate in its state.

    Non-finite gradients are always skipped, and counted in the state as `notfinite_count` (in a
    row) and `total_notfinite`.
    """
    adam = optax.inject_hyperparams(optax.adam)(learning_rate=c.learning_rate)
    chain = optax.chain(optax.clip_by_global_norm(c.max_gradient_norm), adam)
    return optax.apply_if_finite(chain, max_consecutive_errors=_NEVER)


def update(
    state: TrainState,
    rollout: Rollout,
    key: PRNGKeyArray,
    c: config.PPO,
    networks: Networks,
    axis: str | None = None,
) -> tuple[TrainState, Losses]:
    """Learn from one rollout; the losses are [epochs, minibatches].

    The rollout is normalised by the statistics it was collected with; they are updated at the end,
    as is the average of the actor's parameters, whose time constant is a tenth of all iterations so
    far, at most `c.average`. With an `axis`, this is one of several devices, each with its own
    rollout: gradients are averaged, so they learn as one device would from all the rollouts.
    """
    batch = advantages.prepare_batch(state.statistics, rollout, c, axis)
    if networks.mirror is not None:
        mirrored = networks.mirror.obs(advantages.zero_invalid(rollout).obs)
        batch = batch._replace(twin_obs=normalization.normalize(state.statistics.obs, mirrored))

    def on_batch(state: TrainState, batch: Batch) -> tuple[TrainState, Losses]:
        grads, losses = jax.grad(loss, has_aux=True)(state.params, batch, c, networks, axis)
        grads, losses = mean_over_devices((grads, losses), axis)
        return _apply_gradients(state, grads, losses, c)

    def on_epoch(state: TrainState, key: PRNGKeyArray) -> tuple[TrainState, Losses]:
        return jax.lax.scan(on_batch, state, minibatches(batch, key, c.minibatches))

    state, losses = jax.lax.scan(on_epoch, state, jax.random.split(key, c.epochs))
    statistics = Statistics(
        obs=normalization.update_statistics(state.statistics.obs, rollout.obs, rollout.valid, axis),
        critic_obs=normalization.update_statistics(
            state.statistics.critic_obs, rollout.critic_obs, rollout.valid, axis
        ),
    )
    share = average_share(state.iteration, c)
    average = optax.incremental_update(state.params.actor, state.average, share)
    iteration = state.iteration + 1
    return state.replace(average=average, statistics=statistics, iteration=iteration), losses


def average_share(iteration: Int[Array, ""], c: config.PPO) -> Float[Array, ""]:
    """Compute the newest parameters' share of the average."""
    return 1.0 / (1.0 + jnp.minimum(0.1 * iteration, c.average))


def minibatches(batch: Batch, key: PRNGKeyArray, count: int) -> Batch:
    """Split a batch at random by environment into `count` minibatches [count, T, E', ...]."""
    num_envs = batch.value.shape[1]
    if num_envs % count:
        raise ValueError(f"{num_envs} environments do not split into {count} equal minibatches")
    order = jax.random.permutation(key, num_envs).reshape(count, num_envs // count)
    in_time = batch._replace(carry=(), twin=())
    split = jax.tree.map(lambda x: jnp.moveaxis(x[:, order], 1, 0), in_time)
    carry, twin = jax.tree.map(lambda x: x[order], (batch.carry, batch.twin))
    return split._replace(carry=carry, twin=twin)


def adapt_learning_rate(
    rate: Float[Array, ""], kl: Float[Array, ""], c: config.PPO
) -> Float[Array, ""]:
    """Lower the learning rate if the policy moved too far; raise it if it moved too little.

    A KL of 0 (no change yet) or NaN leaves it unchanged.
    """
    low, high = c.learning_rate_range
    slower = kl > _KL_BAND * c.target_kl
    faster = (kl > 0.0) & (kl < c.target_kl / _KL_BAND)
    factor = jnp.where(slower, 1.0 / _RATE_FACTOR, jnp.where(faster, _RATE_FACTOR, 1.0))
    return jnp.clip(rate * factor, low, high)


def _apply_gradients(
    state: TrainState, grads: Params, losses: Losses, c: config.PPO
) -> tuple[TrainState, Losses]:
    """Take one step of the optimiser at the rate adapted to the KL.

    In the first `critic_first` iterations, actor and rate do not change; the actor then starts at
    the lowest rate. The critic has its own, which no KL lowers, if `critic_learning_rate` says so.
    """
    before = optax.tree.get(state.opt_state, "learning_rate")
    rate = adapt_learning_rate(before, losses.kl, c)
    since = state.iteration - c.critic_first
    hold = lambda tree: jax.tree.map(lambda x: jnp.where(since < 0, 0.0, x), tree)
    if c.critic_first:
        rate = jnp.where(since > 0, rate, jnp.where(since < 0, before, c.learning_rate_range[0]))
        grads = grads._replace(actor=hold(grads.actor))
    opt_state = optax.tree.set(state.opt_state, learning_rate=rate)
    changes, opt_state = optimizer(c).update(grads, opt_state, state.params)
    if c.critic_first:  # the optimiser may have come with momentum
        changes = changes._replace(actor=hold(changes.actor))
    if c.critic_learning_rate:  # Adam's step is proportional to its rate
        own = jax.tree.map(lambda x: x * (c.critic_learning_rate / rate), changes.critic)
        changes = changes._replace(critic=own)
    state = state.replace(params=optax.apply_updates(state.params, changes), opt_state=opt_state)
    return state, losses._replace(
        gradient_norm=optax.tree.norm(grads),
        learning_rate=rate,
        skipped=(~opt_state.last_finite).astype(rate.dtype),
    )
