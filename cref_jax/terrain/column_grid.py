"""The terrain as a grid of columns, read by contact, depth, height scan and foothold reward.

Column (i, j) of a `Terrain` is a box, filled from minus infinity up to its height, so risers are
truly vertical. All robots share one array of heights, a `Grid` of lanes. Each robot sees a window
of it, its lane; outside the window the border heights continue, so a lane that is level across is
stored as one column. Frames: x along the lane, z up.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cref_jax.system import xla_kernels

FAR = 1.0  # m, distance of the placeholder for a missing contact plane
BLOCKS = (1, 4, 16, 64)  # columns, sides of the blocks with stored tops; powers of two
_TOUCHING = 1e-6  # m, lower bound of all distances, so that every direction is defined
_REACH = 3  # columns; a foot swinging at 8 m/s is 4 cm inside a wall after one substep
_COLUMNS = [  # searched around a point, its own first
    (0, 0),
    *((a, b) for a in (-1, 0, 1) for b in (-1, 0, 1) if (a, b) != (0, 0)),
    *((k * a, k * b) for k in range(2, _REACH + 1) for a, b in ((-1, 0), (1, 0), (0, -1), (0, 1))),
]
_ABOVE = 1e-5  # m, minimum distance of a second contact in front of the first one's plane


@no_type_check  # vmap and tree.map put batches and non-arrays in it
@flax.struct.dataclass
class Terrain:
    """A window of columns."""

    tops: Float[Array, " N"]  # m, of all lanes
    parts: Int[Array, " P"]
    """Offsets into `tops` of the window's columns, of the blocks of each larger size of BLOCKS, and
    of the bottoms of the largest; each part is stored row by row."""
    across: Int[Array, " B"]  # number of columns, and of blocks of each size, stored across
    origin: Float[Array, " 2"]  # m, outer corner of the window's first column
    cell: float = flax.struct.field(pytree_node=False)  # m, side of a column
    size: tuple[int, int] = flax.struct.field(pytree_node=False)  # columns along and across

    @property
    def heights(self) -> Float[np.ndarray, "X Y"]:
        """The heights of the window's columns, m."""
        first, across = int(self.parts[0]), int(self.across[0])
        stored = np.asarray(self.tops)[first : first + self.size[0] * across]
        return np.broadcast_to(stored.reshape(self.size[0], across), self.size)


@no_type_check
@flax.struct.dataclass
class Grid:
    """Lanes of equal size, each a `Terrain` in the same coordinates."""

    tops: Float[Array, " N"]
    parts: Int[Array, "rows kinds P"]
    across: Int[Array, "rows kinds B"]
    origin: Float[Array, " 2"]
    cell: float = flax.struct.field(pytree_node=False)
    size: tuple[int, int] = flax.struct.field(pytree_node=False)


def from_heights(
    heights: Float[ArrayLike, "X Y"], cell: float, origin: tuple[float, float] = (0.0, 0.0)
) -> Terrain:
    """Build the terrain in which column (i, j) covers origin + [i, i + 1) x [j, j + 1) cell."""
    heights = jnp.asarray(heights, jnp.float32)
    tops, parts, across = _pack_heights(heights, jnp)
    return Terrain(
        tops=tops,
        parts=jnp.asarray(parts, jnp.int32),
        across=jnp.asarray(across, jnp.int32),
        origin=jnp.asarray(origin, jnp.float32),
        cell=float(cell),
        size=heights.shape,
    )


def build_grid(
    lanes: Sequence[Sequence[Float[np.ndarray, "_ _"]]],
    cell: float,
    origin: tuple[float, float],
    size: tuple[int, int],
) -> Grid:
    """Build one grid of lanes [rows][kinds] of `size` columns, each with its corner at `origin`.

    A lane given as one column across is level across.
    """
    stored = [[_pack_heights(lane, np) for lane in row] for row in lanes]
    flat = [part for row in stored for part in row]
    begins = np.cumsum([0, *(tops.size for tops, _, _ in flat[:-1])])
    shape = (len(lanes), len(lanes[0]), -1)
    parts = np.array([parts + begin for (_, parts, _), begin in zip(flat, begins, strict=True)])
    return Grid(
        tops=jnp.asarray(np.concatenate([tops for tops, _, _ in flat])),
        parts=jnp.asarray(parts.reshape(shape), jnp.int32),
        across=jnp.asarray(np.array([across for _, _, across in flat]).reshape(shape), jnp.int32),
        origin=jnp.asarray(origin, jnp.float32),
        cell=float(cell),
        size=size,
    )


def tile(grid: Grid, row: Int[ArrayLike, ""], kind: Int[ArrayLike, ""]) -> Terrain:
    """Return one lane of a grid.

    Every lane has the same coordinates, so positions stay small and float32 stays exact. The
    heights are shared, not copied: under vmap over row and kind they get no batch axis.
    """
    parts, across = grid.parts[row, kind], grid.across[row, kind]
    return Terrain(grid.tops, parts, across, grid.origin, grid.cell, grid.size)


def height_at(terrain: Terrain, xy: Float[ArrayLike, "... 2"]) -> Float[Array, "..."]:
    """Look up the height of the ground under each point, m."""
    xy = jnp.asarray(xy)
    return height_under(terrain, xy[..., 0], xy[..., 1])


def height_under(
    terrain: Terrain, x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> Float[Array, "*n"]:
    """Look up the height of the ground under each point (x, y), m."""
    return _read_heights(terrain.tops, [_column_under(terrain, x, y)])[0]


def closest_point(
    terrain: Terrain, p: Float[Array, " 3"]
) -> tuple[Float[Array, " 3"], Float[Array, " 3"], Float[Array, ""]]:
    """Find the closest point of the surface, the outward unit normal there and the distance, m.

    The distance is negative inside the ground. The 3 x 3 columns around `p` are searched, so the
    result is exact (to `_TOUCHING`) for distances below one cell, as for a contact sphere of that
    radius. Higher up it is the closest point of these columns. Along x and along y, `_REACH`
    columns are searched in each direction, so the way out of a wall is found from that depth. At an
    edge the normal points from the edge to `p`; of two equally close points, the one on p's own
    column is taken.
    """
    place = _locate(terrain, p[0], p[1])
    around = _read_heights(terrain.tops, _neighbor_columns(terrain, place))

    @xla_kernels.as_own_kernel
    def search(place: _Place, z: Float[Array, ""], around: list[Float[Array, ""]]) -> Any:
        offsets, outside = _offsets(terrain.cell, place, z, around)
        return _shortest(offsets), outside

    return _plane(p, *search(place, p[2], around))


def contact_planes(
    terrain: Terrain, p: Float[Array, " 3"], count: int = 1
) -> tuple[Float[Array, "count 3"], Float[Array, "count 3"], Float[Array, " count"]]:
    """Find points, normals and distances, m, of the surfaces that a sphere at `p` may touch.

    The first is `closest_point`. The second is the closest surface whose normal differs by more
    than 45 degrees and which protrudes from the first one's tangent plane: in the corner of a stair
    a sphere touches tread and riser at once. If there is none, it is a level plane `FAR` below.

    Raises:
        ValueError: `count` is neither 1 nor 2.
    """
    if count not in (1, 2):
        raise ValueError(f"a sphere has 1 or 2 contact planes, not {count}")
    place = _locate(terrain, p[0], p[1])
    around = _read_heights(terrain.tops, _neighbor_columns(terrain, place))
    offsets, outside = _offsets(terrain.cell, place, p[2], around)
    nearest = _shortest(offsets)
    planes = [_plane(p, nearest, outside)]
    if count == 2:
        planes.append(_second_plane(p, offsets, nearest, outside))
    points, normals, distances = zip(*planes, strict=True)
    return jnp.stack(points), jnp.stack(normals), jnp.stack(distances)


def block_top(
    terrain: Terrain, i: Int[Array, "*n"], j: Int[Array, "*n"], level: int
) -> Float[Array, "*n"]:
    """Look up the height of the highest column in a block, m.

    The block has BLOCKS[level] x BLOCKS[level] columns and contains column (i, j) of the window, or
    the nearest one inside it. Blocks are counted from the window's first column and end with the
    window.
    """
    return _read_block(terrain, i, j, level, level)


def block_bottom(terrain: Terrain, i: Int[Array, "*n"], j: Int[Array, "*n"]) -> Float[Array, "*n"]:
    """Look up the height of the lowest column in one of the largest blocks, m; see block_top."""
    return _read_block(terrain, i, j, len(BLOCKS) - 1, len(BLOCKS))


class _Place(NamedTuple):
    """The position of a point among the columns of the window, as scalars."""

    i: Int[Array, ""]  # its column, possibly outside the window
    j: Int[Array, ""]
    first: Int[Array, ""]  # the window's first column, in `tops`
    across: Int[Array, ""]  # number of columns stored across
    east: Float[Array, ""]  # m from its column's corner, never exactly on an edge
    north: Float[Array, ""]


class _Offset(NamedTuple):
    """The vector from `p` to the closest point of one column, m, and its squared length, m^2.

    Scalars rather than arrays: XLA then compiles the whole search into one loop over all points of
    all robots, with nothing in memory but the heights.
    """

    x: Float[Array, ""]
    y: Float[Array, ""]
    z: Float[Array, ""]
    square: Float[Array, ""]


@xla_kernels.as_own_kernel
def _locate(terrain: Terrain, x: Float[Array, ""], y: Float[Array, ""]) -> _Place:
    """Locate a point among the columns."""
    x = (x - terrain.origin[0]) * (1.0 / terrain.cell)  # columns
    y = (y - terrain.origin[1]) * (1.0 / terrain.cell)
    i, j = jnp.floor(x), jnp.floor(y)
    # barrier: if length and vector were rounded differently, a normal would not have unit length
    u, v = jax.lax.optimization_barrier((x - i, y - j))
    inside = lambda part: jnp.clip(part * terrain.cell, _TOUCHING, terrain.cell - _TOUCHING)
    i, j = i.astype(jnp.int32), j.astype(jnp.int32)
    # one number per point, though all points of a robot share it: read in step with i and j
    each = lambda of_window: of_window + jnp.zeros_like(i)
    return _Place(
        i=i,
        j=j,
        first=each(terrain.parts[0]),
        across=each(terrain.across[0]),
        east=inside(u),
        north=inside(v),
    )


def _neighbor_columns(terrain: Terrain, place: _Place) -> list[Int[Array, ""]]:
    """Compute the indices of the `_COLUMNS`, or of the nearest ones inside the window."""
    reach, last = range(-_REACH, _REACH + 1), terrain.size[0] - 1
    row = {a: place.first + jnp.clip(place.i + a, 0, last) * place.across for a in reach}
    aside = {b: jnp.clip(place.j + b, 0, place.across - 1) for b in reach}
    return [row[a] + aside[b] for a, b in _COLUMNS]


@xla_kernels.as_own_kernel
def _column_under(
    terrain: Terrain, x: Float[Array, "*n"], y: Float[Array, "*n"]
) -> Int[Array, "*n"]:
    """Compute the index of the column under each point, or of the nearest one in the window."""
    i = jnp.floor((x - terrain.origin[0]) * (1.0 / terrain.cell)).astype(jnp.int32)
    j = jnp.floor((y - terrain.origin[1]) * (1.0 / terrain.cell)).astype(jnp.int32)
    i = jnp.clip(i, 0, terrain.size[0] - 1)
    j = jnp.clip(j, 0, terrain.across[0] - 1)
    return terrain.parts[0] + i * terrain.across[0] + j


@xla_kernels.as_own_kernel
def _read_heights(
    tops: Float[Array, " N"], columns: list[Int[Array, "*n"]]
) -> list[Float[Array, "*n"]]:
    """Read the heights of the columns with these indices, m."""
    # unsigned: an index that may be negative costs another check
    get = lambda column: tops.at[column.astype(jnp.uint32)].get(mode="promise_in_bounds")
    return [get(column) for column in columns]


def _offsets(
    cell: float, place: _Place, z: Float[Array, ""], around: list[Float[Array, ""]]
) -> tuple[list[_Offset], Float[Array, ""]]:
    """Compute the offsets from a point to `_COLUMNS`, and 1 outside the ground or -1 inside.

    `z` is the point's height, `around` the heights of `_COLUMNS`, m. Outside the ground, the
    closest point of a column is in the box below its height; inside, in the air above it.
    """
    to = lambda inside, k: (k + (k < 0)) * cell - inside if k else jnp.zeros_like(inside)
    to_x = {k: to(place.east, k) for k in range(-_REACH, _REACH + 1)}
    to_y = {k: to(place.north, k) for k in range(-_REACH, _REACH + 1)}

    own = around[0] - z
    outside = jnp.where(own <= 0.0, 1.0, -1.0)
    up = -outside * jnp.maximum(jnp.abs(own), 0.5 * _TOUCHING)  # half: its own column comes first
    offsets = [_Offset(jnp.zeros_like(up), jnp.zeros_like(up), up, up * up)]
    for (a, b), height in zip(_COLUMNS[1:], around[1:], strict=True):
        up = -outside * jnp.maximum(-outside * (height - z), 0.0)
        square = to_x[a] * to_x[a] + to_y[b] * to_y[b] + up * up
        offsets.append(_Offset(to_x[a], to_y[b], up, square))
    return offsets, outside


def _read_block(
    terrain: Terrain, i: Int[Array, "*n"], j: Int[Array, "*n"], level: int, part: int
) -> Float[Array, "*n"]:
    """Read the entry of the block around a column from a part of `tops`, m."""
    shift = BLOCKS[level].bit_length() - 1
    i = jnp.clip(i, 0, terrain.size[0] - 1) >> shift
    j = jnp.clip(j, 0, terrain.across[0] - 1) >> shift
    index = terrain.parts[part] + i * terrain.across[level] + j
    # unsigned: an index that may be negative costs another check
    return terrain.tops.at[index.astype(jnp.uint32)].get(mode="promise_in_bounds")


def _pack_heights(
    heights: Float[ArrayLike, "X Y"], xp: Any
) -> tuple[Float[ArrayLike, " n"], Int[np.ndarray, " P"], Int[np.ndarray, " B"]]:
    """Pack a lane: its entries of `tops`, offsets of its parts, blocks across per size."""
    larger = [_split_blocks(heights, side, xp) for side in BLOCKS[1:]]
    parts = [heights, *(blocks.max((1, 3)) for blocks in larger), larger[-1].min((1, 3))]
    begins = np.cumsum([0, *(part.size for part in parts[:-1])])
    across = np.array([part.shape[1] for part in parts[:-1]])
    return xp.concatenate([part.reshape(-1) for part in parts]), begins, across


def _split_blocks(heights: Float[ArrayLike, "X Y"], side: int, xp: Any) -> Any:
    """Split heights into [blocks, side, blocks, side]; partial blocks repeat the border."""
    counts = [-(-n // side) for n in heights.shape]
    more = [(0, count * side - n) for count, n in zip(counts, heights.shape, strict=True)]
    padded = xp.pad(heights, more, mode="edge")
    return padded.reshape(counts[0], side, counts[1], side)


def _shortest(offsets: list[_Offset]) -> _Offset:
    """Select the shortest offset, the first of equally short ones."""
    best = offsets[0]
    for other in offsets[1:]:
        best = _choose(other.square < best.square, other, best)
    return best


def _second_plane(
    p: Float[Array, " 3"], offsets: list[_Offset], nearest: _Offset, outside: Float[Array, ""]
) -> tuple[Float[Array, " 3"], Float[Array, " 3"], Float[Array, ""]]:
    """Find the plane of the nearest other surface, or one `FAR` below `p`."""
    zero = jnp.zeros_like(p[0])
    none = _Offset(zero, zero, zero - FAR, zero + FAR * FAR)
    second = none
    for other in offsets:
        along = other.x * nearest.x + other.y * nearest.y + other.z * nearest.z
        turned = (along <= 0.0) | (along * along < 0.5 * other.square * nearest.square)
        in_front = nearest.square - along > _ABOVE * jnp.sqrt(nearest.square)
        second = _choose(turned & in_front & (other.square < second.square), other, second)
    return _plane(p, _choose(outside > 0.0, second, none), jnp.ones_like(outside))


def _choose(condition: Bool[Array, ""], yes: _Offset, no: _Offset) -> _Offset:
    """Select one of two offsets."""
    return _Offset(*(jnp.where(condition, a, b) for a, b in zip(yes, no, strict=True)))


def _plane(
    p: Float[Array, " 3"], offset: _Offset, outside: Float[Array, ""]
) -> tuple[Float[Array, " 3"], Float[Array, " 3"], Float[Array, ""]]:
    """Convert an offset from `p` to the surface point, the normal there and the distance, m."""
    vector = jnp.stack([offset.x, offset.y, offset.z])
    length = jnp.sqrt(offset.square)
    return p + vector, vector * (-outside / length), outside * length
