"""Evaluation charts: success rates with intervals, failures by cause, success by speed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes

from cref_jax.pages import markup
from cref_jax.pages.markup import Html

ROW_HEIGHT = 0.27  # inches per row of a chart
FRAME_HEIGHT = 0.8  # inches, for the axis and one row of the legend
LEGEND_COLUMNS = 2
CAUSES = {  # display name of each failure cause in a record
    "tilted": "tilted too far",
    "low": "pelvis too low",
    "hit": "upper body on the ground",
    "dropped": "foot far below its support",
    "unstable": "simulation blew up",
    "strayed": "off the path",
    "stalled": "stalled",
    "late": "too late",
    "timeout": "ran out of time",
}
CAUSE_COLOURS = (
    "#b5432a",
    "#e58f3c",
    "#f2cf63",
    "#35618f",
    "#8a8f98",
    "#7fb3a3",
    "#a98bbd",
    "#5b8c5a",
    "#c27ba0",
)
LEVEL_COLOURS = ("#7ab8d9", "#3a86b5", "#1d4e80", "#b5432a")
OURS, THEIRS = "#1d4e80", "#b5432a"


class SuccessRate(NamedTuple):
    """A success rate and its 95 % interval, as fractions."""

    name: str
    rate: float
    low: float  # interval bounds
    high: float
    paper: float | None = None
    by_policy: tuple[float, ...] = ()


class FailureCounts(NamedTuple):
    """Numbers of failed trials by cause."""

    name: str
    trials: int
    by_cause: dict[str, int]


class SpeedCurve(NamedTuple):
    """Success rate over commanded speed."""

    name: str
    speed: tuple[float, ...]  # m/s
    rate: tuple[float, ...]  # NaN without trials


def success_chart(rates: Sequence[SuccessRate]) -> Html:
    """Draw each rate with its interval and, where known, the paper's rate."""

    def paint(axis: Axes) -> None:
        row = np.arange(len(rates))
        rate, low, high = (100.0 * np.array(x) for x in list(zip(*rates, strict=True))[1:4])
        for k, success in enumerate(rates):
            if len(success.by_policy) > 1:
                points = 100.0 * np.array(success.by_policy)
                label = "per policy" if k == 0 else None
                axis.plot(points, np.full(len(points), k), "|", color="0.4", ms=9, label=label)
        axis.hlines(row, low, high, color=OURS, lw=2.5, alpha=0.45, label="95 % interval")
        axis.plot(rate, row, "o", color=OURS, ms=5, label="this evaluation")
        theirs = [np.nan if s.paper is None else 100.0 * s.paper for s in rates]
        if np.isfinite(theirs).any():
            axis.plot(theirs, row, "D", mfc="none", color=THEIRS, ms=5, label="paper")
        _label_rows(axis, [success.name for success in rates])
        axis.set_xlim(-2.0, 102.0)
        axis.set_xlabel("successful trials, %")
        _add_legend(axis)

    return markup.chart(paint, "Success rates with intervals", size=_figure_size(len(rates)))


def failure_chart(failures: Sequence[FailureCounts]) -> Html:
    """Draw the percentage of failed trials by cause."""
    present = dict.fromkeys(cause for f in failures for cause, n in f.by_cause.items() if n)
    causes = [*(c for c in CAUSES if c in present), *(c for c in present if c not in CAUSES)]

    def paint(axis: Axes) -> None:
        left = np.zeros(len(failures))
        trials = np.array([max(f.trials, 1) for f in failures])
        for cause in causes:
            percent = 100.0 * np.array([f.by_cause.get(cause, 0) for f in failures]) / trials
            colour = _cause_color(cause)
            axis.barh(
                np.arange(len(left)), percent, 0.7, left, color=colour, label=display_name(cause)
            )
            left += percent
        _label_rows(axis, [f.name for f in failures])
        axis.set_xlim(0.0, max(1.0, 1.05 * left.max()))
        axis.set_xlabel("failed trials, %")
        if causes:
            _add_legend(axis)

    return markup.chart(paint, "Failures by cause", size=_figure_size(len(failures), len(causes)))


def speed_chart(title: str, lines: Sequence[SpeedCurve]) -> Html:
    """Draw the success rate of each level over commanded speed."""

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
    """Return the display name of a failure cause; unknown causes keep their own."""
    return CAUSES.get(cause, cause)


def _cause_color(cause: str) -> str:
    known = list(CAUSES).index(cause) if cause in CAUSES else len(CAUSES)
    return CAUSE_COLOURS[known % len(CAUSE_COLOURS)]


def _label_rows(axis: Axes, names: list[str]) -> None:
    axis.set_yticks(np.arange(len(names)), names)
    axis.set_ylim(len(names) - 0.4, -0.6)
    axis.grid(axis="y", visible=False)


def _add_legend(axis: Axes) -> None:
    """Place the legend above the axes, across the full width of the chart."""
    handles, labels = axis.get_legend_handles_labels()
    axis.figure.legend(handles, labels, loc="outside upper left", ncols=LEGEND_COLUMNS)


def _figure_size(rows: int, entries: int = 4) -> tuple[float, float]:
    return markup.CHART[0], FRAME_HEIGHT + ROW_HEIGHT * rows + 0.18 * (
        (entries - 1) // LEGEND_COLUMNS
    )
