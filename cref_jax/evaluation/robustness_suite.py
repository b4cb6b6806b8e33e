"""Success with everything randomised, and with each part of the randomisation alone.

A trial's draws depend on the seed and the trial's number, like its start and command.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.table import Table

from cref_jax import ppo
from cref_jax.config import Config, override
from cref_jax.env.state import Spread
from cref_jax.env.world import World
from cref_jax.evaluation import intervals, lateral_drift, paper_results, protocol, tables, trials
from cref_jax.evaluation.trials import Trials
from cref_jax.evaluation.witness import Witness
from cref_jax.physics.simulation import Physics

EVERYTHING = "everything"
STRUCTURES = "structures"
DEPTH = "depth"
PARTS = (*Spread._fields, STRUCTURES, DEPTH)
RAILS = {"structures": 8, "push_yaw_rate": 1.0}
"""Capsules in the depth image, and rad/s by which pushes turn the robot, as if a wrist caught on a
rail; as in experiments/robust.toml"""
NO_FAULTS = dict.fromkeys(protocol.DEPTH_FAULTS, 0.0)
NO_TILT = {"camera_pitch": 0.0, "camera_position": 0.0}
WORLDS: tuple[tuple[tuple[str, ...], dict[str, float]], ...] = (
    ((EVERYTHING,), {}),
    ((STRUCTURES,), {**NO_TILT, **NO_FAULTS}),
    ((DEPTH,), {**NO_TILT, "structures": 0}),
    (Spread._fields, {"structures": 0, **NO_FAULTS}),
)
"""Parts, and what is changed in the randomisation of their world. The spread of `camera` is that of
its mount, of the structures that it sees and of faults of depth: a world has one of these alone."""
BEYOND = "beyond"  # level: sizes of SSR (arXiv 2605.30770) beyond the paper's
LEVELS = (*paper_results.LEVELS, BEYOND)
BEYOND_SIZES = {"stairs": 0.25, "gap": 0.90, "platform": 0.45}  # m; stairs are not tested there
LANES = tables.LANES | {"flat": ("flat",)}
ALONE = (("flat", "easy"), ("stairs", "medium"), ("gap", "medium"), ("platform", "medium"))


class Row(NamedTuple):
    """A cell and the part that is randomised in it."""

    part: str  # one of PARTS, or EVERYTHING
    kind: str
    level: str


def list_rows() -> list[Row]:
    """List all rows: the cells with everything, then each part alone on one cell per kind."""
    cells = [
        *paper_results.METHODS[paper_results.FULL].success,
        ("gap", BEYOND),
        ("platform", BEYOND),
    ]
    whole = [Row(EVERYTHING, *cell) for cell in cells]
    return whole + [Row(part, *cell) for part in PARTS for cell in ALONE]


def obstacle_size(kind: str, level: str) -> float:
    """Return the obstacle size, m; 0 on flat ground."""
    if kind == "flat":
        return 0.0
    return BEYOND_SIZES[kind] if level == BEYOND else tables.cell_sizes()[kind][level]


def row_world(c: Config, physics: Physics) -> World:
    """Build the world with the lanes of all rows and the ranges of randomisation."""
    sized = {
        lane: [obstacle_size(kind, at) for at in LEVELS]
        for kind, of in LANES.items()
        for lane in of
    }
    w = tables.make_lane_world(c, physics, sized)
    return w.replace(config=override(protocol.randomise(w.config), {"randomisation": RAILS}))


def run_rows(
    w: World,
    train: ppo.TrainState,
    count: int,
    seed: int,
    on_finished: Callable[[int], None] = lambda count: None,
    selected: Sequence[Row] | None = None,
    witness: Witness | None = None,
) -> list[dict[str, Any]]:
    """Run `count` trials per row; `on_finished(n)` is called as trials end."""
    every = list(selected or list_rows())
    found = {}
    for parts, changes in WORLDS:
        world = w.replace(config=override(w.config, {"randomisation": changes}))
        rows = [row for row in every if row.part in parts]
        if rows:
            found |= dict(
                zip(
                    rows,
                    _run_in(world, train, rows, count, seed, on_finished, witness),
                    strict=True,
                )
            )
    return [found[row] for row in every]


def _run_in(
    w: World,
    train: ppo.TrainState,
    rows: Sequence[Row],
    count: int,
    seed: int,
    on_finished: Callable[[int], None],
    witness: Witness | None,
) -> list[dict[str, Any]]:
    """Run the rows that share a world; the witness sees those with everything randomised."""
    on = [
        tables.round_robin_lanes(LANES[row.kind], LEVELS.index(row.level), count, w.lanes.kinds)
        for row in rows
    ]
    kind, level = map(np.concatenate, zip(*on, strict=True))
    spread = jax.tree.map(lambda *x: np.repeat(x, count), *(_spread(row.part) for row in rows))
    # same start, command and draws on a lane, whichever parts are randomised
    number = np.tile(np.arange(count), len(rows))
    specs = trials.TrialSpecs(number, kind, level, spread)
    seen = [_describe(row) if row.part == EVERYTHING else None for row in rows]
    look = witness.watch(w, seen, specs) if witness else trials.LOOK_AWAY
    outcomes = trials.run(
        w, trials.make_step_fn(train), specs, seed, protocol.robots_per_block(), on_finished, look
    )
    part = lambda k: Trials(*(x[k * count : (k + 1) * count] for x in outcomes))
    return [_row_result(row, part(k)) for k, row in enumerate(rows)]


def overall(results: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Compute the mean success over the paper's cells, with everything randomised."""
    cells = [
        row for row in results if row["part"] == EVERYTHING and row["level"] in paper_results.LEVELS
    ]
    rate = lambda some: intervals.mean(
        [intervals.wilson(row["successes"], row["trials"]) for row in some]
    )
    whole = rate(cells)
    return {
        "rate": whole.value,
        "wilson_low": whole.low,
        "wilson_high": whole.high,
        "trained": rate([row for row in cells if row["level"] != "ood"]).value,
        "ood": rate([row for row in cells if row["level"] == "ood"]).value,
    }


def to_table(results: Sequence[dict[str, Any]]) -> Table:
    """Build the table of the cells with everything randomised, in percent."""
    shown = Table(box=None, padding=(0, 1))
    shown.add_column("success, everything randomised, %", no_wrap=True)
    for title in ("trials", "ours", "95 %"):
        shown.add_column(title, justify="right", no_wrap=True)
    whole = overall(results)
    for row in (row for row in results if row["part"] == EVERYTHING):
        name = f"{row['kind']} {100 * row['size_m']:.0f} cm"
        shown.add_row(name, str(row["trials"]), f"{100 * row['rate']:.1f}", _interval_text(row))
    shown.add_row("all twelve", "", f"{100 * whole['rate']:.1f}", _interval_text(whole))
    shown.add_row("nine trained", "", f"{100 * whole['trained']:.1f}", "")
    return shown


def parts_table(results: Sequence[dict[str, Any]]) -> Table:
    """Build the table of success with each part alone, in percent."""
    shown = Table(box=None, padding=(0, 1))
    shown.add_column("success with one part alone, %", no_wrap=True)
    for kind, level in ALONE:
        name = kind if kind == "flat" else f"{kind} {100 * obstacle_size(kind, level):.0f} cm"
        shown.add_column(name, justify="right", no_wrap=True)
    for part in PARTS:
        rates = [f"{100 * row['rate']:.0f}" for row in results if row["part"] == part]
        shown.add_row(part, *rates)
    return shown


def _spread(part: str) -> Spread:
    if part == EVERYTHING:
        return Spread(*[np.float32(1.0)] * len(Spread._fields))
    own = "camera" if part in (STRUCTURES, DEPTH) else part
    return Spread(*(np.float32(name == own) for name in Spread._fields))


def _describe(row: Row) -> dict[str, Any]:
    size = obstacle_size(row.kind, row.level)
    return {"kind": row.kind, "level": row.level, "size_m": size}


def _row_result(row: Row, outcomes: Trials) -> dict[str, Any]:
    rate = intervals.wilson(int(outcomes.succeeded.sum()), len(outcomes.succeeded))
    return {
        "part": row.part,
        **_describe(row),
        "trials": len(outcomes.succeeded),
        "successes": int(outcomes.succeeded.sum()),
        "rate": rate.value,
        "wilson_low": rate.low,
        "wilson_high": rate.high,
        "failures": outcomes.failures(),
        "sideways": lateral_drift.summarize(outcomes.drift, outcomes.aside),
    }


def _interval_text(of: dict[str, Any]) -> str:
    return f"{100 * of['wilson_low']:.0f}-{100 * of['wilson_high']:.0f}"
