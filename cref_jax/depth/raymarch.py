"""Ray marching over columns of arbitrary heights, for lanes that are not level across.

Every ray starts where it descends to the highest column within the camera's reach. Through low
relief it then walks column by column, which takes few steps. Over higher relief it first leaps from
block to block. The only state of a walk is the depth reached; its sign bit marks the end.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config
from cref_jax.terrain import BLOCKS, Terrain, block_bottom, block_top

ALONG = 1e-6  # columns/m, minimum slope of a ray against the borders of columns
_LOW = 8.0  # columns of height; lower relief is walked, 8 to 20 borders at 40 to 20 degrees
# a float plus this is whole, and its lowest bits are the integer
_ROUNDER = np.float32(1.5 * 2**23)
_ROUNDER_BITS = int(_ROUNDER.view(np.int32))
_COLUMN, _SMALL, _MIDDLE, _LARGE = range(len(BLOCKS))


class _Eye(NamedTuple):
    """A camera on the grid, as scalars: XLA then compiles one loop over all rays of all cameras.

    Columns are counted from the corner of the camera's largest block: numbers stay small, so
    float32 stays exact, and blocks begin at multiples of their side.
    """

    i: Int[Array, ""]  # column of the window at that corner
    j: Int[Array, ""]
    x: Float[Array, ""]  # columns
    y: Float[Array, ""]
    z: Float[Array, ""]  # m
    axes: Float[Array, "3 3"]  # columns/m, columns/m, 1: world x, y, z of the camera's axes
    nudge: float  # columns along the ray, from a point on a border into the column it belongs to


class _Rays(NamedTuple):
    """All rays of a camera and the ground they march over."""

    ground: Terrain
    eye: _Eye
    to_x: Float[Array, "H W"]  # columns/m, never zero
    to_y: Float[Array, "H W"]
    x: Float[np.ndarray, "1 W"]  # m/m, in the camera's frame
    y: Float[np.ndarray, "H 1"]
    camera: config.Camera


class _Ray(NamedTuple):
    """Ray directions per unit of depth, and their inverses."""

    x: Float[Array, "H W"]  # columns/m
    y: Float[Array, "H W"]
    z: Float[Array, "H W"]  # m/m
    per_x: Float[Array, "H W"]  # m/column
    per_y: Float[Array, "H W"]
    per_z: Float[Array, "H W"]  # m/m; 0 for a ray that does not descend


def ground_depth(
    ground: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
    camera: config.Camera,
) -> Float[Array, "H W"]:
    """Render the depth of the ground along each ray d = (x, y, 1), m; d_max where it hits none.

    The columns of `rotation` are the camera's axes in the world.
    """
    reach = ray_reach(ground, camera)
    eye = _to_columns(ground, position, rotation, reach)
    bottom, top = _find_relief(ground, eye, reach)
    is_high = top - bottom > _LOW * ground.cell
    to_x, to_y = (_avoid_zero(row[0] * x + row[1] * y + row[2]) for row in eye.axes[:2])

    def walk(
        depth: Float[Array, "H W"], levels: tuple[int, ...], is_on: Bool[Array, ""]
    ) -> Float[Array, "H W"]:
        """Continue the walks over blocks of these levels in turn, if `is_on`."""
        return _walk(_Rays(ground, eye, to_x, to_y, x, y, camera), levels, depth, is_on)

    to_z = eye.axes[2, 0] * x + eye.axes[2, 1] * y + eye.axes[2, 2]
    outside = jnp.where(eye.z > top, camera.d_max, 0.0)
    depth = jnp.where(to_z < 0.0, (top - eye.z) * _inverse_if_down(to_z), outside)
    depth = jnp.where(depth > 0.0, depth, 0.0)
    depth = jnp.abs(walk(depth, (_MIDDLE, _MIDDLE), is_high))
    depth = walk(depth, (_COLUMN, _COLUMN), ~is_high)
    depth = walk(depth, (_SMALL, _COLUMN, _COLUMN), is_high)
    is_hit = _has_ended(depth) & (-depth < camera.d_max)  # False for NaN
    return jnp.where(is_hit, -depth, camera.d_max)


def ray_reach(ground: Terrain, camera: config.Camera) -> float:
    """Compute the length of the longest ray in columns."""
    corner = [math.tan(math.radians(0.5 * view)) for view in camera.view]
    return camera.d_max * math.hypot(1.0, *corner) / ground.cell


def _to_columns(
    ground: Terrain, position: Float[Array, "3"], rotation: Float[Array, "3 3"], reach: float
) -> _Eye:
    """Convert the camera's pose to columns."""
    place = (position[:2] - ground.origin) * (1.0 / ground.cell)
    column = jnp.floor(place)
    inside = column.astype(jnp.int32) & (BLOCKS[-1] - 1)
    corner = column.astype(jnp.int32) - inside
    x, y = place - column + inside.astype(jnp.float32)
    scale = jnp.array([[1.0 / ground.cell], [1.0 / ground.cell], [1.0]])
    nudge = 1.2e-6 * (reach + BLOCKS[-1])  # ten times the rounding of a float
    return _Eye(corner[0], corner[1], x, y, position[2], rotation * scale, nudge)


def _find_relief(
    ground: Terrain, eye: _Eye, reach: float
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Find the lowest and the highest column of all large blocks within reach, m."""
    side = BLOCKS[_LARGE]
    most = int(reach) // side + 1
    i, j = np.meshgrid(*2 * [side * np.arange(-most, most + 1)])
    around = ground, eye.i + i, eye.j + j
    return block_bottom(*around).min(), block_top(*around, _LARGE).max()


def _avoid_zero(slope: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return jnp.where(jnp.abs(slope) < ALONG, ALONG, slope)


def _inverse_if_down(to_z: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return jnp.where(to_z < 0.0, 1.0 / to_z, 0.0)


def _walk(
    rays: _Rays, levels: tuple[int, ...], depth: Float[Array, "H W"], is_on: Bool[Array, ""]
) -> Float[Array, "H W"]:
    """Walk each ray to d_max, or to the ground, whose depth gets the sign bit.

    A walk over large blocks alone ends at the first block that the ray hits.
    """
    most = int(2 * (ray_reach(rays.ground, rays.camera) + 2))  # two borders per column
    ends_at = min(levels)

    def is_short(carry: tuple) -> Bool[Array, ""]:
        count, _, _, is_walking, _ = carry
        return (count < most) & jnp.any(is_walking)

    def advance(carry: tuple) -> tuple:
        count, axes, one, _, depth = carry
        for k in range(2):  # into a second array and back: with one, XLA would copy it
            # from the depth before the steps: from that after them, XLA would compute them twice
            is_walking = jnp.any(_is_walking(depth, rays.camera), axis=1) & is_on
            ray = _ray(rays, axes, one)
            further = depth
            for level in levels:
                further = _step(rays, ray, further, level, level == ends_at)
            # for a row that has ended, a branch skips all of the above
            depth = jnp.where(is_walking[:, None], further, depth)
            if k == 0:
                depth = jax.lax.optimization_barrier(depth)
        # as if they changed: else XLA would store all inverses, and reading them is slower
        axes, one = (jnp.where(count < most, v, 0.0) for v in (axes, one))
        return count + 1, axes, one, is_walking, depth

    is_walking = jnp.full(depth.shape[:1], is_on)
    start = (0, rays.eye.axes, jnp.float32(1.0), is_walking, depth)
    return jax.lax.while_loop(is_short, advance, start)[-1]


def _ray(rays: _Rays, axes: Float[Array, "3 3"], one: Float[Array, ""]) -> _Ray:
    """Compute directions and inverses; `axes` are those of the eye, `one` is 1."""
    to_x, to_y = rays.to_x, rays.to_y
    to_z = axes[2, 0] * rays.x + axes[2, 1] * rays.y + axes[2, 2]
    inverse = one / (to_x * to_y)  # one division for two
    return _Ray(to_x, to_y, to_z, inverse * to_y, inverse * to_x, _inverse_if_down(to_z))


def _step(
    rays: _Rays, ray: _Ray, depth: Float[Array, "H W"], level: int, is_end: bool
) -> Float[Array, "H W"]:
    """Compute the depth at which each ray leaves its block of BLOCKS[level] or hits the ground.

    If `is_end`, a hit sets the sign bit; a depth with the sign bit set stays. Minima and maxima are
    selections, one instruction each; those that keep a NaN are four. Likewise, the integer is taken
    from the bits of a rounded float, because a conversion checks for NaN and overflow.
    """
    ground, eye, side = rays.ground, rays.eye, BLOCKS[level]
    east, north = ray.x > 0.0, ray.y > 0.0
    # rounding half a column less gives the floor
    i = depth * ray.x + (jnp.where(east, eye.x + eye.nudge, eye.x - eye.nudge) - 0.5) + _ROUNDER
    j = depth * ray.y + (jnp.where(north, eye.y + eye.nudge, eye.y - eye.nudge) - 0.5) + _ROUNDER
    i, j = _bits(i), _bits(j)
    top = block_top(ground, eye.i + (i - _ROUNDER_BITS), eye.j + (j - _ROUNDER_BITS), level)

    border_x = _float(i & -side) - jnp.where(east, _ROUNDER - side, _ROUNDER)
    border_y = _float(j & -side) - jnp.where(north, _ROUNDER - side, _ROUNDER)
    depth_x, depth_y = (border_x - eye.x) * ray.per_x, (border_y - eye.y) * ray.per_y
    out = jnp.where(depth_x < depth_y, depth_x, depth_y)
    lowest = eye.z + ray.z * jnp.where(ray.z < 0.0, out, depth)

    on_top = (top - eye.z) * ray.per_z
    hit = jnp.where(on_top > depth, on_top, depth)  # on its top, or on its side
    further = jnp.where(lowest <= top, -hit if is_end else hit, out)
    return jnp.where(_has_ended(depth), depth, further)


def _is_walking(depth: Float[Array, "*n"], camera: config.Camera) -> Bool[Array, "*n"]:
    """Check for depths between zero and d_max, by one comparison of bits; False for NaN."""
    most = int(np.float32(camera.d_max).view(np.uint32))
    return _bits(depth).astype(jnp.uint32) < most  # a sign bit makes it large


def _has_ended(depth: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    return _bits(depth) < 0  # also true for -0


def _bits(x: Float[Array, "*n"]) -> Int[Array, "*n"]:
    return jax.lax.bitcast_convert_type(x, jnp.int32)


def _float(bits: Int[Array, "*n"]) -> Float[Array, "*n"]:
    return jax.lax.bitcast_convert_type(bits, jnp.float32)
