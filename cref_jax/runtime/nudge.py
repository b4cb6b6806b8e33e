"""A small swing of the hips before the start: it shows signs and sides that no robot at rest shows.

While the pose measured first is held, one hip pitches forward and the other back, so that the base
yaws, and the first leg's hip rolls. Gyro, joint angles and targets must then tell of one motion.
"""

from __future__ import annotations

import numpy as np

from cref_jax.runtime.joints import Joints
from cref_jax.runtime.legs import Legs
from cref_jax.runtime.status import Status

PITCH = 0.083  # of the hips' torque, as long as they do not move; 0.1 rad of 1.2, torque over kp
ROLL = 0.125  # of one hip's torque; 0.15 rad, of which a standing robot reaches a tenth
SWING = 0.16  # s, to and fro
AFTER = 2  # control periods, in which the last of it is answered
LAGS = (2, 3)  # control periods after which a joint has begun to follow
LEAST_TURN = 0.001  # rad per control period; less is no turn
LEAST_MOVE = 0.004  # rad; less is no movement
MOST_YIELD = 0.3  # rad, of joints that are held; what moves more is not held
BOTH_STAND = 0.1  # of the soles' directions; with more between them, not both feet stand
AGAINST = -0.6  # correlation of turns; in simulation 0.8 to 1, with noise down to -0.3
ACROSS = 0.8  # correlation of the base's pitch with the gyro's x; in simulation up to 0.54,
MORE_THAN_ALONG = 0.3  # and 0.4 less than that with its y
OTHER_SIDE = 0.5  # correlation; in simulation -1 to -0.9, with noise up to 0
UNFOLLOWED = -0.4  # correlation; in simulation 0.7, with noise down to -0.1


class Nudge:
    """Targets of the swing, its measurements, and what these say."""

    def __init__(self, legs: Legs, joints: Joints, period: float) -> None:
        self._legs, self._names, self._period = legs, joints.names, period
        self._steps = round(SWING / period) + AFTER
        pitches, rolls = legs.turning_about(1), legs.turning_about(0)
        self._rolls = rolls
        self._can_yaw = all(legs.turning_about(2))
        self.possible = len(pitches) == 2 and all(len(leg) > 2 for leg in pitches)
        self.possible &= all(len(leg) > 0 for leg in rolls)
        self._swing = np.zeros(len(joints.names), np.float32)  # rad
        if self.possible:
            (self._left, *_, left_ankle), (self._right, *_, right_ankle) = pitches
            hip, full = self._left, joints.effort / joints.kp
            self._swing[[hip, right_ankle]] = PITCH * full[hip]
            self._swing[[self._right, left_ankle]] = -PITCH * full[hip]
            self._swing[rolls[0][0]] = ROLL * full[rolls[0][0]]
            self._swing *= legs.signs(len(joints.names))
        self.reset()

    def reset(self) -> None:
        """Forget what was measured."""
        self._q: list[np.ndarray] = []
        self._w: list[np.ndarray] = []
        self.detail = ""

    def offset(self) -> np.ndarray:
        """Compute how far the targets are from the held pose after the newest measurement, rad."""
        return self._swing * np.float32(self._share(len(self._q) - 1))

    def add(self, q: np.ndarray, angular_velocity: np.ndarray) -> None:
        """Add what was measured in a step, rad [J] and rad/s [3]."""
        if not self.is_over():
            self._q.append(q.copy())
            self._w.append(angular_velocity.copy())

    def is_over(self) -> bool:
        """Check whether all of the swing has been measured, or none is possible."""
        return not self.possible or len(self._q) >= self._steps

    def judge(self) -> Status:
        """Find out which signs are wrong and whether the legs are exchanged; sets `detail`."""
        if len(self._q) < self._steps:
            return Status.OK
        q, w = np.array(self._q), np.array(self._w)
        if np.abs(q - q[0]).max() > MOST_YIELD:
            return Status.OK
        moved, turn = np.diff(q, axis=0), 0.5 * (w[1:] + w[:-1]) * self._period
        by_legs = np.array([self._legs.turns(*step) for step in zip(q[1:], moved)])
        pitch = by_legs[..., 1].mean(axis=1)
        across, along = (abs(_correlate(pitch, turn[:, axis], LEAST_TURN)) for axis in (0, 1))
        if across > max(ACROSS, along + MORE_THAN_ALONG):
            self.detail = "by the legs the base pitches about the IMU's x"
            return Status.IMU_TURNED
        yaw = [_correlate(leg, turn[:, 2], LEAST_TURN) for leg in by_legs[..., 2].T]
        if np.mean(yaw) < AGAINST:
            self.detail = "the sign of angular_velocity's z is wrong by the legs"
            return Status.GYRO_WRONG
        roll = [_correlate(leg, turn[:, 0], LEAST_TURN) for leg in by_legs[..., 0].T]
        soles = np.array([self._legs.down(pose) for pose in q])
        both_stand = np.abs(soles[:, 0] - soles[:, 1]).max() < BOTH_STAND
        apart = (q[:, self._left] - q[:, self._right]) * np.sign(self._swing[self._left])
        if min(roll) < AGAINST:
            names = " or ".join(self._names[j] for j in self._rolls[int(np.argmin(roll))])
            self.detail = f"the sign of {names} is wrong"
        elif both_stand and self._turns_against(np.diff(apart), turn[:, 2]):
            self.detail = "the legs are exchanged: the base turns the other way than their hips"
        elif both_stand and self._follow(apart) < UNFOLLOWED:
            self.detail = "the legs are exchanged: one does what is asked of the other"
        return Status.JOINTS_MIXED_UP if self.detail else Status.OK

    def _share(self, step: int) -> float:
        """Compute the share of the swing that the targets have in a step, -1 to 1."""
        phase = step * self._period / SWING
        return float(np.sin(2.0 * np.pi * phase)) if 0.0 < phase < 1.0 else 0.0

    def _turns_against(self, apart: np.ndarray, yaw: np.ndarray) -> bool:
        """Check whether the base yaws against the hips, from their and its changes, rad.

        Without yaw joints it is feet which slip that turn the base, and they do so either way.
        """
        return self._can_yaw and _correlate(apart, yaw, LEAST_TURN) > OTHER_SIDE

    def _follow(self, apart: np.ndarray) -> float:
        """Correlate the swing with how far the hips are apart, less their steady sinking."""
        count = len(apart)
        line = np.stack([np.ones(count), np.arange(count)], axis=1)
        steady = line @ np.linalg.pinv(line)
        wanted = [np.array([self._share(step - lag) for step in range(count)]) for lag in LAGS]
        rest = apart - steady @ apart
        return float(np.mean([_correlate(x - steady @ x, rest, LEAST_MOVE) for x in wanted]))


def _correlate(x: np.ndarray, y: np.ndarray, least: float) -> float:
    """Correlate two signals; what is smaller than `least` counts as that."""
    floor = len(x) * least * least
    return float(x @ y / np.sqrt((x @ x + floor) * (y @ y + floor)))
