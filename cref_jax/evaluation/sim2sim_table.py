"""Success that a policy keeps in the whole-robot simulator, per cell of Table II."""

from collections.abc import Sequence
from typing import NamedTuple

from rich.table import Table

from cref_jax.evaluation import intervals, paper_results, tables
from cref_jax.evaluation.crossing import LaneResult

Lane = tuple[str, float]  # kind of lane, size of its obstacles in m


class CellComparison(NamedTuple):
    """The same trials in both simulators; those on stairs go up, then down."""

    name: str
    training: tuple[LaneResult, ...]
    stand_in: tuple[LaneResult, ...]

    @property
    def kept_share(self) -> float:
        """Successes on the whole robot over those in training; nan if training has none."""
        in_training = count_successes(self.training)
        return count_successes(self.stand_in) / in_training if in_training else float("nan")

    def line(self) -> str:
        """Format both counts as one line."""
        counts = lambda c: f"{count_successes(c)} of {count_trials(c)}"
        return f"  training simulation {counts(self.training)}, whole robot {counts(self.stand_in)}"


def list_lanes() -> dict[str, tuple[Lane, ...]]:
    """List the lanes of flat ground and of each cell of Table II, by the cell's name."""
    result: dict[str, tuple[Lane, ...]] = {"flat": (("flat", 0.0),)}
    for kind, level in paper_results.METHODS[paper_results.FULL].success:
        size = tables.cell_sizes()[kind][level]
        result[f"{kind} {100 * size:.0f} cm"] = tuple((lane, size) for lane in tables.LANES[kind])
    return result


def count_successes(results: Sequence[LaneResult]) -> int:
    """Count the trials that reached the end."""
    return sum(r.successes for r in results)


def count_trials(results: Sequence[LaneResult]) -> int:
    """Count all trials."""
    return sum(r.trials for r in results)


def to_table(cells: Sequence[CellComparison]) -> Table:
    """Build the table for the terminal, rates in percent."""
    shown = Table(box=None, padding=(0, 1))
    shown.add_column("success, %", no_wrap=True)
    for title in ("trials", "training", "whole robot", "95 %", "kept"):
        shown.add_column(title, justify="right", no_wrap=True)
    shown.add_column("failures of the whole robot")
    for cell in cells:
        count = count_trials(cell.stand_in)
        rate = intervals.wilson(count_successes(cell.stand_in), count)
        causes: dict[str, int] = {}
        for result in cell.stand_in:
            for cause, n in result.by_cause.items():
                causes[cause] = causes.get(cause, 0) + n
        shown.add_row(
            cell.name,
            str(count),
            f"{100 * count_successes(cell.training) / count_trials(cell.training):.1f}",
            f"{100 * rate.value:.1f}",
            f"{100 * rate.low:.0f}-{100 * rate.high:.0f}",
            "" if count_successes(cell.training) == 0 else f"{cell.kept_share:.2f}",
            ", ".join(f"{n} {cause}" for cause, n in causes.items() if n),
        )
    return shown
