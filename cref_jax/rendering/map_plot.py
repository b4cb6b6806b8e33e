"""A height map from above, as a robot will walk on it."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cref_jax.terrain import Terrain
from cref_jax.terrain.heightmap import MAP_START


def draw_map(ground: Terrain, out: Path) -> None:
    """Write a picture of the heights, with the start and the way along +x."""
    heights, cell = np.asarray(ground.heights), ground.cell
    left, low = (float(x) for x in ground.origin)
    wide, deep = (n * cell for n in heights.shape)
    figure = Figure(figsize=(8.0, 8.0 * min(1.0, deep / wide) + 1.0), layout="constrained")
    axis = figure.subplots()
    image = axis.imshow(
        heights.T, origin="lower", extent=(left, left + wide, low, low + deep), cmap="viridis"
    )
    figure.colorbar(image, label="height above the start, m", shrink=0.8)
    axis.annotate(
        "", (MAP_START + 1.0, 0.0), (MAP_START, 0.0),
        arrowprops={"arrowstyle": "->", "color": "red", "lw": 2.0},
    )  # fmt: skip
    axis.plot(MAP_START, 0.0, "o", color="red", label="start, and the way to walk")
    axis.legend(loc="upper right")
    axis.set(xlabel="x, m", ylabel="y, m")
    figure.savefig(out, dpi=120)
