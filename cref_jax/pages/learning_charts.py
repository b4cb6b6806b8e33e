"""Learning curves of a run as charts."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from cref_jax.pages import markup, training_log
from cref_jax.pages.markup import Html, Section, join, paragraph
from cref_jax.pages.training_log import Log

MOST_POINTS = 600  # per curve, more than one per pixel
WINDOWS = 150  # per log; a point is the mean over one window
LEAST_WINDOW = 10  # iterations
INK, MARK = "#1d4e80", "#b5432a"
SMALL = (markup.CHART[0], 2.2)  # inches, of a reward term's chart

TITLES = {  # title and unit of a log column
    "episode/length_s": "episode length, s",
    "episode/falls_per_minute": "falls per minute",
    "walk/speed_error": "speed error with exploration, m/s",
    "walk/reward": "reward per step",
    "loss/kl": "KL per update, nats",
    "train/learning_rate": "learning rate",
    "train/action_std": "standard deviation of the actions",
    "samples_per_s": "samples per second",
}
GROUPS = {  # prefix of log columns, one per kind of lane, that share a chart
    "level/": "curriculum level",
    "fell/": "share of episodes with a fall",
}
LOGARITHMIC = ("train/learning_rate",)
LATEST = {  # figures at the top of a page: format and title
    "episode/length_s": ("{:.1f} s", "episode length"),
    "walk/speed_error": ("{:.3f} m/s", "speed error with exploration"),
    "samples_per_s": ("{:,.0f}", "samples per second"),
}
HIDDEN = ("iteration", "train/samples", "loss/learning_rate", "episode/ended", "episode/fell")


class RunCurves(NamedTuple):
    """The log of a run and the marks that all its charts share."""

    log: Log
    marks: Sequence[int]  # iterations at which training restarted
    target_kl: float | None

    @property
    def window(self) -> int:
        """Number of iterations averaged in a point."""
        return max(LEAST_WINDOW, math.ceil(len(self.log["iteration"]) / WINDOWS))

    @property
    def millions(self) -> np.ndarray:
        """Samples after each iteration, in millions; the iterations if samples are not logged."""
        known = "train/samples" in self.log
        return self.log["train/samples"] / 1e6 if known else self.log["iteration"]


class LevelCurve(NamedTuple):
    """The curriculum level of a run on one kind of lane."""

    variant: str
    millions: Sequence[float]  # samples
    level: Sequence[float | None]  # None where it was not logged


def sections(
    log: Log, marks: Sequence[int], target_kl: float | None, starts: int
) -> Iterator[Section]:
    """Yield the training curves, the reward terms and, collapsed, all other curves."""
    of = RunCurves(log, marks, target_kl)
    names = [name for name in log.columns if name not in HIDDEN]
    plots = [_curve_chart(of, (name,), title) for name, title in TITLES.items() if name in log]
    for start, title in GROUPS.items():
        group = tuple(name for name in names if name.startswith(start))
        plots += [_curve_chart(of, group, title)] if group else []
    yield Section("Learning curves", join(_reading_note(of, starts), markup.charts(*plots)))
    terms = [name for name in names if name.startswith("reward/")]
    used = [name for name in terms if np.nan_to_num(log[name]).any()]
    if used:
        unused = ", ".join(name.removeprefix("reward/") for name in terms if name not in used)
        body = markup.charts(
            *(_curve_chart(of, (n,), n.removeprefix("reward/"), SMALL) for n in used)
        )
        note = "Weighted terms of Table I, mean over robots and steps."
        note += f" Zero throughout: {unused}." if unused else ""
        yield Section("Reward terms", join(paragraph(note), body))
    shown = {*TITLES, *terms, *(n for n in names if n.startswith(tuple(GROUPS)))}
    rest = [name for name in names if name not in shown]
    if rest:
        body = markup.charts(*(_curve_chart(of, (name,), name, SMALL) for name in rest))
        yield Section("Other curves of the log", markup.collapsible(f"{len(rest)} curves", body))


def latest_values(log: Log) -> Iterator[tuple[str, str]]:
    """Yield the smoothed last values of the `LATEST` columns with their titles."""
    of = RunCurves(log, (), None)
    for name, (form, title) in LATEST.items():
        if name in log:
            value = float(training_log.smooth(log, name, of.window)[-1])
            shown = form.format(value) if math.isfinite(value) else markup.MISSING
            yield shown, f"{title}, last {of.window} iterations"


def level_chart(title: str, curves: Sequence[LevelCurve]) -> Html:
    """Draw levels over the samples: a colour per variant, a curve per run."""
    variants = list(dict.fromkeys(curve.variant for curve in curves))

    def paint(axis: Axes) -> None:
        for number, variant in enumerate(variants):
            for k, curve in enumerate(c for c in curves if c.variant == variant):
                label = variant if k == 0 else None
                axis.plot(curve.millions, curve.level, lw=1.3, color=f"C{number}", label=label)
        axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        _label_axes(axis, title, ("level",), samples=True)

    return markup.chart(paint, title)


def _reading_note(of: RunCurves, starts: int) -> Html:
    """Explain smoothing, restarts and damaged lines to the reader of the curves."""
    log, count = of.log, len(of.log["iteration"])
    notes = [f"Each point is the mean over the last {of.window} of {count:,} iterations."]
    if of.marks:
        at = ", ".join(map(str, of.marks))
        notes.append(f"Dotted lines mark restarts of the run (iteration {at}).")
    if starts - 1 > len(of.marks):
        notes.append(f"The run was started {starts} times; the log does not show every restart.")
    if log.damaged:
        lines, verb = ("1 line", "is") if log.damaged == 1 else (f"{log.damaged} lines", "are")
        notes.append(f"{lines} of the log could not be read and {verb} left out.")
    return paragraph(" ".join(notes))


def _curve_chart(
    of: RunCurves, names: Sequence[str], title: str, size: tuple[float, float] = markup.CHART
) -> Html:
    """Draw log columns over the samples, one curve per name."""
    x = of.millions

    def paint(axis: Axes) -> None:
        several = len(names) > 1
        for name in names:
            mean = training_log.smooth(of.log, name, of.window)
            at = training_log.even_indices(len(mean), MOST_POINTS)
            label = name.partition("/")[2].replace("_", " ") if several else None
            axis.plot(x[at], mean[at], lw=1.3, color=None if several else INK, label=label)
        for mark in of.marks:
            place = min(int(np.searchsorted(of.log["iteration"], mark)), len(x) - 1)
            axis.axvline(x[place], color=MARK, lw=0.9, ls=":")
        if "loss/kl" in names and of.target_kl:
            axis.axhline(of.target_kl, color="0.5", lw=0.9, ls="--", label="target")
            axis.legend()
        if several:
            axis.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        _label_axes(axis, title, names, "train/samples" in of.log)

    return markup.chart(paint, title, size=size)


def _label_axes(axis: Axes, title: str, names: Sequence[str], samples: bool) -> None:
    """Set the titles and limits; an axis without negative values starts at zero."""
    axis.set_title(title)
    axis.set_xlabel("samples, millions" if samples else "iterations")
    if set(names) <= set(LOGARITHMIC):
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(LogFormatter())  # the default one writes formulas
        axis.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False))
        return
    low, high = axis.get_ylim()
    if low > 0.0 or (low <= 0.0 and low > -0.06 * high):
        axis.set_ylim(bottom=0.0)
    elif high < 0.0:
        axis.set_ylim(top=0.0)
