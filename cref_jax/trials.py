"""Trials: robots start anew, and each is followed until it first comes to its lane's end or fails.

Blocks of a fixed number of robots are stepped together, so what becomes of trial i depends on the
seed, on i and on its lane alone: not on how many trials are asked for. (Another size of block, as
on another device, rounds matrix products otherwise.)
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cref_jax import episode, ppo, rollout, stall
from cref_jax.env import Outcome
from cref_jax.episode import Ending
from cref_jax.rollout import Robots
from cref_jax.world import World

FALLS = ("unstable", "tilted", "low", "hit", "dropped")  # of Ending; the first that is true counts
FAILURES = (*FALLS, "stalled", "late")  # late: on its feet and moving, but not at the end in time
ENDINGS = ("finished", *FAILURES)
SEED = 1_000_003  # apart from the seeds of training
CHUNK = 50  # control steps between two looks at whether all have come to an end

Walker = Callable[[World, Robots], tuple[Robots, Outcome]]  # a jax.tree_util.Partial, so no retrace


class Trials(NamedTuple):
    """The outcome of N trials."""

    speed: Float[np.ndarray, " N"]  # m/s forward, commanded
    ending: Int[np.ndarray, " N"]  # index into ENDINGS
    seconds: Float[np.ndarray, " N"]
    forward: Float[np.ndarray, " N"]  # m/s, mean speed in the body frame

    @property
    def succeeded(self) -> Bool[np.ndarray, " N"]:
        """The robot came to the lane's end in time."""
        return self.ending == 0

    def failures(self) -> dict[str, int]:
        """Return how many trials failed in each way."""
        return {name: int((self.ending == ENDINGS.index(name)).sum()) for name in FAILURES}


class Trace(NamedTuple):
    """What is seen of E robots at T steps; after a robot's first end it is another's."""

    ending: Ending  # [T, E] each
    progress: Float[Array | np.ndarray, "T E"]  # m from the start along the lane
    forward: Float[Array | np.ndarray, "T E"]  # m/s, body frame


def follow(train: ppo.TrainState) -> Walker:
    """Return what a policy's mean action makes of robots, without noise."""
    return jax.tree_util.Partial(_follow, train)


def begin(
    world: World, seed: int, number: Int[np.ndarray, " E"],
    kind: Int[np.ndarray, " E"], level: Int[np.ndarray, " E"],
) -> Robots:  # fmt: skip
    """Return the robots at the start of the trials of these numbers, on these lanes."""
    key = jax.random.key(SEED + seed)
    arrays = [jnp.asarray(x, jnp.int32) for x in (number, kind, level)]
    return _begin(world, key, *arrays)


def run(
    world: World,
    walker: Walker,
    kind: Int[np.ndarray, " N"],
    level: Int[np.ndarray, " N"],
    seed: int,
    block: int,
    ended: Callable[[int], None] = lambda count: None,
) -> Trials:
    """Return what becomes of N trials, trial i on the lane of that kind and level.

    Args:
        world: kinds in it that are not level across must be alone in it: see rollout.exposed.
        walker: what steps the robots.
        kind: of each lane.
        level: of each lane.
        seed: of the starts and commands.
        block: robots that are stepped together.
        ended: is told how many trials have come to an end since the last time.
    """
    parts = []
    for first in range(0, len(kind), block):
        number = np.arange(first, first + block)
        lane = np.minimum(number, len(kind) - 1)  # a last block is filled, and what it adds dropped
        count = min(block, len(kind) - first)
        robots = begin(world, seed, number, kind[lane], level[lane])
        parts.append(_followed(world, walker, robots, count, ended))
    return Trials(*map(np.concatenate, zip(*parts, strict=True)))


def judged(trace: Trace, speed: Float[np.ndarray, " E"], period: float) -> Trials:
    """Return each robot's outcome; `period` lies between two steps, s.

    One that has fallen has failed wherever it is, and so has one that has stalled before; who is
    still on its way at the last step is late.
    """
    steps = len(trace.progress)
    end, stalled = _ends(trace, speed, period)
    last = np.minimum(np.minimum(end, stalled), steps - 1)
    at_last = lambda flags: np.asarray(flags)[last, np.arange(len(last))] & (end <= stalled)
    names = [*FALLS, "finished"]
    flags = [at_last(getattr(trace.ending, name)) for name in names]
    ending = np.select(
        [*flags, stalled < end],
        [ENDINGS.index(name) for name in (*names, "stalled")],
        ENDINGS.index("late"),
    )
    lived = np.arange(steps)[:, None] <= last
    return Trials(
        speed=speed,
        ending=ending,
        seconds=(last + 1) * period,
        forward=np.sum(trace.forward * lived, axis=0) / (last + 1),
    )


def _followed(
    world: World, walker: Walker, robots: Robots, count: int, ended: Callable[[int], None]
) -> Trials:
    """Step the robots until the first `count` have come to an end; say so as they do."""
    c = world.config
    period, speed = c.physics.control_period, np.asarray(robots.env.command[:count, 0])
    traces: list[Trace] = []
    over = 0
    while over < count and len(traces) * CHUNK * period < c.episode.length:
        robots, part = _steps(world, walker, robots)
        traces.append(jax.tree.map(lambda x: np.asarray(x)[:, :count], part))
        trace = jax.tree.map(lambda *x: np.concatenate(x), *traces)
        first = np.minimum(*_ends(trace, speed, period))
        before, over = over, int((first < len(trace.progress)).sum())
        ended(over - before)
    return judged(trace, speed, period)


def _ends(
    trace: Trace, speed: Float[np.ndarray, " E"], period: float
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Return the step at which each episode ended, and that at which it stalled; T for never."""
    over = np.asarray(trace.ending.terminated | trace.ending.truncated)
    end = np.where(over.any(axis=0), over.argmax(axis=0), len(over))
    return end, stall.stalls(np.asarray(trace.progress), speed, period)


def _follow(train: ppo.TrainState, world: World, robots: Robots) -> tuple[Robots, Outcome]:
    nets = rollout.networks(world.config.network, len(world.physics.robot.joint_names))
    memory, policy = rollout.act(nets, train, robots)
    return rollout.advance(world, robots, memory, policy.mean[0])


@jax.jit
def _begin(
    world: World, key: PRNGKeyArray, number: Int[Array, " E"],
    kind: Int[Array, " E"], level: Int[Array, " E"],
) -> Robots:  # fmt: skip
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(number)
    split = jax.vmap(jax.random.split)(keys)
    state = jax.vmap(episode.reset, in_axes=(None, 0, 0, 0))(world, split[:, 0], kind, level)
    return rollout.placed(world, state, split[:, 1])


@jax.jit
def _steps(world: World, walker: Walker, robots: Robots) -> tuple[Robots, Trace]:
    """Advance by `CHUNK` control steps."""

    def step(robots: Robots, _: None) -> tuple[Robots, Trace]:
        robots, outcome = walker(world, robots)
        m = outcome.measures
        return robots, Trace(outcome.ending, m.progress, m.forward_speed)

    return jax.lax.scan(step, robots, None, length=CHUNK)
