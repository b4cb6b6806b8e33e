"""Results of the trials in the scenes: records, pass criterion and tables."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.table import Table

from cref_jax import robot
from cref_jax.deploy import Status
from cref_jax.evaluation.intervals import wilson
from cref_jax.evaluation.lateral_drift import summarize
from cref_jax.whole_body.disturbances import UNDISTURBED, Disturbance

PASSED = 0.5
"""share of a scene's trials that must reach its end; assumed: the paper counts scenes and gives no
criterion"""
RULE = (
    f"A scene is passed when at least {PASSED:.0%} of its trials reach its end within 40 s, "
    "without a fall, a step off the path or a stall (less than 0.3 of the commanded distance over "
    "10 s)."
)


class Condition(NamedTuple):
    """Conditions under which trials are run."""

    name: str
    disturbance: Disturbance = UNDISTURBED
    friction: float = robot.FRICTION


class TrialOutcome(NamedTuple):
    """Measures by which a trial is counted; see whole_body.trial.Trial."""

    ending: str
    seconds: float
    progress: float  # m
    speed: float  # m/s
    status: Status
    drift: float  # m, see lateral_drift.measure
    aside: float  # m


class SceneResult(NamedTuple):
    """Outcome of the undisturbed trials in one scene."""

    name: str
    title: str
    trials: int
    successes: int
    failures: dict[str, int]  # by cause
    rate: float
    wilson_low: float
    wilson_high: float
    seconds: float | None  # mean time of a success
    passed: bool
    sideways: dict[str, float]  # m, see lateral_drift.summarize


class ConditionResult(NamedTuple):
    """Outcome of the trials in all scenes under one condition."""

    name: str
    dropped: float  # share of frames
    latency: int  # control steps
    invalid: float  # share of the image
    noise: float  # m, deviation at 1 m
    scale: float
    dead: float  # share of the columns
    view: tuple[float, float]  # deg, vertical and horizontal
    friction: float
    trials: int
    successes: int
    failures: dict[str, int]  # by cause
    rate: float
    wilson_low: float
    wilson_high: float
    by_scene: dict[str, int]  # successes
    passed: int  # scenes
    said: dict[str, int]  # trials in which the policy raised each status flag


class Verdict(NamedTuple):
    """All results of the suite."""

    rule: str  # pass criterion
    passed: int  # scenes
    scenes: tuple[SceneResult, ...]
    conditions: tuple[ConditionResult, ...]  # the undisturbed one first

    def as_dict(self) -> dict[str, Any]:
        """Convert the records to JSON types."""
        return {
            **self._asdict(),
            "scenes": [result._asdict() for result in self.scenes],
            "conditions": [result._asdict() for result in self.conditions],
        }


def build_verdict(
    titles: dict[str, str], table: dict[Condition, dict[str, list[TrialOutcome]]]
) -> Verdict:
    """Summarize all trials.

    Args:
        titles: of the scenes, by name.
        table: outcomes by condition, the undisturbed one first, then by scene.
    """
    undisturbed = next(iter(table.values()))
    each = [summarize_scene(name, titles[name], outcomes) for name, outcomes in undisturbed.items()]
    return Verdict(
        rule=RULE,
        passed=sum(result.passed for result in each),
        scenes=tuple(each),
        conditions=tuple(summarize_condition(*row) for row in table.items()),
    )


def summarize_scene(name: str, title: str, outcomes: Sequence[TrialOutcome]) -> SceneResult:
    """Summarize the undisturbed trials in one scene."""
    rate = wilson(count_successes(outcomes), len(outcomes))
    seconds = [o.seconds for o in outcomes if o.ending == "finished"]
    return SceneResult(
        name=name,
        title=title,
        trials=len(outcomes),
        successes=count_successes(outcomes),
        failures=count_causes(outcomes),
        rate=rate.value,
        wilson_low=rate.low,
        wilson_high=rate.high,
        seconds=float(np.mean(seconds)) if seconds else None,
        passed=is_passed(outcomes),
        sideways=summarize(
            np.array([o.drift for o in outcomes]), np.array([o.aside for o in outcomes])
        ),
    )


def summarize_condition(
    condition: Condition, by_scene: dict[str, list[TrialOutcome]]
) -> ConditionResult:
    """Summarize the trials in all scenes under one condition."""
    every = [outcome for outcomes in by_scene.values() for outcome in outcomes]
    rate = wilson(count_successes(every), len(every))
    raised = Counter(flag.name for o in every for flag in Status if flag & o.status)
    return ConditionResult(
        name=condition.name,
        dropped=condition.disturbance.dropped,
        latency=condition.disturbance.latency,
        invalid=condition.disturbance.invalid,
        noise=condition.disturbance.noise,
        scale=condition.disturbance.scale,
        dead=condition.disturbance.dead,
        view=condition.disturbance.view,
        friction=condition.friction,
        trials=len(every),
        successes=count_successes(every),
        failures=count_causes(every),
        rate=rate.value,
        wilson_low=rate.low,
        wilson_high=rate.high,
        by_scene={name: count_successes(outcomes) for name, outcomes in by_scene.items()},
        passed=sum(is_passed(outcomes) for outcomes in by_scene.values()),
        said={str(name): count for name, count in raised.items()},
    )


def count_successes(outcomes: Sequence[TrialOutcome]) -> int:
    """Count the trials that reached the end."""
    return sum(o.ending == "finished" for o in outcomes)


def count_causes(outcomes: Sequence[TrialOutcome]) -> dict[str, int]:
    """Count the failures by cause, the most frequent first."""
    return dict(Counter(o.ending for o in outcomes if o.ending != "finished").most_common())


def is_passed(outcomes: Sequence[TrialOutcome]) -> bool:
    """Check whether a scene is passed, by `RULE`."""
    return count_successes(outcomes) >= PASSED * len(outcomes)


def to_tables(verdict: Verdict) -> tuple[Table, Table]:
    """Build the tables of the verdict: by scene, and by condition."""
    by_scene = Table(title=f"{verdict.passed} of {len(verdict.scenes)} scenes passed")
    for column in ("scene", "trials", "successes", "95 %", "failures"):
        by_scene.add_column(column, justify="left" if column in ("scene", "failures") else "right")
    for r in verdict.scenes:
        by_scene.add_row(
            r.title, str(r.trials), str(r.successes), _interval_text(r), _causes_text(r.failures),
            style="green" if r.passed else "",
        )  # fmt: skip
    by_condition = Table(title="the same scenes under conditions")
    for column in ("condition", "trials", "successes", "95 %", "scenes passed", "failures"):
        left = column in ("condition", "failures")
        by_condition.add_column(column, justify="left" if left else "right")
    for r in verdict.conditions:
        by_condition.add_row(
            r.name, str(r.trials), str(r.successes), _interval_text(r), str(r.passed),
            _causes_text(r.failures),
        )  # fmt: skip
    return by_scene, by_condition


def _interval_text(result: SceneResult | ConditionResult) -> str:
    return f"{result.wilson_low:.0%} to {result.wilson_high:.0%}"


def _causes_text(causes: dict[str, int]) -> str:
    return ", ".join(f"{count} {cause}" for cause, count in causes.items())
