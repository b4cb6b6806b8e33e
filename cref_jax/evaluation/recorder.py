"""What E robots and their policy do at each step: what the laboratories in experiments/ share.

A laboratory opens a policy, puts robots on lanes side by side, and says what it wants to know of
each step. Nothing counts from the step on that ends a robot's first episode.
"""

import csv
import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped
from rich.progress import Progress

from cref_jax import cli, config, network, ppo
from cref_jax.config import Config
from cref_jax.env.environment import Outcome
from cref_jax.env.world import World, build_world, make_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import protocol, trials
from cref_jax.physics.records import EngineName
from cref_jax.policy import sources
from cref_jax.policy.trained import TrainedPolicy
from cref_jax.rendering import robot_scene
from cref_jax.terrain import Terrain, cross_section, lanes
from cref_jax.terrain.atlas import Atlas
from cref_jax.training import rollout

CHUNK = 50  # steps in one call of the compiled program: 1 s; changes no result
STAIRS = ("stairs_up", "stairs_down", "ascent", "descent")
BEFORE = 0.5  # m before an obstacle from where a robot is on its way over it; assumed: a stride
ON_CPU = 64  # robots, where nobody says how many; assumed: a minute of a CPU


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """The options of every laboratory."""

    command: float = 0.6
    """m/s forward"""
    num_envs: int | None = None
    """robots (default: 64 on a CPU, hundreds or thousands on an accelerator)"""
    seed: int = 0
    """seed of the initial states"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx and warp on the device"""


class Moment(NamedTuple):
    """One control step of E robots."""

    robots: rollout.Robots  # before it: what the policy acts on
    policy: network.Output  # what it says, [1, E, ...]
    outcome: Outcome
    after: rollout.Robots  # a robot that has come to its end stands at its next start


class Watched(NamedTuple):
    """What was looked at during T steps of E robots."""

    alive: Bool[np.ndarray, "T E"]  # no end has come, neither before this step nor by it
    seen: Any  # what was kept of each step, arrays [T, ...]; only those of `alive` count


def open_policy(
    run: Path | None, policy: Path | None, engine: EngineName
) -> tuple[TrainedPolicy, World]:
    """Return the policy that was asked for, or the newest there is, and the world of its training.

    Raises:
        ConfigError: it is no policy, or both are given.
        CheckpointError: the run has no checkpoint that can be read.
    """
    source = sources.resolve_policy(run, policy)
    world = build_world(sources.read_config(source), engine)
    return sources.load(source, world)._replace(run=source), world


def medium_lanes(c: Config) -> Atlas:
    """Return lanes of each kind at its medium size of Table II, or else the middle of training."""
    whole = lanes.build(dataclasses.replace(c.terrain, name="mixed"))
    middle = np.mean(whole.sizes, axis=0).tolist()
    sizes = {
        kind: (lanes.named_sizes(c.terrain, kind).get("medium", size),)
        for kind, size in zip(whole.kinds, middle, strict=True)
    }
    return lanes.grid(c.terrain, sizes, protocol.LANE_SEEDS)


def kind_of_lane(c: Config, asked: str | None) -> str:
    """Return the kind of lane to follow one robot on: the one asked for, or the policy's own.

    Raises:
        ConfigError: there is no such kind.
    """
    kinds = lanes.build(dataclasses.replace(c.terrain, name="mixed")).kinds
    if asked is not None and asked not in kinds:
        raise ConfigError(config.unknown("kind", asked, list(kinds)))
    own = [kind for kind in lanes.build(c.terrain).kinds if kind in kinds and kind != "flat"]
    return asked or ("stairs_up" if "stairs_up" in own or not own else own[0])


def place_robots(c: Config, world: World, atlas: Atlas, command: float) -> World:
    """Return the world of trials on these lanes, to be walked at `command`, m/s forward.

    Raises:
        ConfigError: the command is not above zero.
    """
    if not 0.0 < command < math.inf:
        raise ConfigError(f"--command must be above 0 m/s, not {command:g}")
    trial = protocol.trial_config(c)
    trial = dataclasses.replace(
        trial, command=dataclasses.replace(trial.command, lane_vx=(command, command))
    )
    return make_world(trial, world.physics).replace(lanes=atlas)


def round_robin_lanes(
    atlas: Atlas, count: int
) -> tuple[Int[np.ndarray, " E"], Int[np.ndarray, " E"]]:
    """Return kind and level of the lane of each robot: kinds in turn, then their levels."""
    number = np.arange(count)
    return number % len(atlas.kinds), number // len(atlas.kinds) % atlas.levels


def begin(world: World, seed: int, count: int) -> rollout.Robots:
    """Return robots at the start of their lanes."""
    return trials.begin(world, seed, np.arange(count), *round_robin_lanes(world.lanes, count))


def name_of_lane(world: World, kind: str) -> str:
    """Return the kind of a lane and the size of its obstacles, for people."""
    size = 100 * float(world.lanes.sizes[0, world.lanes.kinds.index(kind)])
    return f"{kind}, {size:.0f} {'%' if kind == 'slope' else 'cm'}" if size else kind


def default_num_envs(asked: int | None, on_accelerator: int) -> int:
    """Return how many robots to watch: as many as asked for, or as the device does in a minute.

    Raises:
        ConfigError: fewer than one are asked for.
    """
    if asked is None:
        return ON_CPU if jax.default_backend() == "cpu" else on_accelerator
    if asked < 1:
        raise ConfigError(f"--num-envs must be at least 1, not {asked}")
    return asked


def steps_of(seconds: float, c: Config) -> int:
    """Return the number of control steps in a time, at least one.

    Raises:
        ConfigError: the time is not above 0, or above a trial's.
    """
    most = protocol.TRIAL_SECONDS
    if not 0.0 < seconds <= most:
        raise ConfigError(f"--seconds must be above 0, up to {most:g}, not {seconds:g}")
    return max(1, round(seconds / c.physics.control_period))


def watch(
    world: World,
    train: ppo.TrainState,
    robots: rollout.Robots,
    steps: int,
    look: Callable[[World, Moment], Any],
) -> Watched:
    """Let the policy's mean action walk the robots, and return what `look` saw of each step.

    It is over after `steps`, or a second after the last robot's end.
    """
    alive = jnp.ones(robots.begins.shape, bool)
    parts: list[Watched] = []
    with Progress(transient=True, disable=not sys.stdout.isatty()) as bar:
        task = bar.add_task("walking", total=steps)
        while steps > 0 and alive.any():
            count = min(CHUNK, steps)
            (robots, alive), part = _chunk(world, train, (robots, alive), look, count)
            parts.append(jax.tree.map(np.asarray, part))
            steps -= count
            bar.advance(task, count)
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@functools.partial(jax.jit, static_argnames=("look", "count"))
def _chunk(
    world: World,
    train: ppo.TrainState,
    carry: tuple[rollout.Robots, Bool[Array, " E"]],
    look: Callable[[World, Moment], Any],
    count: int,
) -> tuple[tuple[rollout.Robots, Bool[Array, " E"]], Watched]:
    """Return the robots after `count` steps, and what was seen of these."""
    nets = rollout.networks(world.config.network, len(world.physics.robot.joint_names))

    def step(
        carry: tuple[rollout.Robots, Bool[Array, " E"]], _: None
    ) -> tuple[tuple[rollout.Robots, Bool[Array, " E"]], Watched]:
        robots, alive = carry
        memory, policy = rollout.policy_step(nets, train, robots)
        after, outcome = rollout.env_step(world, robots, memory, policy.mean[0])
        alive &= ~(outcome.ending.terminated | outcome.ending.truncated)
        seen = look(world, Moment(robots, policy, outcome, after))
        return (after, alive), Watched(alive, seen)

    return jax.lax.scan(step, carry, None, length=count)


def terrain_under(
    atlas: Atlas, x: Float[np.ndarray, "T E"], before: float = BEFORE
) -> Shaped[np.ndarray, "T E"]:
    """Return the kind of ground that each robot at `x`, m along its lane, walks on.

    On a lane of stairs that is the direction of the flight, whichever comes first there. It is ""
    on the level ground of other lanes, but for the last `before` m before an obstacle.
    """
    names = np.full(x.shape, "", dtype="U16")
    for e, (kind, level) in enumerate(zip(*round_robin_lanes(atlas, x.shape[1]), strict=True)):
        names[:, e] = _on_lane(atlas.tile(level, kind), atlas.kinds[kind], x[:, e], before)
    return names


def _on_lane(
    ground: Terrain, kind: str, x: Float[np.ndarray, "*n"], before: float
) -> Shaped[np.ndarray, "*n"]:
    """Return the kind of ground of robots that are all on this lane."""
    if kind in STAIRS:
        shape = cross_section.of_lane(ground)
        way = cross_section.flight_at(shape, x)
        way = np.where(way == 0, cross_section.flight_at(shape, x + before), way)
        return np.array(["", "stairs up", "stairs down"])[way]
    heights, _ = robot_scene.window(ground)
    uneven = ground.cell * np.flatnonzero(heights.any(axis=1))
    if not uneven.size:
        return np.full(x.shape, kind)
    over = (x >= uneven[0] - before) & (x <= uneven[-1] + ground.cell)
    return np.where(over, kind, "")


def onsets(flag: Bool[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
    """Return where a flag goes up along the first axis, time; one that is up at first does."""
    before = np.concatenate([np.zeros_like(flag[:1]), flag[:-1]])
    return flag & ~before


def write_table(out: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a .csv: a header, then the rows, numbers with up to six digits."""
    said = lambda x: f"{x:.6g}" if isinstance(x, float | np.floating) else x
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([said(x) for x in row] for row in rows)
