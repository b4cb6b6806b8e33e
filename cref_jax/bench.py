"""Measure this machine: `python -m cref_jax.bench`.

Every figure of a table comes from one run, so that they can be compared with each other. Each is
the best of several repetitions, which disturbs less than a mean by what else the machine does. A
stage's share is that of the least time that its matrix products, at the rate of a large one, or its
arrays, at the rate of a copy, would take here; that of the physics is MuJoCo's own batch.
"""

import dataclasses
import functools
import json
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import tyro
from rich.console import Console
from rich.table import Table

from cref_jax import (
    brax_peer,
    cli,
    config,
    depth,
    env,
    foothold,
    lanes,
    learn,
    peers,
    ppo,
    processes,
    rollout,
    roofline,
    runs,
)
from cref_jax.config import Config
from cref_jax.physics import EngineName, resolve_engine
from cref_jax.roofline import Rates
from cref_jax.world import World

STEPS = 12  # control steps of one timed call
FOOTHOLD, ITERATION = "foothold reward", "iteration of make train"
BLIND, BRAX = "iteration on flat ground, blind", "iteration of brax's PPO, the same"


@dataclass(frozen=True)
class Options:
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
    debug: bool = False
    """show the traceback of an error"""


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
        cli.prepare(options.engines)
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
                world = runs.world_of(_config(options, most), engine)
                rows += _engine(options, rates, engine, world, _started(world, most))
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
    world = runs.world_of(_config(options, count), resolve_engine("auto"))
    state = jax.jit(learn.initial_state)(world)
    timed = functools.partial(_timed, options, rates, count)
    return [
        *_engine(options, rates, resolve_engine("auto"), world, state.robots),
        timed("terrain query", _queries, world, state.robots),
        timed("depth, 20 Hz", _frames, world, state.robots),
        timed(FOOTHOLD, _footholds, world, state.robots),
        timed("policy", _policy, world, state),
        timed("update, one epoch", _update, world, state),
    ]


def _engine(
    options: Options, rates: Rates, engine: EngineName, world: World, robots: rollout.Robots
) -> list[Row]:
    """Return the times of a step with this engine, beside MuJoCo's own batch."""
    count = len(robots.begins)
    timed = functools.partial(_timed, options, rates, count)
    rows = [
        timed(f"environment step, {engine}", _steps, world, robots)._replace(share=None),
        timed(f"physics, {engine}", _physics, world, robots)._replace(share=None),
    ]
    if engine != "mujoco":
        return rows
    substeps, threads = world.config.physics.substeps, processes.cores()
    alone = peers.raw_substep(
        world.physics, robots.env.body, threads, STEPS * substeps, options.repeats
    )
    raw = Row("physics, MuJoCo's own batch", count, alone * substeps, 0.0)
    return [rows[0], rows[1]._replace(share=raw.seconds / rows[1].seconds), raw]


def _config(options: Options, count: int) -> Config:
    return _preset(options.terrain, {"run": {"num_envs": count}, "ppo": {"epochs": 1}})


def _preset(terrain: str, changes: dict[str, Any] | None = None) -> Config:
    """Return the settings of `make train` on this device, with these changes.

    Raises:
        ConfigError: the terrain or a setting cannot be used.
    """
    device = "cpu" if jax.default_backend() == "cpu" else "gpu"
    c = config.override(runs.composed(terrain, None, device), changes or {})
    config.check(c)
    return c


def _started(world: World, count: int) -> rollout.Robots:
    start = jax.jit(rollout.start, static_argnames="num_envs")
    return start(world, jax.random.key(0), count)


def compare_depth(options: Options) -> list[peers.Speed]:
    """Return the speed of the depth camera and of NVIDIA Warp's ray-cast, on a flight of stairs."""
    c = config.override(Config(), {"terrain": {"name": "stairs"}})
    lane = lanes.single(c.terrain, "stairs_up", 0.15)
    with Console().status("depth: compiling and timing"):
        return peers.compare(lane.tile(0, 0), c.camera, lane.is_profile[0])


def show(options: Options, rates: Rates, rows: list[Row], speeds: list[peers.Speed]) -> None:
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
    options: Options, rates: Rates, rows: list[Row], speeds: list[peers.Speed]
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
    *arguments: Any,
) -> Row:
    """Compile a stage and return its best time for one control step."""
    # the world is closed over, so not counted: of all lanes a stage reads a little
    least = roofline.work_of(functools.partial(make, world), *arguments).seconds(rates)
    begun = time.perf_counter()
    program = jax.jit(make).lower(world, *arguments).compile()
    compiled = time.perf_counter() - begun
    run = lambda: jax.block_until_ready(program(world, *arguments))
    seconds = peers.shortest(run, options.repeats)
    return Row(stage, count, seconds / STEPS, compiled, least / seconds)


def _iteration(options: Options, stage: str, c: Config) -> Row:
    """Return the time of a whole iteration of `make train` with these settings."""
    mesh = runs.mesh_of(c)
    world = runs.world_of(c, resolve_engine("auto"), max(processes.cores() // mesh.size, 1))
    state = jax.jit(learn.initial_state, static_argnames="mesh")(world, mesh)
    begun = time.perf_counter()
    program = learn.chunk.lower(world, state, mesh, c.run.chunk).compile()
    compiled = time.perf_counter() - begun
    run = {"state": state}  # each call consumes the state that it is given

    def step() -> Any:
        run["state"], log = program(world, run["state"])
        return jax.block_until_ready(log)

    seconds = peers.shortest(step, options.repeats)
    return Row(stage, c.run.num_envs, seconds / (c.ppo.horizon * c.run.chunk), compiled)


def _steps(world: World, robots: rollout.Robots) -> Any:
    """Step the whole environment under small random actions."""
    joints = robots.env.action.shape[-1]

    def step(state: env.EnvState, key: jax.Array) -> tuple[env.EnvState, Any]:
        action = 0.3 * jax.random.normal(key, (*state.step.shape, joints))
        state, outcome = env.step_all(world, state, action)
        return state, (outcome.reward.sum(), outcome.observation.privileged.sum())

    return jax.lax.scan(step, robots.env, jax.random.split(jax.random.key(1), STEPS))


def _physics(world: World, robots: rollout.Robots) -> Any:
    """Step the physics alone, with its terrain queries."""
    target = jnp.asarray(world.physics.robot.nominal_pose)

    def one(state: env.EnvState, body: Any) -> Any:
        ground = world.lanes.tile(state.level, state.kind)
        return world.physics.step(
            ground, body, jnp.stack([target, target]), state.delay, state.dynamics
        )[0]

    step = lambda body, _: (jax.vmap(one)(robots.env, body), None)
    return jax.lax.scan(step, robots.env.body, None, length=STEPS)[0]


def _queries(world: World, robots: rollout.Robots) -> Any:
    """Ask for the tangent planes of all spheres, as often as a control step does."""

    def one(state: env.EnvState, body: Any) -> Any:
        return world.physics.planes(world.lanes.tile(state.level, state.kind), body)

    def query(body: Any, _: None) -> tuple[Any, None]:
        position, rotation = jax.vmap(one)(robots.env, body)
        moved = 1e-6 * (position.sum(axis=(1, 2)) + rotation.sum(axis=(1, 2)))
        return body._replace(qpos=body.qpos.at[:, 0].add(moved)), None  # or it would be hoisted

    count = STEPS * world.config.physics.substeps
    return jax.lax.scan(query, robots.env.body, None, length=count)[0]


def _frames(world: World, robots: rollout.Robots) -> Any:
    """Render as many images as come in so many control steps."""
    c = world.config
    count = depth.most_frames(STEPS, c.camera, c.physics.control_period)

    def render(state: env.EnvState, _: None) -> tuple[env.EnvState, None]:
        images = rollout.exposed(world, state)
        moved = 1e-9 * images.sum(axis=(1, 2, 3), dtype=jnp.float32)  # or it would be hoisted
        return state.replace(camera_pitch=state.camera_pitch + moved), None

    return jax.lax.scan(render, robots.env, None, length=count)[0]


def _footholds(world: World, robots: rollout.Robots) -> Any:
    """Find candidates and measure the distance to them, as each control step does."""
    c = world.config.foothold

    def one(state: env.EnvState, body: Any) -> Any:
        ground = world.lanes.tile(state.level, state.kind)
        soles = foothold.soles(world.physics.links(body), world.physics.robot)
        near = foothold.distance(state.candidates, soles.centre)
        ahead = foothold.candidates(ground, soles.centre, soles.heading, state.command[0], c)
        lost = foothold.unsupported(ground, soles, c)
        return near.sum() + ahead.z.sum() + ahead.accepted.sum() + lost.sum()

    def find(body: Any, _: None) -> tuple[Any, None]:
        found = jax.vmap(one)(robots.env, body)
        moved = 1e-9 * jnp.where(jnp.isfinite(found), found, 0.0)
        return body._replace(qpos=body.qpos.at[:, 0].add(moved)), None  # or it would be hoisted

    return jax.lax.scan(find, robots.env.body, None, length=STEPS)[0]


def _policy(world: World, state: learn.RunState) -> Any:
    """Run the policy alone."""
    nets = rollout.networks(world.config.network, state.robots.env.action.shape[-1])

    def step(robots: rollout.Robots, _: None) -> tuple[rollout.Robots, Any]:
        memory, policy = rollout.act(nets, state.train, robots)
        return robots.replace(memory=memory), policy.mean.sum()

    return jax.lax.scan(step, state.robots, None, length=STEPS)


def _update(world: World, state: learn.RunState) -> Any:
    """Run one epoch of the update on a rollout of zeros with the right shapes."""
    c = world.config
    c = dataclasses.replace(c, ppo=dataclasses.replace(c.ppo, horizon=STEPS))
    nets = rollout.networks(c.network, state.robots.env.action.shape[-1])
    collect = functools.partial(rollout.collect, dataclasses.replace(world, config=c), nets)
    shapes = jax.eval_shape(collect, state.train, state.robots, jax.random.key(0))[1]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return ppo.update(state.train, zeros, jax.random.key(0), c.ppo, nets.functions)


if __name__ == "__main__":
    main()
