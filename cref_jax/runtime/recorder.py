"""The last 30 s of a policy's inputs, to be written after something has gone wrong."""

from __future__ import annotations

import math
import os
import threading
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

SECONDS = 30.0
FRAME_RATE = 30.0  # 1/s, at most
FRAME_BYTES = 64 << 20  # at most, of all frames; those of the bundled policies need 11 MB
INPUTS = ("angular_velocity", "gravity", "command", "q", "qd", "now", "commanded")


class _Step(NamedTuple):
    inputs: list[np.ndarray]
    target: np.ndarray
    status: int
    told_to_stop: bool


class Recorder:
    """A ring of what a policy was given and what it answered, since its reset."""

    def __init__(
        self, period: float, depth_scale: float, careful: bool, start_after: float
    ) -> None:
        self._settings = {
            "depth_scale": depth_scale,
            "careful": careful,
            "start_after": start_after,
        }
        self._steps: deque[_Step] = deque(maxlen=int(SECONDS / period))
        self._frames: deque[tuple[np.ndarray, float, int]] = deque()
        self._lock = threading.Lock()  # frames may come from a thread of their own
        self.reset()

    def reset(self) -> None:
        """Forget what was recorded."""
        with self._lock:
            self._steps.clear()
            self._frames.clear()
            self._count = 0  # steps since the reset
            self._bytes = 0  # of the frames

    def add_step(
        self, inputs: Sequence[Any], target: np.ndarray, status: int, told_to_stop: bool
    ) -> None:
        """Record a step."""
        *vectors, now, commanded = inputs
        kept = [_copy_numbers(x).astype(np.float64) for x in vectors]
        times = [np.array(to_time(x)) for x in (now, commanded)]
        self._steps.append(_Step([*kept, *times], target.copy(), status, told_to_stop))
        self._count += 1

    def add_frame(self, depth: Any, stamp: Any) -> None:
        """Record a frame, before the step that is next."""
        frame, time = _copy_numbers(depth), to_time(stamp)
        with self._lock:
            self._frames.append((frame, time, self._count))
            self._bytes += frame.nbytes
            while self._bytes > FRAME_BYTES or len(self._frames) > SECONDS * FRAME_RATE:
                self._bytes -= self._frames.popleft()[0].nbytes

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the recording as .npz; what was no array of numbers is left out as NaN."""
        steps, frames, first = list(self._steps), list(self._frames), self._count - len(self._steps)
        columns = zip(*(step.inputs for step in steps)) if steps else [[] for _ in INPUTS]
        arrays = {name: _stack(list(column)) for name, column in zip(INPUTS, columns)}
        arrays["target"] = _stack([step.target for step in steps])
        arrays["status"] = np.array([step.status for step in steps], np.int64)
        arrays["told_to_stop"] = np.array([step.told_to_stop for step in steps], bool)
        arrays["frames"] = _stack([frame for frame, _, _ in frames])
        arrays["stamps"] = np.array([stamp for _, stamp, _ in frames], np.float64)
        arrays["frame_step"] = np.array([step - first for _, _, step in frames], np.int64)
        arrays["lost"] = np.array(first, np.int64)
        arrays.update({name: np.array(value) for name, value in self._settings.items()})
        with open(path, "wb") as file:
            np.savez(file, **arrays)


def to_time(value: Any) -> float:
    """Convert to s; NaN unless the value is a number."""
    try:
        return float(value)
    except Exception:  # an object's own conversion may raise anything
        return math.nan


def to_array(value: Any) -> np.ndarray:
    """Convert to an array without a mask, under which any number may be hidden."""
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError("an array must be one without a mask")
    return np.asarray(value)


def _copy_numbers(value: Any) -> np.ndarray:
    """Copy an input, which may be anything, to an array; an empty one if it is no numbers."""
    try:
        array = np.array(to_array(value))
    except Exception:  # an object's own conversion may raise anything
        return np.zeros(0)
    return array if array.dtype.kind in "fiu" and array.size <= 1 << 22 else np.zeros(0)


def _stack(arrays: Sequence[np.ndarray]) -> np.ndarray:
    """Stack arrays of the most common shape and type; the others become NaN, or 0 of integers."""
    kinds = [(array.shape, array.dtype.str) for array in arrays]
    if not kinds:
        return np.zeros(0)
    shape, dtype = max(set(kinds), key=kinds.count)
    empty = np.full(shape, np.nan if np.dtype(dtype).kind == "f" else 0, dtype)
    return np.stack([a if k == (shape, dtype) else empty for a, k in zip(arrays, kinds)])
