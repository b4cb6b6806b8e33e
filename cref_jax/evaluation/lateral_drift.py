"""How far robots come off their way, across it; y = 0 is its middle."""

import numpy as np
from jaxtyping import Bool, Float


def spans(
    y: Float[np.ndarray, "T N"], lived: Bool[np.ndarray, "T N"] | None = None
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Return |y| at the end and the largest |y| of each trial, m.

    Robots start beside the middle and are steered to it: what is left at the end is drift.

    `lived` says which steps are the trial's: the first ones, one at least.
    """
    lived = np.ones(y.shape, bool) if lived is None else lived
    last = lived.sum(axis=0) - 1
    return np.abs(y[last, np.arange(y.shape[1])]), np.where(lived, np.abs(y), 0.0).max(axis=0)


def summarize(drift: Float[np.ndarray, " N"], largest: Float[np.ndarray, " N"]) -> dict[str, float]:
    """Return the figures of all trials from those of each, m: as JSON has them.

    `drift_m` is the mean of |y| at the end, `largest_m` that of the largest |y|, `worst_m` the
    largest of all.
    """
    means = float(np.mean(drift)), float(np.mean(largest))
    return {"drift_m": means[0], "largest_m": means[1], "worst_m": float(np.max(largest))}
