"""The measurements of a step: checked each for itself and against each other."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

from cref_jax.runtime.cross_checks import CrossChecks
from cref_jax.runtime.joints import Joints
from cref_jax.runtime.legs import Legs
from cref_jax.runtime.recorder import to_array
from cref_jax.runtime.status import FAULTS, Status

GRAVITY_LENGTH = (0.8, 1.25)  # of a unit vector; rejects m/s^2
UPRIGHT = -0.5  # largest z of gravity, 60 deg of tilt; walking stays below -0.9
MOST_TURNING = 12.0  # rad/s; walking with pushes stays below 6
MOST_JOINT_SPEED = 50.0  # rad/s; walking with noise stays below 25
POSE_MARGIN = 0.5  # rad beyond a joint's range; more means degrees, or another joint's angle
MOST_FOOT_TILT = 0.35  # at the start, 20 deg; sensors of a randomised robot show up to 6 deg
MOST_CHANGE = 0.08  # of it before the start, 5 deg
MOST_SAG = 0.23  # rad, of joints that are held; in simulation they yield by 0.21 in 0.2 s
MOST_APART = 0.08  # of the soles of two feet that stand
TILTS = 5  # samples, of which a mean has little noise


class Senses:
    """The measurements of the newest step, as good as they are."""

    def __init__(self, joints: Joints, legs: Legs | None, period: float, careful: bool) -> None:
        self._joints, self._legs = joints, legs
        self._careful = careful
        self._checks = CrossChecks(period, len(joints.names), legs)
        self.q = joints.default.copy()  # rad, as measured last
        self.reset()

    def reset(self) -> None:
        """Forget what was measured."""
        self._checks.reset()
        self.first: np.ndarray | None = None  # q as measured first, rad
        self.detail = ""  # what is wrong with which input
        self._tilts: deque[np.ndarray] = deque(maxlen=2 * TILTS)  # of the feet, before the start
        self.angular_velocity = self.gravity = np.zeros(3, np.float32)
        self.command = np.zeros(3, np.float32)
        self.qd = np.zeros_like(self.q)

    def take(self, inputs: Sequence[Any], target: np.ndarray | None) -> Status:
        """Check angular velocity, gravity, command, q and qd, and keep them if they can be used.

        Args:
            inputs: as the robot's program gave them.
            target: of the step before, rad [J]; None before the start.
        """
        count = len(self._joints.names)
        sizes = zip(inputs, (3, 3, 3, count, count))
        self.detail = ""
        vectors = [to_vector(x, size) for x, size in sizes]
        w, g, command, q, qd = vectors
        if q is not None and not self._keep_pose(q):
            return Status.BAD_INPUT
        if w is None or g is None or command is None or q is None or qd is None:
            names = ("angular_velocity", "gravity", "command", "q", "qd")
            wrong = [name for name, x in zip(names, vectors) if x is None]
            self.detail = f"{', '.join(wrong)}: not as many finite numbers as there must be"
            return Status.BAD_INPUT
        status = self._check_each(w, g, qd)
        if status & FAULTS:
            return status
        held = self._joints.default if target is None else target
        wrong = self._checks.compare(w, g, q, qd, held, forget=target is None)
        status |= wrong if self._careful else Status.OK
        w, g, qd = self._checks.mend(status)
        self.angular_velocity, self.gravity, self.command, self.qd = w, g, command, qd
        return status

    def stands(self) -> bool:
        """Check whether the feet are level, by gravity and joint angles."""
        return bool(np.abs(self._tilt_feet()).max() < MOST_FOOT_TILT)

    def leans_as_legs_say(self) -> bool:
        """Check whether gravity has moved as the legs of a robot that stands on both feet say."""
        self._tilts.append(self._tilt_feet())
        if len(self._tilts) < 2 * TILTS:
            return True
        early, late = np.array(self._tilts).reshape(2, TILTS, -1, 3).mean(axis=1)
        held = self.first is None or np.abs(self.q - self.first).max() < MOST_SAG
        both_stand = held and np.abs(late - late[0]).max() < MOST_APART
        return bool(not both_stand or np.abs(late - early).max() < MOST_CHANGE)

    def _tilt_feet(self) -> np.ndarray:
        """Compute the soles' directions less that of gravity, in the base's frame [legs, 3]."""
        if self._legs is None:
            return np.zeros((1, 3))
        return self._legs.down(self.q) - self.gravity / np.sqrt(self.gravity @ self.gravity)

    def _keep_pose(self, q: np.ndarray) -> bool:
        """Keep joint angles if they are within their ranges."""
        joints = self._joints
        possible = (q > joints.low - POSE_MARGIN) & (q < joints.high + POSE_MARGIN)
        if not possible.all():
            worst = joints.names[int(np.argmin(possible))]
            self._checks.forget_history()
            self.detail = f"q is beyond the range of {worst}: degrees, or another order?"
            return False
        if np.ptp(q) == 0.0 and np.ptp(joints.default) > 0.0:
            self.detail = f"all joint angles are {q[0]:g}: nothing measures them"
            return False
        self.q[:] = q
        if self.first is None:
            self.first = self.q.copy()
        return True

    def _check_each(self, w: np.ndarray, g: np.ndarray, qd: np.ndarray) -> Status:
        """Check whether each measurement is possible."""
        length = float(np.sqrt(g @ g))
        if not GRAVITY_LENGTH[0] < length < GRAVITY_LENGTH[1]:
            self.detail = f"gravity must be a unit vector, and its length is {length:.3g}"
            return Status.BAD_INPUT
        if g[2] > UPRIGHT * length:
            return Status.GRAVITY_TURNED
        fast = Status.GYRO_TOO_FAST if np.abs(w).max() > MOST_TURNING else Status.OK
        return fast | (Status.JOINTS_TOO_FAST if np.abs(qd).max() > MOST_JOINT_SPEED else Status.OK)


def to_vector(value: Any, size: int) -> np.ndarray | None:
    """Convert to f32[size]; None unless the value is `size` finite numbers."""
    try:
        array = to_array(value)
    except Exception:  # an object's own conversion may raise anything
        return None
    if array.dtype.kind not in "fiu" or array.shape != (size,):
        return None
    array = array.astype(np.float32)
    return array if np.isfinite(array).all() else None
