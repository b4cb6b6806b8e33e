"""Which foot bears when, of one walk: intervals of contact, stride, shares of time in the air."""

from typing import Any

import numpy as np
from jaxtyping import Bool

SECONDS = 8.0  # of contacts that are kept; assumed: about ten strides


def describe(airborne: Bool[np.ndarray, "T F"], period: float) -> dict[str, Any]:
    """Describe a walk by its feet; `period` is the time of a step, s.

    The stride is the mean time between successive touchdowns of the same foot, None where no foot
    comes down twice. A foot that is down in the first step has been down since 0.
    """
    count = min(len(airborne), round(SECONDS / period))
    strides = [np.diff(np.flatnonzero(up[:-1] & ~up[1:])) for up in airborne.T]
    steps = np.concatenate(strides)
    return {
        "seconds": round(count * period, 6),
        "stride_s": round(float(steps.mean()) * period, 4) if steps.size else None,
        "airborne": [round(float(share), 4) for share in airborne.mean(axis=0)],
        "contacts": [_intervals(~up[:count], period) for up in airborne.T],
    }


def _intervals(down: Bool[np.ndarray, " T"], period: float) -> list[list[float]]:
    """List begin and end of each stretch of contact, s."""
    changes = np.flatnonzero(np.diff(down, prepend=False, append=False))
    return [[round(float(x) * period, 6) for x in pair] for pair in changes.reshape(-1, 2)]
