"""What may go wrong from the camera to the policy: lost, late, partly blind and wrong frames."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

REGIONS = 3  # at a time, at most; assumed
REGION_FRAMES = (4, 20)  # how long they stay, from, to: 0.2 to 1 s at 20 Hz; assumed
FARTHEST = 10.0  # m; noise grows up to there, so that what is far or nowhere stays so; assumed
WOBBLES = 5  # waves around a region's outline, at most; assumed

Frame = Float[np.ndarray, "H W"]  # z-depth, m


class Disturbance(NamedTuple):
    """How bad the way from the camera to the policy is; as it stands, as good as in training."""

    dropped: float = 0.0  # share of frames that are lost, each by itself
    latency: int = 1  # control steps from a frame's exposure until the policy has it
    invalid: float = 0.0  # share of the image that reads nothing, as where light is reflected
    noise: float = 0.0  # m, deviation at 1 m; grows with the distance's square, as stereo's does
    scale: float = 1.0  # depth read for a depth of 1
    dead: float = 0.0  # share of columns that read nothing, the same for a whole trial
    seed: int = 0  # of all that is random here


UNDISTURBED = Disturbance()


class Channel:
    """The way of a trial's frames from the camera to the policy."""

    def __init__(self, disturbance: Disturbance) -> None:
        self._d = disturbance
        self._losses, self._holes, self._errors = (
            np.random.default_rng([disturbance.seed, k]) for k in range(3)
        )  # apart, so that one does not change the other
        self._dead: Bool[np.ndarray, " W"] | None = None
        self._way: list[tuple[int, Frame, float]] = []  # due at a step, frame, exposed at a time
        self._blind: Frame = np.zeros((0, 0))
        self._left = 0  # frames until other regions go blind

    def loses_one(self) -> bool:
        """Return whether the frame that is to be exposed now is lost; to be asked once a frame."""
        return bool(self._losses.random() < self._d.dropped)

    def send(self, frame: Frame, step: int, stamp: float) -> None:
        """Send a frame that was exposed at this control step and time, s."""
        frame = self._misread(frame)
        if self._d.invalid > 0.0:
            frame = np.where(self._mask(frame.shape), self._blind, frame)
        self._way.append((step + self._d.latency, frame, stamp))

    def receive(self, step: int) -> tuple[Frame, float] | None:
        """Return the frame that has come at this control step, and when it was exposed."""
        if self._way and self._way[0][0] <= step:
            return self._way.pop(0)[1:]
        return None

    def _misread(self, frame: Frame) -> Frame:
        """Return the frame as a camera reads it that errs; undisturbed it is the same one."""
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
        return frame

    def _mask(self, shape: tuple[int, int]) -> Bool[np.ndarray, "H W"]:
        """Return what is blind in this frame; some of it reads 0 and some NaN."""
        if self._left == 0:
            rng = self._holes
            self._left = int(rng.integers(*REGION_FRAMES, endpoint=True))
            count = int(rng.integers(1, REGIONS, endpoint=True))
            which = regions(shape, self._d.invalid, count, rng)
            readings = rng.choice([0.0, np.nan], count).astype(np.float32)
            self._blind = np.where(which >= 0, readings[which], np.float32(1.0))
        self._left -= 1
        return (self._blind == 0.0) | np.isnan(self._blind)


def regions(
    shape: tuple[int, int], share: float, count: int, rng: np.random.Generator
) -> np.ndarray:
    """Return for each pixel which of `count` regions it is in, or -1, i64[H, W].

    Together they cover `share` of the image, to the pixel. A region reaches from its middle to
    k r(angle) in each direction, where r is a wobbly outline, so it is in one piece; k is the same
    for all, and such that the share comes out. Where two overlap, a pixel is in the nearer one.
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
