"""The last 30 s of a policy's inputs, to be written after something has gone wrong."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np

SECONDS = 30.0
FRAME_RATE = 30.0  # 1/s, at most
INPUTS = ("angular_velocity", "gravity", "command", "q", "qd", "now", "commanded")


class Recorder:
    """A ring of what a policy was given and what it answered, since its reset."""

    def __init__(self, period: float, depth_scale: float) -> None:
        self._depth_scale = depth_scale
        self._steps: deque[tuple[list[Any], np.ndarray, int]] = deque(maxlen=int(SECONDS / period))
        self._frames: deque[tuple[Any, Any, int]] = deque(maxlen=int(SECONDS * FRAME_RATE))
        self.reset()

    def reset(self) -> None:
        """Forget what was recorded."""
        self._steps.clear()
        self._frames.clear()
        self._count = 0  # steps since the reset

    def add_step(self, inputs: Sequence[Any], target: np.ndarray, status: int) -> None:
        """Record a step."""
        self._steps.append(([_copy_input(x) for x in inputs], target.copy(), status))
        self._count += 1

    def add_frame(self, depth: Any, stamp: Any) -> None:
        """Record a frame, before the step that is next."""
        self._frames.append((_copy_input(depth), stamp, self._count))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the recording as .npz; what was no array of numbers is left out as NaN."""
        steps, frames, first = list(self._steps), list(self._frames), self._count - len(self._steps)
        columns = zip(*(inputs for inputs, _, _ in steps)) if steps else [[] for _ in INPUTS]
        arrays = {name: _stack(list(column)) for name, column in zip(INPUTS, columns)}
        arrays["target"] = _stack([target for _, target, _ in steps])
        arrays["status"] = np.array([status for _, _, status in steps], np.int64)
        arrays["frames"] = _stack([frame for frame, _, _ in frames])
        arrays["stamps"] = _stack([stamp for _, stamp, _ in frames])
        arrays["frame_step"] = np.array([step - first for _, _, step in frames], np.int64)
        arrays["depth_scale"] = np.array(self._depth_scale)
        arrays["lost"] = np.array(first, np.int64)
        with open(path, "wb") as file:
            np.savez(file, **arrays)


def _copy_input(value: Any) -> Any:
    """Copy an input, which may be anything, to an array; None if it cannot be one of numbers."""
    try:
        array = np.array(value)
    except Exception:  # an object's own conversion may raise anything
        return None
    return array if array.dtype.kind in "fiu" and array.size <= 1 << 22 else None


def _stack(values: Sequence[Any]) -> np.ndarray:
    """Stack values of the most common shape and type; the others become NaN, or 0 of integers."""
    arrays = [np.zeros(0) if value is None else np.asarray(value) for value in values]
    kinds = [(array.shape, array.dtype.str) for array in arrays]
    if not kinds:
        return np.zeros(0)
    shape, dtype = max(set(kinds), key=kinds.count)
    empty = np.full(shape, np.nan if np.dtype(dtype).kind == "f" else 0, dtype)
    return np.stack([a if k == (shape, dtype) else empty for a, k in zip(arrays, kinds)])
