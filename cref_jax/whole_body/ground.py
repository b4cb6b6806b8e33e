"""What the whole robot walks on: lanes of boxes, or any scene of solids."""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import geoms
from cref_jax.errors import ConfigError

MOST_BOXES = 20_000
MARGIN = 4.0  # m around the lane where its border goes on, as in training; further than is seen
GROUND, SEEN, UNSEEN = 0, 1, 2  # geom groups; rays meet the first two


@runtime_checkable
class Ground(Protocol):
    """What a trial is walked on.

    The ground always meets soles and shanks, and the links that are kept clear. Where
    `stops_every_link`, it meets arms, knees and the capsules of the feet as well: a hand is stopped
    by a rail, which is no fall, and a foot stands across slots that its spheres would sink into.
    Pelvis, torso, head and thighs end the trial wherever they touch. On a lane there is nothing
    beside the robot, and contact is as in training, by spheres alone. On level ground the two are
    the same: spheres and capsules of a foot end at one height.
    """

    @property
    def end(self) -> float:
        """Return where along x a trial is won, m; infinite on open ground."""
        ...

    @property
    def width(self) -> float:
        """Return how wide the path is, m; it lies on both sides of y = 0."""
        ...

    @property
    def stops_every_link(self) -> bool:
        """Return whether all links of the robot are solid to it."""
        ...

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add its geoms to a model, in the group GROUND."""
        ...


class Lane(NamedTuple):
    """A lane of columns, as in training."""

    heights: Float[np.ndarray, "X Y"]  # m, of the columns
    origin: Float[np.ndarray, "2"]  # m, outer corner of the first column
    cell: float  # m
    end: float  # m along x where a trial is won; infinite on open ground
    width: float = math.inf  # m
    stops_every_link: bool = False

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add boxes, and a border around them.

        Raises:
            ConfigError: they are too many.
        """
        around = math.ceil(MARGIN / self.cell)
        heights = np.pad(self.heights, around, mode="edge")
        origin = self.origin - around * self.cell
        found = geoms.boxes(heights, max(heights.shape), MOST_BOXES)
        if found is None:
            raise ConfigError(f"this ground needs more than {MOST_BOXES} boxes")
        bottom = float(self.heights.min()) - 0.1  # m
        for first, size, height in zip(found.first, found.size, found.height, strict=True):
            half = 0.5 * (height - bottom)
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[*(origin + (first + 0.5 * size) * self.cell), height - half],
                size=[*(0.5 * size * self.cell), half],
                friction=[friction, 0.005, 0.0001],
                contype=0,
                conaffinity=1,
                group=GROUND,
            )
