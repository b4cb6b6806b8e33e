"""Lateral deviation of robots from the middle of their path, y = 0."""

import numpy as np
from jaxtyping import Bool, Float


def measure(
    y: Float[np.ndarray, "T N"], active: Bool[np.ndarray, "T N"] | None = None
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Compute |y| at the end and the largest |y| of each trial, m.

    Robots start beside the middle and are steered to it: what remains at the end is drift.

    `active` marks the steps that belong to the trial: the first ones, at least one.
    """
    active = np.ones(y.shape, bool) if active is None else active
    last = active.sum(axis=0) - 1
    return np.abs(y[last, np.arange(y.shape[1])]), np.where(active, np.abs(y), 0.0).max(axis=0)


def summarize(drift: Float[np.ndarray, " N"], largest: Float[np.ndarray, " N"]) -> dict[str, float]:
    """Summarize all trials for JSON, m.

    `drift_m` is the mean |y| at the end, `largest_m` the mean of the largest |y| of each trial,
    `worst_m` the largest of all.
    """
    means = float(np.mean(drift)), float(np.mean(largest))
    return {"drift_m": means[0], "largest_m": means[1], "worst_m": float(np.max(largest))}
