"""When a robot counts as stuck: it has hardly moved for a while, though it was told to walk."""

import numpy as np
from jaxtyping import Float, Int

STALL_SECONDS = 10.0  # assumed: long enough to stumble, turn back onto the path and go on
STALL_SHARE = 0.3  # of the commanded distance; assumed: far below what any walking robot misses


def stalled_at(progress: Float[np.ndarray, " T"], speed: float, period: float) -> int | None:
    """Find the first control step at which the robot has stalled, None if it never does.

    It has stalled at step t if it has come less than `STALL_SHARE` of the commanded distance
    forward between step t - `STALL_SECONDS` and step t; at the earliest after `STALL_SECONDS`.

    Args:
        progress: x of the robot at each control step, m.
        speed: commanded, m/s.
        period: between two control steps, s.
    """
    first = int(stalls(progress[:, None], np.array([speed]), period)[0])
    return first if first < len(progress) else None


def stalls(
    progress: Float[np.ndarray, "T E"], speed: Float[np.ndarray, " E"], period: float
) -> Int[np.ndarray, " E"]:
    """Compute `stalled_at` for each of E robots, T where one never stalls."""
    steps = len(progress)
    window = round(STALL_SECONDS / period)
    if steps <= window:
        return np.full(len(speed), steps)
    short = progress[window:] - progress[:-window] < STALL_SHARE * speed * STALL_SECONDS
    return np.where(short.any(axis=0), window + short.argmax(axis=0), steps)
