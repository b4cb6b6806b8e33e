"""Trials: robots start anew, and each is followed until it first comes to its lane's end or fails.

Each device steps a block of robots together, and where one has come to its end the next trial
begins. A trial's place in a block comes from its number, so what becomes of it depends on the seed,
on its number and on its lane alone: not on how many trials are asked for, nor on the number of
devices. (Another size of block, as on another device, rounds matrix products otherwise.)
"""

import collections
import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cref_jax import depth, ppo
from cref_jax.config import Config
from cref_jax.env import resets, stall
from cref_jax.env.environment import Outcome
from cref_jax.env.state import Ending, Spread, even_spread
from cref_jax.env.world import World
from cref_jax.evaluation import lateral_drift
from cref_jax.training import rollout
from cref_jax.training.rollout import Robots

FALLS = ("unstable", "tilted", "low", "hit", "dropped")  # of Ending; the first that is true counts
FAILURES = (*FALLS, "stalled", "late")  # late: on its feet and moving, but not at the end in time
ENDINGS = ("finished", *FAILURES)
SEED = 1_000_003  # apart from the seeds of training
CHUNK = 50  # control steps between two looks at which have come to an end
AXIS = "robots"  # of the mesh

Walker = Callable[[World, Robots], tuple[Robots, Outcome]]  # a jax.tree_util.Partial, so no retrace


class Asked(NamedTuple):
    """N trials to make."""

    number: Int[np.ndarray, " N"]  # from which it starts; twice only on different lanes
    kind: Int[np.ndarray, " N"]  # of the lane
    level: Int[np.ndarray, " N"]
    spread: Spread | None = None  # [N] each: how much of what is randomised; all when left out


class Trials(NamedTuple):
    """The outcome of N trials."""

    speed: Float[np.ndarray, " N"]  # m/s forward, commanded
    ending: Int[np.ndarray, " N"]  # index into ENDINGS
    seconds: Float[np.ndarray, " N"]
    forward: Float[np.ndarray, " N"]  # m/s, mean speed in the body frame
    drift: Float[np.ndarray, " N"]  # m, distance from the lane's middle at the end
    aside: Float[np.ndarray, " N"]  # m, the largest distance from the lane's middle

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
    y: Float[Array | np.ndarray, "T E"]  # m across the lane, before the step


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
    return _begin(world, key, *arrays, even_spread(np.ones(len(number))))


def run(
    world: World,
    walker: Walker,
    asked: Asked,
    seed: int,
    block: int,
    ended: Callable[[int], None] = lambda count: None,
) -> Trials:
    """Return what becomes of the trials.

    Args:
        world: a kind that is not level across must be alone in it: see camera_feed.render_frames.
        walker: what steps the robots.
        asked: the trials.
        seed: of the starts and commands.
        block: robots that are stepped together on one device.
        ended: is told how many trials have come to an end since the last time.
    """
    places = _Places(asked.number, block)
    mesh = jax.make_mesh(
        (places.blocks,), (AXIS,), axis_types=(AxisType.Auto,),
        devices=jax.devices()[: places.blocks],
    )  # fmt: skip
    world, walker = jax.device_put((world, walker), NamedSharding(mesh, P()))
    key = jax.random.key(SEED + seed)
    spread = asked.spread or even_spread(np.ones(len(asked.number)))
    found: dict[int, Trials] = {}
    robots, clock = None, 0
    while places.left:
        if not places.courses:
            robots, clock = None, 0
        if _is_in_phase(world.config, clock) and (new := places.filled()).size:
            lanes = (jnp.asarray(x[places.trial], jnp.int32) for x in asked[:3])
            of = jax.tree.map(lambda x: jnp.asarray(x)[places.trial], spread)
            begun = _begin_on(world, key, *lanes, of, mesh)
            places.begin(new, np.asarray(begun.env.command[:, 0]))
            is_new = np.isin(np.arange(places.trial.size), new)
            robots = begun if robots is None else _replaced(robots, begun, is_new, world.config)
        robots, part = _steps(world, walker, robots, mesh)
        clock += CHUNK
        over = places.follow(jax.tree.map(np.asarray, part), world.config)
        found |= over
        ended(len(over))
    return Trials(*map(np.concatenate, zip(*(found[k] for k in sorted(found)), strict=True)))


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
    drift, aside = lateral_drift.spans(np.asarray(trace.y), lived)
    return Trials(
        speed=speed,
        ending=ending,
        seconds=(last + 1) * period,
        forward=np.sum(trace.forward * lived, axis=0) / (last + 1),
        drift=drift,
        aside=aside,
    )


@dataclasses.dataclass
class _Course:
    """A trial that is under way, and what has been seen of it."""

    trial: int
    speed: Float[np.ndarray, "1"]  # m/s, commanded
    parts: list[Trace] = dataclasses.field(default_factory=list)


class _Places:
    """Which trial is made at each place of the blocks, and which ones wait for one."""

    def __init__(self, number: Int[np.ndarray, " N"], block: int) -> None:
        row = number % block
        self._waiting = [collections.deque(np.flatnonzero(row == k)) for k in range(block)]
        self.blocks = min(jax.device_count(), max(map(len, self._waiting)))
        self.trial = np.zeros(self.blocks * block, int)  # where none is left, any will do
        self.courses: dict[int, _Course] = {}  # by place

    @property
    def left(self) -> bool:
        """Whether there are trials that have not come to an end."""
        return bool(self.courses) or any(self._waiting)

    def filled(self) -> Int[np.ndarray, " n"]:
        """Return the free places that have been given the next trial."""
        new = []
        for place in range(self.trial.size):
            waiting = self._waiting[place % len(self._waiting)]
            if place not in self.courses and waiting:
                self.trial[place] = waiting.popleft()
                new.append(place)
        return np.array(new, int)

    def begin(self, new: Int[np.ndarray, " n"], speed: Float[np.ndarray, " E"]) -> None:
        """Follow the trials at these places from here on."""
        self.courses |= {k: _Course(int(self.trial[k]), speed[k : k + 1]) for k in new}

    def follow(self, part: Trace, c: Config) -> dict[int, Trials]:
        """Return the trials that have come to an end in these `CHUNK` steps."""
        period, over = c.physics.control_period, {}
        for place, course in list(self.courses.items()):
            course.parts.append(jax.tree.map(lambda x, k=place: x[:, k : k + 1], part))
            trace = jax.tree.map(lambda *x: np.concatenate(x), *course.parts)
            steps = len(trace.progress)
            first = np.minimum(*_ends(trace, course.speed, period))
            if first[0] < steps or steps * period >= c.episode.length:
                over[course.trial] = judged(trace, course.speed, period)
                del self.courses[place]
        return over


def _is_in_phase(c: Config, clock: int) -> bool:
    """Return whether a trial may begin: whether frames come from now on as they do at first."""
    period = c.physics.control_period
    following = 1 + np.arange(round(c.episode.length / period))
    first, now = (depth.is_due(k + following, c.camera, period) for k in (0, clock))
    return c.network.variant == "blind" or bool(jnp.all(first == now))


def _ends(
    trace: Trace, speed: Float[np.ndarray, " E"], period: float
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Return the step at which each episode ended, and that at which it stalled; T for never."""
    over = np.asarray(trace.ending.terminated | trace.ending.truncated)
    end = np.where(over.any(axis=0), over.argmax(axis=0), len(over))
    return end, stall.stalls(np.asarray(trace.progress), speed, period)


def _follow(train: ppo.TrainState, world: World, robots: Robots) -> tuple[Robots, Outcome]:
    nets = rollout.networks(world.config.network, len(world.physics.robot.joint_names))
    memory, policy = rollout.policy_step(nets, train, robots)
    return rollout.env_step(world, robots, memory, policy.mean[0])


def _started(
    world: World, key: PRNGKeyArray, number: Int[Array, " E"],
    kind: Int[Array, " E"], level: Int[Array, " E"], spread: Spread,
) -> Robots:  # fmt: skip
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(number)
    split = jax.vmap(jax.random.split)(keys)
    reset = jax.vmap(resets.reset, in_axes=(None, 0, 0, 0, 0))
    state = reset(world, split[:, 0], kind, level, spread)
    return rollout.init_robots(world, state, split[:, 1])


_begin = jax.jit(_started)


@functools.partial(jax.jit, static_argnames="mesh")
def _begin_on(
    world: World, key: PRNGKeyArray, number: Int[Array, " E"],
    kind: Int[Array, " E"], level: Int[Array, " E"], spread: Spread, mesh: Mesh,
) -> Robots:  # fmt: skip
    """Do the same on the devices of the mesh."""
    robots, each = _partition(world.config), P(AXIS)
    start = jax.shard_map(
        _started, mesh=mesh, in_specs=(P(), P(), each, each, each, each), out_specs=robots,
        check_vma=False,
    )  # fmt: skip
    return start(world, key, number, kind, level, spread)


@functools.partial(jax.jit, static_argnames="c")
def _replaced(robots: Robots, begun: Robots, is_new: Bool[Array, " E"], c: Config) -> Robots:
    """Return the robots, in place of some those that begin; the cameras' clock goes on."""

    def chosen(spec: P, old: Array, new: Array) -> Array:
        if not spec:
            return old
        axes = [k for k in range(old.ndim) if k != len(spec) - 1]
        return jnp.where(jnp.expand_dims(is_new, axes), new, old)

    of = lambda spec, old, new: jax.tree.map(functools.partial(chosen, spec), old, new)
    return jax.tree.map(of, _partition(c), robots, begun, is_leaf=lambda x: isinstance(x, P))


@functools.partial(jax.jit, static_argnames="mesh")
def _steps(world: World, walker: Walker, robots: Robots, mesh: Mesh) -> tuple[Robots, Trace]:
    """Advance by `CHUNK` control steps."""

    def advance(world: World, walker: Walker, robots: Robots) -> tuple[Robots, Trace]:
        def step(robots: Robots, _: None) -> tuple[Robots, Trace]:
            y = robots.env.body.qpos[:, 1]
            robots, outcome = walker(world, robots)
            m = outcome.measures
            return robots, Trace(outcome.ending, m.progress, m.forward_speed, y)

        return jax.lax.scan(step, robots, None, length=CHUNK)

    place = _partition(world.config)
    shared = jax.shard_map(
        advance, mesh=mesh, in_specs=(P(), P(), place), out_specs=(place, P(None, AXIS)),
        check_vma=False,
    )  # fmt: skip
    return shared(world, walker, robots)


def _partition(c: Config) -> Robots:
    return rollout.partition(AXIS, c.network.variant)
