"""Rays that walk over columns of any heights, for lanes that are not level across.

Every ray starts where it comes down to the highest column within the camera's reach. Low relief it
then walks through column by column, which is a few of them. Over higher relief it first leaps from
block to block. All walks have one state, the depth reached; its sign bit says that it has ended.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config
from cref_jax.terrain import BLOCKS, Terrain, block_bottom, block_top

_ALONG = 1e-6  # columns/m, no ray is more nearly parallel to a border of columns
_LOW = 8.0  # columns of height: lower relief is walked through; 8 to 20 borders at 40 to 20 degrees
_ROUNDER = np.float32(
    1.5 * 2**23
)  # a float plus this is whole, and its lowest bits are the integer
_ROUNDER_BITS = int(_ROUNDER.view(np.int32))
_COLUMN, _SMALL, _MIDDLE, _LARGE = range(len(BLOCKS))


class _Eye(NamedTuple):
    """Where a camera is on the grid. Scalars: XLA then makes one loop over all rays of all cameras.

    Columns are counted from the corner of the largest block that the camera stands on: numbers
    stay small, so float32 stays exact, and blocks begin at multiples of their side.
    """

    i: Int[Array, ""]  # column of the window in that corner
    j: Int[Array, ""]
    x: Float[Array, ""]  # columns
    y: Float[Array, ""]
    z: Float[Array, ""]  # m
    axes: Float[Array, "3 3"]  # columns/m, columns/m, 1: the world's x, y, z of the camera's axes
    nudge: float  # columns, further along the ray is the column that a point on a border belongs to


class _Rays(NamedTuple):
    """All rays of a camera and what they meet."""

    ground: Terrain
    eye: _Eye
    to_x: Float[Array, "H W"]  # columns/m, never zero
    to_y: Float[Array, "H W"]
    x: Float[np.ndarray, "1 W"]  # m/m, in the camera's frame
    y: Float[np.ndarray, "H 1"]
    camera: config.Camera


class _Ray(NamedTuple):
    """Directions, for one unit of depth, and the inverses that divide by them."""

    x: Float[Array, "H W"]  # columns/m
    y: Float[Array, "H W"]
    z: Float[Array, "H W"]  # m/m
    per_x: Float[Array, "H W"]  # m/column
    per_y: Float[Array, "H W"]
    per_z: Float[Array, "H W"]  # m/m; 0 for a ray that does not go down


def ground_depth(
    ground: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
    camera: config.Camera,
) -> Float[Array, "H W"]:
    """Return the depth of the ground along each ray d = (x, y, 1), m, or d_max where there is none.

    The columns of `rotation` are the camera's axes in the world.
    """
    reach = ray_reach(ground, camera)
    eye = _eye(ground, position, rotation, reach)
    bottom, top = _relief(ground, eye, reach)
    is_high = top - bottom > _LOW * ground.cell
    to_x, to_y = (_apart_from_zero(row[0] * x + row[1] * y + row[2]) for row in eye.axes[:2])

    def walk(
        depth: Float[Array, "H W"], levels: tuple[int, ...], is_on: Bool[Array, ""]
    ) -> Float[Array, "H W"]:
        """Walk on over blocks of these levels in turn, if this camera does."""
        return _walk(_Rays(ground, eye, to_x, to_y, x, y, camera), levels, depth, is_on)

    to_z = eye.axes[2, 0] * x + eye.axes[2, 1] * y + eye.axes[2, 2]
    outside = jnp.where(eye.z > top, camera.d_max, 0.0)
    depth = jnp.where(to_z < 0.0, (top - eye.z) * _inverse_if_down(to_z), outside)
    depth = jnp.where(depth > 0.0, depth, 0.0)
    depth = jnp.abs(walk(depth, (_MIDDLE, _MIDDLE), is_high))
    depth = walk(depth, (_COLUMN, _COLUMN), ~is_high)
    depth = walk(depth, (_SMALL, _COLUMN, _COLUMN), is_high)
    seen = _has_ended(depth) & (-depth < camera.d_max)  # not NaN, either
    return jnp.where(seen, -depth, camera.d_max)


def ray_reach(ground: Terrain, camera: config.Camera) -> float:
    """Return the number of columns in the longest ray."""
    corner = [math.tan(math.radians(0.5 * view)) for view in camera.view]
    return camera.d_max * math.hypot(1.0, *corner) / ground.cell


def _eye(
    ground: Terrain, position: Float[Array, "3"], rotation: Float[Array, "3 3"], reach: float
) -> _Eye:
    """Return a camera in columns."""
    place = (position[:2] - ground.origin) * (1.0 / ground.cell)
    column = jnp.floor(place)
    inside = column.astype(jnp.int32) & (BLOCKS[-1] - 1)
    corner = column.astype(jnp.int32) - inside
    x, y = place - column + inside.astype(jnp.float32)
    scale = jnp.array([[1.0 / ground.cell], [1.0 / ground.cell], [1.0]])
    nudge = 1.2e-6 * (reach + BLOCKS[-1])  # ten times the rounding of a float
    return _Eye(corner[0], corner[1], x, y, position[2], rotation * scale, nudge)


def _relief(ground: Terrain, eye: _Eye, reach: float) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return the lowest and the highest column of all large blocks within reach, m."""
    side = BLOCKS[_LARGE]
    most = int(reach) // side + 1
    i, j = np.meshgrid(*2 * [side * np.arange(-most, most + 1)])
    around = ground, eye.i + i, eye.j + j
    return block_bottom(*around).min(), block_top(*around, _LARGE).max()


def _apart_from_zero(slope: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return jnp.where(jnp.abs(slope) < _ALONG, _ALONG, slope)


def _inverse_if_down(to_z: Float[Array, "*n"]) -> Float[Array, "*n"]:
    return jnp.where(to_z < 0.0, 1.0 / to_z, 0.0)


def _walk(
    rays: _Rays, levels: tuple[int, ...], depth: Float[Array, "H W"], is_on: Bool[Array, ""]
) -> Float[Array, "H W"]:
    """Return the depth after walks to the end: of d_max, or with the sign bit set, of the ground.

    A walk over nothing but large blocks ends at the first one that the ray meets.
    """
    most = int(2 * (ray_reach(rays.ground, rays.camera) + 2))  # two borders a column
    ends_at = min(levels)

    def is_short(carry: tuple) -> Bool[Array, ""]:
        count, _, _, is_walking, _ = carry
        return (count < most) & jnp.any(is_walking)

    def advance(carry: tuple) -> tuple:
        count, axes, one, _, depth = carry
        for k in range(2):  # into a second array and back: with one, XLA would copy it
            # of the depth before and not after the steps: XLA would make them once more for this
            is_walking = jnp.any(_is_walking(depth, rays.camera), axis=1) & is_on
            ray = _ray(rays, axes, one)
            further = depth
            for level in levels:
                further = _step(rays, ray, further, level, level == ends_at)
            # a row that has ended is a branch around all of the above
            depth = jnp.where(is_walking[:, None], further, depth)
            if k == 0:
                depth = jax.lax.optimization_barrier(depth)
        # as if they changed: or XLA would store all inverses, and reading them takes longer
        axes, one = (jnp.where(count < most, v, 0.0) for v in (axes, one))
        return count + 1, axes, one, is_walking, depth

    is_walking = jnp.full(depth.shape[:1], is_on)
    start = (0, rays.eye.axes, jnp.float32(1.0), is_walking, depth)
    return jax.lax.while_loop(is_short, advance, start)[-1]


def _ray(rays: _Rays, axes: Float[Array, "3 3"], one: Float[Array, ""]) -> _Ray:
    """Return the rays; `axes` are those of the eye, `one` is 1."""
    to_x, to_y = rays.to_x, rays.to_y
    to_z = axes[2, 0] * rays.x + axes[2, 1] * rays.y + axes[2, 2]
    inverse = one / (to_x * to_y)  # one division for two
    return _Ray(to_x, to_y, to_z, inverse * to_y, inverse * to_x, _inverse_if_down(to_z))


def _step(
    rays: _Rays, ray: _Ray, depth: Float[Array, "H W"], level: int, is_end: bool
) -> Float[Array, "H W"]:
    """Return the depth where each ray leaves its block of BLOCKS[level], or comes upon its top.

    If `is_end`, that sets its sign bit; a depth that has it stays. Minima and maxima are choices,
    which are one instruction; those that keep a NaN are four. So is taking the integer from a
    rounded float's bits, where a conversion looks for NaN and overflow.
    """
    ground, eye, side = rays.ground, rays.eye, BLOCKS[level]
    east, north = ray.x > 0.0, ray.y > 0.0
    # the nearest whole number to half a column less is the one below
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
    met = jnp.where(on_top > depth, on_top, depth)  # on its top, or on its side
    further = jnp.where(lowest <= top, -met if is_end else met, out)
    return jnp.where(_has_ended(depth), depth, further)


def _is_walking(depth: Float[Array, "*n"], camera: config.Camera) -> Bool[Array, "*n"]:
    """Return which depths are between zero and d_max, one comparison of bits; not NaN."""
    most = int(np.float32(camera.d_max).view(np.uint32))
    return _bits(depth).astype(jnp.uint32) < most  # a sign bit makes it large


def _has_ended(depth: Float[Array, "*n"]) -> Bool[Array, "*n"]:
    return _bits(depth) < 0  # -0, too


def _bits(x: Float[Array, "*n"]) -> Int[Array, "*n"]:
    return jax.lax.bitcast_convert_type(x, jnp.int32)


def _float(bits: Int[Array, "*n"]) -> Float[Array, "*n"]:
    return jax.lax.bitcast_convert_type(bits, jnp.float32)
