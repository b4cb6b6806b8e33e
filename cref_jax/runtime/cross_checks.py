"""Senses that must say the same thing in their own ways, and which of them does not.

The joints' speeds are the changes of their angles; gravity turns as the gyro says; the base turns
over a standing foot as that leg's joints say; and joints follow their targets. Each pair is
compared over the last seconds, so that noise and slipping feet are no alarm, and a wrong sign, axis
or order is one within a step or two of the robot.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cref_jax.runtime.legs import Legs
from cref_jax.runtime.status import Status

KEEP = 0.99  # of the past in a step: 2 s at 50 Hz
FADE = 0.9  # of a turn or a movement in a step: 0.2 s at 50 Hz; what changes slower is not compared
LEAST_STEPS = 10
SURE = 3.0  # standard errors
SURE_OF_ONE_AXIS = 5.0  # of two
SURE_OF_ONE_JOINT = 6.0  # of a dozen
SURE_OF_LEGS = 3.0  # walking and standing stay within 0.2, legs that are exchanged reach 4
JOINT_FLOOR = 0.002  # rad per step; less is no movement
TURN_FLOOR = 0.004  # of gravity, or rad of the base; less is no turn
FOLLOWED_FLOOR = 0.05  # rad; a joint that moves less need not follow its target
OTHER_UNIT = 0.2  # of what another sense says, or less
CLEAR = 0.5  # correlation that tells an axis
TURNED = 0.45  # correlation of the base's roll by gyro and by legs; walking stays above -0.3
LEAST_NOISE = 0.1  # share of a signal
LAG = 2  # steps after which noise has changed and motion has not
MOUNT_JUDGED = 63.0  # weighted steps: 2 s; later nothing turns it, and a stumble looks like it
FEET_STAND = 20  # steps after the start, before which no foot has been far from the ground
DELAY = 2  # steps until a joint has begun to follow its target
FROZEN_STEPS = 25  # with the same numbers
FROZEN_MOTION = 0.05  # rad, of a joint or a target meanwhile
FROZEN_TURN = 0.01  # rad, of the base meanwhile
_IMU = Status.GYRO_WRONG | Status.GRAVITY_WRONG | Status.IMU_TURNED
_TO_TURN = np.array([[0.0, 1.0], [-1.0, 0.0]])  # x, y of an upright gravity's change, of gyro x, y


class Agreement:
    """Correlation of two signals over the last KEEP-weighted steps."""

    def __init__(self, size: int, floor: float) -> None:
        self._size, self._floor = size, floor * floor
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.count = 0.0
        self._sums = np.zeros((5, self._size))  # x y, x x, y y, and x and y with those before
        self._past = [np.zeros((2, self._size))] * LAG

    def add(self, x: np.ndarray, y: np.ndarray) -> None:
        """Add what both say of one step."""
        self.count = KEEP * self.count + 1.0
        self._sums *= KEEP
        before_x, before_y = self._past[0]
        self._sums += (x * y, x * x, y * y, x * before_x, y * before_y)
        self._past = [*self._past[1:], np.array((x, y))]

    def correlate(self) -> np.ndarray:
        """Compute the correlation of each part [size]."""
        return self._sums[0] / self._norm(self._sums)

    def correlate_all(self) -> float:
        """Compute the correlation of all parts together."""
        sums = self._sums.sum(axis=1)
        return float(sums[0] / self._norm(sums))

    def expect(self) -> np.ndarray:
        """Compute the correlation of each part [size] if the other signal held what one holds.

        Noise differs from step to step, motion does not: a signal's correlation with itself of
        LAG steps before is its motion, at least. Above 1, the other signal is too small for it.
        """
        motion, noise = self._sums[3:], np.maximum(self._sums[1:3] - self._sums[3:], 0.0)
        least = motion - SURE * noise / np.sqrt(max(self.count, 1.0))
        return np.maximum(least.max(axis=0), 0.0) / self._norm(self._sums)

    def doubt(self) -> np.ndarray:
        """Compute the standard error of each correlation [size]; motion in common has none."""
        _, xx, yy, past_x, past_y = self._sums
        floor = self.count * self._floor
        noise = 2.0 - past_x / (xx + floor) - past_y / (yy + floor)
        return np.sqrt((np.clip(noise, 0.0, 2.0) + LEAST_NOISE) / max(self.count, 1.0))

    def ratio(self) -> float:
        """Compute the size of x relative to y; what is below the floor counts as the floor."""
        _, xx, yy = self._sums[:3].sum(axis=1) + self.count * self._floor
        return float(np.sqrt(xx / yy))

    def energy(self) -> np.ndarray:
        """Sum the squares of each part of x [size]."""
        return self._sums[1]

    def _norm(self, sums: np.ndarray) -> Any:
        floor = self.count * self._floor
        return np.sqrt((sums[1] + floor) * (sums[2] + floor))


class CrossChecks:
    """Compares the senses at each step, and does without the wrong one."""

    def __init__(self, period: float, joints: int, legs: Legs | None) -> None:
        self._period, self._legs, self._joints = period, legs, joints
        self._speeds = Agreement(joints, JOINT_FLOOR)  # changes of angles, qd
        self._turns = Agreement(4, TURN_FLOOR)  # x, x, y, y of gravity; x, y, x, y by the gyro
        self._rolls = Agreement(4, TURN_FLOOR)  # roll, roll, pitch, pitch by legs; x, y, x, y
        self._targets = Agreement(joints, FOLLOWED_FLOOR)  # targets, angles
        self._exchanged = Agreement(joints, FOLLOWED_FLOOR)  # the same, of the other leg
        self._across = np.arange(joints) if legs is None else legs.exchange(joints)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.wrong = Status.OK
        self._frame = np.eye(3)  # from the axes of the wrong sense to the base's
        self.forget_history()

    def forget_history(self) -> None:
        """Forget the steps before, but not what they have shown to be wrong."""
        pairs = (self._speeds, self._turns, self._rolls, self._targets, self._exchanged)
        for agreement in pairs:
            agreement.reset()
        self._before: tuple[np.ndarray, ...] | None = None
        self._recent = np.zeros((4, 2))  # turns of late: gravity, the same by the gyro, legs, gyro
        self._moves = np.zeros((2, self._joints))  # of late: of targets, of joints
        self._delayed = [np.zeros(self._joints)] * DELAY
        self._moved = np.zeros(self._joints)  # rad, in this step
        self._change = np.zeros(3)  # of gravity in this step
        self._same = np.zeros(4, int)  # steps with the same gyro, gravity, q and qd

    def compare(self, *senses: np.ndarray, forget: bool = False) -> Status:
        """Compare angular velocity, gravity, q, qd and the last target with those of before.

        What was wrong once stays so, unless it is to `forget`, as before a start.
        """
        if forget:
            self.wrong = Status.OK
        before, self._before = self._before, tuple(x.astype(float) for x in senses)
        if before is None:
            return self.wrong
        (w, g, q, qd, target), (w0, g0, q0, qd0, target0) = self._before, before
        self._moved, self._change = q - q0, g - g0
        self._speeds.add(self._moved, 0.5 * (qd + qd0) * self._period)
        self._add_turns(0.5 * (w + w0) * self._period, 0.5 * (g + g0), g - g0)
        self._moves *= FADE
        self._moves += (target - target0, self._moved)
        self._delayed = [*self._delayed[1:], self._moves[0].copy()]
        self._targets.add(self._delayed[0], self._moves[1])
        self._exchanged.add(self._delayed[0], self._moves[1][self._across])
        equal = [bool((x == y).all()) for x, y in zip(self._before, before)]
        self._same = np.where(equal[:4], self._same + 1, 0)
        if self._speeds.count > LEAST_STEPS:
            stands = forget or self._speeds.count < FEET_STAND
            self.wrong |= self._judge_joints() | self._judge_imu(stands) | self._judge_frozen()
        return self.wrong

    def mend(self, wrong: Status) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute angular velocity, gravity and qd without the senses that are `wrong`."""
        assert self._before is not None
        w, g, _, qd, _ = self._before
        if wrong & Status.GYRO_TOO_FAST:
            w = np.array([-self._change[1], self._change[0], 0.0]) / self._period
        elif wrong & (Status.GYRO_WRONG | Status.IMU_TURNED):
            w = self._frame @ w
        if wrong & (Status.GRAVITY_WRONG | Status.IMU_TURNED):
            g = self._frame @ g
        if wrong & (Status.JOINT_SPEEDS_WRONG | Status.JOINTS_TOO_FAST):
            qd = self._moved / self._period
        return w, g, qd

    def _add_turns(self, turn: np.ndarray, g: np.ndarray, change: np.ndarray) -> None:
        """Add the turn in a step: of gravity, by the gyro, and by the legs."""
        (a, b, c), (x, y, z) = turn, g
        self._recent *= FADE
        self._recent[0] += change[:2]
        self._recent[1] += c * y - b * z, a * z - c * x  # -turn x gravity
        (gx, gy), (wx, wy) = self._recent[:2]
        self._turns.add(np.array([gx, gx, gy, gy]), np.array([wx, wy, wx, wy]))
        if self._legs is not None:
            assert self._before is not None
            q = self._before[2].astype(np.float32)
            self._recent[2] += self._legs.turn(q, self._moved)[:2]
            self._recent[3] += a, b
            (roll, pitch), (x, y) = self._recent[2:]
            self._rolls.add(np.array([roll, roll, pitch, pitch]), np.array([x, y, x, y]))

    def _judge_joints(self) -> Status:
        """Find out whether qd is wrong, or joints do not follow their targets."""
        status, root = Status.OK, float(np.sqrt(self._speeds.count))
        together, each = self._speeds.correlate_all(), self._speeds.correlate().min()
        reversed_ = together < -SURE / root or each < -SURE_OF_ONE_JOINT / root
        if reversed_ or self._speeds.ratio() < OTHER_UNIT:
            status |= Status.JOINT_SPEEDS_WRONG
        together, each = self._targets.correlate_all(), self._targets.correlate().min()
        exchanged = together - self._exchanged.correlate_all() < -SURE_OF_LEGS / root
        if together < -SURE / root or each < -SURE_OF_ONE_JOINT / root or exchanged:
            status |= Status.JOINTS_MIXED_UP
        return status

    def _judge_imu(self, standing: bool) -> Status:
        """Find out whether gyro, gravity or the frame of both is wrong, and which axes it has."""
        turns = self._turns.correlate().reshape(2, 2)  # of gravity x, y; by the gyro x, y
        legs, of_legs = self._legs_by_gyro(standing)
        found = self.wrong & _IMU
        if not found:
            excess = turns.diagonal() - 0.5 * self._turns.expect()[[0, 3]]
            doubt = self._turns.doubt()[[0, 3]]
            along, across = legs[0]
            bound = TURNED + SURE * of_legs
            if (excess < -SURE_OF_ONE_AXIS * doubt).any():
                roll, _, _, pitch = self._rolls.correlate()  # feet slip less sideways
                found = self._blame(turns, float(roll if excess[1] < 0.0 else pitch))
            elif (standing or self._rolls.count < MOUNT_JUDGED) and (
                along < -bound or (abs(across) > bound and along < 0.5 * abs(across))
            ):
                found = Status.IMU_TURNED
        if found:
            self._learn_axes(found, turns, legs)
        return found

    def _blame(self, turns: np.ndarray, gyro_by_legs: float) -> Status:
        """Choose which of gravity and gyro is wrong; the legs agree with the right one."""
        right_but_for_its_size = turns.trace() > 1.0
        gyro_says_little = self._turns.ratio() > 1.0 / OTHER_UNIT
        if gyro_by_legs > 0.0 and not right_but_for_its_size and not gyro_says_little:
            return Status.GRAVITY_WRONG
        return Status.GYRO_WRONG

    def _learn_axes(self, found: Status, turns: np.ndarray, legs: np.ndarray) -> None:
        """Find the axes of the wrong sense, for as long as the base turns enough to tell."""
        if found & Status.GYRO_WRONG and turns.trace() > 1.0:
            self._frame = np.eye(3) * self._turns.ratio()
            return
        frame, clear = _nearest_quarter(legs if found & Status.IMU_TURNED else turns)
        if clear or (self._frame == np.eye(3)).all():
            of_gyro = _TO_TURN.T @ frame @ _TO_TURN
            axes = {Status.GRAVITY_WRONG: frame.T, Status.GYRO_WRONG: of_gyro}
            self._frame[:2, :2] = axes.get(found, frame)
            self._frame[2, 2] = 0.0 if found & Status.GYRO_WRONG else 1.0  # yaw's sign is unknown

    def _legs_by_gyro(self, standing: bool) -> tuple[np.ndarray, float]:
        """Compute correlations of roll and pitch by legs with the gyro's x and y [2, 2].

        Feet that walk slip and tilt less sideways than forward, so pitch counts only while both
        stand; then the axis about which the base turns more tells of the other. Second, the larger
        standard error of those that count.
        """
        rolls, doubt = self._rolls.correlate().reshape(2, 2), self._rolls.doubt().reshape(2, 2)
        energy = self._rolls.energy()
        if standing and energy[2] > energy[0]:
            x, y = rolls[1]
            return np.array([[y, -x], [x, y]]), float(doubt[1].min())
        x, y = rolls[0]
        return np.array([[x, y], [-y, rolls[1, 1]]]), 1.0 / float(np.sqrt(self._rolls.count + 1.0))

    def _judge_frozen(self) -> Status:
        """Find out whether a sense says the same while another one tells of a motion."""
        gyro, gravity, q, qd = self._same >= FROZEN_STEPS
        turns, moves = np.abs(self._recent).max(axis=1), np.abs(self._moves).max(axis=1)
        frozen = Status.OK
        if gyro and turns[0] > FROZEN_TURN:
            frozen |= Status.GYRO_WRONG
        if gravity and turns[1] > FROZEN_TURN:
            frozen |= Status.GRAVITY_WRONG
        if qd and moves[1] > FROZEN_MOTION:
            frozen |= Status.JOINT_SPEEDS_WRONG
        if q and moves[0] > FROZEN_MOTION:
            frozen |= Status.JOINTS_MIXED_UP
        return frozen


def _nearest_quarter(matrix: np.ndarray) -> tuple[np.ndarray, bool]:
    """Find the axes, [2, 2] of -1, 0 and 1, most like a matrix, and whether they are clear."""
    straight, crossed = matrix.diagonal(), matrix[[0, 1], [1, 0]]
    is_straight = np.abs(straight).sum() >= np.abs(crossed).sum()
    signs = np.where(matrix < 0.0, -1.0, 1.0)
    clear = bool(np.abs(straight if is_straight else crossed).min() > CLEAR)
    return signs * (np.eye(2) if is_straight else 1.0 - np.eye(2)), clear
