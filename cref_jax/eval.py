"""Evaluate a policy: `python -m cref_jax.eval --suite table`."""

import cref_jax.system.startup  # noqa: F401

import contextlib
import dataclasses
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from cref_jax import cli
from cref_jax.config import limits
from cref_jax.config.ranges import Within
from cref_jax.env.world import World, build_world
from cref_jax.errors import ConfigError
from cref_jax.evaluation import (
    command_suite,
    crossing,
    failure_films,
    highway_gate,
    intervals,
    paper_results,
    robustness_suite,
    scene_results,
    scene_suite,
    tables,
    walking,
)
from cref_jax.evaluation.witness import Witness
from cref_jax.pages import evaluation_page
from cref_jax.physics.records import EngineName
from cref_jax.policy import learner_file, reader, sources, trained, writer
from cref_jax.system import jax_setup, parallel
from cref_jax.terrain.generators import KINDS
from cref_jax.training import run_dir

Suite = Literal["table", "robust", "ood", "walk", "cross", "commands", "gate"]
PLAIN_SECONDS = 20.0  # between two lines where there is no terminal


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Measure how a trained policy walks."""

    run: tuple[Path, ...] = ()
    """runs/NAME (default: the newest run, or the bundled policy where there is none); of several,
    such as seeds of one training, the suites table and walk pool the trials"""
    policy: tuple[Path, ...] = ()
    """exported policies instead of runs"""
    robot: str | None = None
    """a robot by name: its newest run (default: any); another robot's is an error"""
    suite: Suite | None = None
    """table: the twelve cells of Table II and the failures of Table III; robust: the same with
    masses, friction, motors, delays, sensors, pushes, camera mount, structures in view and
    faults of depth randomised, and with each of these alone; ood: twenty scenes outside the
    training distribution, in MuJoCo C by the numpy runtime; cross: lanes with obstacles of one
    size; walk: episodes of 20 s on flat ground at 0.4 to 0.8 m/s; commands: standing, walking
    at each speed, sideways, turning, stopping; gate: the highway gate by terrain, contact phase
    and posture (default: walk for a policy of flat ground, table for all others)"""
    kind: Annotated[str, tyro.conf.arg(help=f"kind of lane to cross: {', '.join(KINDS)}")] = "gap"
    size: Annotated[float, Within(0, 100)] = 0.3
    """size of the obstacles, m; for a slope its gradient"""
    num_envs: Annotated[int | None, Within(1, 1_000_000)] = None
    """trials per cell, episodes or robots (default: 100 on a CPU, 2000 on an accelerator; 10 per
    scene)"""
    stress: Annotated[int, Within(0, 1000)] = 2
    """trials per scene under each condition: bad frames of each kind, a narrower view, friction"""
    film: str | None = None
    """film one trial in this scene instead of evaluating in all: SCENE.mp4"""
    films: Annotated[int, Within(0, 20)] = 3
    """films of failures, one for each of the N cells with the most, in the suites table, robust and
    cross: a few seconds each; 0 for none"""
    seed: Annotated[int, limits.SEED] = 0
    """seed of initial states and commands"""
    engine: EngineName = "auto"
    """mujoco steps on the CPU, mjx and warp on the device"""
    out: Path | None = None
    """folder for eval.json and eval.html (default: the run's, or the current one)"""


class Subject(NamedTuple):
    """A policy to evaluate."""

    source: Path
    policy: trained.TrainedPolicy
    world: World  # of its own settings


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        options = cli.parse(Options, arguments, "eval")
        jax_setup.prepare([options.engine])
        paths = _resolve_sources(options)
        trained_on = [sources.read_config(path).terrain.name for path in paths]
        suite = options.suite or _suite_for(trained_on)
        out = options.out or (paths[0] if sources.is_run(paths[0]) else Path())
        options = dataclasses.replace(options, suite=suite, out=out)
        cli.prepare_output(out / "eval.json", ".json")
        subjects = [_subject(path, options) for path in paths]
        if options.film:
            _film(subjects[0], options, out / f"{options.film}.mp4")
            return
        started = time.monotonic()
        suites = {
            "table": _table, "robust": _robust, "ood": _ood, "cross": _cross, "walk": _walk,
            "commands": _commands, "gate": _gate,
        }  # fmt: skip
        found = suites[suite](subjects, options)
        record = {"suite": suite, "seed": options.seed, **_provenance(subjects)}
        record |= {"seconds": round(time.monotonic() - started, 1), **found}
        _write(out, record)


def _resolve_sources(options: Options) -> list[Path]:
    """Resolve the runs and policies to evaluate.

    Raises:
        ConfigError: an option that cannot be used.
    """
    if options.run and options.policy:
        raise ConfigError("give --run or --policy, not both")
    if options.film and options.suite != "ood":
        raise ConfigError("--film takes a scene of --suite ood; a lane is filmed by cref_jax.play")
    given = [*options.run, *map(sources.find_policy, options.policy)]
    if len(given) > 1 and options.suite not in (None, "table", "walk"):
        raise ConfigError(f"--suite {options.suite} takes one run or policy, not {len(given)}")
    for path in given:
        sources.check_robot(path, options.robot)
    return given or [sources.resolve_policy(None, None, options.robot)]


def _suite_for(terrains: list[str]) -> Suite:
    """Choose the suite that measures what was learned on these terrains."""
    return "walk" if set(terrains) == {"flat"} else "table"


def _subject(source: Path, options: Options) -> Subject:
    # trials are shared out among the devices, of which a CPU has one a core
    in_trials = options.suite in ("table", "robust", "cross")
    threads = max(parallel.cores() // jax.device_count(), 1) if in_trials else 0
    world = build_world(sources.read_config(source), options.engine, threads)
    policy = sources.load(source, world)
    print(sources.describe(source, policy), flush=True)
    if policy.config.terrain.name == "flat" and options.suite in ("table", "robust", "ood"):
        print("on flat ground it learned to cross nothing: --suite walk measures what it learned")
    return Subject(source, policy, world)


def _trials_per_cell(options: Options) -> int:
    """Return the number of trials per cell."""
    return options.num_envs or (100 if jax.default_backend() == "cpu" else paper_results.TRIALS)


def _table(subjects: list[Subject], options: Options) -> dict[str, Any]:
    """Evaluate in all cells of Table II."""
    count = _trials_per_cell(options)
    print(f"{tables.interval_note(count * len(subjects))}\n{tables.RULE}", flush=True)
    judged, witness = [], Witness()  # of the first policy
    with _progress(Console(), 12 * count * len(subjects)) as ended:
        for subject in subjects:
            train = subject.policy.train
            w = tables.cell_world(subject.policy.config, subject.world.physics)
            see = None if judged else witness
            judged.append(tables.run_cells(w, train, count, options.seed, ended, see))
    rows = tables.cell_rows(judged)
    whole = tables.overall(rows)
    cli.print_table(tables.to_table(rows, whole))
    print("* beyond chance: 0 is not in the 95 % interval of the difference")
    print(tables.failure_lines(rows))
    seen = _pictures(witness, options)
    return {"rule": tables.RULE, "cells": rows, "overall": whole, **seen}


def _robust(subjects: list[Subject], options: Options) -> dict[str, Any]:
    """Evaluate with everything randomised, and with each part alone."""
    count, policy = _trials_per_cell(options), subjects[0].policy
    w = robustness_suite.row_world(policy.config, subjects[0].world.physics)
    with _progress(Console(), len(robustness_suite.list_rows()) * count) as ended:
        witness = Witness()
        found = robustness_suite.run_rows(
            w, policy.train, count, options.seed, ended, witness=witness
        )
    cli.print_table(robustness_suite.to_table(found))
    cli.print_table(robustness_suite.parts_table(found))
    whole = [row for row in found if row["part"] == robustness_suite.EVERYTHING]
    parts = [row for row in found if row["part"] != robustness_suite.EVERYTHING]
    overall = robustness_suite.overall(found)
    seen = _pictures(witness, options)
    return {"rule": tables.RULE, "cells": whole, "overall": overall, "parts": parts, **seen}


def _ood(subjects: list[Subject], options: Options) -> dict[str, Any]:
    """Evaluate in the scenes, through the numpy runtime."""
    with _export_subject(subjects[0]) as path:
        verdict = scene_suite.run_scenes(path, options.num_envs or 10, options.stress, options.seed)
    for table in scene_results.to_tables(verdict):
        cli.print_table(table)
    return verdict.as_dict()


def _film(subject: Subject, options: Options, out: Path) -> None:
    """Film the first trial in a scene."""
    with _export_subject(subject) as path:
        trial = scene_suite.film_trial(path, options.film or "", out, options.seed)
    print(f"wrote {out}: {trial.ending} after {trial.seconds:.1f} s and {trial.progress:.1f} m")


@contextlib.contextmanager
def _export_subject(subject: Subject) -> Iterator[Path]:
    """Yield the policy as an exported one; one in training is exported to a temporary folder."""
    if not (sources.is_run(subject.source) or learner_file.is_learner(subject.source)):
        yield subject.source
        return
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "policy"
        writer.write(subject.policy, subject.world, path)
        yield path


def _cross(subjects: list[Subject], options: Options) -> dict[str, Any]:
    subject, count, witness = subjects[0], _trials_per_cell(options), Witness()
    with _progress(Console(), count) as ended:
        result = crossing.cross(
            subject.policy.config, subject.world.physics, subject.policy.train, options.kind,
            options.size, count, options.seed, ended, witness=witness,
        )  # fmt: skip
    print(f"{subject.source}, iteration {subject.policy.iteration}: {result.line()}")
    return result._asdict() | _pictures(witness, options)


def _walk(subjects: list[Subject], options: Options) -> dict[str, Any]:
    """Walk on level ground; the episodes of several policies are pooled."""
    count, walks = _trials_per_cell(options), []
    for subject in subjects:
        policy, physics = subject.policy, subject.world.physics
        walks.append(walking.walk(policy.config, physics, policy.train, count, options.seed))
        print(f"{subject.source}, iteration {policy.iteration}: {walks[-1].line()}")
    pooled = walking.pool(walks)
    stood = intervals.wilson(pooled.episodes - pooled.fell, pooled.episodes)
    within = f"without a fall {100 * stood.low:.1f} to {100 * stood.high:.1f} % (95 %)"
    print(f"together: {pooled.line()}; {within}" if len(walks) > 1 else within)
    of_each = {"fell_by_policy": [walk.fell for walk in walks]} if len(walks) > 1 else {}
    return pooled._asdict() | {"wilson_low": stood.low, "wilson_high": stood.high} | of_each


def _pictures(witness: Witness, options: Options) -> dict[str, Any]:
    """Collect what the page draws of the trials, and film failures."""
    folder = (options.out or Path()) / f"failures_{options.suite}"
    films = failure_films.write(witness.world, witness.worst(options.films), folder)
    for line in dict.fromkeys(failure_films.describe(row, folder.parent) for row in films):
        print(line)
    return witness.record() | {"films": films}


def _commands(subjects: list[Subject], options: Options) -> dict[str, Any]:
    """Evaluate how commands are followed on level ground."""
    policy = subjects[0].policy
    with Console().status("13 commands, 10 s each"):
        physics = subjects[0].world.physics
        found = command_suite.run_commands(
            policy.config, physics, policy.train, _trials_per_cell(options), options.seed
        )
    cli.print_table(command_suite.to_table(found))
    print(command_suite.describe(found))
    return found


def _gate(subjects: list[Subject], options: Options) -> dict[str, Any]:
    """Measure the highway gate, and print its mean in each state."""
    policy, world = subjects[0].policy, subjects[0].world
    count = _trials_per_cell(options)
    rows = highway_gate.measure(policy.config, world, policy.train, count, options.seed)
    table = Table(title="highway gate (1: memory)", box=None)
    for title in ("group", "state", "steps", "mean", "quartiles"):
        table.add_column(title, justify="left" if title in ("group", "state") else "right")
    for row in rows:
        numbers = [f"{row[key]:.3f}" for key in ("mean", "q25", "q75") if row["n"]] or ["-"] * 3
        spread = " to ".join(numbers[1:])
        table.add_row(row["group"], row["state"], f"{row['n']:,}", numbers[0], spread)
    cli.print_table(table)
    return {"rule": highway_gate.RULE, "robots": count, "gate": rows}


def _provenance(subjects: list[Subject]) -> dict[str, Any]:
    """Collect policy, versions and machine for the record."""
    policies = [
        {
            "name": subject.policy.run.name,
            "source": subject.source.name if subject.source.is_absolute() else str(subject.source),
            "digest": reader.policy_digest(subject.policy),
            "iteration": subject.policy.iteration,
            "samples": subject.policy.samples,
        }
        for subject in subjects
    ]
    return {
        "policies": policies,
        "versions": run_dir.versions(),
        **run_dir.machine(),
    }


@contextlib.contextmanager
def _progress(console: Console, total: int) -> Iterator[Callable[[int], None]]:
    """Yield a callback that advances the progress bar."""
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
    """Write eval.json and its page.

    What is there of another suite stays, under that suite's name.
    """
    path = out / "eval.json"
    try:
        out.mkdir(parents=True, exist_ok=True)
        before = _suite(path)
        if before not in (None, record["suite"]):
            for old in out.glob("eval.*"):
                old.replace(old.with_stem(f"eval_{before}"))
        path.write_text(json.dumps(record, indent=2) + "\n")
    except OSError as error:
        raise ConfigError(f"cannot write {path}: {error.strerror}") from None
    evaluation_page.write(record, out / "eval.html")
    print(f"wrote {path} and eval.html")


def _suite(path: Path) -> str | None:
    """Return the suite of an existing eval.json, or None."""
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        return json.loads(path.read_text())["suite"]
    return None


if __name__ == "__main__":
    main()
