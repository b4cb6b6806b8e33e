"""Benchmark this machine: `python -m cref_jax.bench`.

All figures of a table come from one run and are therefore comparable. Each is the fastest of
several repetitions, which is less sensitive to other load than a mean. The share of a stage is its
roofline bound over its time: the bound is that of its matrix products at the rate of a large one or
of its arrays at the rate of a copy. The bound of the physics is MuJoCo's own batch.
"""

import cref_jax.system.startup  # noqa: F401

import functools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
from jax.sharding import PartitionSpec as P
from rich.console import Console
from rich.table import Table

from cref_jax import cli, config, robot
from cref_jax.benchmarks import brax_peer, roofline, stages, warp_raycast
from cref_jax.benchmarks.roofline import Rates
from cref_jax.config import Config, limits, presets
from cref_jax.config.ranges import Within
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.physics.records import EngineName
from cref_jax.physics.simulation import resolve_engine
from cref_jax.system import jax_setup, parallel
from cref_jax.terrain import lanes
from cref_jax.training import devices, iteration, rollout

STEP = "environment step, "  # before the name of an engine
FOOTHOLD, ITERATION = "foothold reward", "iteration of make train"
BLIND, BRAX = "iteration on flat ground, blind", "iteration of brax's PPO, the same"


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Measure the time of each stage and compare the engines."""

    terrain: str = "mixed"
    """terrain name"""
    robot: str | None = None
    """a robot by name (default: the first)"""
    num_envs: Annotated[tuple[int, ...], Within(1, 1_000_000)] = (64, 256)
    """numbers of parallel robots; every stage is measured with each"""
    repeats: Annotated[int, Within(1, 1000)] = 5
    """repetitions; the fastest is reported"""
    engines: tuple[EngineName, ...] = ()
    """engines to compare with the default one, at the last number of robots; mjx on a CPU gives
    XLA spare threads, which slow down all other stages"""
    brax: bool = True
    """also compare brax's PPO, on flat ground without a camera"""
    depth: bool = True
    """also compare the depth camera with MuJoCo's ray-cast and, if installed, NVIDIA Warp's"""
    out: Path | None = None
    """also write the figures to this JSON file"""


class StageTime(NamedTuple):
    """One measured stage."""

    stage: str
    robots: int
    seconds: float  # per control step of all robots
    compile_seconds: float
    share: float | None = None  # of the machine's bound; None if that is unknown


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "bench")
        jax_setup.prepare(options.engines)
        if not options.num_envs:
            raise ConfigError("--num-envs takes at least one number of robots")
        if options.out:
            cli.prepare_output(options.out, ".json")
        for count in options.num_envs:
            _stage_config(options, count)  # what cannot run is said before anything is measured
        robots = " and ".join(map(str, options.num_envs))
        print(f"{options.terrain}, {robots} robots, on {_machine_name()}", flush=True)
        rates = roofline.measure_rates()
        rows = measure_stages(options, rates)
        speeds = compare_depth(options) if options.depth else []
        show(options, rates, rows, speeds)
        if options.out:
            record = as_json(options, rates, rows, speeds)
            options.out.write_text(json.dumps(record, indent=2) + "\n")


def measure_stages(options: Options, rates: Rates) -> list[StageTime]:
    """Measure every stage for each number of robots, and the whole iteration."""
    rows, console = [], Console()
    for count in options.num_envs:
        with console.status(f"{count} robots: compiling and timing"):
            rows += _measure_stages(options, rates, count)
    most = options.num_envs[-1]
    for engine in options.engines:
        if engine != resolve_engine("auto"):
            with console.status(f"engine {engine}: compiling and timing"):
                world, state = _init_run(_stage_config(options, most), engine)
                rows += _measure_engine(options, rates, engine, world, state.robots)
    with console.status("whole iteration: compiling and timing"):
        c = _build_preset(options, options.terrain)
        rows.append(_time_iteration(options, ITERATION, c))
    if options.brax:
        with console.status("brax's PPO: compiling and timing"):
            rows += _measure_learners(options)
    return rows


def _measure_learners(options: Options) -> list[StageTime]:
    """Measure an iteration of our PPO and of brax's, blind on flat ground."""
    c = _build_preset(options, "flat", {"network": {"variant": "blind"}})
    seconds = c.run.num_envs / brax_peer.measure_samples_per_second(c)
    return [_time_iteration(options, BLIND, c), StageTime(BRAX, c.run.num_envs, seconds, 0.0)]


def _measure_stages(options: Options, rates: Rates, count: int) -> list[StageTime]:
    """Measure the stages with `count` robots."""
    world, state = _init_run(_stage_config(options, count), resolve_engine("auto"))
    measure = functools.partial(_time_stage, options, rates, count)
    return [
        *_measure_engine(options, rates, resolve_engine("auto"), world, state.robots),
        measure("terrain query", stages.query_terrain, world, state.robots),
        measure("depth, 20 Hz", stages.render_frames, world, state.robots),
        measure(FOOTHOLD, stages.find_footholds, world, state.robots),
        # no share: count_work cannot know in how many steps a frame is encoded
        measure("policy", stages.run_policy, world, state)._replace(share=None),
        measure("update, one epoch", stages.update, world, state),
    ]


def _measure_engine(
    options: Options, rates: Rates, engine: EngineName, world: World, robots: rollout.Robots
) -> list[StageTime]:
    """Measure a control step with this engine and, for mujoco, that of MuJoCo's own batch."""
    count = len(robots.begins)
    measure = functools.partial(_time_stage, options, rates, count)
    whole = measure(STEP + engine, stages.step_environment, world, robots)
    ours = measure(f"physics, {engine}", stages.step_physics, world, robots)
    whole, ours = whole._replace(share=None), ours._replace(share=None)
    if engine != "mujoco":
        return [whole, ours]
    substeps, threads = world.config.physics.substeps, parallel.cores()
    substep = warp_raycast.time_raw_substep(
        world.physics, robots.env.body, threads, stages.STEPS * substeps, options.repeats
    )
    raw = StageTime("physics, MuJoCo's own batch", count, substep * substeps, 0.0)
    return [whole, ours._replace(share=raw.seconds / ours.seconds), raw]


def _stage_config(options: Options, count: int) -> Config:
    changes = {"run": {"num_envs": count}, "ppo": {"epochs": 1}}
    return _build_preset(options, options.terrain, changes)


def _build_preset(options: Options, terrain: str, changes: dict[str, Any] | None = None) -> Config:
    """Build the settings of `make train` on this device, with these changes.

    Raises:
        ConfigError: the terrain, the robot or a setting is invalid.
    """
    device = "cpu" if jax.default_backend() == "cpu" else "gpu"
    c = config.override(presets.build_config(terrain, None, device), changes or {})
    limits.check(c)
    return robot.fill_in(c, options.robot)


def _init_run(c: Config, engine: EngineName) -> tuple[World, iteration.RunState]:
    """Build the world and the initial state of a run, sharded over the devices."""
    mesh = devices.choose_mesh(c)
    world = build_world(c, engine, max(parallel.cores() // mesh.size, 1))
    return world, jax.jit(iteration.initial_state, static_argnames="mesh")(world, mesh)


def compare_depth(options: Options) -> list[warp_raycast.Speed]:
    """Measure the depth camera and its peers on a flight of stairs."""
    c = config.override(robot.fill_in(Config(), options.robot), {"terrain": {"name": "stairs"}})
    lane = lanes.build_single(c.terrain, "stairs_up", 0.15)
    with Console().status("depth: compiling and timing"):
        return warp_raycast.compare_renderers(lane.tile(0, 0), c.camera, lane.is_profile[0])


def show(
    options: Options, rates: Rates, rows: list[StageTime], speeds: list[warp_raycast.Speed]
) -> None:
    """Print the tables and the ratios."""
    table = Table(title=f"{robot.name_robot(options.robot)}, {options.terrain}, {_machine_name()}")
    columns = (
        "stage",
        "robots",
        "ms per control step",
        "robot steps/s",
        "share of bound",
        "compile time, s",
    )
    for column in columns:
        table.add_column(column, justify="left" if column == "stage" else "right")
    for row in rows:
        times = f"{1e3 * row.seconds:.2f}", f"{row.robots / row.seconds:,.0f}"
        share = "" if row.share is None else f"{row.share:.0%}"
        table.add_row(row.stage, str(row.robots), *times, share, f"{row.compile_seconds:.1f}")
    products, memory = rates.products / 1e9, rates.memory / 1e9
    console = Console()
    console.print(f"matrix products {products:,.0f} GFLOP/s, memory {memory:,.1f} GB/s per device")
    cli.print_table(table)
    for name, ratio in ratios(rows).items():
        console.print(f"{name}: {ratio:,.3g}")
    if not speeds:
        return
    table = Table(title="depth images of stairs, 64 x 48")
    for column in ("renderer", "frames/s", "threads", "pixels within 1 cm"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    for s in speeds:
        table.add_row(s.renderer, f"{s.frames_per_second:,.0f}", s.threads, f"{s.agreement:.1%}")
    cli.print_table(table)


def ratios(rows: list[StageTime]) -> dict[str, float]:
    """Compute the ratios between measured stages, for the largest number of robots."""
    seconds = {row.stage: row.seconds / row.robots for row in rows}
    steps = {stage.removeprefix(STEP): s for stage, s in seconds.items() if stage.startswith(STEP)}
    result = {}
    if "mujoco" in steps and "mjx" in steps:
        gain = steps["mjx"] / steps["mujoco"]
        result["engine mujoco over engine mjx, environment steps/s"] = gain
    share = seconds["terrain query"] / min(steps.values())
    result["terrain query, share of an environment step"] = share
    result["foothold reward, share of an iteration"] = seconds[FOOTHOLD] / seconds[ITERATION]
    if BRAX in seconds:
        result["our PPO over brax's, samples/s"] = seconds[BRAX] / seconds[BLIND]
    return result


def as_json(
    options: Options, rates: Rates, rows: list[StageTime], speeds: list[warp_raycast.Speed]
) -> dict[str, Any]:
    """Build the JSON record of all figures and of the machine."""
    return {
        "machine": _machine_name(),
        "rates": rates._asdict(),
        "terrain": options.terrain,
        "robot": robot.name_robot(options.robot),
        "rows": [row._asdict() for row in rows],
        "ratios": ratios(rows),
        "depth": [speed._asdict() for speed in speeds],
    }


def _machine_name() -> str:
    device = jax.devices()[0]
    return f"{device.device_kind} x {jax.device_count()}, {os.cpu_count()} CPU cores"


def _time_stage(
    options: Options,
    rates: Rates,
    count: int,
    stage: str,
    make: Callable[..., Any],
    world: World,
    state: rollout.Robots | iteration.RunState,
) -> StageTime:
    """Compile a stage and measure its best time per control step.

    Each device runs it with its own robots, as in training.
    """
    mesh, parts = devices.choose_mesh(world.config), iteration.partition(world)
    part = parts if isinstance(state, iteration.RunState) else parts.robots
    shared = functools.partial(jax.shard_map, mesh=mesh, out_specs=P(), check_vma=False)
    # the world is closed over and not counted, since a stage reads little of all lanes
    alone = shared(functools.partial(make, world), in_specs=(part,))
    work = roofline.count_work(alone, state)
    least = work._replace(moved=work.moved // mesh.size).seconds(rates)
    started_at = time.perf_counter()
    program = jax.jit(shared(make, in_specs=(P(), part))).lower(world, state).compile()
    compile_seconds = time.perf_counter() - started_at
    run = lambda: jax.block_until_ready(program(world, state))
    seconds = warp_raycast.shortest_time(run, options.repeats)
    return StageTime(stage, count, seconds / stages.STEPS, compile_seconds, least / seconds)


def _time_iteration(options: Options, stage: str, c: Config) -> StageTime:
    """Measure a whole iteration of `make train` with these settings, per control step."""
    mesh = devices.choose_mesh(c)
    world, state = _init_run(c, resolve_engine("auto"))
    started_at = time.perf_counter()
    program = iteration.chunk.lower(world, state, mesh, c.run.chunk).compile()
    compile_seconds = time.perf_counter() - started_at
    run = {"state": state}  # each call donates its input state

    def step() -> Any:
        run["state"], log = program(world, run["state"])
        return jax.block_until_ready(log)

    seconds = warp_raycast.shortest_time(step, options.repeats)
    return StageTime(
        stage, c.run.num_envs, seconds / (c.ppo.horizon * c.run.chunk), compile_seconds
    )


if __name__ == "__main__":
    main()
