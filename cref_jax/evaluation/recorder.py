"""Step-by-step records of E robots and their policy, shared by the labs in experiments/.

A lab opens a policy, places robots on lanes side by side, and selects what to record of each step.
The step that ends a robot's first episode and all later ones do not count.
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
from cref_jax.terrain.generators import size_unit
from cref_jax.training import rollout

CHUNK = 50  # steps per call of the compiled program: 1 s; does not affect results
STAIRS = ("stairs_up", "stairs_down", "ascent", "descent")
BEFORE = 0.5  # m before an obstacle at which crossing it begins; assumed: a stride
ON_CPU = 64  # robots by default; assumed: a minute of computation


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Options of every lab."""

    command: float = 0.6
    """m/s forward"""
    num_envs: int | None = None
    """number of robots (default: 64 on a CPU, hundreds or thousands on an accelerator)"""
    seed: int = 0
    """seed of the initial states"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx and warp on the device"""


class Moment(NamedTuple):
    """One control step of E robots."""

    robots: rollout.Robots  # before it: the policy's input
    policy: network.Output  # its output, [1, E, ...]
    outcome: Outcome
    after: rollout.Robots  # a robot whose episode ended is at its next start


class StepRecords(NamedTuple):
    """Records of T steps of E robots."""

    alive: Bool[np.ndarray, "T E"]  # its first episode has not ended by this step
    seen: Any  # values of each step, arrays [T, ...]; valid where `alive`


def open_policy(
    run: Path | None, policy: Path | None, engine: EngineName
) -> tuple[TrainedPolicy, World]:
    """Load the requested policy or the default one, and build the world of its training.

    Raises:
        ConfigError: the path is not a policy, or both are given.
        CheckpointError: the run has no readable checkpoint.
    """
    source = sources.resolve_policy(run, policy)
    world = build_world(sources.read_config(source), engine)
    return sources.load(source, world)._replace(run=source), world


def medium_lanes(c: Config) -> Atlas:
    """Build lanes of each kind at its medium size of Table II, else mid-range of training."""
    whole = lanes.build(dataclasses.replace(c.terrain, name="mixed"))
    middle = np.mean(whole.sizes, axis=0).tolist()
    sizes = {
        kind: (lanes.named_sizes(c.terrain, kind).get("medium", size),)
        for kind, size in zip(whole.kinds, middle, strict=True)
    }
    return lanes.build_grid(c.terrain, sizes, protocol.LANE_SEEDS)


def choose_kind(c: Config, requested: str | None) -> str:
    """Choose the kind of lane to follow one robot on: as requested, or the policy's own.

    Raises:
        ConfigError: the kind does not exist.
    """
    kinds = lanes.build(dataclasses.replace(c.terrain, name="mixed")).kinds
    if requested is not None and requested not in kinds:
        raise ConfigError(config.describe_unknown("kind", requested, list(kinds)))
    own = [kind for kind in lanes.build(c.terrain).kinds if kind in kinds and kind != "flat"]
    return requested or ("stairs_up" if "stairs_up" in own or not own else own[0])


def make_trial_world(c: Config, world: World, atlas: Atlas, command: float) -> World:
    """Build the world of trials on these lanes at `command`, m/s forward.

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
    """Return kind and level of each robot's lane: round-robin over kinds, then levels."""
    number = np.arange(count)
    return number % len(atlas.kinds), number // len(atlas.kinds) % atlas.levels


def start_robots(world: World, seed: int, count: int) -> rollout.Robots:
    """Place robots at the start of their lanes."""
    return trials.start_robots(
        world, seed, np.arange(count), *round_robin_lanes(world.lanes, count)
    )


def lane_name(world: World, kind: str) -> str:
    """Format a lane's kind and the size of its obstacles."""
    size = 100 * float(world.lanes.sizes[0, world.lanes.kinds.index(kind)])
    return f"{kind}, {size:.0f} {size_unit(kind)}" if size else kind


def default_num_envs(requested: int | None, on_accelerator: int) -> int:
    """Return the requested number of robots, or about a minute's work for the device.

    Raises:
        ConfigError: the number is below 1.
    """
    if requested is None:
        return ON_CPU if jax.default_backend() == "cpu" else on_accelerator
    if requested < 1:
        raise ConfigError(f"--num-envs must be at least 1, not {requested}")
    return requested


def count_steps(seconds: float, c: Config) -> int:
    """Convert a duration to control steps, at least one.

    Raises:
        ConfigError: the duration is not above 0, or exceeds a trial's.
    """
    most = protocol.TRIAL_SECONDS
    if not 0.0 < seconds <= most:
        raise ConfigError(f"--seconds must be above 0, up to {most:g}, not {seconds:g}")
    return max(1, round(seconds / c.physics.control_period))


def record(
    world: World,
    train: ppo.TrainState,
    robots: rollout.Robots,
    steps: int,
    look: Callable[[World, Moment], Any],
) -> StepRecords:
    """Step the robots with the policy's mean action and record `look` for each step.

    Stops after `steps`, or within a second of the last robot's end.
    """
    alive = jnp.ones(robots.begins.shape, bool)
    parts: list[StepRecords] = []
    with Progress(transient=True, disable=not sys.stdout.isatty()) as bar:
        task = bar.add_task("walking", total=steps)
        while steps > 0 and alive.any():
            count = min(CHUNK, steps)
            (robots, alive), part = _run_chunk(world, train, (robots, alive), look, count)
            parts.append(jax.tree.map(np.asarray, part))
            steps -= count
            bar.advance(task, count)
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)


@functools.partial(jax.jit, static_argnames=("look", "count"))
def _run_chunk(
    world: World,
    train: ppo.TrainState,
    carry: tuple[rollout.Robots, Bool[Array, " E"]],
    look: Callable[[World, Moment], Any],
    count: int,
) -> tuple[tuple[rollout.Robots, Bool[Array, " E"]], StepRecords]:
    """Run `count` steps; return the robots after them and their records."""

    def step(
        carry: tuple[rollout.Robots, Bool[Array, " E"]], _: None
    ) -> tuple[tuple[rollout.Robots, Bool[Array, " E"]], StepRecords]:
        robots, alive = carry
        after, policy, outcome = rollout.step_policy(world, train, robots)
        alive &= ~(outcome.ending.terminated | outcome.ending.truncated)
        values = look(world, Moment(robots, policy, outcome, after))
        return (after, alive), StepRecords(alive, values)

    return jax.lax.scan(step, carry, None, length=count)


def terrain_under(
    atlas: Atlas, x: Float[np.ndarray, "T E"], before: float = BEFORE
) -> Shaped[np.ndarray, "T E"]:
    """Classify the ground under each robot at `x`, m along its lane.

    On stairs: the direction of the flight at `x`, else of that `before` m ahead. On other lanes:
    the kind from `before` m before the first obstacle to the last one, and "" elsewhere; the kind
    throughout if there are no obstacles.
    """
    names = np.full(x.shape, "", dtype="U16")
    for e, (kind, level) in enumerate(zip(*round_robin_lanes(atlas, x.shape[1]), strict=True)):
        names[:, e] = _terrain_on_lane(atlas.tile(level, kind), atlas.kinds[kind], x[:, e], before)
    return names


def _terrain_on_lane(
    ground: Terrain, kind: str, x: Float[np.ndarray, "*n"], before: float
) -> Shaped[np.ndarray, "*n"]:
    """Classify the ground under robots that share this lane."""
    if kind in STAIRS:
        shape = cross_section.from_lane(ground)
        way = cross_section.flight_at(shape, x)
        way = np.where(way == 0, cross_section.flight_at(shape, x + before), way)
        return np.array(["", "stairs up", "stairs down"])[way]
    heights, _ = robot_scene.window(ground)
    uneven = ground.cell * np.flatnonzero(heights.any(axis=1))
    if not uneven.size:
        return np.full(x.shape, kind)
    over = (x >= uneven[0] - before) & (x <= uneven[-1] + ground.cell)
    return np.where(over, kind, "")


def find_onsets(flag: Bool[np.ndarray, "*n"]) -> Bool[np.ndarray, "*n"]:
    """Find where a flag is raised along the first axis, time; a flag set at first counts."""
    before = np.concatenate([np.zeros_like(flag[:1]), flag[:-1]])
    return flag & ~before


def write_csv(out: Path, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a .csv: a header, then the rows; numbers have up to six digits."""
    to_text = lambda x: f"{x:.6g}" if isinstance(x, float | np.floating) else x
    with out.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows([to_text(x) for x in row] for row in rows)
