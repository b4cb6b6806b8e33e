"""Ground of the whole robot: lanes of boxes, or any scene of solids."""

import math
from typing import NamedTuple, Protocol, runtime_checkable

import mujoco
import numpy as np
from jaxtyping import Float

from cref_jax import geoms
from cref_jax.errors import ConfigError

MOST_BOXES = 20_000
MARGIN = 4.0  # m by which the lane's border is extended, as in training; beyond the camera's range
GROUND, SEEN, UNSEEN = 0, 1, 2  # geom groups; rays hit the first two


@runtime_checkable
class Ground(Protocol):
    """The ground of a trial.

    The ground always collides with soles and shanks, and with the links that are kept clear. If
    `stops_every_link`, it also collides with arms, knees and the capsules of the feet: a rail stops
    a hand, which is not a fall, and a foot can stand across slots that its spheres would sink into.
    Contact of pelvis, torso, head or thighs ends the trial. On a lane nothing stands beside the
    robot, and contact is as in training, by spheres alone. On level ground both are the same:
    spheres and capsules of a foot end at the same height.
    """

    @property
    def end(self) -> float:
        """The x at which a trial is won, m; infinite on open ground."""
        ...

    @property
    def width(self) -> float:
        """The width of the path, m, centred on y = 0."""
        ...

    @property
    def stops_every_link(self) -> bool:
        """Whether it collides with all links of the robot."""
        ...

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add its geoms to a model, in the group GROUND."""
        ...


class Lane(NamedTuple):
    """A lane of columns, as in training."""

    heights: Float[np.ndarray, "X Y"]  # m, of the columns
    origin: Float[np.ndarray, "2"]  # m, outer corner of the first column
    cell: float  # m
    end: float  # m along x at which a trial is won; infinite on open ground
    width: float = math.inf  # m
    stops_every_link: bool = False

    def add_to(self, spec: mujoco.MjSpec, friction: float) -> None:
        """Add boxes, and a border around them.

        Raises:
            ConfigError: there are too many boxes.
        """
        around = math.ceil(MARGIN / self.cell)
        heights = np.pad(self.heights, around, mode="edge")
        origin = self.origin - around * self.cell
        boxes = geoms.merge_boxes(heights, max(heights.shape), MOST_BOXES)
        if boxes is None:
            raise ConfigError(f"this ground needs more than {MOST_BOXES} boxes")
        bottom = float(self.heights.min()) - 0.1  # m
        for first, size, height in zip(boxes.first, boxes.size, boxes.height, strict=True):
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
