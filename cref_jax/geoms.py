"""Ground as MuJoCo geoms: columns of equal height merged into boxes, and its materials."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

GROUND = 0  # geom group of the lane and of the plain; the robot's shapes are in 2 and 3
MOST_BOXES = 150  # beyond, a height field; stairs take some 40, a slope 200 and more
TILE = 1.0  # m, between two changes of tone
TONES = ((0.80, 0.78, 0.74), (0.66, 0.65, 0.63))  # red, green, blue


class Boxes(NamedTuple):
    """Rectangles of columns of one height and tone, B of them."""

    first: Int[np.ndarray, "B 2"]  # column
    size: Int[np.ndarray, "B 2"]  # columns
    height: Float[np.ndarray, " B"]  # m
    tone: Int[np.ndarray, " B"]  # index into TONES


def add_checker(
    spec: mujoco.MjSpec, name: str, tones: tuple[tuple[float, ...], ...], repeat: float
) -> None:
    """Add a material with two fields of each tone a period, `repeat` periods a metre."""
    spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=tones[0],
        rgb2=tones[1],
        width=256,
        height=256,
    )
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    spec.add_material(name=name, textures=textures, texuniform=True, texrepeat=[repeat, repeat])


def boxes(heights: Float[np.ndarray, "X Y"], tile: int, most: int = MOST_BOXES) -> Boxes | None:
    """Return boxes that cover every column once, or None if more than `most` would be needed.

    Greedy: from the first column that is left, as far as possible across, then along.
    """
    tone = _tones(heights, tile)
    number = np.unique(heights, return_inverse=True)[1].reshape(heights.shape)
    look = 2 * number + tone  # what a box has in common; -1: in a box already
    found: list[tuple[tuple[int, int], tuple[int, int]]] = []
    while (look >= 0).any():
        if len(found) == most:
            return None
        i, j = (int(k) for k in np.unravel_index(np.argmax(look >= 0), look.shape))
        across = _run(look[i, j:] == look[i, j])
        along = _run((look[i:, j : j + across] == look[i, j]).all(axis=1))
        look[i : i + along, j : j + across] = -1
        found.append(((i, j), (along, across)))
    first, size = (np.array(part, np.int32) for part in zip(*found, strict=True))
    at = tuple(first.T)
    return Boxes(first, size, heights[at], tone[at])


def _tones(heights: Float[np.ndarray, "X Y"], tile: int) -> Int[np.ndarray, "X Y"]:
    """Return 0 or 1 for each column: along x they take turns at each riser and each `tile`."""
    x = np.arange(heights.shape[0])[:, None]
    risers = np.diff(heights, axis=0, prepend=heights[:1]) != 0.0
    since = x - np.maximum.accumulate(np.where(risers, x, 0), axis=0)  # the last riser
    return np.cumsum(risers | ((since > 0) & (since % tile == 0)), axis=0) % 2


def _run(flags: Bool[np.ndarray, " n"]) -> int:
    """Return how many flags are true before the first that is not."""
    return len(flags) if flags.all() else int(np.argmin(flags))
