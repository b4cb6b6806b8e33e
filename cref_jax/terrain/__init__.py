"""The ground: a grid of columns, kinds of lane, and a user's own height maps."""

from cref_jax.terrain.column_grid import (
    BLOCKS,
    FAR,
    Grid,
    Terrain,
    block_bottom,
    block_top,
    build_grid,
    closest_point,
    contact_planes,
    from_heights,
    height_at,
    height_under,
    tile,
)

__all__ = [
    "BLOCKS",
    "FAR",
    "Grid",
    "Terrain",
    "block_bottom",
    "block_top",
    "build_grid",
    "closest_point",
    "contact_planes",
    "from_heights",
    "height_at",
    "height_under",
    "tile",
]
