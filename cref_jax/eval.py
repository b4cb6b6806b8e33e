"""Judge a policy: `python -m cref_jax.eval --suite table`."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from cref_jax import cli, evaluation, evaluation_page, exported, paper, runs, table
from cref_jax.config import ConfigError
from cref_jax.physics import EngineName
from cref_jax.world import World

Suite = Literal["table", "walk", "cross"]
PLAIN_SECONDS = 20.0  # between two lines where there is no terminal


@dataclass(frozen=True)
class Options:
    """Measure how a trained policy walks."""

    run: tuple[Path, ...] = ()
    """runs/NAME; the newest one when left out, or the bundled policy where there is none; of
    several, such as seeds of one training, the table pools the trials"""
    policy: tuple[Path, ...] = ()
    """exported policies instead of runs"""
    suite: Suite = "table"
    """table: the twelve cells of Table II and the failures of Table III; cross: trials on lanes
    with obstacles of one size; walk: episodes of 20 s on flat ground at 0.4 to 0.8 m/s"""
    kind: str = "gap"
    """of the obstacles to cross: gap, stairs_up, stairs_down, platform, rough, slope, flat"""
    size: float = 0.3
    """of the obstacles to cross, m"""
    num_envs: int | None = None
    """trials of each cell, or episodes; when left out 100 on a CPU and 2000 on an accelerator"""
    seed: int = 0
    """of the first states and commands"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx on the device"""
    out: Path | None = None
    """folder for eval.json and eval.html; the run's own when left out, or the present one"""
    debug: bool = False
    """show the traceback of an error"""


class Subject(NamedTuple):
    """A policy to judge."""

    source: Path
    policy: runs.Policy
    world: World  # of its own settings


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    options = tyro.cli(Options, args=arguments, prog="python -m cref_jax.eval")
    with cli.one_line_errors(options.debug):
        cli.prepare()
        subjects = [_subject(path, options.engine) for path in _sources(options)]
        count = options.num_envs or (100 if jax.default_backend() == "cpu" else paper.TRIALS)
        started = time.monotonic()
        judge = {"table": _table, "cross": _cross, "walk": _walk}[options.suite]
        found = judge(subjects, options, count)
        source = subjects[0].source
        out = options.out or (source if exported.is_run(source) else Path())
        record = {"suite": options.suite, "seed": options.seed, **_origin(subjects)}
        record |= {"seconds": round(time.monotonic() - started, 1), **found}
        _write(out, record)


def _sources(options: Options) -> list[Path]:
    """Return the runs and policies to judge.

    Raises:
        ConfigError: an option that cannot be used.
    """
    if options.num_envs is not None and options.num_envs < 1:
        raise ConfigError(f"--num-envs must be at least 1, not {options.num_envs}")
    if options.run and options.policy:
        raise ConfigError("give --run or --policy, not both")
    given = [*options.run, *options.policy]
    if len(given) > 1 and options.suite != "table":
        raise ConfigError(f"--suite {options.suite} takes one run or policy, not {len(given)}")
    return given or [exported.chosen(None, None)]


def _subject(source: Path, engine: EngineName) -> Subject:
    world = runs.world_of(exported.read_config(source), engine)
    return Subject(source, exported.load(source, world), world)


def _table(subjects: list[Subject], options: Options, count: int) -> dict[str, Any]:
    """Judge in all cells of Table II."""
    console = Console()
    console.print(f"{table.width(count * len(subjects))}\n{table.RULE}", highlight=False)
    judged = []
    with _progress(console, 12 * count * len(subjects)) as ended:
        for subject in subjects:
            w = table.world(subject.policy.config, subject.world.physics)
            judged.append(table.judge(w, subject.policy.train, count, options.seed, ended))
    rows = table.cells(judged)
    whole = table.overall(rows)
    console.print(table.text(rows, whole))
    console.print("* beyond chance: 0 is not in the 95 % interval of the difference")
    console.print(table.failures(rows), highlight=False)
    return {"rule": table.RULE, "cells": rows, "overall": whole}


def _cross(subjects: list[Subject], options: Options, count: int) -> dict[str, Any]:
    subject = subjects[0]
    with _progress(Console(), count) as ended:
        result = evaluation.cross(
            subject.policy.config, subject.world.physics, subject.policy.train, options.kind,
            options.size, count, options.seed, ended,
        )  # fmt: skip
    print(f"{subject.source}, iteration {subject.policy.iteration}: {result.line()}")
    return result._asdict()


def _walk(subjects: list[Subject], options: Options, count: int) -> dict[str, Any]:
    subject = subjects[0]
    result = evaluation.walk(
        subject.policy.config, subject.world.physics, subject.policy.train, count, options.seed
    )
    print(f"{subject.source}, iteration {subject.policy.iteration}: {result.line()}")
    return result._asdict()


def _origin(subjects: list[Subject]) -> dict[str, Any]:
    """Return what was judged, by what and on what."""
    policies = [
        {
            "name": subject.policy.run.name,
            "source": subject.source.name if subject.source.is_absolute() else str(subject.source),
            "digest": exported.digest(subject.policy),
            "iteration": subject.policy.iteration,
            "samples": subject.policy.samples,
        }
        for subject in subjects
    ]
    return {
        "policies": policies,
        "versions": runs.versions(),
        **runs.machine(),
    }


@contextmanager
def _progress(console: Console, total: int) -> Iterator[Callable[[int], None]]:
    """Yield what is told of the trials that have come to an end, and shows how many are left."""
    bar = Progress(
        TextColumn("trials"), MofNCompleteColumn(), BarColumn(), TextColumn("left"),
        TimeRemainingColumn(), console=console, transient=True,
    )  # fmt: skip
    task, said = bar.add_task("trials", total=total), time.monotonic()

    def ended(count: int) -> None:
        nonlocal said
        bar.advance(task, count)
        now = bar.tasks[0]
        if not console.is_terminal and time.monotonic() - said > PLAIN_SECONDS:
            said = time.monotonic()
            left = f", {now.time_remaining / 60:.1f} min left" if now.time_remaining else ""
            console.print(f"{now.completed:.0f} of {total} trials{left}", highlight=False)

    if console.is_terminal:
        with bar:
            yield ended
    else:
        yield ended


def _write(out: Path, record: dict[str, Any]) -> None:
    """Write eval.json, and the same as a page for people."""
    path = out / "eval.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
    evaluation_page.write(record, out / "eval.html")
    print(f"wrote {path} and eval.html")


if __name__ == "__main__":
    main()
