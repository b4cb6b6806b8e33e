"""Reading, smoothing and thinning of a run's training log.

runs/NAME/log.jsonl holds one JSON object per iteration. A run resumed after a crash repeats the
iterations since its checkpoint, so its log holds them twice: the later ones count. A line damaged
by a power cut is skipped.
"""

import json
from array import array
from bisect import bisect_left
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cref_jax.errors import ConfigError

WEIGHTS = {  # averages over the episodes that ended in an iteration; logged as 0 without any
    "episode/length_s": "episode/ended",
    "fell/": "episode/ended",  # all kinds: the log has no count per kind
}


class Log(NamedTuple):
    """A log as columns of N iterations; NaN where a line lacks the value."""

    columns: dict[str, Float[np.ndarray, " N"]]
    repeated: tuple[int, ...]  # first iteration of each repeated stretch
    damaged: int  # unreadable lines

    def __getitem__(self, name: str) -> Float[np.ndarray, " N"]:
        """Return a column."""
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        """Return whether the column exists."""
        return name in self.columns

    def minutes(self) -> Float[np.ndarray, " N"]:
        """Compute the training time up to each iteration, without pauses, min."""
        samples = np.diff(self["train/samples"], prepend=0.0)
        return np.nancumsum(np.maximum(samples, 0.0) / self["samples_per_s"]) / 60.0


def read(path: Path) -> Log:
    """Read a log.

    Raises:
        ConfigError: the file is missing or unreadable, or it has no whole line.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            log = _parse_lines(file)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    if not log.columns:
        raise ConfigError(f"{path} has no whole line")
    return log


def smooth(log: Log, name: str, window: int) -> Float[np.ndarray, " N"]:
    """Compute the mean over each iteration and the `window` - 1 before it, NaN without values.

    Averages over episodes are weighted by the number of episodes that ended.
    """
    by = next((w for key, w in WEIGHTS.items() if name.startswith(key) and w in log), None)
    weights = np.nan_to_num(log[by]) if by else np.ones_like(log[name])
    known = np.isfinite(log[name])
    weights = np.where(known, weights, 0.0)
    total = _moving_sum(weights * np.where(known, log[name], 0.0), window)
    weight = _moving_sum(weights, window)
    has_value = weight > 0.0
    return np.where(has_value, total / np.where(has_value, weight, 1.0), np.nan)


def even_indices(count: int, most: int) -> Int[np.ndarray, " M"]:
    """Compute at most `most` evenly spaced indices below `count`, both ends included."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _parse_lines(lines: Iterable[str]) -> Log:
    """Parse the lines of a log into columns; repeated iterations replace the earlier ones."""
    columns: dict[str, array[float]] = {"iteration": array("d")}
    iterations, damaged, repeated = columns["iteration"], 0, []
    for line in lines:
        row = _parse_line(line)
        if row is None:
            damaged += 1
            continue
        count = len(iterations)
        if count and row["iteration"] <= iterations[-1]:
            count = bisect_left(iterations, row["iteration"])
            for column in columns.values():
                del column[count:]
            repeated = [*(i for i in repeated if i < row["iteration"]), int(row["iteration"])]
        for name, value in row.items():
            known = isinstance(value, int | float)
            column = columns.setdefault(name, array("d"))
            column.extend([np.nan] * (count - len(column)))
            column.append(value if known else np.nan)
    count = len(iterations)
    whole = {
        name: np.append(np.frombuffer(column), np.full(count - len(column), np.nan))
        for name, column in columns.items()
        if count
    }
    return Log(whole, tuple(repeated), damaged)


def _parse_line(line: str) -> dict[str, Any] | None:
    """Parse the values of a line; None if it is damaged."""
    try:
        row = json.loads(line)
        return row if np.isfinite(row["iteration"]) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _moving_sum(values: Float[np.ndarray, " N"], window: int) -> Float[np.ndarray, " N"]:
    """Compute the sum of each value and the `window` - 1 before it.

    Each window is summed by itself: differences of sums from the start on would lose all values
    after a very large one.
    """
    before = np.pad(values, (min(window, len(values)) - 1, 0))
    return np.lib.stride_tricks.sliding_window_view(before, len(before) - len(values) + 1).sum(-1)
