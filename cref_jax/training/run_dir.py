"""The folder of a run: what it stores, and how to open it again.

runs/NAME/config.json     every setting, so that the run can be resumed or evaluated
runs/NAME/origin.jsonl    versions, device, command line and git state at each start
runs/NAME/log.jsonl       one line per iteration
runs/NAME/tensorboard/    the same for TensorBoard
runs/NAME/wandb/          the same for Weights & Biases, and wandb_id: the id of its run there
runs/NAME/checkpoints/    see checkpoint.py
"""

import contextlib
import dataclasses
import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import jax

from cref_jax.config import Config, folders, presets
from cref_jax.errors import ConfigError
from cref_jax.robot.registry import name_robot
from cref_jax.system import disk
from cref_jax.terrain import map_files
from cref_jax.training.checkpoint import Checkpoints

ROOT = Path("runs")
PROGRAM = ("cref_jax", "experiments", "terrains", "pyproject.toml")  # what decides a result


def write_config(run: Path, c: Config) -> None:
    """Write all settings of the run; the file before stays until this one is whole."""
    _replace_config(run, json.dumps(dataclasses.asdict(c), indent=2) + "\n")


def _replace_config(run: Path, text: str) -> None:
    part = run / "config.json.part"
    part.write_text(text)
    part.replace(run / "config.json")


@contextlib.contextmanager
def try_config(run: Path, c: Config) -> Iterator[None]:
    """Write the settings that a run goes on with; a ConfigError puts those before back."""
    file = run / "config.json"
    before = file.read_text() if file.exists() else None
    write_config(run, c)
    try:
        yield
    except ConfigError:
        if before is not None:
            _replace_config(run, before)
        raise


def write_origin(
    run: Path,
    iteration: int = 0,
    terrain: str = "",
    engine: str = "",
    samples: Mapping[str, int] | None = None,
    num_envs: int | None = None,
    arguments: Sequence[str] = (),
) -> None:
    """Append a line with the origin of this start: versions, device, command and git state.

    `iteration` is the number of iterations done before it, `terrain` a name or a map's file,
    `samples` those done by each stage of a run that has several, `num_envs` the robots from here
    on, `arguments` the command line's. Starts without an iteration done are forgotten: nothing of
    theirs is left.
    """
    line = {
        "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "iteration": iteration,
        **({"num_envs": num_envs} if num_envs else {}),
        **({"samples": dict(samples)} if samples else {}),
        "command": ["train", *arguments],
        "python": platform.python_version(),
        **machine(),
        "engine": engine,
        "git": _git_state(),
        **({"map": map_files.digest(Path(terrain))} if map_files.is_map(terrain) else {}),
        **versions(),
    }
    path = run / "origin.jsonl"
    with disk.append_lines(path) if iteration else path.open("w", encoding="utf-8") as file:
        file.write(json.dumps(line) + "\n")


def machine() -> dict[str, Any]:
    """Describe the devices and cores that this program runs on."""
    kind = jax.devices()[0].device_kind
    return {"device": f"{jax.device_count()} x {kind}", "cores": os.cpu_count()}


def versions() -> dict[str, str]:
    """Read the versions of the packages that a result may depend on."""
    packages = ("cref-jax", "jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")
    return {name: importlib.metadata.version(name) for name in packages}


def read_config(run: Path) -> Config:
    """Read the settings of a run.

    Raises:
        ConfigError: no such run, or its settings are from another version of the program.
    """
    path = run / "config.json"
    try:
        changes = json.loads(path.read_text())
    except (FileNotFoundError, NotADirectoryError):
        raise ConfigError(f"{run} is not a run: it has no config.json") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: {error}") from None
    return presets.apply_table(Config(), changes, path)


def check_map(run: Path, terrain: str) -> None:
    """Refuse a map that is not the one the run began on.

    Raises:
        ConfigError: the map or its settings have changed.
    """
    began_on = _read_origin(run, 0).get("map")
    if began_on and map_files.is_map(terrain) and map_files.digest(Path(terrain)) != began_on:
        raise ConfigError(
            f"{terrain} or the .toml beside it has changed since {run} began; begin a new run on "
            f"it with --init {run}"
        )


def last_engine(run: Path) -> str | None:
    """Read the engine of a run's last start, None if it is not recorded."""
    return _read_origin(run, -1).get("engine")


def count_samples(run: Path, c: Config, iteration: int) -> int:
    """Count the control steps of experience in a run's first iterations.

    A run that goes on may do so with another number of robots; a start that goes on from before an
    earlier one replaces what that one did.
    """
    starts = [(s.get("iteration", 0), s.get("num_envs", c.run.num_envs)) for s in read_starts(run)]
    samples, end = 0, iteration
    for first, num_envs in reversed([(0, c.run.num_envs), *starts]):
        samples += max(end - first, 0) * num_envs * c.ppo.horizon
        end = min(end, first)
    return samples


def read_starts(run: Path) -> list[dict[str, Any]]:
    """Read the lines of `write_origin`; those of another form are left out."""
    return [line for line in disk.read_objects(run / "origin.jsonl") if _is_start(line)]


def _is_start(line: dict[str, Any]) -> bool:
    command = line.get("command", [])
    are_words = isinstance(command, list) and all(isinstance(word, str) for word in command)
    return are_words and all(isinstance(line.get(x, 0), int) for x in ("iteration", "num_envs"))


def _read_origin(run: Path, start: int) -> dict[str, Any]:
    return next(iter(read_starts(run)[start:]), {})


def first_option(run: Path, name: str) -> str | None:
    """Read an option from the command line that began a run, None if it was not given."""
    command = _read_origin(run, 0).get("command", [])
    for word, following in pairwise([*command, ""]):
        if word == f"--{name}":
            return following
        if word.startswith(f"--{name}="):
            return word.partition("=")[2]
    return None


def check_writable(folder: Path) -> None:
    """Check, without creating anything, that files can be written in a folder.

    Raises:
        ConfigError: it cannot be made or written.
    """
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not there.is_dir():
        raise ConfigError(f"cannot write in {folder}: {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"cannot write in {folder}: no permission for {there}")


def reserve(name: str) -> Path:
    """Create the folder of a new run, with a number after its name where another run has it."""
    ROOT.mkdir(parents=True, exist_ok=True)
    for number in itertools.count(1):
        run = ROOT / (name if number == 1 else f"{name}-{number}")
        with contextlib.suppress(FileExistsError):
            run.mkdir()
            return run
    raise AssertionError("one of all numbers is free")


def newest(root: Path = ROOT, robot: str | None = None) -> Path:
    """Find the run with the newest checkpoint, of this robot or of any.

    A run whose settings cannot be read is left out where a robot is asked for.

    Raises:
        ConfigError: no run has one.
    """
    runs = [
        path.parent for path in root.glob("*/checkpoints") if Checkpoints(path).latest() is not None
    ]
    if robot is not None:
        runs = [run for run in runs if _robot_of(run) == robot]
    if not runs:
        whose, more = (f" of '{robot}'", ["--robot", robot]) if robot else ("", [])
        how = folders.command_line("train", "--terrain", "flat", *more)
        raise ConfigError(f"no trained run{whose} in {root}/; train one with: {how}")
    return max(runs, key=lambda run: (run / "checkpoints").stat().st_mtime)


def _robot_of(run: Path) -> str | None:
    """Read the robot's name; None, and a line that says so, where the settings are unreadable."""
    try:
        return name_robot(read_config(run).robot.name)
    except ConfigError as error:
        print(f"{run} is left out: {error}", file=sys.stderr)
        return None


def checkpoints(run: Path, keep: int = 3) -> Checkpoints:
    """Open the checkpoints of a run."""
    return Checkpoints(run / "checkpoints", keep)


def _git_state() -> str | None:
    """Read the program's commit, with a "+" if its own files have uncommitted changes.

    None without git, and for an installed program, whatever repository it may lie below.
    """
    file = Path(__file__)
    top = file.parents[2]
    git = lambda *words: subprocess.run(
        ["git", "-C", str(top), *words], capture_output=True, text=True, check=True
    ).stdout.strip()
    try:
        git("ls-files", "--error-unmatch", str(file.relative_to(top)))
        changes = git("status", "--porcelain", "--", *PROGRAM)
        return git("rev-parse", "HEAD") + ("+" if changes else "")
    except (OSError, subprocess.CalledProcessError):
        return None
