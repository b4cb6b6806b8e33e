"""Tables II and III: twelve cells of success, the failures on stairs, the paper's figures beside.

A trial of a cell of stairs is one flight, up and down in turn, so that the failures of both
directions add up to those of the cell, as they do in the paper.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Int
from rich.table import Table

from cref_jax import config, ppo
from cref_jax.config import Config
from cref_jax.env.world import World, make_world
from cref_jax.evaluation import intervals, lateral_drift, paper_results, protocol, trials
from cref_jax.evaluation.intervals import Rate
from cref_jax.evaluation.paper_results import Cell
from cref_jax.evaluation.trials import Trials
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import lanes

LANES = {"stairs": ("ascent", "descent"), "gap": ("gap",), "platform": ("platform",)}
UP, DOWN = 0, 1  # in LANES["stairs"]
SPEEDS = (0.4, 0.5, 0.6, 0.7, 0.8)  # m/s, edges of the groups of commands
RULE = (
    "A trial is won at the lane's end, within 40 s, and lost where the robot falls, stalls (less "
    "than 0.3 of the commanded distance over 10 s) or is late. Commands: 0.4 to 0.8 m/s forward."
)


class Lanes(NamedTuple):
    """On which lane of the world each of N trials is made."""

    kind: Int[np.ndarray, " N"]
    level: Int[np.ndarray, " N"]


class Outcomes(NamedTuple):
    """The trials of one policy in one cell."""

    trials: Trials
    is_down: Bool[np.ndarray, " N"]  # a flight of stairs down; never true elsewhere


def cell_sizes() -> dict[str, dict[str, float]]:
    """Return the size of each kind's obstacles at each level, m."""
    return {kind: lanes.named_sizes(config.Terrain(), of[0]) for kind, of in LANES.items()}


def world(c: Config, physics: Physics) -> World:
    """Return the world with the lanes of all cells."""
    sized = {lane: tuple(cell_sizes()[kind].values()) for kind, of in LANES.items() for lane in of}
    return world_of(c, physics, sized)


def world_of(c: Config, physics: Physics, sized: Mapping[str, Sequence[float]]) -> World:
    """Return the world of trials on lanes with obstacles of these sizes of each kind, m."""
    atlas = lanes.grid(config.Terrain(cell=c.terrain.cell), sized, protocol.LANE_SEEDS)
    return make_world(protocol.trial_config(c), physics).replace(lanes=atlas)


def lanes_of(cell: Cell, count: int, kinds: Sequence[str]) -> Lanes:
    """Return the lanes of so many trials of a cell: kinds and seeds in turn."""
    return round_robin_lanes(LANES[cell[0]], paper_results.LEVELS.index(cell[1]), count, kinds)


def round_robin_lanes(names: Sequence[str], level: int, count: int, kinds: Sequence[str]) -> Lanes:
    """Return so many lanes of these names and this level, of a world's kinds and seeds in turn."""
    number, variants = np.arange(count), len(protocol.LANE_SEEDS)
    of = np.array([kinds.index(lane) for lane in names])
    first = level * variants
    return Lanes(of[number % len(of)], first + number // len(of) % variants)


def run_cells(
    w: World,
    train: ppo.TrainState,
    count: int,
    seed: int,
    ended: Callable[[int], None] = lambda count: None,
) -> dict[Cell, Outcomes]:
    """Return what a policy makes of `count` trials of each cell; `ended` is told of each end."""
    every = list(paper_results.METHODS[paper_results.FULL].success)
    on = [lanes_of(cell, count, w.lanes.kinds) for cell in every]
    kind, level = map(np.concatenate, zip(*on, strict=True))
    asked = trials.Asked(np.tile(np.arange(count), len(every)), kind, level)
    made = trials.run(w, trials.follow(train), asked, seed, protocol.robots_per_block(), ended)
    down = kind == w.lanes.kinds.index("descent")
    part = lambda k: slice(k * count, (k + 1) * count)
    return {
        cell: Outcomes(Trials(*(x[part(k)] for x in made)), down[part(k)])
        for k, cell in enumerate(every)
    }


def cells(judged: Sequence[Mapping[Cell, Outcomes]]) -> list[dict[str, Any]]:
    """Return the rows of eval.json, the trials of several policies pooled."""
    return [_cell(cell, [of[cell] for of in judged]) for cell in judged[0]]


def overall(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the plain means of all cells, of those inside of training, and of the others."""
    ours = lambda some: intervals.mean([_rate(row) for row in some])
    theirs = lambda some: float(np.mean([row["paper"]["rate"] for row in some]))
    inside = [row for row in rows if row["level"] != "ood"]
    outside = [row for row in rows if row["level"] == "ood"]
    whole = ours(rows)
    return {
        "rate": whole.value,
        "wilson_low": whole.low,
        "wilson_high": whole.high,
        "paper": theirs(rows),
        "trained": ours(inside).value,
        "paper_trained": theirs(inside),
        "ood": ours(outside).value,
        "paper_ood": theirs(outside),
    }


def text(rows: Sequence[dict[str, Any]], whole: dict[str, Any]) -> Table:
    """Return the table for the terminal, in percent."""
    table = Table(box=None, padding=(0, 1))
    table.add_column("success, %", no_wrap=True)
    several = len(rows[0]["by_policy"]) > 1
    titles = ("trials", "ours", "95 %", "paper", "difference", "up", "down")
    for title in (*titles, *(["each policy"] if several else [])):
        table.add_column(title, justify="right", no_wrap=True)
    for row in rows:
        both_ways = row["up_failures"], row["down_failures"]
        table.add_row(
            f"{row['kind']} {100 * row['size_m']:.0f} cm" + " (OOD)" * (row["level"] == "ood"),
            str(row["trials"]),
            *_beside_paper(
                row["rate"], row["paper"]["rate"], _rate(row), row["paper"]["significant"]
            ),
            *("" if failures is None else str(failures) for failures in both_ways),
            *([", ".join(f"{100 * rate:.0f}" for rate in row["by_policy"])] if several else []),
            end_section=row["level"] == "ood",
        )
    ours = Rate(whole["rate"], whole["wilson_low"], whole["wilson_high"])
    table.add_row("all twelve", "", *_beside_paper(whole["rate"], whole["paper"], ours))
    table.add_row("nine trained", "", *_beside_paper(whole["trained"], whole["paper_trained"]))
    table.add_row("three OOD", "", *_beside_paper(whole["ood"], whole["paper_ood"]))
    return table


def failures(rows: Sequence[dict[str, Any]]) -> str:
    """Return how trials failed, in one line a kind of terrain."""
    lines = []
    for kind in paper_results.KINDS:
        of_kind = [row["failures"] for row in rows if row["kind"] == kind]
        total = {name: sum(row[name] for row in of_kind) for name in trials.FAILURES}
        said = ", ".join(f"{n} {name}" for name, n in total.items() if n) or "none"
        lines.append(f"failures on {kind}: {said}")
    return "\n".join(lines)


def interval_note(count: int) -> str:
    """Return how sure `count` trials make a rate, in words."""

    def half(share: float) -> float:
        rate = intervals.wilson(round(share * count), count)
        return 50.0 * (rate.high - rate.low)

    return (
        f"{count} trials a cell: 95 % intervals of +-{half(0.97):.1f} points at 97 % success, "
        f"+-{half(0.75):.1f} at 75 %, +-{half(0.5):.1f} at 50 %"
    )


def _cell(cell: Cell, outcomes: list[Outcomes]) -> dict[str, Any]:
    """Return one row: the trials of all policies together."""
    kind, level = cell
    all_trials = Trials(*map(np.concatenate, zip(*(o.trials for o in outcomes), strict=True)))
    lost, is_down = ~all_trials.succeeded, np.concatenate([o.is_down for o in outcomes])
    rate = intervals.wilson(int((~lost).sum()), len(lost))
    by_policy = [float(o.trials.succeeded.mean()) for o in outcomes]
    return {
        "kind": kind,
        "level": level,
        "size_m": cell_sizes()[kind][level],
        "trials": len(lost),
        "successes": int((~lost).sum()),
        "rate": rate.value,
        "wilson_low": rate.low,
        "wilson_high": rate.high,
        "up_failures": int((lost & ~is_down).sum()) if kind == "stairs" else None,
        "down_failures": int((lost & is_down).sum()) if kind == "stairs" else None,
        "failures": all_trials.failures(),
        "by_speed": _by_speed(all_trials),
        "sideways": lateral_drift.summarize(all_trials.drift, all_trials.aside),
        "by_policy": by_policy,
        "spread": float(np.std(by_policy, ddof=1)) if len(by_policy) > 1 else None,
        "paper": _beside(rate, cell),
    }


def _by_speed(made: Trials) -> list[dict[str, Any]]:
    """Return trials and successes in each group of commanded speeds."""
    group = np.clip(np.searchsorted(SPEEDS, made.speed, side="right") - 1, 0, len(SPEEDS) - 2)
    return [
        {
            "low": low,
            "high": high,
            "trials": int((group == k).sum()),
            "successes": int(made.succeeded[group == k].sum()),
        }
        for k, (low, high) in enumerate(itertools.pairwise(SPEEDS))
    ]


def _beside(ours: Rate, cell: Cell) -> dict[str, Any]:
    """Return the paper's rate, the difference of ours from it and whether it is significant."""
    successes = round(
        paper_results.METHODS[paper_results.FULL].success[cell] / 100.0 * paper_results.TRIALS
    )
    theirs = intervals.wilson(successes, paper_results.TRIALS)
    gap = intervals.difference(ours, theirs)
    return {
        "rate": theirs.value,
        "trials": paper_results.TRIALS,
        "difference": gap.value,
        "difference_low": gap.low,
        "difference_high": gap.high,
        "significant": intervals.is_significant(gap),
    }


def _rate(row: dict[str, Any]) -> Rate:
    return Rate(row["rate"], row["wilson_low"], row["wilson_high"])


def _beside_paper(
    ours: float, theirs: float, interval: Rate | None = None, is_significant: bool = False
) -> list[str]:
    """Return our rate, its interval, the paper's rate and the difference, in percent."""
    span = f"{100 * interval.low:.0f}-{100 * interval.high:.0f}" if interval else ""
    gap = f"{100 * (ours - theirs):+.1f} {'*' if is_significant else ' '}"
    return [f"{100 * ours:.1f}", span, f"{100 * theirs:.2f}", gap]
