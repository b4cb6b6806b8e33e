"""Depth frames: whether they show the ground ahead, and the image that the network gets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from cref_jax.runtime.cross_checks import FADE, FROZEN_MOTION, Agreement
from cref_jax.runtime.recorder import to_array
from cref_jax.runtime.status import UNUSED_FRAME, Status
from cref_jax.runtime.tables import Table

LEAST_SEEN = 0.05  # share of pixels nearer than d_max; walking shows half and more
NEAREST_GROUND = 0.35  # m, median of the picture's lower sixth; walking shows 0.64 and more
UPSIDE_DOWN = 0.3  # m, by which the lower third is farther than the upper; upright it is nearer
FROZEN_FRAMES = 3  # equal frames in a row, while joints move; a simulated camera has no noise
TILT_FLOOR = 0.005  # of gravity to the side; less is no tilt
MIRRORED = ((12, -0.8), (30, -0.45))  # frames; correlation of the ground's tilt in them and by
# gravity. Walking between walls stays above -0.72 and -0.33


class Camera:
    """Checks frames and prepares them; `detail` says what is wrong with one that cannot be read."""

    def __init__(self, depth: Table, scale: float, max_invalid: float) -> None:
        self.shape = depth.whole("rows", 8, 1024), depth.whole("columns", 8, 1024)
        self._scale = scale  # m per unit of uint16
        self._d_max = depth.real("d_max_m", 0.01, 1000.0)
        self._window = depth.whole("window", 1, 15) if depth.has("window") else 1
        self._invalid = max_invalid
        view = depth.table("view_deg")
        self._view = view.real("vertical", 1.0, 175.0), view.real("horizontal", 1.0, 175.0)
        self._tilts = Agreement(1, TILT_FLOOR)
        self.reset()

    def reset(self) -> None:
        """Forget the frames before."""
        self.detail = ""
        self._frame: np.ndarray | None = None  # the newest, as it came
        self._q: np.ndarray | None = None  # rad, joint angles when it came first
        self._repeats = 0  # how often it has come again
        self._way_up = False  # a frame has shown the camera to be the right way up
        self._mirrored = False
        self._tilts.reset()
        self._tilted = np.zeros((2, 1))  # of late: ground in the frame, gravity
        self._before: tuple[float, float] | None = None

    def resample(self, frame: np.ndarray, view: Sequence[float]) -> np.ndarray:
        """Pick the pixels [H, W] of a larger frame that the policy's rays fall into; 0 outside it.

        Args:
            frame: [any height, any width], its optical axis that of the policy's camera.
            view: vertical and horizontal angle that it shows, deg.
        """
        rows, columns = (
            _find_pixels(*sizes) for sizes in zip(self.shape, self._view, frame.shape, view)
        )
        picked = frame[np.maximum(rows, 0)[:, None], np.maximum(columns, 0)]
        return np.where((rows >= 0)[:, None] & (columns >= 0), picked, 0).astype(frame.dtype)

    def prepare(
        self, depth: Any, stamp: Any, q: np.ndarray, gravity: np.ndarray | None
    ) -> tuple[Status, np.ndarray]:
        """Check a frame and compute the network's image f32[H, W] of it.

        Args:
            depth: as the robot's program gave it.
            stamp: likewise.
            q: joint angles as measured last, rad [J].
            gravity: as measured last [3]; without it, tilts are not compared.
        """
        nothing = np.zeros(self.shape, np.float32)
        self.detail, frame = self._read(depth, stamp)
        if self.detail:
            return Status.BAD_DEPTH, nothing
        metres = frame.astype(np.float32)
        if frame.dtype == np.uint16:
            metres /= np.float32(1.0 / self._scale)
        valid = metres > 0.0  # and no NaN
        if 1.0 - valid.mean() > self._invalid:
            return Status.INVALID_DEPTH, nothing
        far = np.float32(self._d_max)
        seen = np.where(valid, np.minimum(metres, far), far)
        status = self._look_through(frame, seen, q)
        if gravity is not None:
            status |= self._compare_tilts(seen, gravity)
        if status & UNUSED_FRAME:
            return status, nothing
        share = seen / far
        if not valid.all():
            # 1 / depth of a plane is linear in the image, so level ground is filled in exactly
            share = np.where(valid, share, 1.0 / fill_holes(1.0 / share, valid))
        image = (nearest_around(share, self._window) - 0.5).astype(np.float32)
        return status, image[:, ::-1] if status & Status.CAMERA_MIRRORED else image

    def _read(self, depth: Any, stamp: Any) -> tuple[str, np.ndarray]:
        """Say why a frame cannot be read, nothing if it can, and convert it to an array."""
        try:
            frame, stamp = to_array(depth), float(stamp)
        except Exception:  # an object's own conversion may raise anything
            return "the frame is no plain array, or its stamp no number", np.zeros(0)
        if frame.shape != self.shape:
            rows, columns = self.shape
            return f"a frame must be {rows} x {columns}, rows x columns, not {frame.shape}", frame
        if frame.dtype.kind != "f" and frame.dtype != np.uint16:
            kind = f"not {frame.dtype}"
            return f"a frame must be float in m, or uint16 times depth_scale, {kind}", frame
        wrong = "" if np.isfinite(stamp) else f"a frame's stamp must be a time in s, not {stamp}"
        return wrong, frame

    def _look_through(self, frame: np.ndarray, seen: np.ndarray, q: np.ndarray) -> Status:
        """Notice a camera that shows no ground ahead; `seen` is in m, up to d_max."""
        if self._frame is not None and np.array_equal(frame, self._frame, equal_nan=True):
            self._repeats += 1
            assert self._q is not None
            if self._repeats >= FROZEN_FRAMES and np.abs(q - self._q).max() > FROZEN_MOTION:
                return Status.FROZEN_DEPTH
        else:
            self._repeats, self._frame, self._q = 0, frame.copy(), q.copy()
        if (seen < self._d_max).mean() < LEAST_SEEN:
            return Status.SEES_NOTHING
        rows = len(seen)
        if np.median(seen[rows - rows // 6 :]) < NEAREST_GROUND:
            return Status.SEES_TOO_NEAR
        drop = float(seen[: rows // 3].mean() - seen[rows - rows // 3 :].mean())
        self._way_up |= drop > UPSIDE_DOWN  # from then on what is near and high is in the way
        return Status.CAMERA_TURNED if drop < -UPSIDE_DOWN and not self._way_up else Status.OK

    def _compare_tilts(self, seen: np.ndarray, gravity: np.ndarray) -> Status:
        """Notice a picture in which the ground tilts to the other side than the robot.

        Where gravity points to the left of the robot, the left of the picture is nearer. Only the
        middle half of the columns counts: walls and rails beside the path are no ground.
        """
        count = seen.shape[1]
        middle = slice(count // 4, count - count // 4)
        columns = np.linspace(-1.0, 1.0, count, dtype=np.float32)[middle]
        nearness = (1.0 / seen[:, middle]).mean(axis=0)
        tilt = -float(nearness @ columns / (columns @ columns) / nearness.mean())
        before, self._before = self._before, (tilt, float(gravity[1]))
        if before is None:
            return Status.OK
        self._tilted *= FADE
        self._tilted += np.array([[tilt - before[0]], [float(gravity[1]) - before[1]]])
        self._tilts.add(*self._tilted)
        agreement, frames = self._tilts.correlate_all(), self._tilts.count
        for least, bound in MIRRORED:
            self._mirrored |= frames > least and agreement < bound
        return Status.CAMERA_MIRRORED if self._mirrored else Status.OK


def _find_pixels(count: int, view: float, size: int, shown: float) -> np.ndarray:
    """Find the pixels of a frame's side that `count` rays fall into; -1 outside.

    Args:
        count: rays, whose tangents are evenly spaced.
        view: angle between the outermost borders of the rays, deg.
        size: pixels.
        shown: angle that they show, deg.
    """
    middles = (2.0 * np.arange(count) + 1.0) / count - 1.0  # in (-1, 1)
    scale = math.tan(math.radians(0.5 * view)) / math.tan(math.radians(0.5 * shown))
    pixels = np.floor(0.5 * (middles * scale + 1.0) * size + 1e-9).astype(int)
    return np.where((pixels >= 0) & (pixels < size), pixels, -1)


def fill_holes(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Interpolate an image [H, W] linearly between known pixels: along rows, then columns."""
    row, column, lines = np.arange(len(values)), np.arange(values.shape[1]), values.copy()
    some = np.flatnonzero(known.any(axis=1))
    for i in some:
        lines[i] = np.interp(column, column[known[i]], values[i, known[i]])
    return np.stack([np.interp(row, some, lines[some, j]) for j in column], axis=1)


def nearest_around(image: np.ndarray, window: int) -> np.ndarray:
    """Compute the minimum of the window x window values around each pixel, fewer at the borders."""
    reach, (rows, columns) = window // 2, image.shape
    wide = np.pad(image, reach, constant_values=np.inf)
    lines = np.minimum.reduce([wide[k : k + rows] for k in range(window)])
    return np.minimum.reduce([lines[:, k : k + columns] for k in range(window)])
