"""A policy with its memory: frames and measurements go in, joint targets come out."""

from __future__ import annotations

from cref_jax.runtime.threads import ONE_THREAD

import os
import threading
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from cref_jax.runtime.files import contents, one_error
from cref_jax.runtime.frames import fill_holes, nearest_around
from cref_jax.runtime.joints import read_joints
from cref_jax.runtime.network import VARIANTS, Actor, Encoder
from cref_jax.runtime.status import FAULTS, Status
from cref_jax.runtime.tables import PolicyFormatError, Table, Weights

TERMS = ("angular_velocity", "gravity", "command", "joint_position", "joint_velocity", "action")
GRAVITY_LENGTH = (0.8, 1.25)  # of a unit vector; rejects m/s^2
POSE_MARGIN = 0.5  # rad beyond a joint's range; more means degrees, or another joint's angle
LATE = 2.0  # control periods between two steps, at most


def load(path: str | os.PathLike[str], joints: Sequence[str] | None = None) -> Policy:
    """Load the policy in a directory, or in a .zip of one.

    Args:
        path: output of `python -m cref_jax.export`.
        joints: names of the robot's joints in its own order, which must equal the policy's.

    Raises:
        PolicyFormatError: a file is missing, damaged or of another format, or the joints differ.
    """
    with one_error(path):
        policy = Policy(*contents(path))
    if joints is not None and tuple(joints) != policy.joints.names:
        ours, theirs = ", ".join(policy.joints.names), ", ".join(map(str, joints))
        raise PolicyFormatError(f"{path}: its joints are {ours}, but the robot's are {theirs}")
    if not any(os.environ.get(name) == "1" for name in ONE_THREAD):
        warnings.warn("steps are slow unless OMP_NUM_THREADS=1 is set first", stacklevel=2)
    return policy


class Policy:
    """A recurrent policy with its memory. Buffers are allocated once."""

    def __init__(self, manifest: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Check the manifest's numbers and the names and shapes of the arrays of weights.npz."""
        root, weights = Table(manifest, "manifest"), Weights(dict(arrays))
        net, guards, obs = root.table("network"), root.table("guards"), root.table("observation")
        self.joints = read_joints(root)
        self.period = 1.0 / root.table("rates").real("control_hz", 1.0, 1000.0)  # s
        self.blind = net.text("variant", VARIANTS) == "blind"
        self.status = Status.OK
        size = 9 + 3 * len(self.joints.names)
        if [term.text("name") for term in obs.tables("terms")] != list(TERMS):
            raise PolicyFormatError(f"observation.terms must be {', '.join(TERMS)}")
        self._mean, self._std = obs.reals("mean", size), obs.reals("std", size, 1e-9)
        self._clip = obs.real("clip", 1e-3, 1e6)
        self._action_clip = root.table("action").real("clip", 1e-3, 1e6)
        command = root.table("command")
        self._command = command.reals("low", 3), command.reals("high", 3)
        self._hold_steps = guards.whole("hold_steps", 0, 1000)
        self._stale = guards.real("stale_s", 1e-3, 10.0)
        self._invalid = guards.real("max_invalid", 0.0, 1.0)
        self._rate = guards.reals("rate_rad", len(self.joints.names), 0.0)
        self._beyond = guards.reals("beyond_rad", len(self.joints.names), 0.0)
        shape, self._d_max = (0, 0), 1.0
        if not self.blind:
            depth = root.table("depth")
            shape = depth.whole("rows", 8, 1024), depth.whole("columns", 8, 1024)
            self._d_max = depth.real("d_max_m", 0.01, 1000.0)
            self._window = depth.whole("window", 1, 15) if depth.has("window") else 1
            self._encoder = Encoder(net, weights, shape)
        self.image_shape = shape  # rows, columns
        self._actor = Actor(net, weights, shape, size, len(self.joints.names))
        weights.finish()
        self._obs = np.zeros(size, np.float32)
        self._target = np.zeros(len(self.joints.names), np.float32)
        self._q = self.joints.default.copy()
        self._lock = threading.Lock()
        self.reset()

    def reset(self) -> None:
        """Clear all memory: call before the first step, and to walk again after damping."""
        with self._lock:
            self._stamp: float | None = None
            self._actor.reset()
        self._previous = np.zeros(len(self.joints.names), np.float32)
        self._before: float | None = None  # time of the last step, s
        self._aimed = False  # a target has been given
        self._faults = self._hold_steps  # nothing to hold yet
        self._damping = False
        self.status = Status.OK

    def on_depth(self, depth: Any, stamp: Any) -> Status:
        """Encode a frame: z-depth [H, W] in metres, or uint16 in millimetres; row 0 is the top.

        `stamp` is its time of exposure, s, on the clock of `step`. Depths beyond d_max, including
        infinity, are clipped to d_max, as misses were in training. Pixels that are 0 or NaN are
        holes, filled in from their surroundings.
        """
        with np.errstate(all="ignore"):
            return self._see(depth, stamp)

    def step(
        self,
        angular_velocity: Any,
        gravity: Any,
        command: Any,
        q: Any,
        qd: Any,
        now: Any,
    ) -> np.ndarray:
        """Compute the joint targets for the next control period, rad [J]; sets `status`.

        Args:
            angular_velocity: of the base in its own frame, rad/s [3].
            gravity: its direction in that frame, [3]; (0, 0, -1) when the robot is upright.
            command: forward and leftward speed, m/s, and yaw rate to the left, rad/s [3].
            q: joint angles, rad [J].
            qd: joint speeds, rad/s [J].
            now: the time, s.
        """
        with np.errstate(all="ignore"):
            status = self._sense((angular_velocity, gravity, command, q, qd)) | self._time(now)
            if not status & FAULTS:
                status |= self._act()
        self._faults = self._faults + 1 if status & FAULTS else 0
        self._damping |= self._faults > self._hold_steps
        if self._damping:
            status |= Status.DAMPING
        elif self._faults:
            status |= Status.HOLDING
        self.status = status
        return (self._q if self._damping else self._target).copy()

    def tensors(self) -> dict[str, np.ndarray]:
        """Copy the network's tensors after the last step, by name."""
        tensors = {**self._actor.tensors(), "previous_action": self._previous}
        return {name: np.array(tensor) for name, tensor in tensors.items()}

    def _see(self, depth: Any, stamp: Any) -> Status:
        """Check a frame and encode it if usable."""
        try:
            frame, stamp = np.asarray(depth), float(stamp)
        except Exception:  # an object's own conversion may raise anything
            return Status.BAD_DEPTH
        usable = frame.dtype.kind == "f" or frame.dtype == np.uint16
        if self.blind or frame.shape != self.image_shape or not usable or not np.isfinite(stamp):
            return Status.BAD_DEPTH
        metres = frame.astype(np.float32)
        if frame.dtype == np.uint16:
            metres /= np.float32(1000.0)
        valid = metres > 0.0  # and no NaN
        if 1.0 - valid.mean() > self._invalid:
            return Status.INVALID_DEPTH
        far = np.float32(self._d_max)
        share = np.where(valid, np.minimum(metres, far), far) / far
        if not valid.all():
            # 1 / depth of a plane is linear in the image, so level ground is filled in exactly
            share = np.where(valid, share, 1.0 / fill_holes(1.0 / share, valid))
        image = (nearest_around(share, self._window) - 0.5).astype(np.float32)
        encoded = self._encoder(image.astype(np.float16).astype(np.float32))  # as in training
        with self._lock:
            self._actor.look(*encoded)
            self._stamp = stamp
        return Status.OK

    def _sense(self, inputs: Sequence[Any]) -> Status:
        """Check the measurements and write them into the observation if plausible."""
        count, joints = len(self.joints.names), self.joints
        vectors = [to_vector(x, size) for x, size in zip(inputs, (3, 3, 3, count, count))]
        angular_velocity, gravity, command, q, qd = vectors
        if q is not None:
            possible = (q > joints.low - POSE_MARGIN) & (q < joints.high + POSE_MARGIN)
            if not possible.all():
                return Status.BAD_INPUT
            self._q[:] = q
        if (
            angular_velocity is None
            or gravity is None
            or command is None
            or q is None
            or qd is None
        ):
            return Status.BAD_INPUT
        if not GRAVITY_LENGTH[0] < float(np.sqrt(gravity @ gravity)) < GRAVITY_LENGTH[1]:
            return Status.BAD_INPUT
        limited = np.clip(command, *self._command)
        parts = (angular_velocity, gravity, limited, q - joints.default, qd, self._previous)
        np.concatenate(parts, out=self._obs)
        return Status.OK if (limited == command).all() else Status.COMMAND_LIMITED

    def _time(self, now: Any) -> Status:
        """Check the time of a step and the age of the current frame."""
        status, before, stamp = Status.OK, self._before, self._stamp
        try:
            now = float(now)
        except (TypeError, ValueError, OverflowError):
            return Status.BAD_INPUT
        if not np.isfinite(now):
            return Status.BAD_INPUT
        self._before = now
        if before is not None and not 0.0 <= now - before <= LATE * self.period:
            status |= Status.LATE
        if self.blind:
            return status
        if stamp is None:
            return status | Status.NO_DEPTH
        return status | (Status.STALE_DEPTH if abs(now - stamp) > self._stale else Status.OK)

    def _act(self) -> Status:
        """Run the network and set the target if the action is finite."""
        self._obs -= self._mean
        self._obs /= self._std
        np.clip(self._obs, -self._clip, self._clip, out=self._obs)
        with self._lock:
            action = self._actor(self._obs)
        if not np.isfinite(action).all():
            return Status.BAD_ACTION
        np.clip(action, -self._action_clip, self._action_clip, out=self._previous)
        return self._aim()

    def _aim(self) -> Status:
        """Convert the action to the target, within the limits."""
        status, joints = Status.OK, self.joints
        wanted = joints.default + joints.scale * self._previous
        target = np.clip(wanted, joints.low - self._beyond, joints.high + self._beyond)
        if (target != wanted).any():
            status |= Status.RANGE_LIMITED
        if self._aimed:
            moved = np.clip(target, self._target - self._rate, self._target + self._rate)
            if (moved != target).any():
                status |= Status.RATE_LIMITED
            target = moved
        self._target[:], self._aimed = target, True
        return status


def to_vector(value: Any, size: int) -> np.ndarray | None:
    """Convert to f32[size]; None unless the value is `size` finite numbers."""
    try:
        array = np.asarray(value)
    except Exception:  # an object's own conversion may raise anything
        return None
    if array.dtype.kind not in "fiu" or array.shape != (size,):
        return None
    array = array.astype(np.float32)
    return array if np.isfinite(array).all() else None
