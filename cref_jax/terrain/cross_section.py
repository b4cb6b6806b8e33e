"""The cross section of a lane that is level across: treads, flights and edges.

Robots walk along +x. A tread lies between two risers of the same direction, which excludes landings
and the level ground before and after a flight.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cref_jax.terrain.column_grid import Terrain

UP, DOWN = 1, -1  # directions of a flight


class Profile(NamedTuple):
    """S sections of constant height, in order along the lane."""

    left: Float[np.ndarray, " S"]  # m, x of the near end
    right: Float[np.ndarray, " S"]  # m, x of the far end
    height: Float[np.ndarray, " S"]  # m
    flight: Int[np.ndarray, " S"]  # UP or DOWN for a tread, else 0


class TreadContacts(NamedTuple):
    """Positions of P touchdowns on treads."""

    position: Float[np.ndarray, " P"]  # m from the nosing towards the riser; NaN off treads
    flight: Int[np.ndarray, " P"]  # UP, DOWN, or 0 off treads


def middle_heights(ground: Terrain) -> Float[np.ndarray, " X"]:
    """Return the heights along the middle of a lane, m."""
    return ground.heights[:, ground.size[1] // 2]


def from_heights(heights: Float[np.ndarray, " X"], cell: float) -> Profile:
    """Split a lane, with columns of `cell` m from x = 0, into sections."""
    risers = np.flatnonzero(np.diff(heights)) + 1  # columns
    ends = np.concatenate([[0], risers, [len(heights)]])
    height = heights[ends[:-1]].astype(np.float64)
    rise = np.sign(np.diff(height)).astype(int)
    flight = np.zeros(len(height), int)
    flight[1:-1] = np.where(rise[:-1] == rise[1:], rise[1:], 0)
    return Profile(ends[:-1] * cell, ends[1:] * cell, height, flight)


def from_lane(ground: Terrain) -> Profile:
    """Split a lane into sections along its middle."""
    return from_heights(middle_heights(ground), ground.cell)


def place_on_treads(
    profile: Profile,
    x: Float[np.ndarray, " P"],
    z: Float[np.ndarray, " P"],
    reach: float,
    most: float,
) -> TreadContacts:
    """Locate touchdowns on treads from the centres of the soles, x and z in m.

    A foot is on the section nearest in height, of those within `reach`, m, of the sole's centre: a
    foot whose centre is beyond the nosing is on the tread under its heel or toes. A foot more than
    `most`, m, above or below that section has touched something else, such as a riser. The nosing
    is a tread's free edge: its near end on the way up, its far end on the way down.
    """
    near = (x[:, None] >= profile.left - reach) & (x[:, None] <= profile.right + reach)
    gap = np.where(near, np.abs(z[:, None] - profile.height), np.inf)
    at = np.argmin(gap, axis=1)
    flight = np.where(gap.min(axis=1) <= most, profile.flight[at], 0)
    from_nosing = np.where(flight == UP, x - profile.left[at], profile.right[at] - x)
    return TreadContacts(np.where(flight == 0, np.nan, from_nosing), flight)


def flight_at(profile: Profile, x: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """Look up the direction of the flight at each x, UP or DOWN, or 0 off treads."""
    at = np.searchsorted(profile.right, x, side="right")
    return profile.flight[np.minimum(at, len(profile.flight) - 1)]


def riser_edges(profile: Profile) -> Float[np.ndarray, " risers"]:
    """Return the x of each riser, m."""
    return profile.right[:-1]
