"""Where the feet came down, and where each stood last."""

import collections
import math

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from cref_jax.whole_body.simulator import WholeBodySim

SHOWN = 40  # touchdowns that are kept
DEBOUNCE = 2  # control steps in a row that must say so, as in training


class Feet:
    """The touchdowns of both feet, left and right, with the debounced contact of training."""

    def __init__(self, body: WholeBodySim, state: mujoco.MjData) -> None:
        """Begin with both feet on the ground."""
        self._body, self._least = body, body.config.reward.contact_force
        self._opposed, self._down = np.zeros(2, int), np.ones(2, bool)
        self._mean = _sole_centres(body)
        self.touchdowns: collections.deque[tuple[int, np.ndarray]] = collections.deque(maxlen=SHOWN)
        self.centres = self._centres(state)  # m, of the soles at their last contact
        self.headings = self._headings(state)  # rad, of the feet at their last contact

    @property
    def down(self) -> Bool[np.ndarray, "2"]:
        """Which feet are on the ground."""
        return self._down

    def update(self, state: mujoco.MjData, force: Float[np.ndarray, "2 3"]) -> None:
        """Take in one control step; `force` is that of the ground, N."""
        touching = np.linalg.norm(force, axis=1) > self._least
        self._opposed = np.where(touching != self._down, self._opposed + 1, 0)
        changes = self._opposed >= DEBOUNCE
        self._opposed[changes] = 0
        centres = self._centres(state)
        for foot in np.flatnonzero(changes & touching):
            self.touchdowns.append((int(foot), centres[foot]))
        self._down = np.where(changes, touching, self._down)
        bears = touching & self._down
        self.centres = np.where(bears[:, None], centres, self.centres)
        self.headings = np.where(bears, self._headings(state), self.headings)

    def _centres(self, state: mujoco.MjData) -> Float[np.ndarray, "2 3"]:
        turned = state.xmat[self._body.feet].reshape(2, 3, 3)
        return state.xpos[self._body.feet] + np.einsum("fij,fj->fi", turned, self._mean)

    def _headings(self, state: mujoco.MjData) -> Float[np.ndarray, "2"]:
        turned = state.xmat[self._body.feet].reshape(2, 3, 3)
        return np.array([math.atan2(r[1, 0], r[0, 0]) for r in turned])


def _sole_centres(body: WholeBodySim) -> Float[np.ndarray, "2 3"]:
    """Compute the centre of each sole in its foot's frame, m: see env.footholds.soles."""
    spheres = body.robot.spheres
    lowest = spheres.position - np.array([0.0, 0.0, 1.0]) * spheres.radius[:, None]
    return np.stack([lowest[spheres.foot == foot].mean(axis=0) for foot in range(2)])
