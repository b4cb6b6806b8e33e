"""A lane that is level across as its sections of one height: treads, flights and edges.

Robots walk along +x. A tread lies between two risers of the same direction, so landings and the
level ground before and after a flight are none.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from cref_jax.terrain.column_grid import Terrain

UP, DOWN = 1, -1  # directions of a flight


class Profile(NamedTuple):
    """S sections of one height, in the order of a walk along the lane."""

    left: Float[np.ndarray, " S"]  # m, x of its near end
    right: Float[np.ndarray, " S"]  # m, x of its far end
    height: Float[np.ndarray, " S"]  # m
    flight: Int[np.ndarray, " S"]  # UP or DOWN for a tread, 0 for what is none


class Landed(NamedTuple):
    """Where P feet have come down on treads."""

    position: Float[np.ndarray, " P"]  # m from the nosing towards the riser; NaN: on no tread
    flight: Int[np.ndarray, " P"]  # UP, DOWN, or 0 for no tread


def middle_heights(ground: Terrain) -> Float[np.ndarray, " X"]:
    """Return the heights along the middle of a lane, m."""
    return ground.heights[:, ground.size[1] // 2]


def of_heights(heights: Float[np.ndarray, " X"], cell: float) -> Profile:
    """Return the sections of a lane whose columns of `cell` m begin at x = 0."""
    risers = np.flatnonzero(np.diff(heights)) + 1  # columns
    ends = np.concatenate([[0], risers, [len(heights)]])
    height = heights[ends[:-1]].astype(np.float64)
    rise = np.sign(np.diff(height)).astype(int)
    flight = np.zeros(len(height), int)
    flight[1:-1] = np.where(rise[:-1] == rise[1:], rise[1:], 0)
    return Profile(ends[:-1] * cell, ends[1:] * cell, height, flight)


def of_lane(ground: Terrain) -> Profile:
    """Return the sections of a lane."""
    return of_heights(middle_heights(ground), ground.cell)


def place_on_treads(
    profile: Profile,
    x: Float[np.ndarray, " P"],
    z: Float[np.ndarray, " P"],
    reach: float,
    most: float,
) -> Landed:
    """Return where feet have come down, from the centres of their soles, m.

    A foot is on the section nearest to it in height, of those under the centre or within `reach` of
    it: one whose centre is beyond the nosing stands on the tread that holds its heel or toes. What
    is more than `most` above or below that section has touched something else, such as a riser.
    The nosing is a tread's free edge: its near end on the way up, its far end on the way down.
    """
    near = (x[:, None] >= profile.left - reach) & (x[:, None] <= profile.right + reach)
    apart = np.where(near, np.abs(z[:, None] - profile.height), np.inf)
    at = np.argmin(apart, axis=1)
    flight = np.where(apart.min(axis=1) <= most, profile.flight[at], 0)
    from_nosing = np.where(flight == UP, x - profile.left[at], profile.right[at] - x)
    return Landed(np.where(flight == 0, np.nan, from_nosing), flight)


def flight_at(profile: Profile, x: Float[np.ndarray, "*n"]) -> Int[np.ndarray, "*n"]:
    """Return the direction of the flight whose treads lie under each x, 0 where there is none."""
    at = np.searchsorted(profile.right, x, side="right")
    return profile.flight[np.minimum(at, len(profile.flight) - 1)]


def edges(profile: Profile) -> Float[np.ndarray, " risers"]:
    """Return x of each riser, m."""
    return profile.right[:-1]
