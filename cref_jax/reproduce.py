"""Train and evaluate the paper's variants, one after the other: `python -m cref_jax.reproduce`."""

import cref_jax.system.startup  # noqa: F401

import json
import shlex
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import tyro
from rich.console import Console
from rich.table import Table

from cref_jax import cli
from cref_jax.config import limits
from cref_jax.config.ranges import Within
from cref_jax.errors import ConfigError, TrainingError
from cref_jax.pages import reproduction_page
from cref_jax.physics.records import EngineName
from cref_jax.reproduction import plan as planning
from cref_jax.reproduction import progress, results
from cref_jax.reproduction.commands import Runner
from cref_jax.reproduction.plan import EXPERIMENTS, Experiment, Plan, Row
from cref_jax.reproduction.progress import GPU, GPU_SPEED, Forecast
from cref_jax.system import jax_setup
from cref_jax.terrain.kind_files import terrain_names
from cref_jax.training import run_dir
from cref_jax.training.parameter_count import count_parameters
from cref_jax.training.run_lock import lock

HOUR = 3600.0  # s
RESULT = "reproduction.json"


@dataclass(frozen=True)
class Options(cli.DebugOption):
    """Train variants x seeds, and put their tables beside the paper's; the same command goes on."""

    variants: tuple[Experiment, ...] = EXPERIMENTS
    """files in experiments/, each a row of the tables"""
    seeds: Annotated[tuple[int, ...], limits.SEED] = (0, 1)
    """of the trainings"""
    samples: Annotated[float | None, Within(1, 1e12)] = None
    """control steps of experience per run, such as 20e6 (default: those of the device's preset)"""
    terrain: Annotated[str, tyro.conf.arg(help=f"{', '.join(terrain_names())}")] = "mixed"
    trials: Annotated[int, Within(1, 1_000_000)] = 100
    """per cell of Table II, and robots whose gate is recorded"""
    num_envs: Annotated[int | None, Within(1, 1_000_000)] = None
    """robots (default: those of the device's preset)"""
    settings: str = ""
    """settings of a run for all rows alike, as `train` takes them, except network.variant; such as
    --settings="--ppo.epochs 3 --run.chunk 4" as one argument"""
    device: Literal["auto", "cpu", "gpu"] = "auto"
    """where the trainings run, which decides their preset"""
    engine: EngineName = "auto"
    """of the trainings: mujoco steps on the CPU, mjx and warp on the device"""
    devices: Annotated[int | None, Within(1, 1_000_000)] = None
    """devices per training (default: all)"""
    plan: bool = False
    """print rows, samples and hours, and train nothing"""
    out: Path = run_dir.ROOT / "reproduce"
    """folder of the runs and of the result"""


def main(arguments: list[str] | None = None) -> None:
    """Run the command line; a mistake in it is one line and exit code 2."""
    with cli.one_line_errors(arguments):
        o = cli.parse(Options, arguments, "reproduce")
        device = planning.choose_device(o.device)
        jax.config.update("jax_platforms", "cpu")  # an accelerator is left to the trainings
        jax_setup.prepare()
        plan = planning.build(
            o.variants, o.seeds, o.terrain, device, o.trials, o.samples, o.num_envs,
            _split_words(o.settings), o.engine, o.devices,
        )  # fmt: skip
        planning.check(o.out, plan)
        if o.plan:
            print_plan(o.out, plan)
            return
        cli.prepare_folder(o.out)
        with lock(o.out), Runner(**planning.environment(plan)) as runner:
            planning.claim(o.out, plan)
            reproduce(o.out, plan, runner)
        if runner.signal is not None:
            _say("stopped; the same command goes on from here")
            sys.exit(128 + runner.signal)


def reproduce(folder: Path, plan: Plan, runner: Runner) -> None:
    """Train and evaluate every row that is not finished, and write the result after each.

    Raises:
        TrainingError: a training or an evaluation has failed.
    """
    parameters = _count_parameters(plan)
    _write(folder, plan, parameters)
    for number, row in enumerate(plan.rows, 1):
        place = f"row {number} of {len(plan.rows)}, {row.name}"
        if runner.signal is None and not progress.is_finished(folder, plan, row):
            _complete_row(folder, plan, row, runner, place)
            _write(folder, plan, parameters)
    if runner.signal is None:
        _say(f"all {len(plan.rows)} rows are finished")
    _say(f"wrote {folder / RESULT} and {(folder / RESULT).with_suffix('.html')}")


def _split_words(settings: str) -> list[str]:
    try:
        return shlex.split(settings)
    except ValueError as error:
        raise ConfigError(f"--settings {settings}: {error}") from None


def _complete_row(folder: Path, plan: Plan, row: Row, runner: Runner, place: str) -> None:
    """Do what is left of a row, until it is done or a signal has come."""
    if not progress.is_trained(folder, plan, row):
        resume = progress.count_trained(folder, row) > 0
        _say(f"{place}: training{' goes on' if resume else ''}; {_time_left(folder, plan)}")
        words = planning.train_words(plan, row, folder, resume)
        _run(runner, words, place, lambda: _say_between(folder, plan))
        if runner.signal is None and not progress.is_trained(folder, plan, row):
            raise TrainingError(f"{place}: the training has ended early; the same command goes on")
    for suite in progress.suites(plan, row):
        if runner.signal is None and not progress.read_evaluation(folder, plan, row, suite):
            _say(f"{place}: evaluation, suite {suite}; {_time_left(folder, plan)}")
            _run(runner, progress.eval_words(plan, row, folder, suite), place)


def _run(runner: Runner, words: list[str], place: str, on_wait: Any = lambda: None) -> None:
    code = runner.run(words, on_wait)
    if code and runner.signal is None:
        raise TrainingError(
            f"{place}: {words[0]} has ended with exit code {code}; what it said is above; the same "
            "command goes on from there"
        )


def _count_parameters(plan: Plan) -> dict[str, dict[str, int]]:
    """Count the parameters of each variant's policy and critic."""
    counts = count_parameters(plan.configs)
    return {
        name: {"policy": sum(parts.values()) - parts["critic"], "critic": parts["critic"]}
        for name, parts in counts.items()
    }


def _write(folder: Path, plan: Plan, parameters: dict[str, dict[str, int]]) -> None:
    """Write the result so far, as JSON and as a page."""
    record = results.build_record(folder, plan, parameters)
    path, part = folder / RESULT, folder / f"{RESULT}.part"
    part.write_text(json.dumps(record, indent=2) + "\n")
    part.replace(path)
    reproduction_page.write(record, path.with_suffix(".html"))


def print_plan(folder: Path, plan: Plan) -> None:
    """Print the rows with their samples and hours, here and on a GPU."""
    here = progress.forecast(folder, plan)
    table = Table(box=None, padding=(0, 1))
    for title in ("row", "iterations", "samples", "hours here", f"hours, {GPU}", "done"):
        table.add_column(title, justify="left" if title == "row" else "right", no_wrap=True)
    hours = lambda seconds: f"{seconds / HOUR:.1f}"
    for row in plan.rows:
        run, samples = plan.configs[row.variant].run, plan.samples(row)
        done = progress.count_trained(folder, row) / run.iterations
        table.add_row(
            row.name, f"{run.iterations:,}", f"{samples / 1e6:,.1f} M",
            hours(here.seconds(plan, row)), hours(samples / GPU_SPEED), f"{done:.0%}",
        )  # fmt: skip
    total = sum(plan.samples(row) for row in plan.rows)
    seconds = sum(here.seconds(plan, row) for row in plan.rows)
    table.add_section()
    table.add_row(
        f"{len(plan.rows)} rows", "", f"{total / 1e6:,.1f} M", hours(seconds),
        hours(total / GPU_SPEED), "",
    )  # fmt: skip
    cli.print_table(table)
    console = Console()
    for line in _plan_notes(here):
        console.print(line, highlight=False, soft_wrap=True)


def _plan_notes(here: Forecast) -> list[str]:
    """Say what the hours of the plan are derived from."""
    evaluation = (
        f"evaluation comes on top: {here.evaluation / 60:.1f} min per row, measured here"
        if here.evaluation is not None
        else "evaluation comes on top; none has been measured here yet"
    )
    return [
        f"hours here: {here.source}",
        f"hours, {GPU}: {GPU_SPEED:,} samples/s, measured for the full network on mixed with "
        "MuJoCo Warp and 4096 robots (experiments/RESULTS.md); not for the other variants",
        f"training alone; {evaluation}",
        f"left here: {here.left / HOUR:.1f} hours",
    ]


def _time_left(folder: Path, plan: Plan) -> str:
    here = progress.forecast(folder, plan)
    without = "" if here.evaluation is not None else " without evaluations"
    return f"{here.left / HOUR:.1f} h left for the whole plan{without} ({here.source})"


def _say_between(folder: Path, plan: Plan) -> None:
    """Say the time left while a row is trained; on a terminal that row's own display is there."""
    if not sys.stdout.isatty():
        _say(_time_left(folder, plan))


def _say(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    main()
