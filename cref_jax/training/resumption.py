"""What a resumed run may change, what would make it another run, and where it goes on."""

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool

from cref_jax.config import Config, presets
from cref_jax.errors import CheckpointError, ConfigError, DamagedCheckpoint
from cref_jax.training import run_dir
from cref_jax.training.checkpoint import Checkpoints
from cref_jax.training.iteration import RunState

MAY_CHANGE = (
    "run.iterations",
    "run.chunk",
    "run.checkpoint_minutes",
    "run.keep",
    "run.num_envs",  # what was learned goes on, with fresh robots
)


def restore(steps: Checkpoints, state: RunState, here: dict[str, int]) -> RunState:
    """Restore the newest checkpoint into a state like `state`, sharded as `here` says.

    Of one with another number of robots, whose robots walk on other kinds of lanes than those of
    `state`, or are of another version of the program, what was learned alone is taken, and that is
    said.

    Raises:
        CheckpointError: it cannot be read.
    """
    stored = steps.meta()
    there = {name: stored.get(name, 1) for name in here}
    changes = "; ".join(
        f"{name} changes from {there[name]} to {count}"
        for name, count in here.items()
        if there[name] != count
    )
    if there["num_envs"] == here["num_envs"]:
        try:
            stored_state = steps.restore(state)[0]
            if _have_equal_lanes(state, stored_state):
                if changes:
                    print(f"{changes}; the robots go on, with other minibatches")
                return stored_state
            print("robots are assigned to other kinds of lanes")
        except DamagedCheckpoint:
            raise
        except CheckpointError as error:  # the environment has gained or lost a part of its state
            if ": robots/" not in str(error):
                raise
            print(f"the robots' state is of another version: {error}")
    if changes:
        print(changes)
    print("so what was learned is kept, the robots start anew, and the run is no longer the same")
    learned = ("train", "ramp", "teachers") if state.teachers else ("train", "ramp")
    return steps.restore(state, parts=learned)[0]


@jax.jit
def _have_equal_lanes(state: RunState, other: RunState) -> Bool[Array, ""]:
    """Check that each robot has the same kind of lane: a program is compiled for them."""
    return jnp.all(state.robots.env.kind == other.robots.env.kind)


def check_origin(
    run: Path, own: Config, arguments: Sequence[str], terrain: str, experiment: str | None
) -> None:
    """Refuse a terrain or an experiment on the command line that the run was not begun with.

    Raises:
        ConfigError: says what the run has.
    """
    asked = {a.partition("=")[0] for a in arguments}
    began_with = {
        "terrain": own.terrain.name,
        "experiment": run_dir.first_option(run, "experiment"),
    }
    for name, other in {"terrain": terrain, "experiment": experiment}.items():
        began = began_with[name]
        if f"--{name}" in asked and began is not None and other != began:
            raise ConfigError(
                f"{run} was begun with {name} '{began}', not '{other}'; to go on with another, "
                f"begin a new run with --init {run}"
            )


def check_settings(run: Path, own: Config, asked: Config) -> None:
    """Refuse settings with which the run would be another one, or had ended before it got here.

    Raises:
        ConfigError: names each, with the run's value and the one asked for.
    """
    done = run_dir.checkpoints(run).latest() or 0
    if asked.run.iterations < done:
        raise ConfigError(
            f"{run} has done {done} iterations already; --iterations must be more, not "
            f"{asked.run.iterations}"
        )
    may_change = [x for x in MAY_CHANGE if x != "run.num_envs" or own.network.variant != "hpl"]
    fixed = [x for x in _find_differences(own, asked) if x[0] not in may_change]
    if fixed:
        each = "; ".join(f"{_option(name)} {old}, not {new}" for name, old, new in fixed)
        raise ConfigError(
            f"{run} was begun with {each}; to go on with other settings, begin a new run with "
            f"--init {run}"
        )


def describe_changes(own: Config, asked: Config) -> list[str]:
    """Say in a line each which settings change from here on."""
    return [
        f"{_option(name)} changes from {old} to {new}"
        for name, old, new in _find_differences(own, asked)
    ]


def describe_unused(own: Config, experiment: str) -> list[str]:
    """Say in a line each which settings of an experiment's file are not those of the run."""
    file = presets.experiment_file(experiment)
    asked = presets.apply_file(own, experiment)
    return [
        f"{file} has {_option(name)} {new}, and the run goes on with {old}"
        for name, old, new in _find_differences(own, asked)
    ]


def _find_differences(own: Any, other: Any, where: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the dotted name and both values of each setting that differs."""
    for field in dataclasses.fields(own):
        name = f"{where}{field.name}"
        old, new = getattr(own, field.name), getattr(other, field.name)
        if dataclasses.is_dataclass(old):
            yield from _find_differences(old, new, f"{name}.")
        elif old != new:
            yield name, old, new


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
