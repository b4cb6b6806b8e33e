"""Measure this machine: `python -m cref_jax.bench`.

Every figure of a table comes from one run, so that they can be compared with each other. Each is
the best of several repetitions, which disturbs less than a mean by what else the machine does. A
stage's share is that of the least time that its matrix products, at the rate of a large one, or its
arrays, at the rate of a copy, would take here; that of the physics is MuJoCo's own batch.
"""

import functools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import tyro
from jax.sharding import PartitionSpec as P
from rich.console import Console
from rich.table import Table

from cref_jax import cli, config
from cref_jax.benchmarks import brax_peer, roofline, stages, warp_raycast
from cref_jax.benchmarks.roofline import Rates
from cref_jax.config import Config, limits, presets
from cref_jax.env.world import World, build_world
from cref_jax.physics.records import EngineName
from cref_jax.physics.simulation import resolve_engine
from cref_jax.system import jax_setup, parallel
from cref_jax.terrain import lanes
from cref_jax.training import devices, iteration, rollout

FOOTHOLD, ITERATION = "foothold reward", "iteration of make train"
BLIND, BRAX = "iteration on flat ground, blind", "iteration of brax's PPO, the same"


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Measure steps a second by stage, and how the engines compare."""

    terrain: str = "mixed"
    """what the robots stand on"""
    num_envs: tuple[int, ...] = (64, 256)
    """robots at once, one column of stages for each"""
    repeats: int = 5
    """the best of so many is taken"""
    engines: tuple[EngineName, ...] = ()
    """engines to compare with this machine's own, with the last number of robots; with mjx on a
    CPU, XLA gets threads to spare, which slows down everything else here"""
    brax: bool = True
    """compare brax's PPO on flat ground, too, without a camera"""
    depth: bool = True
    """compare the depth camera with MuJoCo's ray-cast, too, and with NVIDIA Warp's if installed"""
    out: Path | None = None
    """write the figures as JSON, too"""


class Row(NamedTuple):
    """One measured stage."""

    stage: str
    robots: int
    seconds: float  # for one control step of all robots
    compile_seconds: float
    share: float | None = None  # of what the machine allows; None where nothing says what it does


def main() -> None:
    """Run the command line."""
    options = tyro.cli(Options, prog="python -m cref_jax.bench")
    with cli.one_line_errors(options.debug):
        jax_setup.prepare(options.engines)
        rates = roofline.measure()
        rows = measure(options, rates)
        speeds = compare_depth(options) if options.depth else []
        show(options, rates, rows, speeds)
        if options.out:
            found = as_json(options, rates, rows, speeds)
            options.out.write_text(json.dumps(found, indent=2) + "\n")


def measure(options: Options, rates: Rates) -> list[Row]:
    """Return every stage's time."""
    rows, console = [], Console()
    for count in options.num_envs:
        with console.status(f"{count} robots: compiling and timing"):
            rows += _stages(options, rates, count)
    most = options.num_envs[-1]
    for engine in options.engines:
        if engine != resolve_engine("auto"):
            with console.status(f"engine {engine}: compiling and timing"):
                world, state = _started(_config(options, most), engine)
                rows += _engine(options, rates, engine, world, state.robots)
    with console.status("whole iteration: compiling and timing"):
        rows.append(_iteration(options, ITERATION, _preset(options.terrain)))
    if options.brax:
        with console.status("brax's PPO: compiling and timing"):
            rows += _learners(options)
    return rows


def _learners(options: Options) -> list[Row]:
    """Return the time of an iteration of ours and of brax's PPO, on flat ground and blind."""
    c = _preset("flat", {"network": {"variant": "blind"}})
    seconds = c.run.num_envs / brax_peer.samples_per_second(c)
    return [_iteration(options, BLIND, c), Row(BRAX, c.run.num_envs, seconds, 0.0)]


def _stages(options: Options, rates: Rates, count: int) -> list[Row]:
    """Return the times of the stages for so many robots."""
    world, state = _started(_config(options, count), resolve_engine("auto"))
    timed = functools.partial(_timed, options, rates, count)
    return [
        *_engine(options, rates, resolve_engine("auto"), world, state.robots),
        timed("terrain query", stages.query_terrain, world, state.robots),
        timed("depth, 20 Hz", stages.render_frames, world, state.robots),
        timed(FOOTHOLD, stages.find_footholds, world, state.robots),
        # no share: work_of does not know in how many of the steps a frame is encoded
        timed("policy", stages.run_policy, world, state)._replace(share=None),
        timed("update, one epoch", stages.update, world, state),
    ]


def _engine(
    options: Options, rates: Rates, engine: EngineName, world: World, robots: rollout.Robots
) -> list[Row]:
    """Return the times of a step with this engine, beside MuJoCo's own batch."""
    count = len(robots.begins)
    timed = functools.partial(_timed, options, rates, count)
    whole = timed(f"environment step, {engine}", stages.step_environment, world, robots)
    ours = timed(f"physics, {engine}", stages.step_physics, world, robots)
    whole, ours = whole._replace(share=None), ours._replace(share=None)
    if engine != "mujoco":
        return [whole, ours]
    substeps, threads = world.config.physics.substeps, parallel.cores()
    alone = warp_raycast.raw_substep(
        world.physics, robots.env.body, threads, stages.STEPS * substeps, options.repeats
    )
    raw = Row("physics, MuJoCo's own batch", count, alone * substeps, 0.0)
    return [whole, ours._replace(share=raw.seconds / ours.seconds), raw]


def _config(options: Options, count: int) -> Config:
    return _preset(options.terrain, {"run": {"num_envs": count}, "ppo": {"epochs": 1}})


def _preset(terrain: str, changes: dict[str, Any] | None = None) -> Config:
    """Return the settings of `make train` on this device, with these changes.

    Raises:
        ConfigError: the terrain or a setting cannot be used.
    """
    device = "cpu" if jax.default_backend() == "cpu" else "gpu"
    c = config.override(presets.build_config(terrain, None, device), changes or {})
    limits.check(c)
    return c


def _started(c: Config, engine: EngineName) -> tuple[World, iteration.RunState]:
    """Return the world and the first state of a run, shared out among the devices."""
    mesh = devices.mesh_of(c)
    world = build_world(c, engine, max(parallel.cores() // mesh.size, 1))
    return world, jax.jit(iteration.initial_state, static_argnames="mesh")(world, mesh)


def compare_depth(options: Options) -> list[warp_raycast.Speed]:
    """Return the speed of the depth camera and of NVIDIA Warp's ray-cast, on a flight of stairs."""
    c = config.override(Config(), {"terrain": {"name": "stairs"}})
    lane = lanes.single(c.terrain, "stairs_up", 0.15)
    with Console().status("depth: compiling and timing"):
        return warp_raycast.compare(lane.tile(0, 0), c.camera, lane.is_profile[0])


def show(options: Options, rates: Rates, rows: list[Row], speeds: list[warp_raycast.Speed]) -> None:
    """Print the tables and the ratios that the design promises."""
    table = Table(title=f"{options.terrain}, {_machine()}")
    columns = (
        "stage",
        "robots",
        "ms a control step",
        "robot steps/s",
        "of the machine",
        "compiled in s",
    )
    for column in columns:
        table.add_column(column, justify="left" if column == "stage" else "right")
    for row in rows:
        times = f"{1e3 * row.seconds:.2f}", f"{row.robots / row.seconds:,.0f}"
        share = "" if row.share is None else f"{row.share:.0%}"
        table.add_row(row.stage, str(row.robots), *times, share, f"{row.compile_seconds:.1f}")
    products, memory = rates.products / 1e9, rates.memory / 1e9
    console = Console()
    console.print(f"matrix products {products:,.0f} GFLOP/s, memory {memory:,.1f} GB/s, one device")
    console.print(table)
    for name, ratio in ratios(rows).items():
        console.print(f"{name}: {ratio:,.3g}")
    if not speeds:
        return
    table = Table(title="depth images of stairs, 64 x 48")
    for column in ("renderer", "frames/s", "threads", "pixels within 1 cm"):
        table.add_column(column, justify="left" if column == "renderer" else "right")
    for s in speeds:
        table.add_row(s.renderer, f"{s.frames_per_second:,.0f}", s.threads, f"{s.agreement:.1%}")
    console.print(table)


def ratios(rows: list[Row]) -> dict[str, float]:
    """Return the comparisons, as far as their stages were measured, of the most robots."""
    seconds = {row.stage: row.seconds / row.robots for row in rows}
    steps = {e: seconds.get(f"environment step, {e}") for e in ("mujoco", "mjx")}
    found = {}
    if steps["mujoco"] and steps["mjx"]:
        gain = steps["mjx"] / steps["mujoco"]
        found["engine mujoco over engine mjx, environment steps/s"] = gain
    fastest = min((s for s in steps.values() if s), default=None)
    if fastest:
        found["terrain query, share of an environment step"] = seconds["terrain query"] / fastest
    found["foothold reward, share of an iteration"] = seconds[FOOTHOLD] / seconds[ITERATION]
    if BRAX in seconds:
        found["our PPO over brax's, samples/s"] = seconds[BRAX] / seconds[BLIND]
    return found


def as_json(
    options: Options, rates: Rates, rows: list[Row], speeds: list[warp_raycast.Speed]
) -> dict[str, Any]:
    """Return all figures with where they were measured."""
    return {
        "machine": _machine(),
        "rates": rates._asdict(),
        "terrain": options.terrain,
        "rows": [row._asdict() for row in rows],
        "ratios": ratios(rows),
        "depth": [speed._asdict() for speed in speeds],
    }


def _machine() -> str:
    device = jax.devices()[0]
    return f"{device.device_kind} x {jax.device_count()}, {os.cpu_count()} CPU cores"


def _timed(
    options: Options,
    rates: Rates,
    count: int,
    stage: str,
    make: Callable[..., Any],
    world: World,
    state: rollout.Robots | iteration.RunState,
) -> Row:
    """Compile a stage and return its best time for one control step.

    Every device does it with its own robots, as in training.
    """
    mesh, parts = devices.mesh_of(world.config), iteration.partition(world)
    part = parts if isinstance(state, iteration.RunState) else parts.robots
    shared = functools.partial(jax.shard_map, mesh=mesh, out_specs=P(), check_vma=False)
    # the world is closed over, so not counted: of all lanes a stage reads a little
    alone = shared(functools.partial(make, world), in_specs=(part,))
    work = roofline.work_of(alone, state)
    least = work._replace(moved=work.moved // mesh.size).seconds(rates)
    begun = time.perf_counter()
    program = jax.jit(shared(make, in_specs=(P(), part))).lower(world, state).compile()
    compiled = time.perf_counter() - begun
    run = lambda: jax.block_until_ready(program(world, state))
    seconds = warp_raycast.shortest(run, options.repeats)
    return Row(stage, count, seconds / stages.STEPS, compiled, least / seconds)


def _iteration(options: Options, stage: str, c: Config) -> Row:
    """Return the time of a whole iteration of `make train` with these settings."""
    mesh = devices.mesh_of(c)
    world, state = _started(c, resolve_engine("auto"))
    begun = time.perf_counter()
    program = iteration.chunk.lower(world, state, mesh, c.run.chunk).compile()
    compiled = time.perf_counter() - begun
    run = {"state": state}  # each call consumes the state that it is given

    def step() -> Any:
        run["state"], log = program(world, run["state"])
        return jax.block_until_ready(log)

    seconds = warp_raycast.shortest(step, options.repeats)
    return Row(stage, c.run.num_envs, seconds / (c.ppo.horizon * c.run.chunk), compiled)


if __name__ == "__main__":
    main()
