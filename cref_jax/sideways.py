"""How far robots come off their way, across it."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float


class Sideways(NamedTuple):
    """Of some trials, m; y = 0 is the middle of the way."""

    drift_m: float  # |y at the end - y at the start|, mean over the trials
    largest_m: float  # largest |y| of a trial, mean over the trials
    worst_m: float  # largest |y| of all trials


def spans(
    y: Float[np.ndarray, "T N"], lived: Bool[np.ndarray, "T N"] | None = None
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return |y at the end - y at the start| and the largest |y| of each trial, m.

    `lived` says which steps are the trial's: the first ones, one at least.
    """
    lived = np.ones(y.shape, bool) if lived is None else lived
    last = lived.sum(axis=0) - 1
    drift = np.abs(y[last, np.arange(y.shape[1])] - y[0])
    return drift, np.where(lived, np.abs(y), 0.0).max(axis=0)


def summed(drift: Float[np.ndarray, " N"], largest: Float[np.ndarray, " N"]) -> Sideways:
    """Return the figures of all trials from those of each."""
    return Sideways(float(np.mean(drift)), float(np.mean(largest)), float(np.max(largest)))
