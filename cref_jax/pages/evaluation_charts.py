"""Evaluations as charts: success with its interval, failures by cause, success by speed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from cref_jax.pages import markup
from cref_jax.pages.markup import Html

ROW = 0.27  # inches of a chart's height, for each of its rows
FRAME = 0.8  # inches, for axis and one row of the legend
IN_A_ROW = 2  # entries of a legend
CAUSES = {  # of a failure, by its name in a record
    "tilted": "tilted too far",
    "low": "pelvis too low",
    "hit": "upper body on the ground",
    "dropped": "stepped into the depth",
    "unstable": "simulation blew up",
    "stalled": "stalled",
    "late": "too late",
    "timeout": "ran out of time",
}
CAUSE_COLOURS = ("#b5432a", "#e58f3c", "#f2cf63", "#35618f", "#8a8f98", "#7fb3a3", "#a98bbd")
LEVEL_COLOURS = ("#7ab8d9", "#3a86b5", "#1d4e80", "#b5432a")
OURS, THEIRS = "#1d4e80", "#b5432a"


class Share(NamedTuple):
    """A success rate with what belongs to it; rates are fractions."""

    name: str
    rate: float
    low: float  # of the 95 % interval
    high: float
    paper: float | None = None
    by_policy: tuple[float, ...] = ()


class Failures(NamedTuple):
    """How many of a number of trials failed, by cause."""

    name: str
    trials: int
    by_cause: dict[str, int]


class Line(NamedTuple):
    """Success over the commanded speed."""

    name: str
    speed: tuple[float, ...]  # m/s
    rate: tuple[float, ...]  # NaN where nothing was tried


def success_chart(shares: Sequence[Share]) -> Html:
    """Return each rate with its interval, the paper's beside it."""

    def paint(axis: Axes) -> None:
        row = np.arange(len(shares))
        rate, low, high = (100.0 * np.array(x) for x in list(zip(*shares, strict=True))[1:4])
        for k, share in enumerate(shares):
            if len(share.by_policy) > 1:
                points = 100.0 * np.array(share.by_policy)
                label = "each policy" if k == 0 else None
                axis.plot(points, np.full(len(points), k), "|", color="0.4", ms=9, label=label)
        axis.hlines(row, low, high, color=OURS, lw=2.5, alpha=0.45, label="95 % interval")
        axis.plot(rate, row, "o", color=OURS, ms=5, label="here")
        theirs = [np.nan if s.paper is None else 100.0 * s.paper for s in shares]
        if np.isfinite(theirs).any():
            axis.plot(theirs, row, "D", mfc="none", color=THEIRS, ms=5, label="paper")
        _rows(axis, [share.name for share in shares])
        axis.set_xlim(-2.0, 102.0)
        axis.set_xlabel("trials that succeed, %")
        _legend(axis)

    return markup.chart(paint, "Success rates with their intervals", size=_size(len(shares)))


def failure_chart(failures: Sequence[Failures]) -> Html:
    """Return the share of trials that failed, by cause."""
    found = dict.fromkeys(cause for f in failures for cause, n in f.by_cause.items() if n)
    causes = [*(c for c in CAUSES if c in found), *(c for c in found if c not in CAUSES)]

    def paint(axis: Axes) -> None:
        left = np.zeros(len(failures))
        trials = np.array([max(f.trials, 1) for f in failures])
        for cause in causes:
            shares = 100.0 * np.array([f.by_cause.get(cause, 0) for f in failures]) / trials
            colour = _colour(cause)
            axis.barh(
                np.arange(len(left)), shares, 0.7, left, color=colour, label=display_name(cause)
            )
            left += shares
        _rows(axis, [f.name for f in failures])
        axis.set_xlim(0.0, max(1.0, 1.05 * left.max()))
        axis.set_xlabel("trials that fail, %")
        if causes:
            _legend(axis)

    return markup.chart(paint, "Failures by cause", size=_size(len(failures), len(causes)))


def speed_chart(title: str, lines: Sequence[Line]) -> Html:
    """Return the success of each level over the commanded speed."""

    def paint(axis: Axes) -> None:
        for k, line in enumerate(lines):
            colour = LEVEL_COLOURS[k % len(LEVEL_COLOURS)]
            axis.plot(line.speed, 100.0 * np.array(line.rate), "o-", color=colour, label=line.name)
        axis.set_ylim(-3.0, 103.0)
        axis.set_xlabel("commanded speed, m/s")
        axis.set_ylabel("success, %")
        axis.set_title(title)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))

    return markup.chart(paint, f"Success by speed, {title}")


def display_name(cause: str) -> str:
    """Return a cause of failure in words."""
    return CAUSES.get(cause, cause)


def _colour(cause: str) -> str:
    known = list(CAUSES).index(cause) if cause in CAUSES else len(CAUSES)
    return CAUSE_COLOURS[known % len(CAUSE_COLOURS)]


def _rows(axis: Axes, names: list[str]) -> None:
    axis.set_yticks(np.arange(len(names)), names)
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.grid(axis="y", visible=False)


def _legend(axis: Axes) -> None:
    """Put the legend over the whole width of the chart."""
    handles, labels = axis.get_legend_handles_labels()
    axis.figure.legend(handles, labels, loc="outside upper left", ncols=IN_A_ROW)


def _size(rows: int, entries: int = 4) -> tuple[float, float]:
    return markup.CHART[0], FRAME + ROW * rows + 0.18 * ((entries - 1) // IN_A_ROW)
