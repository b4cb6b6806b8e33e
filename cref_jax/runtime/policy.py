"""A policy with its memory: frames and measurements go in, joint targets come out."""

from __future__ import annotations

from cref_jax.runtime.threads import ONE_THREAD

import math
import os
import threading
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from cref_jax.runtime.camera import Camera
from cref_jax.runtime.files import contents, one_error
from cref_jax.runtime.joints import read_joints
from cref_jax.runtime.legs import Legs
from cref_jax.runtime.network import VARIANTS
from cref_jax.runtime.nudge import Nudge
from cref_jax.runtime.recorder import Recorder, to_array, to_time
from cref_jax.runtime.senses import Senses
from cref_jax.runtime.status import (
    FAULTS,
    SENSES_WRONG,
    STOPPING,
    TOO_FAST,
    UNUSED_FRAME,
    WHY,
    Status,
)
from cref_jax.runtime.tables import PolicyFormatError, Table, Weights
from cref_jax.runtime.variants import build_actor, build_encoder

TERMS = ("angular_velocity", "gravity", "command", "joint_position", "joint_velocity", "action")
LATE = 2.0  # control periods between two steps, at most
STOP_AFTER = 0.3  # s with an old frame or an old command; half a step
START_AFTER = 0.2  # s; a simulated robot whose pose is held falls after one second
START_AGAIN = 1.0  # s, for which all must be right after something was wrong before the start
FAR = 0.8  # rad from the default pose; from farther away, a start moves there first
START_SPEED = 0.5  # rad/s, of the joint that moves most
STILL = 0.5  # rad/s, of a robot that stands


def load(
    path: str | os.PathLike[str],
    joints: Sequence[str] | None = None,
    depth_scale: float = 1e-3,
    careful: bool = True,
    start_after: float = START_AFTER,
) -> Policy:
    """Load the policy in a directory, or in a .zip of one.

    Args:
        path: output of `python -m cref_jax.export`.
        joints: names of the robot's joints in its own order, which must equal the policy's.
        depth_scale: m per unit of a camera's raw (uint16) values; a D435i's is 1e-3, others'
            (D405, L515) 1e-4 or 2.5e-4.
        careful: wait for a frame, start on level feet alone, swing the hips a little before that
            and move to the default pose slowly; compare the senses with each other, and stop when
            they disagree.
        start_after: s, for which all must be right before a careful start, and at least until the
            hips have swung (0.2 s), while the pose measured first is held; longer is better where
            the robot is held up.

    Raises:
        PolicyFormatError: a file is missing, damaged or of another format, or the joints differ.
    """
    if not 1e-6 <= depth_scale <= 1.0:
        raise PolicyFormatError(f"depth_scale must be 1e-6 to 1 m per unit, not {depth_scale}")
    with one_error(path):
        policy = Policy(*contents(path), depth_scale, careful, start_after)
    if joints is not None and tuple(joints) != policy.joints.names:
        ours, theirs = ", ".join(policy.joints.names), ", ".join(map(str, joints))
        raise PolicyFormatError(f"{path}: its joints are {ours}, but the robot's are {theirs}")
    if not any(os.environ.get(name) == "1" for name in ONE_THREAD):
        warnings.warn("steps are slow unless OMP_NUM_THREADS=1 is set first", stacklevel=2)
    return policy


class Policy:
    """A recurrent policy with its memory. Buffers are allocated once."""

    def __init__(
        self,
        manifest: dict[str, Any],
        arrays: dict[str, np.ndarray],
        depth_scale: float = 1e-3,
        careful: bool = True,
        start_after: float = START_AFTER,
    ) -> None:
        """Check the manifest's numbers and the names and shapes of the arrays of weights.npz."""
        root, weights = Table(manifest, "manifest"), Weights(dict(arrays))
        net, guards, obs = root.table("network"), root.table("guards"), root.table("observation")
        self.joints = read_joints(root)
        count = len(self.joints.names)
        self.period = 1.0 / root.table("rates").real("control_hz", 1.0, 1000.0)  # s
        self.blind = net.text("variant", VARIANTS) == "blind"
        self.status = Status.OK
        if [term.text("name") for term in obs.tables("terms")] != list(TERMS):
            raise PolicyFormatError(f"observation.terms must be {', '.join(TERMS)}")
        size = 9 + 3 * count
        self._mean, self._std = obs.reals("mean", size), obs.reals("std", size, 1e-9)
        self._clip = obs.real("clip", 1e-3, 1e6)
        self._action_clip = root.table("action").real("clip", 1e-3, 1e6)
        command = root.table("command")
        self._command = command.reals("low", 3), command.reals("high", 3)
        self._read_guards(guards, count)
        self._camera: Camera | None = None
        self.image_shape = (0, 0)  # rows, columns
        if not self.blind:
            self._camera = Camera(root.table("depth"), depth_scale, self._invalid)
            self.image_shape = self._camera.shape
            self._encoder = build_encoder(net, weights, self.image_shape)
        self._actor = build_actor(net, weights, self.image_shape, size, count)
        weights.finish()
        self._careful, self._start_after = careful, start_after
        legs = Legs(root, self.joints.names) if careful and root.has("legs") else None
        self._senses = Senses(self.joints, legs, self.period, careful)
        self._nudge = Nudge(legs, self.joints, self.period) if legs else None
        self.recorder = Recorder(self.period, depth_scale, careful, start_after)
        self._obs = np.zeros(size, np.float32)
        self._lock = threading.Lock()
        self.reset()

    def _read_guards(self, guards: Table, count: int) -> None:
        self._hold_steps = guards.whole("hold_steps", 0, 1000)
        self._stale = guards.real("stale_s", 1e-3, 10.0)
        self._invalid = guards.real("max_invalid", 0.0, 1.0)
        self._rate = guards.reals("rate_rad", count, 0.0)
        self._beyond = guards.reals("beyond_rad", count, 0.0)

    def reset(self) -> None:
        """Clear all memory: call before the first step, and to walk again after damping."""
        with self._lock:
            self._stamp: float | None = None
            self._seen = Status.OK  # of the newest frame
            if self._camera:
                self._camera.reset()
            self._actor.reset()
        self._senses.reset()
        if self._nudge:
            self._nudge.reset()
        self._refused = Status.OK  # what the nudge has shown to be wrong
        self.recorder.reset()
        self._target = self.joints.default.copy()
        self._previous = np.zeros_like(self._target)
        self._before: float | None = None  # time of the last step, s
        self._good = 0  # steps in a row before the start in which all was right
        self._wait = self._start_after  # s, for which all must be right
        self._begun = False
        self._aimed = False  # the network has given a target
        self._ramp: list[np.ndarray] = []  # targets until the default pose
        self._unseen = 0  # steps in a row without a frame that is new enough
        self._told_to_stop = False
        self._time_detail = ""
        self._faults = 0  # steps in a row without a good input
        self._damping = False
        self.status = Status.OK

    def stop(self) -> None:
        """Stand from now on, whatever the command, until `reset`; see `on_both_feet`."""
        self._told_to_stop = True

    def on_both_feet(self) -> bool:
        """Check whether the robot stands still with level feet, as after `stop`."""
        senses = self._senses
        return bool(senses.stands() and np.abs(senses.qd).max() < STILL)

    def preprocess(self, frame: Any, view: Sequence[float]) -> np.ndarray:
        """Convert a frame of any size and view to one for `on_depth`; 0 beyond its view.

        Args:
            frame: z-depth [height, width], m or raw units, whose optical axis is the policy's.
            view: vertical and horizontal angle that it shows, deg.

        Raises:
            ValueError: the frame is no image, the view no view, or the policy is blind.
        """
        image = to_array(frame)
        if self._camera is None:
            raise ValueError("this policy takes no frames")
        if image.ndim != 2 or image.size == 0 or image.dtype.kind not in "fiu":
            raise ValueError(f"a frame must be height x width numbers, not {image.shape}")
        if len(view) != 2 or not all(1.0 <= angle <= 175.0 for angle in view):
            raise ValueError(f"view must be two angles from 1 to 175 deg, not {view}")
        return self._camera.resample(image, view)

    def on_depth(self, depth: Any, stamp: Any) -> Status:
        """Encode a frame: z-depth [H, W] in m, or uint16 times `depth_scale`; row 0 is the top.

        `stamp` is its time of exposure, s, on the clock of `step`. Depths beyond d_max, including
        infinity, are clipped to d_max, as misses were in training. Pixels that are 0 or NaN are
        holes, filled in from their surroundings.
        """
        self.recorder.add_frame(depth, stamp)
        with np.errstate(all="ignore"):
            self._seen = self._see(depth, stamp)
        return self._seen

    def step(
        self,
        angular_velocity: Any,
        gravity: Any,
        command: Any,
        q: Any,
        qd: Any,
        now: Any,
        commanded: Any = None,
    ) -> np.ndarray:
        """Compute the joint targets for the next control period, rad [J]; sets `status`.

        Args:
            angular_velocity: of the base in its own frame, rad/s [3].
            gravity: its direction in that frame, [3]; (0, 0, -1) when the robot is upright.
            command: forward and leftward speed, m/s, and yaw rate to the left, rad/s [3].
            q: joint angles, rad [J].
            qd: joint speeds, rad/s [J].
            now: the time, s.
            commanded: when the command came, s on the same clock; without it, always just now.
        """
        commanded = now if commanded is None else commanded
        inputs = (angular_velocity, gravity, command, q, qd)
        with np.errstate(all="ignore"):
            status = self._time(now, commanded)
            status |= self._senses.take(inputs, self._target if self._begun else None)
            if not self._begun and not status & FAULTS:
                status |= self._begin(status)
            if self._told_to_stop or (status | self._seen) & STOPPING:
                status |= Status.STOPPED
            if self._begun and not status & FAULTS:
                status |= self._act(bool(status & Status.STOPPED))
        target = self._choose(status)
        given = (*inputs, now, commanded)
        self.recorder.add_step(given, target, int(self.status), self._told_to_stop)
        return target

    @property
    def why(self) -> str:
        """What `status` says, in words."""
        said = [words for flag, words in WHY.items() if flag & self.status]
        frame = self._camera.detail if self._camera and self._seen else ""
        nudge = self._nudge.detail if self._nudge else ""
        details = (self._time_detail, self._senses.detail, nudge, frame)
        return "; ".join([*said, *(detail for detail in details if detail)] if said else said)

    def tensors(self) -> dict[str, np.ndarray]:
        """Copy the network's tensors after the last step, by name."""
        tensors = {**self._actor.tensors(), "previous_action": self._previous}
        return {name: np.array(tensor) for name, tensor in tensors.items()}

    def _see(self, depth: Any, stamp: Any) -> Status:
        """Check a frame and encode it if usable."""
        if self._camera is None:
            return Status.BAD_DEPTH
        senses = self._senses
        gravity = senses.gravity if self._careful else None
        status, image = self._camera.prepare(depth, stamp, senses.q, gravity)
        if status & UNUSED_FRAME:
            return status
        encoded = self._encoder(image.astype(np.float16).astype(np.float32))  # as in training
        with self._lock:
            self._actor.look(*encoded)
            self._stamp = float(stamp)
        return status

    def _time(self, now: Any, commanded: Any) -> Status:
        """Check the time of a step, and the age of the newest frame and of the command."""
        status, before, stamp = Status.OK, self._before, self._stamp
        self._time_detail = ""
        now, commanded = to_time(now), to_time(commanded)
        if not math.isfinite(now) or not math.isfinite(commanded):
            self._time_detail = "now and commanded must be times in s"
            return Status.BAD_INPUT
        self._before = now
        if before is not None and not 0.0 <= now - before <= LATE * self.period:
            status |= Status.LATE
        if abs(now - commanded) > STOP_AFTER:
            status |= Status.STALE_COMMAND | Status.STOPPED
        if self._camera is None:
            return status
        old = stamp is None or abs(now - stamp) > self._stale + 1e-6  # rounding
        self._unseen = self._unseen + 1 if old else 0  # in steps: the clock may be wrong
        if self._unseen * self.period > STOP_AFTER:
            status |= Status.STOPPED
        if stamp is None:
            return status | Status.NO_DEPTH
        return status | (Status.STALE_DEPTH if old else Status.OK)

    def _begin(self, status: Status) -> Status:
        """Begin when all has been right on level feet for long enough, or say why not."""
        if not self._careful:
            self._begun = True
            return Status.OK
        wrong = status & (SENSES_WRONG | TOO_FAST | Status.NO_DEPTH | Status.STALE_DEPTH)
        wrong |= self._refused
        level = self._good > 0 or self._senses.stands()
        if not level or not self._senses.leans_as_legs_say():
            wrong |= Status.NOT_ON_FEET
        self._good = 0 if wrong else self._good + 1
        if wrong & ~(Status.NO_DEPTH | Status.STALE_DEPTH):
            self._wait = max(START_AGAIN, self._start_after)
        ready = self._good > 0 and self._good * self.period > self._wait - 1e-6
        if refused := self._watch_nudge(ready):
            self._refused, self._good, ready = refused, 0, False
        self._begun = ready and (self._nudge is None or self._nudge.is_over())
        first, default = self._senses.q.copy(), self.joints.default
        way = float(np.abs(default - first).max())
        if self._begun and way > FAR:
            steps = int(way / (START_SPEED * self.period))
            self._ramp = [first + (default - first) * (k / steps) for k in range(1, steps + 1)]
        return wrong | self._refused

    def _watch_nudge(self, ready: bool) -> Status:
        """Go on with the swing of the hips, or begin it anew; judge it when all else is ready."""
        if self._nudge is None or not self._good:
            return Status.OK
        if self._good == 1:
            self._nudge.reset()
        self._nudge.add(self._senses.q, self._senses.angular_velocity)
        return self._nudge.judge() if ready else Status.OK

    def _act(self, standing: bool) -> Status:
        """Run the network and set the target if the action is finite."""
        if self._ramp:
            self._target[:] = self._ramp.pop(0)
            return Status.STARTING
        senses, joints = self._senses, self.joints
        command = np.clip(senses.command, *self._command)
        status = Status.COMMAND_LIMITED if (command != senses.command).any() else Status.OK
        if standing:
            command[:] = 0.0
        q = senses.q - joints.default
        parts = (senses.angular_velocity, senses.gravity, command, q, senses.qd, self._previous)
        np.concatenate(parts, out=self._obs)
        self._obs -= self._mean
        self._obs /= self._std
        np.clip(self._obs, -self._clip, self._clip, out=self._obs)
        with self._lock:
            action = self._actor(self._obs)
        if not np.isfinite(action).all():
            if not self._aimed:  # there is no good target to hold
                self._target[:] = senses.q
            return status | Status.BAD_ACTION
        np.clip(action, -self._action_clip, self._action_clip, out=self._previous)
        return status | self._aim()

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

    def _choose(self, status: Status) -> np.ndarray:
        """Choose the target to return: the network's, the last one, or a pose; sets `status`."""
        self._faults = self._faults + 1 if status & FAULTS else 0
        self._damping |= self._begun and self._faults > self._hold_steps
        if not self._begun:
            if status & FAULTS:
                self._good, self._wait = 0, max(START_AGAIN, self._start_after)
            if not self._good and status & ~Status.NO_DEPTH:
                status |= Status.NOT_STARTED
        elif self._damping:
            status |= Status.DAMPING
        elif self._faults:
            status |= Status.HOLDING
        self.status = status | self._seen
        if not self._begun:
            first = self._senses.first
            held = self.joints.default if first is None else first
            return held + self._nudge.offset() if self._nudge and self._good else held.copy()
        return (self._senses.q if self._damping else self._target).copy()
