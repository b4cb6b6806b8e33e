"""Trials: each robot starts anew and is followed until it first reaches its lane's end or fails.

Each device steps a block of robots, and where a trial ends the next one starts. A trial's slot in a
block follows from its number and its row in the table, so its outcome depends only on the seed, its
number, its row and its lane, not on the number of trials or of devices. (Another block size, as on
another device, rounds matrix products differently.)
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

FALLS = ("unstable", "tilted", "low", "hit", "dropped")  # of Ending; the first true one counts
FAILURES = (*FALLS, "stalled", "late")  # late: upright and moving, but not at the end in time
ENDINGS = ("finished", *FAILURES)
SEED = 1_000_003  # offset from the seeds of training
CHUNK = 50  # control steps between checks for trials that have ended
AXIS = "robots"  # of the mesh

# a jax.tree_util.Partial avoids retracing
StepFn = Callable[[World, Robots], tuple[Robots, Outcome]]
Look = Callable[[int, "Walk"], None]
LOOK_AWAY: Look = lambda trial, walk: None


class TrialSpecs(NamedTuple):
    """N trials to run."""

    number: Int[np.ndarray, " N"]  # determines the start; may repeat only on different lanes
    kind: Int[np.ndarray, " N"]  # of the lane
    level: Int[np.ndarray, " N"]
    spread: Spread | None = None  # [N] each: share of the randomisation (default: all)


class Trials(NamedTuple):
    """Outcome of N trials."""

    speed: Float[np.ndarray, " N"]  # m/s forward, commanded
    ending: Int[np.ndarray, " N"]  # index into ENDINGS
    seconds: Float[np.ndarray, " N"]
    forward: Float[np.ndarray, " N"]  # m/s, mean speed in the body frame
    drift: Float[np.ndarray, " N"]  # m, distance from the lane's middle at the end
    aside: Float[np.ndarray, " N"]  # m, the largest distance from the lane's middle

    @property
    def succeeded(self) -> Bool[np.ndarray, " N"]:
        """Whether the robot reached the lane's end in time."""
        return self.ending == 0

    def failures(self) -> dict[str, int]:
        """Count the trials that failed in each way."""
        return {name: int((self.ending == ENDINGS.index(name)).sum()) for name in FAILURES}


class Walk(NamedTuple):
    """One trial as it was walked: T steps, its last one included."""

    qpos: Float[np.ndarray, "T Q"]  # before each step
    airborne: Bool[np.ndarray, "T F"]  # after it: the foot is off the ground
    ending: str  # one of ENDINGS


class Poses(NamedTuple):
    """What pictures need of E robots at T steps."""

    qpos: Float[Array | np.ndarray, "T E Q"]  # before the step
    airborne: Bool[Array | np.ndarray, "T E F"]  # after it


class TrialTrace(NamedTuple):
    """Measures of E robots at T steps; after a robot's first end they belong to a new episode."""

    ending: Ending  # [T, E] each
    progress: Float[Array | np.ndarray, "T E"]  # m from the start along the lane
    forward: Float[Array | np.ndarray, "T E"]  # m/s, body frame
    y: Float[Array | np.ndarray, "T E"]  # m across the lane, before the step


Part = tuple[TrialTrace, Poses]  # of `CHUNK` steps


def make_step_fn(train: ppo.TrainState) -> StepFn:
    """Create a step function that applies the policy's mean action, without noise."""
    return jax.tree_util.Partial(_apply_policy, train)


def start_robots(
    world: World, seed: int, number: Int[np.ndarray, " E"],
    kind: Int[np.ndarray, " E"], level: Int[np.ndarray, " E"],
) -> Robots:  # fmt: skip
    """Place robots at the start of the trials of these numbers, on these lanes."""
    key = jax.random.key(SEED + seed)
    arrays = [jnp.asarray(x, jnp.int32) for x in (number, kind, level)]
    return _start(world, key, *arrays, even_spread(np.ones(len(number))))


def run(
    world: World,
    step_fn: StepFn,
    specs: TrialSpecs,
    seed: int,
    block: int,
    on_finished: Callable[[int], None] = lambda count: None,
    look: Look = LOOK_AWAY,
) -> Trials:
    """Run the trials and classify their outcomes.

    Args:
        world: a kind that is not level across must be its only one: see camera_feed.render_frames.
        step_fn: steps the robots.
        specs: the trials.
        seed: of the starts and commands.
        block: robots stepped together on one device.
        on_finished: called with the number of trials that have ended since the last call.
        look: called with each trial's index in `specs` and its walk, in the order of their ends.
    """
    slots = _Slots(specs.number, block)
    mesh = jax.make_mesh(
        (slots.blocks,), (AXIS,), axis_types=(AxisType.Auto,),
        devices=jax.devices()[: slots.blocks],
    )  # fmt: skip
    world, step_fn = jax.device_put((world, step_fn), NamedSharding(mesh, P()))
    key = jax.random.key(SEED + seed)
    spread = specs.spread or even_spread(np.ones(len(specs.number)))
    results: dict[int, Trials] = {}
    robots, clock = None, 0
    while slots.has_trials:
        if not slots.active:
            robots, clock = None, 0
        if _is_camera_in_phase(world.config, clock) and (new := slots.fill()).size:
            lanes = (jnp.asarray(x[slots.trial], jnp.int32) for x in specs[:3])
            of = jax.tree.map(lambda x: jnp.asarray(x)[slots.trial], spread)
            fresh = _start_on_mesh(world, key, *lanes, of, mesh)
            slots.start(new, np.asarray(fresh.env.command[:, 0]))
            is_new = np.isin(np.arange(slots.trial.size), new)
            robots = (
                fresh if robots is None else _replace_robots(robots, fresh, is_new, world.config)
            )
        robots, part = _run_chunk(world, step_fn, robots, mesh)
        clock += CHUNK
        over = slots.update(jax.tree.map(np.asarray, part), world.config)
        for trial, (outcome, walk) in over.items():
            results[trial] = outcome
            look(trial, walk)
        on_finished(len(over))
    return Trials(*map(np.concatenate, zip(*(results[k] for k in sorted(results)), strict=True)))


def classify(trace: TrialTrace, speed: Float[np.ndarray, " E"], period: float) -> Trials:
    """Classify each robot's outcome; `period` is the time between two steps, s.

    A fall is a failure wherever it happens, and so is an earlier stall; a robot still on its way
    at the last step is late.
    """
    steps = len(trace.progress)
    end, stalled = _first_ends(trace, speed, period)
    last = np.minimum(np.minimum(end, stalled), steps - 1)
    at_last = lambda flags: np.asarray(flags)[last, np.arange(len(last))] & (end <= stalled)
    names = [*FALLS, "finished"]
    flags = [at_last(getattr(trace.ending, name)) for name in names]
    ending = np.select(
        [*flags, stalled < end],
        [ENDINGS.index(name) for name in (*names, "stalled")],
        ENDINGS.index("late"),
    )
    active = np.arange(steps)[:, None] <= last
    drift, aside = lateral_drift.measure(np.asarray(trace.y), active)
    return Trials(
        speed=speed,
        ending=ending,
        seconds=(last + 1) * period,
        forward=np.sum(trace.forward * active, axis=0) / (last + 1),
        drift=drift,
        aside=aside,
    )


@dataclasses.dataclass
class _ActiveTrial:
    """A running trial and its measures so far."""

    trial: int
    speed: Float[np.ndarray, "1"]  # m/s, commanded
    parts: list[TrialTrace] = dataclasses.field(default_factory=list)
    poses: list[Poses] = dataclasses.field(default_factory=list)

    def walk(self, outcome: Trials, period: float) -> Walk:
        """Join the poses up to the trial's end."""
        steps = round(float(outcome.seconds[0]) / period)
        qpos, airborne = (np.concatenate(x)[:steps, 0] for x in zip(*self.poses, strict=True))
        return Walk(qpos, airborne, ENDINGS[outcome.ending[0]])


class _Slots:
    """The trial in each slot of the blocks, and the trials waiting for a slot."""

    def __init__(self, number: Int[np.ndarray, " N"], block: int) -> None:
        slot = _deal_slots(number, block)
        self._waiting = [collections.deque(np.flatnonzero(slot == k)) for k in range(block)]
        self.blocks = min(jax.device_count(), max(map(len, self._waiting)))
        self.trial = np.zeros(self.blocks * block, int)  # any trial where none is left
        self.active: dict[int, _ActiveTrial] = {}  # by slot

    @property
    def has_trials(self) -> bool:
        """Whether any trial has not ended."""
        return bool(self.active) or any(self._waiting)

    def fill(self) -> Int[np.ndarray, " n"]:
        """Assign the next trials to free slots, and return these slots."""
        new = []
        for slot in range(self.trial.size):
            waiting = self._waiting[slot % len(self._waiting)]
            if slot not in self.active and waiting:
                self.trial[slot] = waiting.popleft()
                new.append(slot)
        return np.array(new, int)

    def start(self, new: Int[np.ndarray, " n"], speed: Float[np.ndarray, " E"]) -> None:
        """Start to follow the trials in these slots."""
        self.active |= {k: _ActiveTrial(int(self.trial[k]), speed[k : k + 1]) for k in new}

    def update(self, part: Part, c: Config) -> dict[int, tuple[Trials, Walk]]:
        """Add these `CHUNK` steps, and return the trials that ended in them."""
        period, over = c.physics.control_period, {}
        for slot, running in list(self.active.items()):
            trace, poses = jax.tree.map(lambda x, k=slot: x[:, k : k + 1], part)
            running.parts.append(trace)
            running.poses.append(poses)
            trace = jax.tree.map(lambda *x: np.concatenate(x), *running.parts)
            steps = len(trace.progress)
            first = np.minimum(*_first_ends(trace, running.speed, period))
            if first[0] < steps or steps * period >= c.episode.length:
                outcome = classify(trace, running.speed, period)
                over[running.trial] = outcome, running.walk(outcome, period)
                del self.active[slot]
        return over


def _deal_slots(number: Int[np.ndarray, " N"], block: int) -> Int[np.ndarray, " N"]:
    """Deal out a block's slots by number, and by row where the rows of a table share their numbers.

    All slots have as many trials, give or take one, and more trials per row change no slot.
    """
    rows = np.bincount(number).max()
    seen = collections.Counter[int]()
    place = []
    for n in number.tolist():
        place.append(n * rows + seen[n])
        seen[n] += 1
    return np.array(place) % block


def _is_camera_in_phase(c: Config, clock: int) -> bool:
    """Check whether a trial may start: whether frames follow the same pattern as from step 0."""
    period = c.physics.control_period
    following = 1 + np.arange(round(c.episode.length / period))
    first, now = (depth.is_due(k + following, c.camera, period) for k in (0, clock))
    return not c.network.sees or bool(jnp.all(first == now))


def _first_ends(
    trace: TrialTrace, speed: Float[np.ndarray, " E"], period: float
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Find the steps at which each episode ended and stalled; T for never."""
    over = np.asarray(trace.ending.terminated | trace.ending.truncated)
    end = np.where(over.any(axis=0), over.argmax(axis=0), len(over))
    return end, stall.stalls(np.asarray(trace.progress), speed, period)


def _apply_policy(train: ppo.TrainState, world: World, robots: Robots) -> tuple[Robots, Outcome]:
    robots, _policy, outcome = rollout.step_policy(world, train, robots)
    return robots, outcome


def _init_robots(
    world: World, key: PRNGKeyArray, number: Int[Array, " E"],
    kind: Int[Array, " E"], level: Int[Array, " E"], spread: Spread,
) -> Robots:  # fmt: skip
    keys = jax.vmap(lambda i: jax.random.fold_in(key, i))(number)
    split = jax.vmap(jax.random.split)(keys)
    reset = jax.vmap(resets.reset, in_axes=(None, 0, 0, 0, 0))
    state = reset(world, split[:, 0], kind, level, spread)
    return rollout.init_robots(world, state, split[:, 1])


_start = jax.jit(_init_robots)


@functools.partial(jax.jit, static_argnames="mesh")
def _start_on_mesh(
    world: World, key: PRNGKeyArray, number: Int[Array, " E"],
    kind: Int[Array, " E"], level: Int[Array, " E"], spread: Spread, mesh: Mesh,
) -> Robots:  # fmt: skip
    """Place the robots on the devices of the mesh."""
    robots, each = _partition(world.config), P(AXIS)
    start = jax.shard_map(
        _init_robots, mesh=mesh, in_specs=(P(), P(), each, each, each, each), out_specs=robots,
        check_vma=False,
    )  # fmt: skip
    return start(world, key, number, kind, level, spread)


@functools.partial(jax.jit, static_argnames="c")
def _replace_robots(robots: Robots, fresh: Robots, is_new: Bool[Array, " E"], c: Config) -> Robots:
    """Replace the new robots by fresh ones; the cameras' clock continues."""

    def choose(spec: P, old: Array, new: Array) -> Array:
        if not spec:
            return old
        axes = [k for k in range(old.ndim) if k != len(spec) - 1]
        return jnp.where(jnp.expand_dims(is_new, axes), new, old)

    of = lambda spec, old, new: jax.tree.map(functools.partial(choose, spec), old, new)
    return jax.tree.map(of, _partition(c), robots, fresh, is_leaf=lambda x: isinstance(x, P))


@functools.partial(jax.jit, static_argnames="mesh")
def _run_chunk(world: World, step_fn: StepFn, robots: Robots, mesh: Mesh) -> tuple[Robots, Part]:
    """Step the robots `CHUNK` times."""

    def advance(world: World, step_fn: StepFn, robots: Robots) -> tuple[Robots, Part]:
        def step(robots: Robots, _: None) -> tuple[Robots, Part]:
            qpos = robots.env.body.qpos
            robots, outcome = step_fn(world, robots)
            m = outcome.measures
            trace = TrialTrace(outcome.ending, m.progress, m.forward_speed, qpos[:, 1])
            return robots, (trace, Poses(qpos, m.airborne))

        return jax.lax.scan(step, robots, None, length=CHUNK)

    place = _partition(world.config)
    shared = jax.shard_map(
        advance, mesh=mesh, in_specs=(P(), P(), place), out_specs=(place, P(None, AXIS)),
        check_vma=False,
    )  # fmt: skip
    return shared(world, step_fn, robots)


def _partition(c: Config) -> Robots:
    return rollout.partition(AXIS, c.network)
