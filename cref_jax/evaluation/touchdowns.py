"""Where feet come down on the treads of stairs (Sec. III-B).

A touchdown ends at least `AIR` in the air. Its position is that of the sole's centre, from the
tread's nosing (0) towards its riser, on the way up and down alike.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from cref_jax.terrain import cross_section
from cref_jax.terrain.cross_section import DOWN, UP, Profile, TreadContacts

AIR = 0.06  # s; assumed: three control steps; a shorter time is a rocking foot
REACH = 0.1  # m, half a sole
TILT = 0.05  # m, largest height of the sole's centre above a tread; assumed: tilted by 30 degrees
BIN = 0.01  # m, of a histogram
WAYS = {UP: "up", DOWN: "down"}
FEET = ("left", "right")


class Touchdowns(NamedTuple):
    """N touchdowns on treads."""

    flight: Int[np.ndarray, " N"]  # UP or DOWN
    size: Float[np.ndarray, " N"]  # m, rise of a step
    foot: Int[np.ndarray, " N"]  # 0 left, 1 right
    position: Float[np.ndarray, " N"]  # m from the nosing towards the riser


def find_touchdowns(
    airborne: Bool[np.ndarray, "T F"], period: float
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
    """Find the steps and the feet of the touchdowns; `period` is the time of a step, s."""
    steps, feet = np.nonzero(airborne[:-1] & ~airborne[1:])
    down = np.arange(len(airborne))[:, None]
    last_down = np.maximum.accumulate(np.where(airborne, -1, down))  # at or before each step
    in_the_air = (steps - last_down[steps, feet]) * period
    whole = in_the_air > AIR - 0.5 * period
    return steps[whole] + 1, feet[whole]


def place(stairs: Profile, x: Float[np.ndarray, " n"], z: Float[np.ndarray, " n"]) -> TreadContacts:
    """Locate the centres of soles, m, on the treads of a lane."""
    return cross_section.place_on_treads(stairs, x, z, REACH, TILT)


def tread_depth(stairs: Profile) -> float:
    """Compute the median depth of a lane's treads, m."""
    return float(np.median((stairs.right - stairs.left)[stairs.flight != 0]))


def median_absolute_deviation(x: Float[np.ndarray, " n"]) -> float:
    """Compute the median absolute deviation from the median."""
    return float(np.median(np.abs(x - np.median(x))))


def bin_edges(tread: float) -> Float[np.ndarray, " edges"]:
    """Compute the edges of a histogram over a tread, m, and what a sole reaches on both sides."""
    return BIN * np.arange(round(-REACH / BIN), round((tread + REACH) / BIN) + 1)


def summarize(found: Touchdowns, tread: float) -> dict[str, Any]:
    """Summarise touchdowns on treads of `tread` m: histogram, median and MAD by way, size, foot."""
    edges = bin_edges(tread)
    return {
        "tread_m": round(tread, 6),
        "bin_m": BIN,
        "first_m": -REACH,
        "groups": list(_groups(found, edges)),
    }


def _groups(found: Touchdowns, edges: Float[np.ndarray, " edges"]) -> Iterator[dict[str, Any]]:
    for flight, way in WAYS.items():
        for size in np.unique(found.size[found.flight == flight]):
            there = (found.flight == flight) & (found.size == size)
            for foot, name in enumerate((*FEET, "both")):
                x = found.position[there & ((found.foot == foot) | (name == "both"))]
                yield {
                    "way": way,
                    "size_m": round(float(size), 6),
                    "foot": name,
                    "touchdowns": len(x),
                    "median_m": round(float(np.median(x)), 4) if len(x) else None,
                    "mad_m": round(median_absolute_deviation(x), 4) if len(x) else None,
                    "bins": np.histogram(x, edges)[0].tolist(),
                }
