"""Camera faults between camera and policy: lost, late, partly blind and inaccurate frames."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from cref_jax.config import NARROW_VIEW, Camera, Randomisation

REGIONS = 3  # at most at a time; assumed
REGION_FRAMES = (4, 20)  # range of their lifetime: 0.2 to 1 s at 20 Hz; assumed
FARTHEST = 10.0  # m; noise grows up to this depth, so that far pixels and misses stay far; assumed
WOBBLES = 5  # highest wave number of a region's outline; assumed

Frame = Float[np.ndarray, "H W"]  # z-depth, m


class Disturbance(NamedTuple):
    """Camera faults; the defaults match training."""

    dropped: float = 0.0  # share of frames lost, independently
    latency: int = 1  # control steps from exposure to delivery
    invalid: float = 0.0  # share of the image without a reading, as at reflections
    noise: float = 0.0  # m, standard deviation at 1 m; grows with depth squared, as in stereo
    scale: float = 1.0  # reading / true depth
    dead: float = 0.0  # share of dead columns, fixed for a whole trial
    view: tuple[float, float] = (180.0, 180.0)  # deg, as NARROW_VIEW; pixels outside it read 0
    seed: int = 0  # of all random numbers here


UNDISTURBED = Disturbance()


def sample_disturbance(c: Randomisation, latency: int, rng: np.random.Generator) -> Disturbance:
    """Sample a camera with the ranges of training."""
    return Disturbance(
        latency=latency,
        invalid=rng.uniform(0.0, c.depth_holes),
        noise=rng.uniform(0.0, c.depth_noise),
        scale=1.0 + rng.uniform(-c.depth_scale, c.depth_scale),
        dead=rng.uniform(0.0, c.depth_dead),
        view=NARROW_VIEW if rng.random() < c.narrow_view else UNDISTURBED.view,
        seed=int(rng.integers(2**31)),
    )


class Channel:
    """The channel of a trial's frames from the camera to the policy."""

    def __init__(self, disturbance: Disturbance, view: tuple[float, float] = Camera().view) -> None:
        """Set up the channel of frames with this view, deg, vertical and horizontal."""
        self._d, self._view = disturbance, view
        # separate generators, so that one fault does not change the others
        self._losses, self._holes, self._errors = (
            np.random.default_rng([disturbance.seed, k]) for k in range(3)
        )
        self._dead: Bool[np.ndarray, " W"] | None = None
        self._queue: list[tuple[int, Frame, float]] = []  # due step, frame, time of exposure
        self._blind: Frame = np.zeros((0, 0))
        self._left = 0  # frames until new regions go blind

    def loses_one(self) -> bool:
        """Decide at random whether the next frame is lost; call once per frame."""
        return bool(self._losses.random() < self._d.dropped)

    def send(self, frame: Frame, step: int, stamp: float) -> None:
        """Send a frame exposed at this control step and time, s."""
        frame = self._misread(frame)
        if self._d.invalid > 0.0:
            frame = np.where(self._mask(frame.shape), self._blind, frame)
        self._queue.append((step + self._d.latency, frame, stamp))

    def receive(self, step: int) -> tuple[Frame, float] | None:
        """Receive the frame due at this control step with its time of exposure, or None."""
        if self._queue and self._queue[0][0] <= step:
            return self._queue.pop(0)[1:]
        return None

    def _misread(self, frame: Frame) -> Frame:
        """Apply scale error, noise, dead columns and a narrower view; without, return the frame."""
        d = self._d
        if d.scale != 1.0:
            frame = (d.scale * frame).astype(np.float32)
        if d.noise > 0.0:
            error = self._errors.normal(0.0, d.noise, frame.shape)
            error *= np.square(np.minimum(frame, FARTHEST))
            frame = np.maximum(frame + error, 0.0).astype(np.float32)
        if d.dead > 0.0:
            if self._dead is None:
                count = round(d.dead * frame.shape[1])
                which = self._errors.permutation(frame.shape[1])[:count]
                self._dead = np.isin(np.arange(frame.shape[1]), which)
            frame = np.where(self._dead, np.float32(0.0), frame)
        if d.view != UNDISTURBED.view:
            outside = find_outside(frame.shape, self._view, d.view)
            frame = np.where(outside, np.float32(0.0), frame)
        return frame

    def _mask(self, shape: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
        """Compute the mask of blind pixels in this frame; a region reads 0 or NaN."""
        if self._left == 0:
            rng = self._holes
            self._left = int(rng.integers(*REGION_FRAMES, endpoint=True))
            count = int(rng.integers(1, REGIONS, endpoint=True))
            which = regions(shape, self._d.invalid, count, rng)
            readings = rng.choice([0.0, np.nan], count).astype(np.float32)
            self._blind = np.where(which >= 0, readings[which], np.float32(1.0))
        self._left -= 1
        return (self._blind == 0.0) | np.isnan(self._blind)


def find_outside(
    shape: tuple[int, int], view: tuple[float, float], shown: tuple[float, float]
) -> Bool[np.ndarray, "H W"]:
    """Compute the mask of pixels of a frame that look past what another camera shows.

    Both views, deg, are vertical and horizontal and have one optical axis.
    """
    rows, columns = (
        np.abs(2.0 * np.arange(count) + 1.0 - count) / count * math.tan(math.radians(0.5 * ours))
        > math.tan(math.radians(0.5 * theirs))
        for count, ours, theirs in zip(shape, view, shown, strict=True)
    )
    return rows[:, None] | columns


def regions(
    shape: tuple[int, int], share: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Sample `count` random regions; return the region of each pixel or -1, i64[H, W].

    Together they cover `share` of the image, to the pixel. A region extends from its centre to
    k r(angle) in each direction, where r is a wavy outline, so it is connected; k is the same for
    all and chosen to match the share. Where two overlap, a pixel belongs to the nearer one.
    """
    rows, columns = shape
    y, x = np.mgrid[:rows, :columns] + 0.5
    reach = np.empty((count, rows, columns))
    waves = np.arange(1, WOBBLES + 1)
    for region in reach:
        dy, dx = y - rng.uniform(0, rows), x - rng.uniform(0, columns)
        strength = rng.uniform(0.0, 0.5, WOBBLES) / waves
        phase = rng.uniform(0.0, 2.0 * math.pi, WOBBLES)
        angle = np.arctan2(dy, dx)[..., None]
        outline = np.exp((strength * np.cos(waves * angle + phase)).sum(axis=-1))
        region[:] = np.hypot(dy, dx) / outline
    nearest = reach.min(axis=0)
    within = np.argsort(nearest, axis=None, kind="stable")[: round(share * rows * columns)]
    which = np.full(rows * columns, -1)
    which[within] = reach.argmin(axis=0).ravel()[within]
    return which.reshape(shape)
