"""Slits across treads, landings and boards, narrower than a foot, as between planks or bars."""

import numpy as np

from cref_jax.terrain.generators import END, START, Heights

SHARE = 0.5  # of the lanes; assumed
PERIOD = (0.10, 0.25)  # m from slit to slit; assumed: of planks
DEPTH = 0.3  # m; assumed: deeper than a foot reaches
CLEAR = 0.06  # m from an edge that is there already; assumed: planks begin at an edge


def cut_slits(heights: Heights, widest: float, cell: float, rng: np.random.Generator) -> Heights:
    """Cut slits of up to `widest` metres across some lanes, between the level start and end.

    All of a lane's slits have one width and one distance; edges of obstacles stay whole.
    """
    if rng.random() >= SHARE:
        return heights
    width = int(rng.integers(1, max(1, round(widest / cell)), endpoint=True))
    period = max(round(rng.uniform(*PERIOD) / cell), 2 * width)
    first, last = round(START / cell), len(heights) - round(END / cell)
    clear, cut = round(CLEAR / cell), heights.copy()
    for begin in range(first, last - width, period):
        around = heights[max(begin - clear, 0) : begin + width + clear]
        if np.ptp(around, axis=0).max() < cell:  # level enough: no edge of an obstacle is near
            cut[begin : begin + width] -= DEPTH
    return cut
