"""Run a policy on a robot: one file that needs only Python 3.8 and numpy 1.20 or newer.

    policy = load("policy/", joints=names_in_the_robots_own_order)
    policy.reset()
    policy.on_depth(frame, stamp)  # for every camera frame; from any one thread
    target = policy.step(angular_velocity, gravity, command, q, qd, now)  # at 50 Hz

`load` raises PolicyFormatError unless the files are exactly a policy. After loading, no call
raises: faults of an input are reported in `policy.status`, the last target is held for some steps,
and after that, until `reset`, the target is the measured pose, so that PD only damps.

On a machine with only numpy: python cref_runtime.py --selftest policy/
"""

from __future__ import annotations

import argparse
import contextlib
import enum
import hashlib
import io
import json
import os
import re
import sys
import threading
import time
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
if "numpy" not in sys.modules:  # products this small are ten times slower on several threads
    for _name in (*_ONE_THREAD, "VECLIB_MAXIMUM_THREADS"):
        os.environ.setdefault(_name, "1")

import numpy as np  # noqa: E402  (after setting the number of threads)

SCHEMA = 1  # of the manifest; to be incremented when this file would misread a newer one
TERMS = ("angular_velocity", "gravity", "command", "joint_position", "joint_velocity", "action")
VARIANTS = ("full", "no_cross_attention", "no_grf", "no_highway", "blind")
MOST_BYTES = {"manifest.json": 1 << 20, "cref_runtime.py": 1 << 20}
MOST_BYTES_OF_ARRAYS = 1 << 28  # of every other file
TOLERANCE = 1e-5  # of the self-test: norm of a tensor's error relative to the tensor's norm
GRAVITY_LENGTH = (0.8, 1.25)  # of a unit vector; rejects m/s^2
_NPY = re.compile(
    rb"\x93NUMPY\x01\x00..\{'descr': '(?P<kind><f4|<f8|<i8|\|b1)', 'fortran_order': False, "
    rb"'shape': \((?P<shape>[0-9, ]{0,99})\), \}",
    re.DOTALL,
)
POSE_MARGIN = 0.5  # rad beyond a joint's range; more means degrees, or another joint's angle
LATE = 2.0  # control periods between two steps, at most


class PolicyFormatError(ValueError):
    """The files are not a policy of this format; the message is one line."""


class Status(enum.IntFlag):
    """Faults of a step or a frame; 0 means none."""

    OK = 0
    NO_DEPTH = 1  # no frame has come since the reset
    STALE_DEPTH = 2  # the newest frame is older than the manifest allows
    BAD_DEPTH = 4  # the frame's shape, type or stamp is wrong: not used
    INVALID_DEPTH = 8  # too many of the frame's pixels are holes: not used
    BAD_INPUT = 16  # wrong shape, not finite, or impossible: the network was not run
    BAD_ACTION = 32  # the network's output was not finite
    COMMAND_LIMITED = 64  # the command was outside the trained range and was clipped
    RATE_LIMITED = 128  # the change of the target in this step was limited
    RANGE_LIMITED = 256  # the target was too far beyond a joint's range and was clipped
    LATE = 512  # the previous step is too long ago, or the clock went back
    HOLDING = 1024  # the last good target was returned again
    DAMPING = 2048  # the target is the measured pose, until `reset`


FAULTS = Status.BAD_INPUT | Status.BAD_ACTION


class Joints(NamedTuple):
    """The joints driven by the policy, in the order of every array; SI units."""

    names: tuple[str, ...]
    default: np.ndarray  # rad, q0
    scale: np.ndarray  # rad per unit of action
    low: np.ndarray  # rad
    high: np.ndarray  # rad
    kp: np.ndarray  # N m/rad
    kd: np.ndarray  # N m s/rad
    effort: np.ndarray  # N m


def load(path: str | os.PathLike[str], joints: Sequence[str] | None = None) -> Policy:
    """Load the policy in a directory, or in a .zip of one.

    Args:
        path: output of `python -m cref_jax.export`.
        joints: names of the robot's joints in its own order, which must equal the policy's.

    Raises:
        PolicyFormatError: a file is missing, damaged or of another format, or the joints differ.
    """
    with _one_error(path):
        policy = Policy(*contents(path))
    if joints is not None and tuple(joints) != policy.joints.names:
        ours, theirs = ", ".join(policy.joints.names), ", ".join(map(str, joints))
        raise PolicyFormatError(f"{path}: its joints are {ours}, but the robot's are {theirs}")
    if not any(os.environ.get(name) == "1" for name in _ONE_THREAD):
        warnings.warn("steps are slow unless OMP_NUM_THREADS=1 is set first", stacklevel=2)
    return policy


def contents(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read the manifest and the arrays of weights.npz, by name, as exported.

    Raises:
        PolicyFormatError: a file is missing, damaged or of another format.
    """
    with _one_error(path):
        manifest = _read_manifest(_read(path, "manifest.json"))
        return manifest, _parse_arrays(_read_verified(path, "weights.npz", manifest))


class Policy:
    """A recurrent policy with its memory. Buffers are allocated once."""

    def __init__(self, manifest: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
        """Check the manifest's numbers and the names and shapes of the arrays of weights.npz."""
        root, weights = _Table(manifest, "manifest"), _Weights(dict(arrays))
        net, guards, obs = root.table("network"), root.table("guards"), root.table("observation")
        self.joints = _read_joints(root)
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
            self._encoder = _Encoder(net, weights, shape)
        self.image_shape = shape  # rows, columns
        self._actor = _Actor(net, weights, shape, size, len(self.joints.names))
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
            share = np.where(valid, share, 1.0 / _fill_holes(1.0 / share, valid))
        image = (_nearest_around(share, self._window) - 0.5).astype(np.float32)
        encoded = self._encoder(image.astype(np.float16).astype(np.float32))  # as in training
        with self._lock:
            self._actor.look(*encoded)
            self._stamp = stamp
        return Status.OK

    def _sense(self, inputs: Sequence[Any]) -> Status:
        """Check the measurements and write them into the observation if plausible."""
        count, joints = len(self.joints.names), self.joints
        vectors = [_vector(x, size) for x, size in zip(inputs, (3, 3, 3, count, count))]
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


class _Encoder:
    """Depth tokens and compressed depth of one frame (Eq. 6-8)."""

    def __init__(self, net: _Table, weights: _Weights, shape: tuple[int, int]) -> None:
        tokenizer = weights.under("depth_tokenizer")
        rows, columns = shape
        self._layers, channels = [], 1
        for i, settings in enumerate(_read_convolutions(net, shape)):
            weights_i = tokenizer.under(f"layer_{i}")
            self._layers.append(_Convolution(weights_i, (rows, columns, channels), *settings))
            rows, columns, channels = self._layers[-1].shape
        width = net.whole("token", 1, 4096)
        self._projection = _Dense(tokenizer, "projection", channels, width, rows * columns)
        self._place = tokenizer.take("place", rows * columns, width)
        self._norm = _Norm(tokenizer, width)
        self._blocks = (shape[0] // 8, 8, shape[1] // 8, 8)
        blocks, out = self._blocks[0] * self._blocks[2], net.whole("compressed", 1, 4096)
        self._compression = _Dense(weights, "depth_compression/layer_0", blocks, out, elu=True)

    def __call__(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Compute the tokens [N, D] and the compressed depth [C] of D [H, W]."""
        x = image[..., None]
        for layer in self._layers:
            x = layer(x)
        x = self._projection(x.reshape(-1, x.shape[-1]))
        x += self._place
        means = image.reshape(self._blocks).mean(axis=(1, 3)).reshape(-1)
        return self._norm(x), self._compression(means)


class _Actor:
    """The recurrent part, at 50 Hz: from the observation and the current frame to the action."""

    def __init__(
        self, net: _Table, weights: _Weights, shape: tuple[int, int], size: int, actions: int
    ) -> None:
        variant, width = net.text("variant", VARIANTS), net.whole("token", 1, 4096)
        self._sees = variant != "blind"
        compressed = net.whole("compressed", 1, 4096) if self._sees else 0
        shrink = [stride for _, _, stride in _read_convolutions(net, shape)] if self._sees else []
        tokens = int(np.prod(shape) // np.prod(shrink) ** 2) if self._sees else 0
        self._tokens = np.zeros((tokens, width), np.float32)
        self._query: _Attention | _Pooled | None = None
        if variant == "no_cross_attention":
            self._query = _Pooled(weights.under("pooled_tokens"), width)
        elif self._sees:
            heads = net.whole("heads", 1, 64)
            self._query = _Attention(weights.under("cross_attention"), width, heads, tokens)
        hidden = net.whole("lstm", 1, 4096)
        self._lstm = _Lstm(weights.under("velocity_estimator"), size + compressed, hidden)
        known = size + 3, width, width
        self._tokenizer = _Mlp(weights.under("proprioceptive_tokenizer"), known)
        fused = 2 * width if self._sees else width
        self._fusion = _Fusion(weights.under("fusion"), fused, gated=variant != "no_grf")
        hidden, highway = net.whole("gru", 1, 4096), variant != "no_highway"
        self._memory = _Memory(weights.under("recurrent_fusion"), fused, hidden, highway)
        head = net.wholes("actor", 1, 8192)
        self._head = _Mlp(weights.under("action_head"), (fused, *head, actions))
        weights.take("log_std", actions)  # needed only to continue training
        self._inputs = np.zeros(size + compressed, np.float32)
        self._known = np.zeros(size + 3, np.float32)
        self._x = np.zeros(fused, np.float32)
        self._size, self._width, self._seen = size, width, False

    def reset(self) -> None:
        """Clear the memories; everything derived from a frame is zero until the next one."""
        self._lstm.c[:], self._lstm.h[:], self._memory.h[:] = 0.0, 0.0, 0.0
        self._tokens[:], self._inputs[:], self._x[:] = 0.0, 0.0, 0.0
        if isinstance(self._query, _Attention):
            self._query.weights[:] = 0.0
        self._seen = False

    def look(self, tokens: np.ndarray, compressed: np.ndarray) -> None:
        """Store the encoding of a frame."""
        self._tokens[:], self._inputs[self._size :] = tokens, compressed
        self._seen = True

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Compute the action [J] and update the memory."""
        self._inputs[: self._size], self._known[: self._size] = obs, obs
        self._known[self._size :] = self._lstm(self._inputs)
        state = self._tokenizer(self._known)
        self._x[: self._width] = state
        if self._query is not None and self._seen:
            self._x[self._width :] = self._query(state, self._tokens)
        return self._head(self._memory(self._fusion(self._x)))

    def tensors(self) -> dict[str, np.ndarray]:
        """Return the tensors after the last step, without copying them."""
        tensors = {
            "velocity": self._known[self._size :],
            "state_token": self._x[: self._width],
            "fused": self._fusion.out,
            "lstm_c": self._lstm.c,
            "lstm_h": self._lstm.h,
            "gru": self._memory.h,
            "gate": self._memory.gate,
            "blended": self._memory.out,
            "action": self._head.out,
        }
        if self._query is not None:
            tensors["tokens"], tensors["compressed"] = self._tokens, self._inputs[self._size :]
            tensors["depth_token"] = self._x[self._width :]
            if isinstance(self._query, _Attention):
                tensors["attention"] = self._query.weights
        return tensors


class _Attention:
    """Cross attention: the robot's state queries the depth tokens (Eq. 8-10)."""

    def __init__(self, weights: _Weights, width: int, heads: int, tokens: int) -> None:
        if width % heads:
            raise PolicyFormatError(f"{heads} heads do not divide a width of {width}")
        each = width // heads
        self._norm = _Norm(weights, width)
        self._query = _Dense(weights, "query", width, width, bias=False)
        by_head = (width, heads, each)
        self._key = _copy(weights.take("key", width, width).reshape(by_head), (1, 2, 0))
        self._value = _copy(weights.take("value", width, width).reshape(by_head), (1, 0, 2))
        self._output = _Dense(weights, "output", width, width, bias=False)
        self._shape, self._root = (heads, 1, each), np.float32(np.sqrt(each))
        self.weights = np.zeros((heads, tokens), np.float32)

    def __call__(self, state: np.ndarray, tokens: np.ndarray) -> np.ndarray:
        """Compute e^d [D] from the state [D] and the tokens [N, D]."""
        query = self._query(self._norm(state)).reshape(self._shape)
        query_key = np.matmul(query, self._key)[:, 0]
        weights = np.dot(query_key, tokens.T, out=self.weights)
        weights /= self._root
        weights -= weights.max(axis=1, keepdims=True)
        np.exp(weights, out=weights)
        weights /= weights.sum(axis=1, keepdims=True)
        mixed = weights.dot(tokens)
        return self._output(np.matmul(mixed[:, None], self._value).reshape(-1))


class _Pooled:
    """The ablation of cross attention: the mean of the tokens."""

    def __init__(self, weights: _Weights, width: int) -> None:
        self._projection = _Dense(weights, "projection", width, width)

    def __call__(self, state: np.ndarray, tokens: np.ndarray) -> np.ndarray:
        """Compute the projected mean [D]; the state is not used."""
        return self._projection(tokens.mean(axis=0))


class _Lstm:
    """The base's linear velocity (Eq. 7); gates in the order input, forget, candidate, output."""

    def __init__(self, weights: _Weights, inputs: int, hidden: int) -> None:
        self._input = _Dense(weights, "lstm/input", inputs, 4 * hidden)
        self._recurrent = weights.take("lstm/recurrent", hidden, 4 * hidden)
        self._velocity = _Dense(weights, "velocity", hidden, 3)
        self._gates = np.zeros(4 * hidden, np.float32)
        self.c, self.h = np.zeros(hidden, np.float32), np.zeros(hidden, np.float32)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute the velocity, m/s [3]."""
        gates, n = self._gates, len(self.c)
        np.dot(self.h, self._recurrent, out=gates)
        gates += self._input(x)
        candidate = np.tanh(gates[2 * n : 3 * n])
        _sigmoid(gates)
        self.c *= gates[n : 2 * n]
        self.c += gates[:n] * candidate
        np.tanh(self.c, out=self.h)
        self.h *= gates[3 * n :]
        return self._velocity(self.h)


class _Fusion:
    """Gated residual fusion (Eq. 11-14)."""

    def __init__(self, weights: _Weights, width: int, gated: bool) -> None:
        self._norm = _Norm(weights, width)
        self._mix = _Dense(weights, "mix", width, width, elu=True)
        name, outputs = ("content_gate", 2 * width) if gated else ("content", width)
        self._content = _Dense(weights, name, width, outputs)
        self._gated, self.out = gated, np.zeros(width, np.float32)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute f [D] of x [D]."""
        content = self._content(self._mix(self._norm(x)))
        if self._gated:
            content, gate = content[: len(x)], content[len(x) :]
            content *= _sigmoid(gate)
        return np.add(x, content, out=self.out)


class _Memory:
    """Recurrent fusion with a highway gate (Eq. 15-16); gates in the order reset, update, new."""

    def __init__(self, weights: _Weights, width: int, hidden: int, highway: bool) -> None:
        self._input = _Dense(weights, "gru/input", width, 3 * hidden)
        self._recurrent = weights.take("gru/recurrent", hidden, 3 * hidden)
        self._bias = weights.take("gru/candidate_bias", hidden)
        self._out = _Dense(weights, "memory_out", hidden, width, bias=False)
        self._gate = _Dense(weights, "gate", 2 * width, width) if highway else None
        self._gates = np.zeros(3 * hidden, np.float32)
        self._both = np.zeros(2 * width, np.float32)
        self.h, self.out = np.zeros(hidden, np.float32), np.zeros(width, np.float32)
        self.gate = np.ones(width, np.float32)

    def __call__(self, f: np.ndarray) -> np.ndarray:
        """Compute y [D] of f [D] and update the memory."""
        n, x, gates = len(self.h), self._input(f), self._gates
        np.dot(self.h, self._recurrent, out=gates)
        gates[: 2 * n] += x[: 2 * n]
        reset, update = _sigmoid(gates[:n]), _sigmoid(gates[n : 2 * n])
        candidate = gates[2 * n :]
        candidate += self._bias
        candidate *= reset
        candidate += x[2 * n :]
        np.tanh(candidate, out=candidate)
        self.h -= candidate
        self.h *= update
        self.h += candidate  # (1 - u) n + u h
        z = self._out(self.h)
        if self._gate is None:
            self.out[:] = z
            return self.out
        self._both[: len(f)], self._both[len(f) :] = z, f
        self.gate = _sigmoid(self._gate(self._both))
        np.subtract(z, f, out=self.out)
        self.out *= self.gate
        self.out += f  # b z + (1 - b) f
        return self.out


class _Convolution:
    """A convolution as one matrix product of gathered patches, then ELU; padding as in training."""

    def __init__(
        self,
        weights: _Weights,
        shape: tuple[int, int, int],
        channels: int,
        kernel: int,
        stride: int,
    ) -> None:
        rows, columns, depth = shape
        before = max((kernel - stride) // 2, 0)
        sides = [side + max(kernel - stride, 0) for side in (rows, columns)]
        padded = np.zeros((*sides, depth), np.float32)
        self._inside = padded[before : before + rows, before : before + columns]
        self.shape = rows // stride, columns // stride, channels
        down, across, deep = padded.strides
        self._windows = np.lib.stride_tricks.as_strided(
            padded,
            (*self.shape[:2], kernel, kernel, depth),
            (stride * down, stride * across, down, across, deep),
        )
        count, size = self.shape[0] * self.shape[1], kernel * kernel * depth
        self._patches = np.zeros((count, size), np.float32)
        self._filter = _Dense(weights, "filter", size, channels, count, elu=True)

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Compute the filtered image [h, w, channels] of [H, W, depth]."""
        self._inside[:] = image
        self._patches.reshape(self._windows.shape)[:] = self._windows
        return self._filter(self._patches).reshape(self.shape)


class _Mlp:
    """Dense layers with ELU between them."""

    def __init__(self, weights: _Weights, widths: Sequence[int]) -> None:
        self._layers = [
            _Dense(weights, f"layer_{i}", a, b, elu=i < len(widths) - 2)
            for i, (a, b) in enumerate(zip(widths, widths[1:]))
        ]
        self.out = self._layers[-1].out

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute the last layer's output."""
        for layer in self._layers:
            x = layer(x)
        return x


class _Dense:
    """x W + b, then optionally ELU, in a buffer that the next call overwrites."""

    def __init__(
        self,
        weights: _Weights,
        name: str,
        inputs: int,
        outputs: int,
        rows: int = 0,
        bias: bool = True,
        elu: bool = False,
    ) -> None:
        self._kernel = weights.take(name + "/kernel", inputs, outputs)
        self._bias = weights.take(name + "/bias", outputs) if bias else None
        self.out = np.zeros((rows, outputs) if rows else outputs, np.float32)
        self._below = np.zeros_like(self.out) if elu else None

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Compute the output of x [inputs] or [rows, inputs]."""
        np.dot(x, self._kernel, out=self.out)
        if self._bias is not None:
            self.out += self._bias
        if self._below is not None:
            np.minimum(self.out, 0.0, out=self._below)
            np.expm1(self._below, out=self._below)
            np.maximum(self.out, 0.0, out=self.out)
            self.out += self._below
        return self.out


class _Norm:
    """Layer normalisation over the last axis."""

    def __init__(self, weights: _Weights, width: int) -> None:
        self._scale = weights.take("norm/scale", width)
        self._bias = weights.take("norm/bias", width)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Normalise x."""
        centred = x - x.mean(axis=-1, keepdims=True)
        variance = np.mean(centred * centred, axis=-1, keepdims=True)
        centred *= self._scale / np.sqrt(variance + np.float32(1e-6))
        centred += self._bias
        return centred


def _fill_holes(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Interpolate an image [H, W] linearly between known pixels: along rows, then columns."""
    row, column, lines = np.arange(len(values)), np.arange(values.shape[1]), values.copy()
    some = np.flatnonzero(known.any(axis=1))
    for i in some:
        lines[i] = np.interp(column, column[known[i]], values[i, known[i]])
    return np.stack([np.interp(row, some, lines[some, j]) for j in column], axis=1)


def _nearest_around(image: np.ndarray, window: int) -> np.ndarray:
    """Compute the minimum of the window x window values around each pixel, fewer at the borders."""
    reach, (rows, columns) = window // 2, image.shape
    wide = np.pad(image, reach, constant_values=np.inf)
    lines = np.minimum.reduce([wide[k : k + rows] for k in range(window)])
    return np.minimum.reduce([lines[:, k : k + columns] for k in range(window)])


def _vector(value: Any, size: int) -> np.ndarray | None:
    """Convert to f32[size]; None unless the value is `size` finite numbers."""
    try:
        array = np.asarray(value)
    except Exception:  # an object's own conversion may raise anything
        return None
    if array.dtype.kind not in "fiu" or array.shape != (size,):
        return None
    array = array.astype(np.float32)
    return array if np.isfinite(array).all() else None


def _sigmoid(x: np.ndarray) -> np.ndarray:
    """Compute 1 / (1 + exp(-x)) in place."""
    np.negative(x, out=x)
    np.minimum(x, 80.0, out=x)  # keeps exp from overflowing; the result is below 2e-35 either way
    np.exp(x, out=x)
    x += 1.0
    return np.reciprocal(x, out=x)


def _copy(x: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """Copy x with its axes permuted, contiguous in memory."""
    return np.ascontiguousarray(x.transpose(axes))


class _Weights:
    """The arrays of weights.npz, each taken once by name and shape."""

    def __init__(self, arrays: dict[str, np.ndarray], prefix: str = "") -> None:
        self._left, self._prefix = arrays, prefix

    def under(self, name: str) -> _Weights:
        """Select the arrays of one part of the network."""
        return _Weights(self._left, f"{self._prefix}{name}/")

    def take(self, name: str, *shape: int) -> np.ndarray:
        """Take a copy of an array, aligned in memory."""
        name = self._prefix + name
        if name not in self._left:
            raise PolicyFormatError(f"weights.npz has no '{name}'")
        array = self._left.pop(name)
        if array.dtype != np.dtype("<f4") or array.shape != shape:
            actual = f"{array.dtype}{list(array.shape)}"
            raise PolicyFormatError(f"'{name}' must be float32{list(shape)}, not {actual}")
        if not np.isfinite(array).all():
            raise PolicyFormatError(f"'{name}' has numbers that are not finite")
        return array.astype(np.float32)

    def finish(self) -> None:
        """Refuse arrays that were not taken."""
        if self._left:
            raise PolicyFormatError(f"weights.npz has an unknown '{min(self._left)}'")


class _Table:
    """An object of the manifest, read key by key; every unexpected value is an error."""

    def __init__(self, value: Any, where: str) -> None:
        if not isinstance(value, dict):
            raise PolicyFormatError(f"{where} must be an object")
        self._values, self._where = value, where

    def _get(self, key: str) -> Any:
        if key not in self._values:
            raise PolicyFormatError(f"{self._where} has no '{key}'")
        return self._values[key]

    def _refuse(self, key: str, right: str) -> PolicyFormatError:
        actual = repr(self._values[key])[:60]
        return PolicyFormatError(f"{self._where}.{key} must be {right}, not {actual}")

    def table(self, key: str) -> _Table:
        """Read an object."""
        return _Table(self._get(key), f"{self._where}.{key}")

    def tables(self, key: str) -> list[_Table]:
        """Read an array of objects."""
        where = f"{self._where}.{key}"
        return [_Table(value, f"{where}[{i}]") for i, value in enumerate(self.array(key))]

    def array(self, key: str) -> list[Any]:
        """Read an array of at most 1024 values."""
        values = self._get(key)
        if not isinstance(values, list) or len(values) > 1024:
            raise self._refuse(key, "an array")
        return values

    def text(self, key: str, among: Sequence[str] = ()) -> str:
        """Read a non-empty string, one of `among` if given."""
        value = self._get(key)
        if not isinstance(value, str) or not value or (among and value not in among):
            raise self._refuse(key, f"one of {', '.join(among)}" if among else "a string")
        return value

    def real(self, key: str, low: float, high: float) -> float:
        """Read a number in [low, high]."""
        self._numbers(key, [self._get(key)], low, high)
        return float(self._values[key])

    def reals(self, key: str, count: int, low: float = -1e6) -> np.ndarray:
        """Read `count` numbers from `low` to 1e6 as f32[count]."""
        values = self._numbers(key, self.array(key), low, 1e6)
        if len(values) != count:
            raise self._refuse(key, f"{count} numbers")
        return values

    def has(self, key: str) -> bool:
        """Check whether the key exists: keys of later formats may be missing."""
        return key in self._values

    def whole(self, key: str, low: int, high: int) -> int:
        """Read an integer in [low, high]."""
        value = self._get(key)
        if type(value) is not int or not low <= value <= high:
            raise self._refuse(key, f"an integer from {low} to {high}")
        return value

    def wholes(self, key: str, low: int, high: int) -> tuple[int, ...]:
        """Read an array of integers in [low, high]."""
        values = {str(i): value for i, value in enumerate(self.array(key))}
        table = _Table(values, f"{self._where}.{key}")
        return tuple(table.whole(i, low, high) for i in values)

    def _numbers(self, key: str, values: list[Any], low: float, high: float) -> np.ndarray:
        if not all(type(x) in (int, float) and low <= x <= high for x in values):
            raise self._refuse(key, f"from {low:g} to {high:g}")
        return np.array(values, np.float32)


def _read_joints(root: _Table) -> Joints:
    """Read the joints of the manifest."""
    tables = root.tables("joints")
    names = tuple(table.text("name") for table in tables)
    if not names or len(set(names)) < len(names):
        raise PolicyFormatError("manifest.joints must be one or more joints of different names")
    ranges = {
        "default_rad": (-10.0, 10.0),
        "action_scale_rad": (0.0, 10.0),
        "low_rad": (-10.0, 10.0),
        "high_rad": (-10.0, 10.0),
        "kp": (0.0, 1e4),
        "kd": (0.0, 1e3),
        "effort_nm": (0.0, 1e4),
    }
    columns = [
        np.array([table.real(key, low, high) for table in tables], np.float32)
        for key, (low, high) in ranges.items()
    ]
    joints = Joints(names, *columns)
    if not (joints.low < joints.high).all():
        raise PolicyFormatError("manifest.joints: low_rad must be below high_rad")
    return joints


def _read_convolutions(net: _Table, shape: tuple[int, int]) -> list[tuple[int, ...]]:
    """Read channels, kernel and stride of each layer of the depth tokenizer."""
    rows, columns = shape
    layers = []
    for i, layer in enumerate(net.tables("convolutions")):
        settings = tuple(layer.whole(key, 1, 1024) for key in ("channels", "kernel", "stride"))
        if rows % settings[2] or columns % settings[2]:
            raise PolicyFormatError(f"layer {i} does not divide an image of {shape}")
        rows, columns = rows // settings[2], columns // settings[2]
        layers.append(settings)
    if shape[0] % 8 or shape[1] % 8:
        raise PolicyFormatError(f"an image of {shape} has no blocks of 8 x 8")
    return layers


@contextlib.contextmanager
def _one_error(path: str | os.PathLike[str]) -> Iterator[None]:
    """Convert any exception into a PolicyFormatError that names the path."""
    try:
        yield
    except PolicyFormatError as error:
        message = str(error) if str(error).startswith(str(path)) else f"{path}: {error}"
        raise PolicyFormatError(message) from None
    except Exception as error:  # json, zipfile and numpy raise many kinds on damaged files
        raise PolicyFormatError(f"{path}: {type(error).__name__}: {error}") from None


def _read(path: str | os.PathLike[str], name: str) -> bytes:
    """Read a file of the directory, or of the .zip."""
    place, most = Path(path), MOST_BYTES.get(name, MOST_BYTES_OF_ARRAYS)
    if not place.exists():
        raise PolicyFormatError("no such directory or .zip")
    file, limit = (place / name, most) if place.is_dir() else (place, 2 * MOST_BYTES_OF_ARRAYS)
    if not file.is_file():
        raise PolicyFormatError(f"no file {name}")
    if file.stat().st_size > limit:
        raise PolicyFormatError(f"{file.name} is larger than {limit} bytes")
    data = file.read_bytes()
    if place.is_dir():
        return data
    files = _read_zip(data, "the .zip")
    if len(files.get(name, b"")) > most:
        raise PolicyFormatError(f"{name} is larger than {most} bytes")
    if name not in files:
        raise PolicyFormatError(f"no file {name}")
    return files[name]


def _read_zip(data: bytes, where: str) -> dict[str, bytes]:
    """Read the files of a .zip by name; only stored (uncompressed) ones, so none can expand."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        members = archive.infolist()
        names = [member.filename for member in members]
        if len(set(names)) < len(names):
            raise PolicyFormatError(f"{where} has two files of one name")
        for member in members:
            if member.compress_type != zipfile.ZIP_STORED or member.flag_bits & 1:
                raise PolicyFormatError(f"{where} is compressed or encrypted")
        if sum(member.file_size for member in members) > len(data):
            raise PolicyFormatError(f"{where} is smaller than the sizes in its index")
        return {member.filename: archive.read(member) for member in members}


def _read_manifest(data: bytes) -> dict[str, Any]:
    """Parse the manifest strictly and check its digest."""

    def constant(name: str) -> Any:
        raise PolicyFormatError(f"manifest.json has {name} for a number")

    def unique(pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
        if len(dict(pairs)) < len(pairs):
            raise PolicyFormatError("manifest.json has a key twice")
        return dict(pairs)

    manifest = json.loads(data.decode("utf-8"), parse_constant=constant, object_pairs_hook=unique)
    table = _Table(manifest, "manifest")
    if table.text("format") != "cref-policy":
        raise PolicyFormatError("manifest.json is not that of a policy")
    if table.whole("schema", 0, 1 << 30) != SCHEMA:
        raise PolicyFormatError(f"schema {manifest['schema']}, but this program reads {SCHEMA}")
    if table.text("digest") != manifest_digest(manifest):
        raise PolicyFormatError("manifest.json is not what was exported: its digest differs")
    return manifest


def manifest_digest(manifest: dict[str, Any]) -> str:
    """Compute the SHA-256 of a manifest without its own digest."""
    rest = {key: value for key, value in manifest.items() if key != "digest"}
    text = json.dumps(rest, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _read_verified(path: str | os.PathLike[str], name: str, manifest: dict[str, Any]) -> bytes:
    """Read a file and check its digest against the manifest."""
    data, digest = _read(path, name), _Table(manifest, "manifest").table("files").text(name)
    if hashlib.sha256(data).hexdigest() != digest:
        raise PolicyFormatError(f"{name} is not what was exported: its digest differs")
    return data


def _parse_arrays(data: bytes) -> dict[str, np.ndarray]:
    """Parse the arrays of an .npz by name, without a copy; refuse pickles and objects."""
    arrays = {}
    for name, member in _read_zip(data, "an .npz").items():
        match = _NPY.match(member[:4096])
        if not match or not name.endswith(".npy"):
            raise PolicyFormatError(f"'{name[:60]}' is not an array of numbers")
        kind, text = match.group("kind").decode(), match.group("shape").decode()
        shape = tuple(int(n) for n in text.split(",") if n.strip())
        start = int.from_bytes(member[8:10], "little") + 10
        size = np.dtype(kind).itemsize
        for n in shape:
            size *= n
        if (
            start < match.end()
            or member[match.end() : start].strip()
            or len(member) - start != size
        ):
            raise PolicyFormatError(f"'{name[:60]}' does not have the size in its header")
        arrays[name[:-4]] = np.frombuffer(member, kind, offset=start).reshape(shape)
    return arrays


def self_test(path: str | os.PathLike[str], rounds: int = 20) -> dict[str, np.ndarray]:
    """Replay the test vectors; return the durations of steps, s, with and without a frame.

    Raises:
        PolicyFormatError: it cannot be loaded, or its outputs differ from the training network's.
    """
    policy, manifest = load(path), _read_manifest(_read(path, "manifest.json"))
    if "cref_runtime.py" in manifest["files"]:  # a policy within the package uses the package's own
        _read_verified(path, "cref_runtime.py", manifest)
    vectors = _parse_arrays(_read_verified(path, "testvectors.npz", manifest))
    errors: dict[str, float] = {}
    steps = [_replay(policy, vectors, errors) for _ in range(rounds)]
    name = max(errors, key=lambda n: errors[n])
    if not errors[name] <= TOLERANCE:
        raise PolicyFormatError(f"'{name}' differs from training's by {errors[name]:.1e}")
    seconds, frames = np.concatenate(steps).T
    times = {"a frame and a step": seconds[frames > 0], "a step": seconds[frames == 0]}
    return {name: durations for name, durations in times.items() if len(durations)}


def _replay(policy: Policy, vectors: dict[str, np.ndarray], errors: dict[str, float]) -> np.ndarray:
    """Replay once; return seconds and frames of each step [T, 2], update the largest `errors`."""
    inputs = [vectors[name] for name in (*TERMS[:3], "q", "qd", "now")]
    expected = {k[7:]: v for k, v in vectors.items() if k.startswith("expect/")}
    scales = {k: float(np.linalg.norm(v)) / len(v) ** 0.5 + 1e-9 for k, v in expected.items()}
    steps = np.zeros((len(vectors["now"]), 2))
    for t in range(len(steps)):
        if vectors["reset"][t]:
            policy.reset()
        frames = np.flatnonzero(vectors["frame_step"] == t)
        started_at = time.perf_counter()
        for k in frames:
            policy.on_depth(vectors["frames"][k], vectors["stamps"][k])
        target = policy.step(*(x[t] for x in inputs))
        steps[t] = time.perf_counter() - started_at, len(frames)
        if policy.status & (FAULTS | Status.HOLDING | Status.DAMPING):
            raise PolicyFormatError(f"step {t} of the test vectors: {policy.status!r}")
        tensors = {**policy.tensors(), "target": target}
        for name in expected:
            error = float(np.linalg.norm(tensors[name] - expected[name][t])) / scales[name]
            errors[name] = max(errors.get(name, 0.0), error if np.isfinite(error) else np.inf)
    return steps


def report(times: dict[str, np.ndarray]) -> list[str]:
    """Format the latencies measured by `self_test` as lines of text."""
    of = lambda seconds: 1e3 * np.percentile(seconds, (50, 99, 100))
    text = "{}: p50 {:.2f} ms, p99 {:.2f} ms, max {:.2f} ms"
    return [text.format(name, *of(seconds)) for name, seconds in times.items()]


def main() -> None:
    """Run the self-test from the command line; exit code 2 if it fails."""
    parser = argparse.ArgumentParser(description="Test an exported policy on this machine.")
    parser.add_argument("--selftest", metavar="DIRECTORY", required=True, help="or its .zip")
    path = parser.parse_args().selftest
    try:
        times = self_test(path)
    except PolicyFormatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    print(f"{path}: outputs match the training network to {TOLERANCE:g}")
    version = f"Python {sys.version.split()[0]}, numpy {np.__version__}"
    print("\n".join([version, *report(times)]))


if __name__ == "__main__":
    main()
