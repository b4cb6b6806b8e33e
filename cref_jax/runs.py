"""What a run leaves on disk, and how a later program opens it again.

runs/NAME/config.json     every setting, so that the run can be resumed or evaluated
runs/NAME/origin.jsonl    versions, device, command line and git state at each start
runs/NAME/log.jsonl       one line an iteration
runs/NAME/tensorboard/    the same for TensorBoard
runs/NAME/checkpoints/    see checkpoint.py
"""

import dataclasses
import datetime
import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from cref_jax import config, learn, ppo
from cref_jax.config import Config, folders
from cref_jax.env.world import World, make_world
from cref_jax.errors import ConfigError
from cref_jax.physics.records import EngineName
from cref_jax.physics.simulation import Physics, resolve_engine
from cref_jax.training.checkpoint import Checkpoints

ROOT = Path("runs")


class Policy(NamedTuple):
    """A trained policy and how it came about."""

    config: Config
    train: ppo.TrainState
    iteration: int
    run: Path

    @property
    def samples(self) -> int:
        """Control steps of experience that it has learned from."""
        return self.iteration * self.config.run.num_envs * self.config.ppo.horizon


def composed(terrain: str, experiment: str | None, device: str) -> Config:
    """Return the settings of a new run: the paper's, changed by the device and the experiment.

    Raises:
        ConfigError: an unknown experiment, or a file that cannot be used.
    """
    c = config.override(Config(), {"terrain": {"name": terrain}})
    preset = config.load_toml(_experiment("presets")).get(device, {})
    for_terrain = preset.pop(terrain, {})
    known = {f.name for f in dataclasses.fields(Config)}
    c = config.override(c, {k: v for k, v in preset.items() if k in known})
    c = config.override(c, for_terrain)
    if experiment:
        c = config.override(c, config.load_toml(_experiment(experiment)))
    return c


def write_config(run: Path, c: Config) -> None:
    """Write every setting of the run."""
    (run / "config.json").write_text(json.dumps(dataclasses.asdict(c), indent=2) + "\n")


def write_origin(run: Path, iteration: int = 0) -> None:
    """Add a line with what this start of the run is made by: versions, device, command, git.

    `iteration` is how many are done before it.
    """
    line = {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "iteration": iteration,
        "command": [Path(sys.argv[0]).name, *sys.argv[1:]],
        "python": platform.python_version(),
        **machine(),
        "git": _git_state(),
        **versions(),
    }
    with (run / "origin.jsonl").open("a") as file:
        file.write(json.dumps(line) + "\n")


def machine() -> dict[str, Any]:
    """Return what this program runs on."""
    kind = jax.devices()[0].device_kind
    return {"device": f"{jax.device_count()} x {kind}", "cores": os.cpu_count()}


def versions() -> dict[str, str]:
    """Return the versions of the packages that a result may depend on."""
    packages = ("cref-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
    return {name: importlib.metadata.version(name) for name in packages}


def read_config(run: Path) -> Config:
    """Return the settings of a run.

    Raises:
        ConfigError: there is no such run, or its settings are of another version of the program.
    """
    path = run / "config.json"
    try:
        changes = json.loads(path.read_text())
    except FileNotFoundError:
        raise ConfigError(f"{run} is not a run: it has no config.json") from None
    except json.JSONDecodeError as error:
        raise ConfigError(f"{path}: {error}") from None
    try:
        return config.override(Config(), changes)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def newest(root: Path = ROOT) -> Path:
    """Return the run with the newest checkpoint.

    Raises:
        ConfigError: there is none.
    """
    found = [
        path.parent for path in root.glob("*/checkpoints") if Checkpoints(path).latest() is not None
    ]
    if not found:
        raise ConfigError(f"no trained run in {root}/; train one with: make train TERRAIN=flat")
    return max(found, key=lambda run: (run / "checkpoints").stat().st_mtime)


def checkpoints(run: Path, keep: int = 3) -> Checkpoints:
    """Return the checkpoints of a run."""
    return Checkpoints(run / "checkpoints", keep)


def world_of(c: Config, engine: EngineName = "auto", threads: int = 0) -> World:
    """Return the world that a configuration describes; `threads` is as in Physics."""
    return make_world(c, physics_of(c, engine, threads))


def physics_of(c: Config, engine: EngineName = "auto", threads: int = 0) -> Physics:
    """Return the physics that a configuration describes; `threads` is as in Physics."""
    return Physics(c.robot, c.physics, resolve_engine(engine), threads)


def mesh_of(c: Config, asked: int | None = None) -> Mesh:
    """Return the devices that share a run's robots: as many as `asked`, or as are of use.

    Raises:
        ConfigError: so many are not there, or the robots cannot be shared out among them.
    """
    there, parts = jax.device_count(), c.ppo.minibatches
    even = [n for n in range(1, there + 1) if c.run.num_envs % (n * parts) == 0]
    if asked is not None and asked not in even:
        raise ConfigError(
            f"--devices {asked}: {c.run.num_envs} robots in {parts} minibatches can be shared "
            f"among {', '.join(map(str, even))} of the {there} devices here"
        )
    return learn.mesh_of(asked or even[-1])


def check_memory(program: jax.stages.Compiled, num_envs: int, devices: int = 1) -> int:
    """Return the bytes that a program takes on a device while it runs, its arguments included.

    Of a CPU, all `devices` have one memory.

    Raises:
        ConfigError: there is less.
    """
    m = program.memory_analysis()
    if m is None:  # a device that does not tell
        return 0
    needed = m.argument_size_in_bytes + m.temp_size_in_bytes
    needed += m.output_size_in_bytes - m.alias_size_in_bytes
    stats = jax.devices()[0].memory_stats()  # a CPU has none
    there = stats["bytes_limit"] if stats else _main_memory()
    needed *= 1 if stats else devices
    if needed > there:
        fits = num_envs * there // needed
        raise ConfigError(
            f"{num_envs} robots need {needed / 2**30:.1f} GiB and the device has "
            f"{there / 2**30:.1f}; take --num-envs {2 ** max(fits.bit_length() - 1, 0)}"
        )
    return needed


def load_policy(run: Path, world: World) -> Policy:
    """Return the newest policy of a run; `world` may have another terrain than it was trained on.

    Raises:
        ConfigError: there is no such run.
        CheckpointError: it has no checkpoint that can be read.
    """
    like = jax.eval_shape(lambda w: learn.initial_state(w).train, world)
    c = read_config(run)
    with checkpoints(run) as steps:
        newest = steps.latest()
        train = steps.restore_part("train", like, newest)
        return Policy(c, kept(train), newest or 0, run)


def kept(train: ppo.TrainState) -> ppo.TrainState:
    """Return the state whose actor is the average: the policy that is evaluated and exported."""
    return train.replace(params=train.params._replace(actor=train.average))


def _experiment(name: str) -> Path:
    """Return the file of an experiment, given by its name or as a path."""
    if name.endswith(".toml"):
        return Path(name)
    folder = folders.data_folder("experiments")
    known = sorted(p.stem for p in folder.glob("*.toml") if p.stem != "presets")
    if name not in (*known, "presets"):
        raise ConfigError(config.unknown("experiment", name, known))
    return folder / f"{name}.toml"


def _main_memory() -> int:
    """Return the machine's memory, bytes."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def _git_state() -> str | None:
    """Return the commit that the program is of, marked when it has been changed since."""
    try:
        here = Path(__file__).parent
        ask = lambda *words: subprocess.run(
            ["git", "-C", str(here), *words], capture_output=True, text=True, check=True
        ).stdout.strip()
        return ask("rev-parse", "HEAD") + ("+" if ask("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None
