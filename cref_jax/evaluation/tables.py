"""Tables II and III: success in twelve cells and failures on stairs, beside the paper's results.

A trial on stairs is one flight, alternately up and down, so the failures of both directions add up
to those of the cell, as in the paper.
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
from cref_jax.evaluation.witness import Witness
from cref_jax.physics.simulation import Physics
from cref_jax.terrain import lanes

LANES = {"stairs": ("ascent", "descent"), "gap": ("gap",), "platform": ("platform",)}
UP, DOWN = 0, 1  # in LANES["stairs"]
SPEEDS = (0.4, 0.5, 0.6, 0.7, 0.8)  # m/s, edges of the groups of commanded speeds
RULE = (
    "A trial succeeds if the robot reaches the lane's end within 40 s, and fails if it falls, "
    "stalls (less than 0.3 of the commanded distance over 10 s) or is late. Commands: 0.4 to 0.8 "
    "m/s forward."
)


class Lanes(NamedTuple):
    """Lanes of N trials in the world."""

    kind: Int[np.ndarray, " N"]
    level: Int[np.ndarray, " N"]


class CellOutcomes(NamedTuple):
    """Trials of one policy in one cell."""

    trials: Trials
    is_down: Bool[np.ndarray, " N"]  # down a flight of stairs; false elsewhere


def cell_sizes() -> dict[str, dict[str, float]]:
    """Return the obstacle size of each kind at each level, m."""
    return {kind: lanes.named_sizes(config.Terrain(), of[0]) for kind, of in LANES.items()}


def cell_world(c: Config, physics: Physics) -> World:
    """Build the world with the lanes of all cells."""
    sized = {lane: tuple(cell_sizes()[kind].values()) for kind, of in LANES.items() for lane in of}
    return make_lane_world(c, physics, sized)


def make_lane_world(c: Config, physics: Physics, sized: Mapping[str, Sequence[float]]) -> World:
    """Build the world of trials on lanes with these obstacle sizes of each kind, m."""
    atlas = lanes.build_grid(config.Terrain(cell=c.terrain.cell), sized, protocol.LANE_SEEDS)
    return make_world(protocol.trial_config(c), physics).replace(lanes=atlas)


def cell_lanes(cell: Cell, count: int, kinds: Sequence[str]) -> Lanes:
    """Return the lanes of `count` trials of a cell, round-robin over kinds and seeds."""
    return round_robin_lanes(LANES[cell[0]], paper_results.LEVELS.index(cell[1]), count, kinds)


def round_robin_lanes(names: Sequence[str], level: int, count: int, kinds: Sequence[str]) -> Lanes:
    """Return `count` lanes of one level, round-robin over the named kinds, then over seeds.

    `kinds` are those of the world, in its order.
    """
    number, variants = np.arange(count), len(protocol.LANE_SEEDS)
    of = np.array([kinds.index(lane) for lane in names])
    first = level * variants
    return Lanes(of[number % len(of)], first + number // len(of) % variants)


def run_cells(
    w: World,
    train: ppo.TrainState,
    count: int,
    seed: int,
    on_finished: Callable[[int], None] = lambda count: None,
    witness: Witness | None = None,
) -> dict[Cell, CellOutcomes]:
    """Run `count` trials per cell; `on_finished(n)` is called as trials end."""
    every = list(paper_results.METHODS[paper_results.FULL].success)
    on = [cell_lanes(cell, count, w.lanes.kinds) for cell in every]
    kind, level = map(np.concatenate, zip(*on, strict=True))
    specs = trials.TrialSpecs(np.tile(np.arange(count), len(every)), kind, level)
    look = (
        witness.watch(w, [_describe(cell) for cell in every], specs)
        if witness
        else trials.LOOK_AWAY
    )
    outcomes = trials.run(
        w, trials.make_step_fn(train), specs, seed, protocol.robots_per_block(), on_finished, look
    )
    down = kind == w.lanes.kinds.index("descent")
    part = lambda k: slice(k * count, (k + 1) * count)
    return {
        cell: CellOutcomes(Trials(*(x[part(k)] for x in outcomes)), down[part(k)])
        for k, cell in enumerate(every)
    }


def cell_rows(policies: Sequence[Mapping[Cell, CellOutcomes]]) -> list[dict[str, Any]]:
    """Build the rows of eval.json, pooling the trials of several policies."""
    return [_cell_row(cell, [outcomes[cell] for outcomes in policies]) for cell in policies[0]]


def overall(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Compute the unweighted means of all cells, of those inside training, and of the others."""
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


def to_table(rows: Sequence[dict[str, Any]], whole: dict[str, Any]) -> Table:
    """Build the table for the terminal, in percent."""
    table = Table(box=None, padding=(0, 1))
    table.add_column("success, %", no_wrap=True)
    several = len(rows[0]["by_policy"]) > 1
    titles = ("trials", "ours", "95 %", "paper", "difference", "up", "down")
    for title in (*titles, *(["each policy"] if several else [])):
        table.add_column(title, justify="right", no_wrap=True)
    for row in rows:
        both_ways = row["up_failures"], row["down_failures"]
        table.add_row(
            f"{row['kind']} {100 * row['size_m']:.0f} cm"
            + (" (OOD)" if row["level"] == "ood" else ""),
            str(row["trials"]),
            *_comparison_columns(
                row["rate"], row["paper"]["rate"], _rate(row), row["paper"]["significant"]
            ),
            *("" if failures is None else str(failures) for failures in both_ways),
            *([", ".join(f"{100 * rate:.0f}" for rate in row["by_policy"])] if several else []),
            end_section=row["level"] == "ood",
        )
    ours = Rate(whole["rate"], whole["wilson_low"], whole["wilson_high"])
    table.add_row("all twelve", "", *_comparison_columns(whole["rate"], whole["paper"], ours))
    table.add_row(
        "nine trained", "", *_comparison_columns(whole["trained"], whole["paper_trained"])
    )
    table.add_row("three OOD", "", *_comparison_columns(whole["ood"], whole["paper_ood"]))
    return table


def failure_lines(rows: Sequence[dict[str, Any]]) -> str:
    """Describe the failures, one line per kind of terrain."""
    lines = []
    for kind in paper_results.KINDS:
        of_kind = [row["failures"] for row in rows if row["kind"] == kind]
        total = {name: sum(row[name] for row in of_kind) for name in trials.FAILURES}
        counts = ", ".join(f"{n} {name}" for name, n in total.items() if n) or "none"
        lines.append(f"failures on {kind}: {counts}")
    return "\n".join(lines)


def interval_note(count: int) -> str:
    """Describe the width of a rate's interval for `count` trials."""

    def half(share: float) -> float:
        rate = intervals.wilson(round(share * count), count)
        return 50.0 * (rate.high - rate.low)

    return (
        f"{count} trials per cell: 95 % intervals of +-{half(0.97):.1f} points at 97 % success, "
        f"+-{half(0.75):.1f} at 75 %, +-{half(0.5):.1f} at 50 %"
    )


def _describe(cell: Cell) -> dict[str, Any]:
    kind, level = cell
    return {"kind": kind, "level": level, "size_m": cell_sizes()[kind][level]}


def _cell_row(cell: Cell, outcomes: list[CellOutcomes]) -> dict[str, Any]:
    """Build one row from the pooled trials of all policies."""
    kind, _ = cell
    all_trials = Trials(*map(np.concatenate, zip(*(o.trials for o in outcomes), strict=True)))
    lost, is_down = ~all_trials.succeeded, np.concatenate([o.is_down for o in outcomes])
    rate = intervals.wilson(int((~lost).sum()), len(lost))
    by_policy = [float(o.trials.succeeded.mean()) for o in outcomes]
    return {
        **_describe(cell),
        "trials": len(lost),
        "successes": int((~lost).sum()),
        "rate": rate.value,
        "wilson_low": rate.low,
        "wilson_high": rate.high,
        "up_failures": int((lost & ~is_down).sum()) if kind == "stairs" else None,
        "down_failures": int((lost & is_down).sum()) if kind == "stairs" else None,
        "failures": all_trials.failures(),
        "by_speed": _count_by_speed(all_trials),
        "sideways": lateral_drift.summarize(all_trials.drift, all_trials.aside),
        "by_policy": by_policy,
        "spread": float(np.std(by_policy, ddof=1)) if len(by_policy) > 1 else None,
        "paper": _compare_with_paper(rate, cell),
    }


def _count_by_speed(outcomes: Trials) -> list[dict[str, Any]]:
    """Count trials and successes in each group of commanded speeds."""
    group = np.clip(np.searchsorted(SPEEDS, outcomes.speed, side="right") - 1, 0, len(SPEEDS) - 2)
    return [
        {
            "low": low,
            "high": high,
            "trials": int((group == k).sum()),
            "successes": int(outcomes.succeeded[group == k].sum()),
        }
        for k, (low, high) in enumerate(itertools.pairwise(SPEEDS))
    ]


def _compare_with_paper(ours: Rate, cell: Cell) -> dict[str, Any]:
    """Compute the paper's rate, our difference from it and its significance."""
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


def _comparison_columns(
    ours: float, theirs: float, interval: Rate | None = None, is_significant: bool = False
) -> list[str]:
    """Format our rate, its interval, the paper's rate and the difference, in percent."""
    span = f"{100 * interval.low:.0f}-{100 * interval.high:.0f}" if interval else ""
    gap = f"{100 * (ours - theirs):+.1f} {'*' if is_significant else ' '}"
    return [f"{100 * ours:.1f}", span, f"{100 * theirs:.2f}", gap]
