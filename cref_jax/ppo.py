"""Proximal policy optimisation for recurrent policies (Schulman et al. 2017).

Knows nothing of robots. A rollout goes in as one record [T, E, ...], a train state comes out. Time
is never split: a minibatch is some environments over the whole horizon, from their stored memory.
Samples that are not `valid` count in no loss and in no statistic, whatever they hold.
"""

import contextlib
import io
from typing import NamedTuple, no_type_check

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, Shaped

from cref_jax import config
from cref_jax.losses import Batch, Losses, Networks, Params, agreed, loss, mean_valid

with contextlib.redirect_stdout(io.StringIO()):  # brax loads MJX, which says that warp is missing
    from brax.training.acme import running_statistics
    from brax.training.acme.running_statistics import RunningStatisticsState

OBSERVATION_CLIP = 10.0  # standard deviations; assumed: what lies beyond says nothing more
_VARIANCE_FLOOR = 1e-4  # added to each input's variance; assumed: a constant input stays near 0
_RATE_FACTOR = 1.5  # one adaptation of the learning rate; assumed: the usual factor
_KL_BAND = 2.0  # the rate rests while the KL is within this factor of its target; assumed: usual
_NEVER = 2**31 - 1  # bad gradients in a row before one is applied: when to stop is the caller's


class Statistics(NamedTuple):
    """Running mean and deviation of what each network sees."""

    obs: RunningStatisticsState
    critic_obs: RunningStatisticsState


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@struct.dataclass
class TrainState:
    """Everything that learning carries from one iteration to the next."""

    params: Params
    average: PyTree  # of the actor's parameters, over the last iterations: steadier than they are
    opt_state: optax.OptState  # holds the learning rate and the count of bad gradients, too
    statistics: Statistics
    iteration: Int[Array | jax.ShapeDtypeStruct, "*seeds"]  # or its shape alone, in eval_shape


class Rollout(NamedTuple):
    """T steps of E environments under one policy. Observations are raw."""

    obs: Float[Array, "T E O"]
    critic_obs: Float[Array, "T E S"]
    velocity: Float[Array, "T E V"]  # what the estimator should have said
    action: Float[Array, "T E J"]
    mean: Float[Array, "T E J"]  # of the distribution that the action came from
    log_std: Float[Array, "T E J"]  # of the distribution that the action came from
    reward: Float[Array, "T E"]
    value: Float[Array, "T E"]  # V of the state that the action was taken in
    next_value: Float[Array, "T E"]  # V of the state that the step led to, before any reset
    terminated: Bool[Array, "T E"]  # the episode ended in this step, and nothing follows
    truncated: Bool[Array, "T E"]  # the episode was cut off after this step
    begins: Bool[Array, "T E"]  # this step is the first of an episode: memory is empty before it
    valid: Bool[Array, "T E"]  # False where the simulation failed; the next step must begin anew
    carry: PyTree[Float[Array, "E ?H"]]  # the actor's memory before the first step
    sight: PyTree[Shaped[Array, "?K E *?n"]] = None  # what the actor looks at besides, as it is
    twin: PyTree[Float[Array, "E ?H"]] = None  # the memory of an actor that lives in the mirror


def initial_state(params: Params, obs_size: int, critic_obs_size: int, c: config.PPO) -> TrainState:
    """Return the state before the first iteration."""
    floor = jnp.full((), _VARIANCE_FLOOR, jnp.float32)
    empty = lambda n: running_statistics.init_state(jnp.zeros(n), std_eps=floor)
    return TrainState(
        params=params,
        average=params.actor,
        opt_state=optimiser(c).init(params),
        statistics=Statistics(obs=empty(obs_size), critic_obs=empty(critic_obs_size)),
        iteration=jnp.zeros((), jnp.int32),
    )


def optimiser(c: config.PPO) -> optax.GradientTransformationExtraArgs:
    """Return Adam on clipped gradients, its rate a part of its state.

    A gradient that is not finite is skipped, however many come in a row, and counted in the state
    as `notfinite_count` (in a row) and `total_notfinite`.
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

    The rollout is normalised by the statistics that it was made with. They learn of it at the end,
    and so does the average: it fades over a tenth of all iterations, over `c.average` at most.
    With an `axis` this is one of several devices, each with a rollout of its own: they agree on
    every gradient, and learn as one device would from all the rollouts.
    """
    batch = judge(state.statistics, rollout, c, axis)
    if networks.mirror is not None:
        mirrored = networks.mirror.obs(_zero_invalid(rollout).obs)
        batch = batch._replace(twin_obs=normalise(state.statistics.obs, mirrored))

    def on_batch(state: TrainState, batch: Batch) -> tuple[TrainState, Losses]:
        grads, losses = jax.grad(loss, has_aux=True)(state.params, batch, c, networks, axis)
        grads, losses = agreed((grads, losses), axis)
        return _descend(state, grads, losses, c)

    def on_epoch(state: TrainState, key: PRNGKeyArray) -> tuple[TrainState, Losses]:
        return jax.lax.scan(on_batch, state, minibatches(batch, key, c.minibatches))

    state, losses = jax.lax.scan(on_epoch, state, jax.random.split(key, c.epochs))
    statistics = Statistics(
        obs=observe(state.statistics.obs, rollout.obs, rollout.valid, axis),
        critic_obs=observe(state.statistics.critic_obs, rollout.critic_obs, rollout.valid, axis),
    )
    share = 1.0 / (1.0 + jnp.minimum(0.1 * state.iteration, c.average))
    average = optax.incremental_update(state.params.actor, state.average, share)
    iteration = state.iteration + 1
    return state.replace(average=average, statistics=statistics, iteration=iteration), losses


def judge(
    statistics: Statistics, rollout: Rollout, c: config.PPO, axis: str | None = None
) -> Batch:
    """Return the rollout with advantages and returns, normalised.

    An invalid step has the advantage 0 and passes none on: the steps before it are judged as if the
    horizon had ended with them.
    """
    clean = _zero_invalid(rollout)
    advantage = gae(
        clean.reward,
        clean.value,
        clean.next_value,
        clean.terminated | ~clean.valid,
        clean.truncated,
        c.gamma,
        c.lam,
    )
    mean = lambda x: agreed(mean_valid(x, clean.valid, axis), axis)
    centred = advantage - mean(advantage)
    deviation = jnp.sqrt(mean(jnp.square(centred)))
    return Batch(
        obs=normalise(statistics.obs, clean.obs),
        critic_obs=normalise(statistics.critic_obs, clean.critic_obs),
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


def minibatches(batch: Batch, key: PRNGKeyArray, count: int) -> Batch:
    """Return `count` random parts, each some environments over all time: [count, T, E', ...]."""
    num_envs = batch.value.shape[1]
    if num_envs % count:
        raise ValueError(f"{num_envs} environments do not split into {count} equal minibatches")
    order = jax.random.permutation(key, num_envs).reshape(count, num_envs // count)
    in_time = batch._replace(carry=(), twin=())
    split = jax.tree.map(lambda x: jnp.moveaxis(x[:, order], 1, 0), in_time)
    carry, twin = jax.tree.map(lambda x: x[order], (batch.carry, batch.twin))
    return split._replace(carry=carry, twin=twin)


def adapt(rate: Float[Array, ""], kl: Float[Array, ""], c: config.PPO) -> Float[Array, ""]:
    """Return the learning rate, lower if the policy moved too far and higher if not far enough.

    A KL of 0 (nothing has moved yet) or NaN leaves it as it is.
    """
    low, high = c.learning_rate_range
    slower = kl > _KL_BAND * c.target_kl
    faster = (kl > 0.0) & (kl < c.target_kl / _KL_BAND)
    factor = jnp.where(slower, 1.0 / _RATE_FACTOR, jnp.where(faster, _RATE_FACTOR, 1.0))
    return jnp.clip(rate * factor, low, high)


def normalise(statistics: RunningStatisticsState, x: Float[Array, "*n O"]) -> Float[Array, "*n O"]:
    """Return (x - mean) / std, within +-OBSERVATION_CLIP."""
    return running_statistics.normalize(x, statistics, max_abs_value=OBSERVATION_CLIP)


def observe(
    statistics: RunningStatisticsState,
    x: Float[Array, "T E O"],
    valid: Bool[Array, "T E"],
    axis: str | None = None,
) -> RunningStatisticsState:
    """Return the statistics with the valid samples, of all devices, counted in."""
    clean, weights = jnp.where(valid[..., None], x, 0.0), valid.astype(x.dtype)
    after = running_statistics.update(statistics, clean, weights=weights, pmap_axis_name=axis)
    some = agreed(weights.mean(), axis) > 0.0
    return jax.tree.map(lambda new, old: jnp.where(some, new, old), after, statistics)


def _descend(
    state: TrainState, grads: Params, losses: Losses, c: config.PPO
) -> tuple[TrainState, Losses]:
    """Take one step of the optimiser at the rate that the KL asks for.

    In the first `critic_first` iterations actor and rate stay; the actor begins at the lowest rate.
    """
    before = optax.tree.get(state.opt_state, "learning_rate")
    rate = adapt(before, losses.kl, c)
    if c.critic_first:
        since = state.iteration - c.critic_first
        still = jax.tree.map(lambda g: jnp.where(since < 0, 0.0, g), grads.actor)
        rate = jnp.where(since > 0, rate, jnp.where(since < 0, before, c.learning_rate_range[0]))
        grads = grads._replace(actor=still)
    opt_state = optax.tree.set(state.opt_state, learning_rate=rate)
    changes, opt_state = optimiser(c).update(grads, opt_state, state.params)
    state = state.replace(params=optax.apply_updates(state.params, changes), opt_state=opt_state)
    return state, losses._replace(
        gradient_norm=optax.tree.norm(grads),
        learning_rate=rate,
        skipped=(~opt_state.last_finite).astype(rate.dtype),
    )


def _zero_invalid(rollout: Rollout) -> Rollout:
    """Return the rollout with zeros in place of the numbers of invalid samples."""

    def keep(x: Shaped[Array, "T E *n"]) -> Shaped[Array, "T E *n"]:
        valid = rollout.valid.reshape(rollout.valid.shape + (1,) * (x.ndim - 2))
        return jnp.where(valid, x, jnp.zeros_like(x))

    apart = {name: getattr(rollout, name) for name in ("carry", "sight", "twin")}
    clean = jax.tree.map(keep, rollout._replace(carry=(), sight=(), twin=()))
    return clean._replace(begins=rollout.begins, **apart)
