"""One iteration of training, and many of them as one compiled program.

An iteration is a horizon of experience and an update. Its random numbers come from the seed and the
number of the iteration, so neither the length of a chunk nor a resumption changes any result.
"""

import functools
from typing import no_type_check

import flax.struct
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from cref_jax import ppo, rollout
from cref_jax.world import World

Log = dict[str, Float[Array, "*n"]]  # one number an iteration under each name


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class RunState:
    """Everything that a run carries from one iteration to the next."""

    train: ppo.TrainState
    robots: rollout.Robots


def initial_state(world: World) -> RunState:
    """Return the state before the first iteration."""
    c = world.config
    key_robots, key_params = jax.random.split(jax.random.key(c.run.seed))
    robots = rollout.start(world, key_robots, c.run.num_envs)
    seen = robots.observation
    joints = len(world.physics.robot.joint_names)
    params = rollout.initial_params(c.network, joints, robots, key_params)
    sizes = seen.proprioception.shape[-1], seen.privileged.shape[-1]
    return RunState(ppo.initial_state(params, *sizes, c.ppo), robots)


@functools.partial(jax.jit, static_argnames="iterations", donate_argnums=1)
def chunk(world: World, state: RunState, iterations: int) -> tuple[RunState, Log]:
    """Run `iterations` iterations; every entry of the log is [iterations]."""
    key = jax.random.fold_in(jax.random.key(world.config.run.seed), 1)

    def iteration(state: RunState, _: None) -> tuple[RunState, Log]:
        return _iteration(world, state, jax.random.fold_in(key, state.train.iteration))

    return jax.lax.scan(iteration, state, None, length=iterations)


def _iteration(world: World, state: RunState, key: Array) -> tuple[RunState, Log]:
    c = world.config
    nets = rollout.networks(c.network, len(world.physics.robot.joint_names))
    key_act, key_update = jax.random.split(key)
    robots, experience, trace = rollout.collect(world, nets, state.train, state.robots, key_act)
    train, losses = ppo.update(state.train, experience, key_update, c.ppo, nets.functions)
    log = {
        **_episodes(trace, world.lanes.kinds, c.physics.control_period),
        **{f"reward/{name}": term.mean() for name, term in trace.measures.terms.items()},
        **{f"loss/{name}": part.mean() for name, part in losses._asdict().items()},
        "train/learning_rate": jnp.ravel(losses.learning_rate)[-1],
        "train/action_std": jnp.exp(experience.log_std[0, 0]).mean(),
        "train/samples": (train.iteration * (c.run.num_envs * c.ppo.horizon)).astype(jnp.float32),
    }
    return RunState(train, robots), log


def _episodes(trace: rollout.Trace, kinds: tuple[str, ...], period: float) -> Log:
    """Return how the robots walk, and how the episodes that ended did, by kind of terrain.

    `period` is the length of a control step, s.
    """
    ending, measures = trace.ending, trace.measures
    over = ending.terminated | ending.truncated
    among = lambda x, which: jnp.sum(x * which) / jnp.maximum(which.sum(), 1)
    distance = measures.foothold_distance
    placed = measures.touchdown & jnp.isfinite(distance)
    log = {
        "episode/length_s": among(measures.steps * period, over),
        "episode/ended": over.sum().astype(jnp.float32),
        "episode/fell": ending.terminated.sum().astype(jnp.float32),
        "episode/falls_per_minute": ending.terminated.mean() * (60.0 / period),
        "episode/unstable": ending.unstable.sum().astype(jnp.float32),
        "walk/speed_error": measures.speed_error.mean(),
        "walk/forward_speed": measures.forward_speed.mean(),
        "walk/airborne": measures.airborne.mean(),
        "walk/reward": trace.reward.mean(),
        "foothold/distance": among(jnp.where(placed, distance, 0.0), placed),
        "foothold/empty": among(~jnp.isfinite(distance), measures.touchdown),
    }
    for number, kind in enumerate(kinds):
        here = measures.kind == number
        log[f"level/{kind}"] = among(measures.rank, here)
        log[f"fell/{kind}"] = among(ending.terminated, here & over)
    return log
