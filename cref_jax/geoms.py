"""Terrain as MuJoCo geoms: columns of equal height merged into boxes, and its materials."""

from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

GROUND = 0  # geom group of the lane and the plain; the robot's geoms are in 2 and 3
MOST_BOXES = 150  # above this, a height field; stairs need about 40, a slope 200 or more
TILE = 1.0  # m, length of a tile of one tone
TONES = ((0.80, 0.78, 0.74), (0.66, 0.65, 0.63))  # red, green, blue


class Boxes(NamedTuple):
    """B rectangles of columns, each of one height and tone."""

    first: Int[np.ndarray, "B 2"]  # column
    size: Int[np.ndarray, "B 2"]  # columns
    height: Float[np.ndarray, " B"]  # m
    tone: Int[np.ndarray, " B"]  # index into TONES


def add_checker(
    spec: mujoco.MjSpec, name: str, tones: tuple[tuple[float, ...], ...], repeat: float
) -> None:
    """Add a checker material: two fields of each tone per period, `repeat` periods per metre."""
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


def merge_boxes(
    heights: Float[np.ndarray, "X Y"], tile: int, most: int = MOST_BOXES
) -> Boxes | None:
    """Cover every column by exactly one box; None if that takes more than `most` boxes.

    Greedy: from the first uncovered column, as far as possible across (y), then along (x).
    """
    tone = _column_tones(heights, tile)
    number = np.unique(heights, return_inverse=True)[1].reshape(heights.shape)
    look = 2 * number + tone  # equal within a box; -1: already covered
    rectangles: list[tuple[tuple[int, int], tuple[int, int]]] = []
    while (look >= 0).any():
        if len(rectangles) == most:
            return None
        i, j = (int(k) for k in np.unravel_index(np.argmax(look >= 0), look.shape))
        across = _run_length(look[i, j:] == look[i, j])
        along = _run_length((look[i:, j : j + across] == look[i, j]).all(axis=1))
        look[i : i + along, j : j + across] = -1
        rectangles.append(((i, j), (along, across)))
    first, size = (np.array(part, np.int32) for part in zip(*rectangles, strict=True))
    at = tuple(first.T)
    return Boxes(first, size, heights[at], tone[at])


def _column_tones(heights: Float[np.ndarray, "X Y"], tile: int) -> Int[np.ndarray, "X Y"]:
    """Compute the tone of each column, 0 or 1, changing along x at every riser and every `tile`."""
    x = np.arange(heights.shape[0])[:, None]
    risers = np.diff(heights, axis=0, prepend=heights[:1]) != 0.0
    since = x - np.maximum.accumulate(np.where(risers, x, 0), axis=0)  # the last riser
    return np.cumsum(risers | ((since > 0) & (since % tile == 0)), axis=0) % 2


def _run_length(flags: Bool[np.ndarray, " n"]) -> int:
    """Count the flags that are true before the first false one."""
    return len(flags) if flags.all() else int(np.argmin(flags))
