"""What a run's log says over time: read, made smooth and thinned out.

runs/NAME/log.jsonl has one JSON object an iteration. A run that is resumed after a crash trains the
iterations since its checkpoint again, and its log holds them twice: the later ones count. A line
that a power cut has damaged is skipped.
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

WEIGHTS = {  # measures of the episodes that ended in an iteration, which says 0 if none did
    "episode/length_s": "episode/ended",
    "fell/": "episode/ended",  # of all kinds; a log does not hold the number of each
}


class Log(NamedTuple):
    """A log as columns of N iterations; NaN where a line does not hold the value."""

    columns: dict[str, Float[np.ndarray, " N"]]
    repeated: tuple[int, ...]  # iterations from which on the run was trained again
    damaged: int  # lines that could not be read

    def __getitem__(self, name: str) -> Float[np.ndarray, " N"]:
        """Return a column."""
        return self.columns[name]

    def __contains__(self, name: object) -> bool:
        """Return whether there is such a column."""
        return name in self.columns

    def minutes(self) -> Float[np.ndarray, " N"]:
        """Return how long it had been trained after each iteration, without pauses."""
        samples = np.diff(self["train/samples"], prepend=0.0)
        return np.nancumsum(np.maximum(samples, 0.0) / self["samples_per_s"]) / 60.0


def read(path: Path) -> Log:
    """Return a log.

    Raises:
        ConfigError: there is no such file, or no whole line in it.
    """
    try:
        with path.open(encoding="utf-8", errors="replace") as file:
            log = _columns(file)
    except OSError as error:
        raise ConfigError(f"cannot read {path}: {error.strerror}") from None
    if not log.columns:
        raise ConfigError(f"{path} has no whole line")
    return log


def smooth(log: Log, name: str, window: int) -> Float[np.ndarray, " N"]:
    """Return each iteration's mean with the `window` - 1 before it, NaN where none has a value.

    Measures of episodes are weighted by the number of episodes that ended.
    """
    by = next((w for key, w in WEIGHTS.items() if name.startswith(key) and w in log), None)
    weights = np.nan_to_num(log[by]) if by else np.ones_like(log[name])
    known = np.isfinite(log[name])
    weights = np.where(known, weights, 0.0)
    total = _moving_sum(weights * np.where(known, log[name], 0.0), window)
    weight = _moving_sum(weights, window)
    there = weight > 0.5  # weights are counts, and sums of floats leave a rest
    return np.where(there, total / np.where(there, weight, 1.0), np.nan)


def thinned(count: int, most: int) -> Int[np.ndarray, " M"]:
    """Return at most `most` of `count` places, evenly, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int))


def _columns(lines: Iterable[str]) -> Log:
    """Return the columns of a log's lines."""
    columns: dict[str, array[float]] = {"iteration": array("d")}
    iterations, damaged, repeated = columns["iteration"], 0, []
    for line in lines:
        row = _row(line)
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


def _row(line: str) -> dict[str, Any] | None:
    """Return a line's values, or None where it is damaged."""
    try:
        row = json.loads(line)
        return row if np.isfinite(row["iteration"]) else None
    except (ValueError, TypeError, KeyError, RecursionError):
        return None


def _moving_sum(values: Float[np.ndarray, " N"], window: int) -> Float[np.ndarray, " N"]:
    """Return the sum of each value and the `window` - 1 before it."""
    total = np.cumsum(values)
    total[window:] -= total[:-window].copy()
    return total
