"""Train a policy: `python -m cref_jax.train --terrain gap`."""

import dataclasses
import datetime
import json
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from cref_jax import cli, errors, evaluation, exported, learn, learner, runs
from cref_jax.config import Config, limits
from cref_jax.env.world import World
from cref_jax.errors import ConfigError
from cref_jax.physics.records import EngineName
from cref_jax.physics.simulation import resolve_engine
from cref_jax.progress import Reporter
from cref_jax.system import interrupts, jax_setup, parallel
from cref_jax.training.checkpoint import Checkpoints, lock

CRITIC_FIRST = 200  # iterations after --init without a critic; after 20 its errors made robots fall
NOT_OF_THE_ACTOR = ("critic", "critic_sees", "initial_std", "min_std")  # of a network's settings
MAX_UNSTABLE = 0.01  # share of an iteration's samples; assumed: more is no accident

Device = Literal["auto", "cpu", "gpu"]


@dataclass(frozen=True)
class Options:
    """What is asked for besides the settings of the run."""

    terrain: str = "flat"
    """flat, rough, slope, stairs, gap, platform, mixed, or a height map: path.npy, path.png"""
    experiment: str | None = None
    """a file in experiments/ (without .toml) or a path: differences from the defaults"""
    num_envs: int | None = None
    """robots at once; short for --run.num-envs"""
    iterations: int | None = None
    """iterations in all; short for --run.iterations"""
    seed: int | None = None
    """short for --run.seed"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx and warp on the device"""
    device: Device = "auto"
    """where the program runs; gpu is an error without one"""
    devices: int | None = None
    """how many share the robots; as many as there are when left out, and of a CPU one a core"""
    run_dir: Path | None = None
    """where everything is written; runs/TERRAIN-EXPERIMENT-DATE when left out"""
    init: Path | None = None
    """a run, what it has learned (export --learner), or an exported policy, as which this run
    begins; without a critic, or with another, the critic learns alone first"""
    resume: bool = False
    """go on with the run in --run-dir, or with the newest one"""
    print_config: bool = False
    """print every setting as JSON and stop"""
    evaluate: bool = True
    """let the policy walk 100 episodes at the end"""
    tensorboard: bool = True
    """write TensorBoard files, too"""
    debug: bool = False
    """show the traceback of an error"""


@dataclass(frozen=True)
class Command:
    """Train a policy. Every setting of the run is an option, too."""

    options: Annotated[Options, tyro.conf.arg(name="")] = field(default_factory=Options)
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    arguments = sys.argv[1:] if arguments is None else arguments
    with cli.one_line_errors(debug="--debug" in arguments):
        jax_setup.prepare([_options(arguments).engine])
        options, c = parse(arguments)
        if options.print_config:
            print(json.dumps(dataclasses.asdict(c), indent=2))
            return
        train(options, c)


def parse(arguments: list[str]) -> tuple[Options, Config]:
    """Return what the command line asks for.

    The settings are the paper's, changed by the device's preset, by the experiment and by the
    command line, in this order; those of a run that is resumed are its own.

    Raises:
        ConfigError: a value that cannot be used, an unknown terrain or experiment.
    """
    options = _options(arguments)
    options = dataclasses.replace(options, device=select_device(options.device))
    if options.resume:
        run = options.run_dir or runs.newest()
        options = dataclasses.replace(options, run_dir=run)
        base = runs.read_config(run)
    else:
        base = runs.composed(options.terrain, options.experiment, options.device)
    default = Command(options, base)
    command = tyro.cli(Command, args=arguments, default=default, prog="python -m cref_jax.train")
    c = _with_short_options(command.settings, command.options)
    if command.options.init:
        c = _with_init(c, command.options)
    limits.check(c)
    return dataclasses.replace(command.options, device=options.device), c


def _options(arguments: list[str]) -> Options:
    """Parse the options alone: what they say decides what the settings begin with."""
    asked = [a for a in arguments if a not in ("-h", "--help")]
    options, _ = tyro.cli(Options, args=asked, return_unknown_args=True)
    return options


def select_device(device: Device) -> Literal["cpu", "gpu"]:
    """Choose where the program runs, before JAX is used for the first time.

    Raises:
        ConfigError: a GPU is asked for and JAX has none.
    """
    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
    backend = jax.default_backend()
    if device == "gpu" and backend != "gpu":
        raise ConfigError(
            "--device gpu: JAX has no GPU here; install its plugin with: "
            "pip install 'cref-jax[cuda12]' (driver 525 or newer) or 'cref-jax[cuda13]' (580)"
        )
    return "cpu" if backend == "cpu" else "gpu"


def train(options: Options, c: Config) -> None:
    """Train until the last iteration, Ctrl-C or SIGTERM, and keep what was learned."""
    run = options.run_dir or runs.ROOT / _name(options)
    mesh = runs.mesh_of(c, options.devices)
    threads = max(parallel.cores() // mesh.size, 1)
    # what is wrong with the terrain is said before anything is written
    world = jax.device_put(
        runs.world_of(c, options.engine, threads), NamedSharding(mesh, PartitionSpec())
    )
    with lock(run):
        with runs.checkpoints(run, c.run.keep) as steps:
            first = _first_iteration(steps, options.resume, run)
            runs.write_config(run, c)
            runs.write_origin(run, first)
            samples = c.run.num_envs * c.ppo.horizon
            with Reporter(run, first, c.run.iterations, samples, options.tensorboard) as report:
                report.say(_headline(run, c, options, first))
                programs = _Programs(world, mesh, report)
                if first < c.run.iterations:
                    programs.of(min(c.run.chunk, c.run.iterations - first))
                state = _first_state(world, mesh, steps, options)
                state = _loop(world, state, steps, report, programs)
        _summary(run, c, state, options)


class _Programs:
    """The compiled programs of chunks of iterations."""

    def __init__(self, world: World, mesh: Mesh, report: Reporter) -> None:
        self._world, self.mesh, self._report = world, mesh, report
        self._shapes = learn.shapes(world, mesh)
        self._of: dict[int, jax.stages.Compiled] = {}

    def of(self, size: int) -> jax.stages.Compiled:
        """Return the program of `size` iterations; the first one is announced and weighed.

        Raises:
            ConfigError: it needs more memory than there is.
        """
        if size not in self._of:
            first = not self._of
            if first:
                self._report.say(
                    "compiling (half a minute on four cores, seconds from the cache) ..."
                )
            begun = time.monotonic()
            lowered = learn.chunk.lower(self._world, self._shapes, self.mesh, size)
            self._of[size] = lowered.compile()
            if first:
                seconds = time.monotonic() - begun
                robots = self._world.config.run.num_envs
                needed = runs.check_memory(self._of[size], robots, self.mesh.size)
                self._report.say(
                    f"compiled in {seconds:.0f} s; it takes {needed / 2**30:.1f} GiB of memory; "
                    "Ctrl-C saves and stops"
                )
        return self._of[size]


def _loop(
    world: World,
    state: learn.RunState,
    steps: Checkpoints,
    report: Reporter,
    programs: _Programs,
) -> learn.RunState:
    """Train chunk by chunk; save in between, at the end, and when asked to stop."""
    c = world.config
    done = int(state.train.iteration)
    if done >= c.run.iterations:
        report.say(f"nothing left to do: {done} of {c.run.iterations} iterations are done")
        return state
    saved = time.monotonic()
    with interrupts.StopRequest() as stop:
        while done < c.run.iterations and not stop.asked:
            program = programs.of(min(c.run.chunk, c.run.iterations - done))
            begun = time.monotonic()
            state, log = program(world, state)
            log = {name: np.asarray(values) for name, values in log.items()}
            report.chunk(done, log, time.monotonic() - begun)
            _check_health(log, c.run.num_envs * c.ppo.horizon)
            done = int(state.train.iteration)
            if time.monotonic() - saved > 60 * c.run.checkpoint_minutes:
                _save(steps, state, done, programs.mesh)
                saved = time.monotonic()
        _save(steps, state, done, programs.mesh)
    if stop.asked:
        report.say(f"stopped and saved at iteration {done}")
    return state


def _first_iteration(steps: Checkpoints, resume: bool, run: Path) -> int:
    """Return how many iterations are done.

    Raises:
        ConfigError: there is nothing to resume, or something that would be overwritten.
    """
    latest = steps.latest()
    if resume and latest is None:
        raise ConfigError(f"{run} has no checkpoint to resume; leave --resume out")
    if not resume and latest is not None:
        raise ConfigError(f"{run} holds a run already; add --resume, or choose another --run-dir")
    return latest or 0


def _first_state(world: World, mesh: Mesh, steps: Checkpoints, options: Options) -> learn.RunState:
    """Return the state to begin with: fresh, with what was learned, or of the newest checkpoint."""
    state = jax.jit(learn.initial_state, static_argnames="mesh")(world, mesh)
    if options.init:
        policy = exported.load(options.init, world)
        if _has_critic(options.init, world.config):
            average = jax.tree.map(jnp.copy, policy.train.average)  # the actor gives its own away
            learned = policy.train.replace(average=average, iteration=state.train.iteration)
            return state.replace(train=learned)
        return state.replace(train=exported.begun(state.train, policy))
    if not options.resume:
        return state
    stored, here = steps.meta(), _sharing(state, mesh)
    there = {name: stored.get(name, 1) for name in here}
    if there == here:
        return steps.restore(state)[0]
    for name, count in here.items():
        if there[name] != count:
            print(f"{name} changes from {there[name]} to {count}")
    print("so what was learned is kept, the robots start anew, and the run is no longer the same")
    return steps.restore(state, parts=("train",))[0]


def _save(steps: Checkpoints, state: learn.RunState, done: int, mesh: Mesh) -> None:
    steps.save(done, state, _sharing(state, mesh))


def _sharing(state: learn.RunState, mesh: Mesh) -> dict[str, int]:
    """Return how the robots are shared out; each device has the kinds of lane in turn."""
    return {"num_envs": state.robots.begins.shape[0], "shares": mesh.size}


def _check_health(log: Mapping[str, np.ndarray], samples: int) -> None:
    """Stop before a broken simulation or update is saved.

    Raises:
        TrainingError: too many robots blew up, or no gradient was finite.
    """
    unstable = float(log["episode/unstable"].max()) / samples
    if unstable > MAX_UNSTABLE:
        raise errors.TrainingError(
            f"the physics blew up in {unstable:.1%} of the samples; the last checkpoint is good"
        )
    if float(log["loss/skipped"].min()) == 1.0:
        raise errors.TrainingError("no gradient was finite; the last checkpoint is good")


def _headline(run: Path, c: Config, options: Options, first: int) -> str:
    engine = resolve_engine(options.engine)
    device = jax.devices()[0].device_kind
    start = f", from iteration {first}" if first else ""
    return (
        f"{run}: {c.terrain.name} with {c.run.num_envs} robots, engine {engine}, on {device}; "
        f"iterations {c.run.iterations}{start}"
    )


def _summary(run: Path, c: Config, state: learn.RunState, options: Options) -> None:
    """Say what was learned and what to type next."""
    if options.evaluate:
        physics = runs.physics_of(c, options.engine)
        one = jax.device_put(runs.kept(state.train), jax.devices()[0])
        result = evaluation.walk(c, physics, one)
        print(f"on flat ground: {result.line()}")
    print(f'saved in {run}; next: make play ARGS="--run {run}"')


def _with_short_options(c: Config, options: Options) -> Config:
    """Return the settings with --num-envs, --iterations and --seed written in."""
    short = {name: getattr(options, name) for name in ("num_envs", "iterations", "seed")}
    given = {name: value for name, value in short.items() if value is not None}
    return dataclasses.replace(c, run=dataclasses.replace(c.run, **given))


def _with_init(c: Config, options: Options) -> Config:
    """Return the settings of a run that begins as `--init`.

    Raises:
        ConfigError: it has another network, or there is something to resume as well.
    """
    if options.resume:
        raise ConfigError("give --init or --resume, not both")
    theirs, ours = exported.read_config(options.init or Path()).network, c.network
    for name, value in dataclasses.asdict(theirs).items():
        if name not in NOT_OF_THE_ACTOR and value != getattr(ours, name):
            raise ConfigError(
                f"--init {options.init} has another network: {name} is {value}, and here "
                f"{getattr(ours, name)}; set --network.{name.replace('_', '-')}"
            )
    first = c.ppo.critic_first or (0 if _has_critic(options.init, c) else CRITIC_FIRST)
    return dataclasses.replace(c, ppo=dataclasses.replace(c.ppo, critic_first=first))


def _has_critic(init: Path, c: Config) -> bool:
    """Return whether everything that a training learns is in `init`, and not the actor alone."""
    theirs = exported.read_config(init)
    read_out = theirs.ppo.readout_weight > 0.0, c.ppo.readout_weight > 0.0
    whole = exported.is_run(init) or learner.is_learner(init)
    return whole and theirs.network == c.network and read_out[0] == read_out[1]


def _name(options: Options) -> str:
    """Return the name of a new run."""
    parts = [Path(options.terrain).stem, *([options.experiment] if options.experiment else [])]
    return "-".join([*parts, datetime.datetime.now().strftime("%Y%m%d-%H%M%S")])


if __name__ == "__main__":
    main()
