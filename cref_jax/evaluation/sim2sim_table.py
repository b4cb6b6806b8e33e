"""How much of its success a policy keeps on the robot's stand-in, cell by cell of Table II."""

from collections.abc import Sequence
from typing import NamedTuple

from rich.table import Table

from cref_jax.evaluation import intervals, paper_results, tables
from cref_jax.evaluation.crossing import Crossing

Lane = tuple[str, float]  # kind of lane, size of its obstacles in m


class Cell(NamedTuple):
    """The same trials in both simulations; those of stairs go up, then down."""

    name: str
    training: tuple[Crossing, ...]
    stand_in: tuple[Crossing, ...]

    @property
    def kept(self) -> float:
        """Successes of the stand-in for one of the training simulation; nan where it had none."""
        had = successes(self.training)
        return successes(self.stand_in) / had if had else float("nan")

    def line(self) -> str:
        """Return both counts as one line."""
        counts = lambda c: f"{successes(c)} of {trials(c)}"
        return f"  training simulation {counts(self.training)}, whole robot {counts(self.stand_in)}"


def lanes() -> dict[str, tuple[Lane, ...]]:
    """Return the lanes of flat ground and of each cell of Table II, by the cell's name."""
    found: dict[str, tuple[Lane, ...]] = {"flat": (("flat", 0.0),)}
    for kind, level in paper_results.METHODS[paper_results.FULL].success:
        size = tables.cell_sizes()[kind][level]
        found[f"{kind} {100 * size:.0f} cm"] = tuple((lane, size) for lane in tables.LANES[kind])
    return found


def successes(crossings: Sequence[Crossing]) -> int:
    """Return how many trials came to the end."""
    return sum(c.successes for c in crossings)


def trials(crossings: Sequence[Crossing]) -> int:
    """Return how many trials there were."""
    return sum(c.trials for c in crossings)


def text(cells: Sequence[Cell]) -> Table:
    """Return the table for the terminal, rates in percent."""
    shown = Table(box=None, padding=(0, 1))
    shown.add_column("success, %", no_wrap=True)
    for title in ("trials", "training", "whole robot", "95 %", "kept"):
        shown.add_column(title, justify="right", no_wrap=True)
    shown.add_column("failures of the whole robot")
    for cell in cells:
        count = trials(cell.stand_in)
        rate = intervals.wilson(successes(cell.stand_in), count)
        causes: dict[str, int] = {}
        for crossing in cell.stand_in:
            for cause, n in crossing.by_cause.items():
                causes[cause] = causes.get(cause, 0) + n
        shown.add_row(
            cell.name,
            str(count),
            f"{100 * successes(cell.training) / trials(cell.training):.1f}",
            f"{100 * rate.value:.1f}",
            f"{100 * rate.low:.0f}-{100 * rate.high:.0f}",
            "" if successes(cell.training) == 0 else f"{cell.kept:.2f}",
            ", ".join(f"{n} {cause}" for cause, n in causes.items() if n),
        )
    return shown
