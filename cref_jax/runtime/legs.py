"""What the angles of the legs say about the base: how it stands, and how it turns."""

from __future__ import annotations

import numpy as np

from cref_jax.runtime.tables import PolicyFormatError, Table


class Legs:
    """Orientation of every foot from the joint angles of its leg, in the base's frame."""

    def __init__(self, root: Table, names: tuple[str, ...]) -> None:
        """Read joints and axes of the legs, from the hip down, of a robot whose joints are at 0."""
        legs, order = [], []
        for leg in root.tables("legs"):
            joints = leg.tables("joints")
            order.append([joint.text("name", names) for joint in joints])
            legs.append([joint.reals("axis", 3, -1.0) for joint in joints])
        if len({len(leg) for leg in legs}) != 1 or not legs[0]:
            raise PolicyFormatError("manifest.legs must be legs of equally many joints")
        self._columns = np.array([[names.index(name) for name in leg] for leg in order])
        self._axes = np.array(legs, np.float32)  # [legs, joints, 3]
        x, y, z = np.moveaxis(self._axes, -1, 0)
        zero = np.zeros_like(x)
        rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
        self._cross = np.moveaxis(np.array(rows), (0, 1), (-2, -1))  # a x v = cross @ v
        self._twice = self._cross @ self._cross

    def exchange(self, count: int) -> np.ndarray:
        """List for each of `count` joints the same joint of the other leg; itself for the rest."""
        others = np.arange(count)
        if len(self._columns) == 2:
            left, right = self._columns
            others[left], others[right] = right, left
        return others

    def down(self, q: np.ndarray) -> np.ndarray:
        """Compute where the soles point in the base's frame, a unit vector of each [legs, 3]."""
        return -self._turn_down(q)[1][:, :, 2]

    def turning_about(self, axis: int) -> list[list[int]]:
        """List the joints of each leg, from the hip down, that turn about x, y or z (0, 1, 2)."""
        about = np.abs(self._axes).argmax(axis=-1) == axis
        return [columns[those].tolist() for columns, those in zip(self._columns, about)]

    def signs(self, count: int) -> np.ndarray:
        """Compute for each of `count` joints the sign of its axis; 1 for those of no leg."""
        signs = np.ones(count, np.float32)
        signs[self._columns] = np.sign(self._axes.sum(axis=-1))
        return signs

    def turns(self, q: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Compute how far the base turned over each foot, if that stood still, rad [legs, 3].

        Args:
            q: joint angles, rad [J].
            moved: their changes, rad [J].
        """
        axes, _ = self._turn_down(q)
        return -np.einsum("lja,lj->la", axes, moved[self._columns])

    def turn(self, q: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Compute how far the base turned by the leg of which this is least, rad [3]."""
        turns = self.turns(q, moved)
        return turns[int(np.argmin((turns * turns).sum(axis=1)))]

    def _turn_down(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the joints' axes [legs, joints, 3] and the feet's rotations [legs, 3, 3]."""
        angle = q[self._columns][..., None, None]
        turns = np.sin(angle) * self._cross + (1.0 - np.cos(angle)) * self._twice
        turns += np.eye(3, dtype=np.float32)
        rotation = np.broadcast_to(np.eye(3, dtype=np.float32), turns[:, 0].shape)
        axes = np.zeros_like(self._axes)
        for j in range(axes.shape[1]):
            axes[:, j] = (rotation @ self._axes[:, j, :, None])[..., 0]
            rotation = rotation @ turns[:, j]
        return axes, rotation
