"""What the trials in the scenes come to: the records, how they are counted, and their tables."""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

from cref_jax import robot
from cref_jax.deploy import Status
from cref_jax.disturbance import UNDISTURBED, Disturbance
from cref_jax.proportion import wilson

PASSED = 0.5  # share of a scene's trials that must come to its end; assumed: the paper counts
# scenes, and does not say what it takes
RULE = f"at least {PASSED:.0%} of its trials come to the end"


class Condition(NamedTuple):
    """What the trials are run under."""

    name: str
    disturbance: Disturbance = UNDISTURBED
    friction: float = robot.FRICTION


class Outcome(NamedTuple):
    """What a trial is counted by; see stand_in.Trial."""

    ending: str
    seconds: float
    progress: float  # m
    speed: float  # m/s
    status: Status


class SceneResult(NamedTuple):
    """The outcome of the undisturbed trials in one scene."""

    scene: str
    title: str
    trials: int
    successes: int
    by_cause: dict[str, int]  # of the failures
    wilson_low: float
    wilson_high: float
    seconds: float | None  # mean time of a success
    passed: bool


class ConditionResult(NamedTuple):
    """The outcome of the trials in all scenes under one condition."""

    condition: str
    dropped: float  # share of frames
    latency: int  # control steps
    invalid: float  # share of the image
    friction: float
    trials: int
    successes: int
    by_cause: dict[str, int]  # of the failures
    wilson_low: float
    wilson_high: float
    by_scene: dict[str, int]  # successes
    scenes_passed: int
    said: dict[str, int]  # trials in which the policy noticed this


class Verdict(NamedTuple):
    """Everything that was measured."""

    policy: str
    digest: str
    seed: int
    rule: str  # when a scene counts as passed
    scenes_passed: int
    scenes: tuple[SceneResult, ...]
    conditions: tuple[ConditionResult, ...]  # the undisturbed one first

    def as_dict(self) -> dict[str, Any]:
        """Return what JSON can hold."""
        return {
            **self._asdict(),
            "scenes": [result._asdict() for result in self.scenes],
            "conditions": [result._asdict() for result in self.conditions],
        }


def verdict(
    policy: str,
    digest: str,
    seed: int,
    titles: dict[str, str],
    table: dict[Condition, dict[str, list[Outcome]]],
) -> Verdict:
    """Return what all trials come to.

    Args:
        policy: where it lies.
        digest: of the policy.
        seed: of the trials.
        titles: of the scenes, by their names.
        table: outcomes by condition, the undisturbed one first, and by scene.
    """
    undisturbed = next(iter(table.values()))
    each = [scene_result(name, titles[name], found) for name, found in undisturbed.items()]
    return Verdict(
        policy=policy,
        digest=digest,
        seed=seed,
        rule=RULE,
        scenes_passed=sum(result.passed for result in each),
        scenes=tuple(each),
        conditions=tuple(condition_result(*row) for row in table.items()),
    )


def scene_result(name: str, title: str, outcomes: Sequence[Outcome]) -> SceneResult:
    """Return what the undisturbed trials in one scene come to."""
    _, low, high = wilson(successes(outcomes), len(outcomes))
    seconds = [o.seconds for o in outcomes if o.ending == "finished"]
    return SceneResult(
        scene=name,
        title=title,
        trials=len(outcomes),
        successes=successes(outcomes),
        by_cause=by_cause(outcomes),
        wilson_low=low,
        wilson_high=high,
        seconds=float(np.mean(seconds)) if seconds else None,
        passed=is_passed(outcomes),
    )


def condition_result(condition: Condition, by_scene: dict[str, list[Outcome]]) -> ConditionResult:
    """Return what the trials in all scenes under one condition come to."""
    every = [outcome for outcomes in by_scene.values() for outcome in outcomes]
    _, low, high = wilson(successes(every), len(every))
    said = Counter(flag.name for o in every for flag in Status if flag & o.status)
    return ConditionResult(
        condition=condition.name,
        dropped=condition.disturbance.dropped,
        latency=condition.disturbance.latency,
        invalid=condition.disturbance.invalid,
        friction=condition.friction,
        trials=len(every),
        successes=successes(every),
        by_cause=by_cause(every),
        wilson_low=low,
        wilson_high=high,
        by_scene={name: successes(outcomes) for name, outcomes in by_scene.items()},
        scenes_passed=sum(is_passed(outcomes) for outcomes in by_scene.values()),
        said={str(name): count for name, count in said.items()},
    )


def successes(outcomes: Sequence[Outcome]) -> int:
    """Return how many came to the end."""
    return sum(o.ending == "finished" for o in outcomes)


def by_cause(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Return how many failed for each cause, the most frequent first."""
    return dict(Counter(o.ending for o in outcomes if o.ending != "finished").most_common())


def is_passed(outcomes: Sequence[Outcome]) -> bool:
    """Return whether a scene counts as passed, by `RULE`."""
    return successes(outcomes) >= PASSED * len(outcomes)


def show(verdict: Verdict, console: Console) -> None:
    """Print the verdict as two tables."""
    by_scene = Table(title=f"{verdict.scenes_passed} of {len(verdict.scenes)} scenes passed")
    for column in ("scene", "trials", "to the end", "95 %", "failures"):
        by_scene.add_column(column, justify="left" if column in ("scene", "failures") else "right")
    for r in verdict.scenes:
        by_scene.add_row(
            r.title, str(r.trials), str(r.successes), _interval(r), _causes(r.by_cause),
            style="green" if r.passed else "",
        )  # fmt: skip
    console.print(by_scene)
    by_condition = Table(title=f"a scene is passed when {verdict.rule}")
    for column in ("condition", "trials", "to the end", "95 %", "scenes passed", "failures"):
        left = column in ("condition", "failures")
        by_condition.add_column(column, justify="left" if left else "right")
    for r in verdict.conditions:
        by_condition.add_row(
            r.condition, str(r.trials), str(r.successes), _interval(r), str(r.scenes_passed),
            _causes(r.by_cause),
        )  # fmt: skip
    console.print(by_condition)


def _interval(result: SceneResult | ConditionResult) -> str:
    return f"{result.wilson_low:.0%} to {result.wilson_high:.0%}"


def _causes(causes: dict[str, int]) -> str:
    return ", ".join(f"{count} {cause}" for cause, count in causes.items())
