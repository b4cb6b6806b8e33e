"""Train a policy: `python -m cref_jax.train --terrain gap`."""

import cref_jax.system.startup  # noqa: F401

import contextlib
import dataclasses
import datetime
import json
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import jax
import tyro
from jax.sharding import Mesh

from cref_jax import cli
from cref_jax.benchmarks import profiled
from cref_jax.config import Config, folders, limits, presets
from cref_jax.env.world import World, build_physics, build_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import walking
from cref_jax.physics.records import EngineName
from cref_jax.physics.simulation import resolve_engine
from cref_jax.policy import sources, trained, warm_start
from cref_jax.rendering import map_plot
from cref_jax.robot import ROBOTS, fill_in
from cref_jax.system import jax_setup, parallel
from cref_jax.system.interrupts import StopRequest
from cref_jax.terrain import map_files
from cref_jax.terrain.kind_files import terrain_names
from cref_jax.training import (
    devices,
    distillation,
    imitation,
    iteration,
    processes,
    resumption,
    run_dir,
    trainer,
    wandb_log,
)
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.progress import Reporter, SilentReporter
from cref_jax.training.run_lock import lock

PROGRAM = "python -m cref_jax.train"


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Options besides the settings of the run."""

    terrain: Annotated[
        str,
        tyro.conf.arg(help=f"{', '.join(terrain_names())}, or a height map: path.npy, path.png"),
    ] = "flat"
    experiment: str | None = None
    """a file in experiments/ (without .toml) or a path: differences from the defaults"""
    robot: Annotated[
        str | None, tyro.conf.arg(help=f"{', '.join(ROBOTS)}; short for --robot.name")
    ] = None
    num_envs: int | None = None
    """environments; short for --run.num-envs"""
    iterations: int | None = None
    """total iterations; short for --run.iterations"""
    seed: int | None = None
    """short for --run.seed"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx and warp on the device"""
    device: devices.Device = "auto"
    """where the program runs; gpu is an error without one"""
    devices: int | None = None
    """devices to shard the environments over (default: all; one per CPU core)"""
    distributed: bool = False
    """train together with the other processes that Slurm, Open MPI or Kubernetes started"""
    coordinator: str | None = None
    """host:port of process 0, where nothing starts the processes; with the next two"""
    num_processes: int | None = None
    """processes that train together"""
    process_id: int | None = None
    """number of this one, from 0"""
    run_dir: Path | None = None
    """folder of the run (default: runs/TERRAIN-EXPERIMENT-DATE)"""
    init: Path | None = None
    """begin as this run, learner file (export --learner) or exported policy; where it has no critic
    of this network, the critic learns alone first"""
    resume: bool = False
    """continue the run in --run-dir, or the newest one"""
    print_config: bool = False
    """print every setting as JSON and stop"""
    evaluate: bool = True
    """evaluate 100 episodes on flat ground at the end"""
    tensorboard: bool = True
    """write TensorBoard files"""
    profile: bool = False
    """trace one call of the program: stages.json in the run's folder holds its time by stage"""
    wandb: bool = False
    """log to Weights & Biases as well (pip install 'cref-jax[wandb]'): offline without a login"""


@dataclass(frozen=True)
class Command:
    """Train a policy. Every setting of the run is also an option."""

    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    given, arguments = arguments, sys.argv[1:] if arguments is None else arguments
    with processes.ending_together(), cli.one_line_errors(given):
        cli.check_arguments(arguments)
        asked = _options(arguments)
        jax_setup.prepare([asked.engine])
        others = asked.coordinator, asked.num_processes, asked.process_id
        if asked.distributed or any(x is not None for x in others):
            processes.join(*others)
        options, c = parse(arguments)
        if options.print_config:
            print(json.dumps(dataclasses.asdict(c), indent=2))
            return
        train(options, c, arguments)


def parse(arguments: list[str]) -> tuple[Options, Config]:
    """Parse the command line.

    The settings are the paper's, changed by the device's preset, by the experiment and by the
    command line, in this order; those of a run that is resumed are its own.

    Raises:
        ConfigError: a value that cannot be used, an unknown terrain or experiment.
    """
    options = _options(arguments)
    options = dataclasses.replace(options, device=devices.select_device(options.device))
    resumed = (options.run_dir or run_dir.newest()) if options.resume else None
    if resumed:
        base = fill_in(run_dir.read_config(resumed))
        resumption.check_origin(resumed, base, arguments, options.terrain, options.experiment)
        run_dir.check_map(resumed, base.terrain.name)
        options = dataclasses.replace(options, run_dir=resumed)
    else:
        base = presets.build_config(options.terrain, options.experiment, options.device)
    default = Command(options, base)
    command = tyro.cli(Command, args=arguments, default=default, prog=PROGRAM)
    if not resumed and command.settings.terrain.name != base.terrain.name:
        name = command.settings.terrain.name
        raise ConfigError(f"--terrain.name: say --terrain {name}, whose preset comes with it")
    init = command.options.init and sources.find_policy(command.options.init)
    options = dataclasses.replace(command.options, device=options.device, init=init)
    c = fill_in(_with_short_options(command.settings, options), options.robot)
    c = distillation.fill_in(c)
    if options.resume:
        sources.check_robot(options.run_dir or Path(), c.robot.name)
    if init and options.resume:
        raise ConfigError("give --init or --resume, not both")
    if init:
        c = warm_start.adapt_settings(c, init)
    warm_start.check_teachers(c, init, options.resume)
    limits.check(c)
    if resumed:
        resumption.check_settings(resumed, base, c)
    return options, c


def _options(arguments: list[str]) -> Options:
    """Parse the options alone, since they decide the defaults of the settings."""
    asked = [a for a in arguments if a not in ("-h", "--help")]
    options, _ = tyro.cli(Options, args=asked, prog=PROGRAM, return_unknown_args=True)
    return options


def train(options: Options, c: Config, arguments: list[str]) -> None:
    """Train until the last iteration, Ctrl-C or SIGTERM, then save."""
    if options.wandb:
        wandb_log.check_installed()
    run_dir.check_writable(options.run_dir or run_dir.ROOT)
    mesh = devices.choose_mesh(c, options.devices)
    threads = max(parallel.cores() // len(mesh.local_devices), 1)
    # what is wrong with the terrain is said before anything is written
    world = processes.replicate(build_world(c, options.engine, threads), mesh)
    imitation.number_lanes(c, world.lanes)
    name = run_dir.reserve if processes.is_first() else run_dir.ROOT.joinpath
    run = options.run_dir or name(_name(options))
    options = dataclasses.replace(options, run_dir=run)
    with lock(run) if processes.is_first() else contextlib.nullcontext():
        with run_dir.checkpoints(run, c.run.keep) as steps:
            first = _first_iteration(steps, options.resume, run)
            lines = _opening_lines(run, c, mesh.size, options, first)
            with _open_reporter(run, c, first, options, arguments) as report:
                for line in lines:
                    report.say(line)
                if processes.is_first() and map_files.is_map(c.terrain.name):
                    map_plot.draw_map(world.lanes.tile(0, 0), run / "map.png")
                    report.say(f"the map, with the start: {run / 'map.png'}")
                state = _run_stages(world, mesh, steps, report, options)
        processes.leave()
        if processes.is_first():
            _summary(run, c, state, options)


def _run_stages(
    world: World,
    mesh: Mesh,
    steps: Checkpoints,
    report: Reporter | SilentReporter,
    options: Options,
) -> iteration.RunState:
    """Train the policy; one that learns from a teacher, after its teacher."""
    if world.config.network.variant != "hpl":
        return _run_stage(world, mesh, steps, report, options)
    taught = world.replace(config=distillation.teacher_config(world.config))
    last = taught.config.run.iterations
    done, stop = steps.latest() or 0, StopRequest()
    if done > last:
        return _run_stage(world, mesh, steps, report, options)
    if done == last:
        state = _first_state(taught, mesh, steps, options)
    else:
        state = _run_stage(taught, mesh, steps, report, options, stop)
    if stop.requested or int(state.train.iteration) < last:
        return state
    samples = trained.count_samples(taught.config, last)
    said = trained.describe_samples(taught.config, last, samples)
    report.say(f"the teacher is done after {said}")
    programs = _compile(world, mesh, report, options, last)
    state = iteration.start_student(world, state, mesh)
    return trainer.run_chunks(world, state, steps, report, programs)


def _run_stage(
    world: World,
    mesh: Mesh,
    steps: Checkpoints,
    report: Reporter | SilentReporter,
    options: Options,
    stop: StopRequest | None = None,
) -> iteration.RunState:
    """Train from the first state, or from the newest checkpoint, to the last iteration."""
    programs = _compile(world, mesh, report, options, steps.latest() or 0)
    state = _first_state(world, mesh, steps, options)
    return trainer.run_chunks(world, state, steps, report, programs, stop)


def _compile(
    world: World, mesh: Mesh, report: Reporter | SilentReporter, options: Options, first: int
) -> trainer.Programs:
    """Compile the program of the first chunk after `first` iterations."""
    run, folder = world.config.run, options.run_dir if options.profile else None
    programs = profiled.build_programs(world, mesh, report, folder)
    if first < run.iterations:
        programs.get(min(run.chunk, run.iterations - first))
    return programs


@contextlib.contextmanager
def _open_reporter(
    run: Path, c: Config, first: int, options: Options, arguments: list[str]
) -> Iterator[Reporter | SilentReporter]:
    """Write the run's settings and origin, and open its log; the first process alone does."""
    if not processes.is_first():
        with SilentReporter() as report:
            yield report
        return
    with run_dir.try_config(run, c):
        stages = distillation.samples_by_stage(c, first)
        engine = resolve_engine(options.engine)
        size = c.run.num_envs
        run_dir.write_origin(run, first, c.terrain.name, engine, stages, size, arguments)
        each, before = size * c.ppo.horizon, run_dir.count_samples(run, c, first)
        wandb = dataclasses.asdict(c) if options.wandb else None
        with Reporter(
            run, first, c.run.iterations, each, before, options.tensorboard, wandb
        ) as report:
            yield report


def _first_iteration(steps: Checkpoints, resume: bool, run: Path) -> int:
    """Return the number of completed iterations.

    Raises:
        ConfigError: there is nothing to resume, or something that would be overwritten.
    """
    latest = steps.latest()
    if resume and latest is None:
        raise ConfigError(f"{run} has no checkpoint to resume; leave --resume out")
    if not resume and latest is not None:
        raise ConfigError(f"{run} holds a run already; add --resume, or choose another --run-dir")
    return latest or 0


def _first_state(
    world: World, mesh: Mesh, steps: Checkpoints, options: Options
) -> iteration.RunState:
    """Build the first state: fresh, from --init, or of the newest checkpoint."""
    start = jax.jit(iteration.initial_state, static_argnames="mesh").lower(world, mesh).compile()
    processes.wait_for_all()
    state = start(world)
    if options.init:
        learned, taught = warm_start.start(state, options.init, world)
        learned, taught = processes.replicate((learned, taught), mesh)
        return state.replace(train=learned, teachers=taught)
    if not options.resume:
        return state
    return resumption.restore(steps, state, trainer.describe_sharding(state, mesh))


def _opening_lines(run: Path, c: Config, count: int, options: Options, first: int) -> list[str]:
    """Say what is trained, what it begins as, and what is not as before in a resumed run."""
    engine = resolve_engine(options.engine)
    device = (f"{count} x " if count > 1 else "") + jax.devices()[0].device_kind
    start = f", from iteration {first}" if first else ""
    headline = (
        f"{run}: {c.robot.name} on {c.terrain.name}, {c.run.num_envs} robots, engine {engine}, "
        f"on {device}; iterations {c.run.iterations}{start}"
    )
    if options.init:
        return [headline, f"begins as {sources.summarize(options.init)}"]
    if not options.resume:
        return [headline]
    own, last = fill_in(run_dir.read_config(run)), run_dir.last_engine(run)
    lines = [headline, *resumption.describe_changes(own, c)]
    if last not in (None, engine):
        lines.append(f"engine changes from {last} to {engine}: not bit for bit from here on")
    if options.experiment:
        lines += resumption.describe_unused(own, options.experiment)
    return lines


def _summary(run: Path, c: Config, state: iteration.RunState, options: Options) -> None:
    """Print the samples of each stage, the evaluation and the next command."""
    if c.network.variant == "hpl":
        done = int(state.train.iteration)
        print(f"trained for {trained.describe_samples(c, done, trained.count_samples(c, done))}")
    if options.evaluate and int(state.train.iteration) >= c.run.iterations:
        print("evaluating 100 episodes on flat ground ...", flush=True)
        physics = build_physics(c, options.engine)
        learned = trained.with_averaged_actor(processes.to_host(state.train))
        one = jax.device_put(learned, jax.local_devices()[0])
        result = walking.walk(c, physics, one)
        print(f"on flat ground: {result.line()}")
    print(f"saved in {run}; next: {folders.command_line('play', '--run', run)}")


def _with_short_options(c: Config, options: Options) -> Config:
    """Apply --num-envs, --iterations and --seed to the settings."""
    short = {name: getattr(options, name) for name in ("num_envs", "iterations", "seed")}
    given = {name: value for name, value in short.items() if value is not None}
    return dataclasses.replace(c, run=dataclasses.replace(c.run, **given))


def _name(options: Options) -> str:
    """Return the name of a new run."""
    parts = [Path(options.terrain).stem]
    parts += [options.robot] if options.robot else []
    parts += [Path(options.experiment).stem] if options.experiment else []
    parts += [f"seed{options.seed}"] if options.seed is not None else []  # jobs of one second
    return "-".join([*parts, datetime.datetime.now().strftime("%Y%m%d-%H%M%S")])


if __name__ == "__main__":
    main()
