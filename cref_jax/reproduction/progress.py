"""How far a plan is: what of each row is done, at what speed, and how long the rest takes."""

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

from cref_jax.errors import ConfigError
from cref_jax.evaluation import highway_gate
from cref_jax.policy import trained
from cref_jax.reproduction.plan import Plan, Row
from cref_jax.system import parallel
from cref_jax.training.checkpoint import Checkpoints

GPU = "H100"
GPU_SPEED = 162_786  # samples/s of `mixed`, 4096 robots, engine warp: experiments/RESULTS.md
CORE_SPEED = (
    86.0e6 / (230 * 60) / 4
)  # samples/s per core of `full` on `mixed`: experiments/README.md
LOGGED = re.compile(rb'^\{"iteration": (\d+), "samples_per_s": (\d+)', re.MULTILINE)


class Speed(NamedTuple):
    """Samples that were trained on, and the time that took."""

    samples: int
    seconds: float

    @property
    def rate(self) -> float | None:
        """Samples per second, None without a measurement."""
        return self.samples / self.seconds if self.seconds else None


def suites(plan: Plan, row: Row) -> tuple[str, ...]:
    """Return the suites of `eval` that a row is measured with."""
    has_gate = plan.configs[row.variant].network.variant not in highway_gate.GATELESS
    return ("table", "gate") if has_gate else ("table",)


def evaluation_folder(folder: Path, row: Row, suite: str) -> Path:
    """Return the folder of a row's evaluation."""
    return folder / row.name / "evaluation" / suite


def eval_words(plan: Plan, row: Row, folder: Path, suite: str) -> list[str]:
    """Write the command that evaluates a row."""
    out = evaluation_folder(folder, row, suite)
    words = ["eval", "--run", str(folder / row.name), "--suite", suite, "--out", str(out)]
    return [*words, "--num-envs", str(plan.trials), "--films", "0"]


def count_trained(folder: Path, row: Row) -> int:
    """Count the iterations of a row's newest checkpoint."""
    path = folder / row.name / "checkpoints"
    return (Checkpoints(path).latest() or 0) if path.is_dir() else 0


def is_trained(folder: Path, plan: Plan, row: Row) -> bool:
    """Check whether a row's last iteration is saved.

    Raises:
        ConfigError: there are more iterations than planned.
    """
    done, last = count_trained(folder, row), plan.configs[row.variant].run.iterations
    if done > last:
        raise ConfigError(f"{folder / row.name} has {done} iterations, more than the plan's {last}")
    return done == last


def read_evaluation(folder: Path, plan: Plan, row: Row, suite: str) -> dict[str, Any] | None:
    """Read a row's evaluation by a suite; None where it is missing, cut short or of another state.

    It is of another state if it has another number of trials, or is of other iterations.
    """
    try:
        path = evaluation_folder(folder, row, suite) / "eval.json"
        record = json.loads(path.read_text())
        trials = {"table": lambda: record["cells"][0]["trials"], "gate": lambda: record["robots"]}
        found = record["suite"], record["policies"][0]["iteration"], trials[suite]()
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return None
    last = plan.configs[row.variant].run.iterations
    return record if found == (suite, last, plan.trials) else None


def is_finished(folder: Path, plan: Plan, row: Row) -> bool:
    """Check whether a row is trained and evaluated."""
    return is_trained(folder, plan, row) and all(
        read_evaluation(folder, plan, row, suite) is not None for suite in suites(plan, row)
    )


def measure_speed(folder: Path, plan: Plan, row: Row) -> Speed:
    """Measure a row's speed by its log, without pauses; repeated iterations count twice."""
    try:
        log = (folder / row.name / "log.jsonl").read_bytes()
    except OSError:
        return Speed(0, 0.0)
    each = trained.count_samples(plan.configs[row.variant], 1)
    rates = [int(rate) for _, rate in LOGGED.findall(log) if int(rate)]
    return Speed(each * len(rates), sum(each / rate for rate in rates))


def count_logged(folder: Path, row: Row) -> int:
    """Count the iterations of a row that are done, saved or not."""
    try:
        logged = LOGGED.findall((folder / row.name / "log.jsonl").read_bytes())
    except OSError:
        return 0
    return int(logged[-1][0]) if logged else 0


class Forecast(NamedTuple):
    """Time that the plan takes on this machine, and what it is derived from."""

    rates: dict[str, float]  # samples/s of each variant
    source: str
    evaluation: float | None  # s per row, None before one was measured
    training_left: float  # s
    left: float  # s, evaluations included as far as known

    def seconds(self, plan: Plan, row: Row) -> float:
        """Compute the time of a row's whole training, s."""
        return plan.samples(row) / self.rates[row.variant]


def forecast(folder: Path, plan: Plan) -> Forecast:
    """Forecast by the logs in the folder; without any, by an assumed speed."""
    speeds = {row: measure_speed(folder, plan, row) for row in plan.rows}
    of = lambda rows: Speed(*map(sum, zip(*(speeds[row] for row in rows), strict=True))).rate
    all_rows = of(plan.rows)
    assumed = CORE_SPEED * parallel.cores() if plan.device == "cpu" else float(GPU_SPEED)
    rates = {
        variant: of([row for row in plan.rows if row.variant == variant]) or all_rows or assumed
        for variant in plan.variants
    }
    own = sum(of([row for row in plan.rows if row.variant == v]) is not None for v in plan.variants)
    seconds, waiting = [], 0
    for row in plan.rows:
        found = [read_evaluation(folder, plan, row, suite) for suite in suites(plan, row)]
        if all(found):
            seconds.append(sum(record["seconds"] for record in found if record))
        else:
            waiting += 1
    evaluation = sum(seconds) / len(seconds) if seconds else None
    training = sum(
        (plan.samples(row) - _samples_done(folder, plan, row)) / rates[row.variant]
        for row in plan.rows
    )
    source = _describe_source(plan, own, assumed)
    return Forecast(rates, source, evaluation, training, training + waiting * (evaluation or 0.0))


def _samples_done(folder: Path, plan: Plan, row: Row) -> int:
    c = plan.configs[row.variant]
    return trained.count_samples(c, min(count_logged(folder, row), c.run.iterations))


def _describe_source(plan: Plan, own: int, assumed: float) -> str:
    if own:
        others = "; the others have the mean of all logs" if own < len(plan.variants) else ""
        return f"measured, by the logs of {own} of {len(plan.variants)} variants here{others}"
    if plan.device == "gpu":
        return f"not measured: that of an {GPU} is taken for this GPU"
    return (
        f"not measured, assumed: {CORE_SPEED:,.0f} samples/s per core, as `full` had on `mixed` on "
        f"four cores, here with {parallel.cores()}"
    )
