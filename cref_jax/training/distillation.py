"""Distillation of a privileged teacher into a student with a camera (arXiv 2406.10759).

DAgger (Ross et al. 2011): the student acts, the teacher says what it would do in the states that
are visited, and the student learns it by backpropagation through the horizon.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, PyTree, Shaped

from cref_jax import config, network, ppo
from cref_jax.env.world import World
from cref_jax.ppo import reductions
from cref_jax.training import rollout

_TEACHER_SHARE = 0.9  # of all iterations; assumed: imitation needs fewer samples than PPO


class Lesson(NamedTuple):
    """What the student has seen over a horizon, and what its teacher would have done."""

    obs: Float[Array, "T E O"]  # normalised
    begins: Bool[Array, "T E"]
    valid: Bool[Array, "T E"]
    sight: PyTree[Shaped[Array, "?K E *?n"]]
    target: Float[Array, "T E J"]  # the teacher's mean action
    carry: PyTree[Float[Array, "E ?H"]]  # the student's memory before the first step


class Losses(NamedTuple):
    """The loss of one minibatch, and diagnostics of the step."""

    imitation: Float[Array, "*n"]  # of the mean actions, summed over joints
    gradient_norm: Float[Array, "*n"]  # before clipping
    learning_rate: Float[Array, "*n"]
    skipped: Float[Array, "*n"]  # 1 where the gradient was not finite


def fill_in(c: config.Config) -> config.Config:
    """Fill in how many iterations are the teacher's."""
    if c.network.variant != "hpl" or c.distillation.teacher_iterations:
        return c
    count = max(round(_TEACHER_SHARE * c.run.iterations), 1)
    stages = dataclasses.replace(c.distillation, teacher_iterations=count)
    return dataclasses.replace(c, distillation=stages)


def teacher_config(c: config.Config) -> config.Config:
    """Return the settings of the first stage of a run."""
    last = fill_in(c).distillation.teacher_iterations
    return dataclasses.replace(
        c,
        network=dataclasses.replace(c.network, variant="hpl_teacher"),
        run=dataclasses.replace(c.run, iterations=last),
    )


def samples_by_stage(c: config.Config, iteration: int) -> dict[str, int]:
    """Count the control steps of experience of each stage; of a run of one stage, none."""
    if c.network.variant != "hpl":
        return {}
    of_teacher = min(iteration, teacher_config(c).run.iterations)
    each = c.run.num_envs * c.ppo.horizon
    return {"teacher": of_teacher * each, "student": (iteration - of_teacher) * each}


def initial_teacher(
    c: config.Config, num_actions: int, robots: rollout.Robots, key: PRNGKeyArray
) -> PyTree:
    """Initialise the parameters of an untrained teacher."""
    blind = robots.replace(feed=None)
    return rollout.initial_params(teacher_config(c), num_actions, blind, key).actor


def with_teacher(train: ppo.TrainState, teacher: PyTree, c: config.Config) -> ppo.TrainState:
    """Give a student its teacher, and begin with the teacher's GRU, action head and deviations."""
    shared = {name: part for name, part in teacher["params"].items() if name != "height_encoder"}
    actor = {"params": {**train.params.actor["params"], **shared}}
    return train.replace(
        params=train.params._replace(actor=actor),
        average=actor,
        opt_state=_optimizer(c).init(actor),
        teacher=teacher,
    )


def learn(
    world: World,
    nets: rollout.Modules,
    train: ppo.TrainState,
    robots: rollout.Robots,
    keys: rollout.Keys,
    axis: str | None = None,
) -> tuple[ppo.TrainState, rollout.Robots, Losses, rollout.Trace]:
    """Let the student act for a horizon, and teach it what its teacher would have done.

    It acts by its mean (assumed: as it is evaluated).
    """
    c, taught = world.config, robots.memory.teacher
    robots, seen, trace = rollout.collect(world, nets, train, robots, keys.robots, explores=False)
    obs = ppo.normalize(train.statistics.obs, ppo.zero_invalid(seen).obs)
    teacher = network.build_actor(teacher_config(c).network, seen.action.shape[-1])
    taught, output = teacher.apply(train.teacher, taught, obs, seen.begins, seen.guide)
    lesson = Lesson(obs, seen.begins, seen.valid, seen.sight, output.mean, seen.carry)
    train, losses = update(train, lesson, keys.update, c, nets.functions.actor, axis)
    robots = robots.replace(memory=robots.memory._replace(teacher=taught))
    return train, robots, losses, trace


def update(
    train: ppo.TrainState,
    lesson: Lesson,
    key: PRNGKeyArray,
    c: config.Config,
    actor: ppo.Actor,
    axis: str | None = None,
) -> tuple[ppo.TrainState, Losses]:
    """Learn from one lesson; the losses are [epochs, minibatches].

    Statistics of observations stay the teacher's. Epochs, minibatches and the average of parameters
    are PPO's, the latter counted from the first lesson (assumed).
    """

    def on_batch(train: ppo.TrainState, part: Lesson) -> tuple[ppo.TrainState, Losses]:
        error, grads = jax.value_and_grad(loss)(train.params.actor, part, actor, axis)
        error, grads = reductions.mean_over_devices((error, grads), axis)
        changes, state = _optimizer(c).update(grads, train.opt_state, train.params.actor)
        params = train.params._replace(actor=optax.apply_updates(train.params.actor, changes))
        rate = optax.tree.get(state, "learning_rate")
        skipped = (~state.last_finite).astype(rate.dtype)
        losses = Losses(error, optax.tree.norm(grads), rate, skipped)
        return train.replace(params=params, opt_state=state), losses

    def on_epoch(train: ppo.TrainState, key: Array) -> tuple[ppo.TrainState, Losses]:
        return jax.lax.scan(on_batch, train, _minibatches(lesson, key, c.ppo.minibatches))

    train, losses = jax.lax.scan(on_epoch, train, jax.random.split(key, c.ppo.epochs))
    since = train.iteration - teacher_config(c).run.iterations
    average = optax.incremental_update(
        train.params.actor, train.average, ppo.average_share(since, c.ppo)
    )
    return train.replace(average=average, iteration=train.iteration + 1), losses


def loss(
    params: PyTree, lesson: Lesson, actor: ppo.Actor, axis: str | None = None
) -> Float[Array, ""]:
    """Compute the mean of sum_j |mu_j - mu*_j| over the valid samples; `axis` as in mean_valid."""
    _, student = actor(params, lesson.carry, lesson.obs, lesson.begins, lesson.sight)
    error = jnp.abs(student.mean - lesson.target).sum(axis=-1)
    return reductions.mean_valid(error, lesson.valid, axis)


def _optimizer(c: config.Config) -> optax.GradientTransformationExtraArgs:
    rate = c.distillation.learning_rate
    return ppo.optimizer(dataclasses.replace(c.ppo, learning_rate=rate))


def _minibatches(lesson: Lesson, key: PRNGKeyArray, count: int) -> Lesson:
    """Split a lesson at random by environment, as ppo.minibatches does."""
    order = jax.random.permutation(key, lesson.valid.shape[1]).reshape(count, -1)
    in_time = jax.tree.map(lambda x: jnp.moveaxis(x[:, order], 1, 0), lesson._replace(carry=()))
    return in_time._replace(carry=jax.tree.map(lambda x: x[order], lesson.carry))
