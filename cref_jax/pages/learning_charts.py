"""The learning curves of one run as charts."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import LogFormatter

from cref_jax.pages import markup, training_log
from cref_jax.pages.markup import Html, Section, join, paragraph
from cref_jax.pages.training_log import Log

MOST_POINTS = 600  # of a curve: one a pixel, and more
WINDOWS = 150  # that a log is divided into; a point is the mean over one of them
LEAST_WINDOW = 10  # iterations
INK, MARK = "#1d4e80", "#b5432a"
SMALL = (markup.CHART[0], 2.2)  # inches, of a reward term

TITLES = {  # of the log: what it is, with its unit
    "episode/length_s": "episode length, s",
    "episode/falls_per_minute": "falls a minute",
    "walk/speed_error": "speed error with exploration, m/s",
    "walk/reward": "reward a step",
    "loss/kl": "KL of an update, nats",
    "train/learning_rate": "learning rate",
    "train/action_std": "deviation of the actions",
    "samples_per_s": "samples a second",
}
GROUPS = {  # names in the log that begin so: one chart for all kinds of lanes
    "level/": "level of the curriculum",
    "fell/": "share of episodes that fall",
}
LOGARITHMIC = ("train/learning_rate",)
NEWEST = {  # shown at the top of a page: how, and what it is
    "episode/length_s": ("{:.1f} s", "episode length"),
    "walk/speed_error": ("{:.3f} m/s", "speed error with exploration"),
    "samples_per_s": ("{:,.0f}", "samples a second"),
}
HIDDEN = ("iteration", "train/samples", "loss/learning_rate", "episode/ended", "episode/fell")


class Curves(NamedTuple):
    """What the charts of a run share."""

    log: Log
    marks: Sequence[int]  # iterations after which it was started anew
    target_kl: float | None

    @property
    def window(self) -> int:
        """Number of iterations that a point is the mean of."""
        return max(LEAST_WINDOW, math.ceil(len(self.log["iteration"]) / WINDOWS))

    @property
    def millions(self) -> np.ndarray:
        """Samples of all iterations, in millions; the iterations where samples are not known."""
        known = "train/samples" in self.log
        return self.log["train/samples"] / 1e6 if known else self.log["iteration"]


def sections(
    log: Log, marks: Sequence[int], target_kl: float | None, starts: int
) -> Iterator[Section]:
    """Return the curves of training, the reward's terms, and on a click everything else."""
    of = Curves(log, marks, target_kl)
    names = [name for name in log.columns if name not in HIDDEN]
    drawn = [_chart(of, (name,), title) for name, title in TITLES.items() if name in log]
    for start, title in GROUPS.items():
        group = tuple(name for name in names if name.startswith(start))
        drawn += [_chart(of, group, title)] if group else []
    yield Section("Learning curves", join(_words(of, starts), markup.charts(*drawn)))
    terms = [name for name in names if name.startswith("reward/")]
    used = [name for name in terms if np.nan_to_num(log[name]).any()]
    if used:
        unused = ", ".join(name.removeprefix("reward/") for name in terms if name not in used)
        body = markup.charts(*(_chart(of, (n,), n.removeprefix("reward/"), SMALL) for n in used))
        words = "Each term of Table I with its weight, mean over robots and steps."
        words += f" Zero throughout: {unused}." if unused else ""
        yield Section("Reward terms", join(paragraph(words), body))
    shown = {*TITLES, *terms, *(n for n in names if n.startswith(tuple(GROUPS)))}
    rest = [name for name in names if name not in shown]
    if rest:
        body = markup.charts(*(_chart(of, (name,), name, SMALL) for name in rest))
        yield Section("Everything else in the log", markup.folded(f"{len(rest)} curves", body))


def newest(log: Log) -> Iterator[tuple[str, str]]:
    """Return what the log says at its end, and what it is."""
    of = Curves(log, (), None)
    for name, (form, title) in NEWEST.items():
        if name in log:
            value = float(training_log.smooth(log, name, of.window)[-1])
            shown = form.format(value) if math.isfinite(value) else markup.MISSING
            yield shown, f"{title}, last {of.window} iterations"


def _words(of: Curves, starts: int) -> Html:
    """Return how the curves are to be read."""
    log, count = of.log, len(of.log["iteration"])
    words = [f"A point is the mean of the last {of.window} of {count:,} iterations."]
    if of.marks:
        at = ", ".join(map(str, of.marks))
        words.append(f"A dotted line stands where the run was started anew (iteration {at}).")
    if starts - 1 > len(of.marks):
        words.append(
            f"It was started {starts} times; where the others began, the log does not say."
        )
    if log.damaged:
        lines = "1 line" if log.damaged == 1 else f"{log.damaged} lines"
        words.append(f"{lines} of the log could not be read and is left out.")
    return paragraph(" ".join(words))


def _chart(
    of: Curves, names: Sequence[str], title: str, size: tuple[float, float] = markup.CHART
) -> Html:
    """Return curves over the samples, one a name."""
    x = of.millions

    def paint(axis: Axes) -> None:
        several = len(names) > 1
        for name in names:
            mean = training_log.smooth(of.log, name, of.window)
            at = training_log.thinned(len(mean), MOST_POINTS)
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
        _dress(axis, title, names, "train/samples" in of.log)

    return markup.chart(paint, title, size=size)


def _dress(axis: Axes, title: str, names: Sequence[str], samples: bool) -> None:
    """Set titles and limits; what cannot be negative begins at zero."""
    axis.set_title(title)
    axis.set_xlabel("samples, millions" if samples else "iterations")
    if set(names) <= set(LOGARITHMIC):
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(LogFormatter())  # the usual one writes formulas
        axis.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False))
        return
    low, high = axis.get_ylim()
    if low > 0.0 or (low <= 0.0 and low > -0.06 * high):
        axis.set_ylim(bottom=0.0)
    elif high < 0.0:
        axis.set_ylim(top=0.0)
