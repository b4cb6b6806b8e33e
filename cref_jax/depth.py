"""The depth camera: what it sees of the ground and of the robot's own links, and when.

The image is the distance along the optical axis, as a RealSense reports it (Sec. II-D). Frames: the
camera's x right, y down, z forward; pixel (0, 0) is at the top left.
"""

import math
from fractions import Fraction
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cref_jax import config, geometry, kinematics, robot, terrain
from cref_jax.kinematics import Links
from cref_jax.terrain import BLOCKS, Terrain, block_top

_LEVEL = 3  # mask of the bits of a march's state that hold the level of BLOCKS
_ALONG = 1e-6  # columns/m, no ray is more nearly parallel to a border of columns
_PARALLEL = 1e-9  # no ray is more nearly parallel to a capsule: sine squared of their angle


def render(
    terrain: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    capsules: Float[Array, "C 7"],
    camera: config.Camera,
    is_profile: bool = False,
) -> Float[Array, "H W"]:
    """Return the depth image of one camera, m.

    The columns of `rotation` are the camera's axes in the world; a capsule is two ends and a
    radius, in the world. What is further than d_max, or nowhere, reads d_max. A camera in the
    ground reads 0; a capsule that the camera is inside of is not seen.

    `is_profile` promises that heights are the same all across (along y), as on stairs: the image is
    the same, and comes eight times as fast.
    """
    height, width = camera.shape
    x, y = _slopes(width, camera.view[1]), _slopes(height, camera.view[0])
    if is_profile:
        ground = _sweep(terrain, position, rotation, x[None, :], y[:, None], camera)
    else:
        eye = _eye(terrain, position, rotation, camera)
        ground = jax.vmap(lambda y: _march(terrain, eye, x, y, camera))(y)
    links = _links(position, rotation, capsules, x[None, :], y[:, None])
    return jnp.minimum(jnp.minimum(ground, links), camera.d_max)


def normalise(depth: Float[Array, "*n H W"], camera: config.Camera) -> Float[Array, "*n H W"]:
    """Return D / d_max - 0.5, the image that the network sees, in [-0.5, 0.5]."""
    return depth / camera.d_max - 0.5


def pose(
    links: Links,
    mount: robot.Mount,
    camera: config.Camera,
    pitch_error: Float[ArrayLike, ""],
    position_error: Float[ArrayLike, "3"],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Return position, m, and axes of the camera in the world, as `render` takes them.

    The optical axis looks camera.pitch below the mount's x axis, and `pitch_error`, rad, further
    down. The camera sits `position_error`, m along the mount's axes, from its place.
    """
    pitch = math.radians(camera.pitch) + pitch_error
    c, s = jnp.cos(pitch), jnp.sin(pitch)
    right_down_forward = jnp.array([[0.0, -1.0, 0.0], [-s, 0.0, -c], [c, 0.0, -s]])
    link, to_link = links.rotation[mount.body], jnp.asarray(mount.rotation)
    place = mount.position + geometry.rotate(to_link, jnp.asarray(position_error))
    axes = geometry.rotate(geometry.quat_multiply(link, to_link), right_down_forward)
    return links.position[mount.body] + geometry.rotate(link, place), axes.T


def capsules_in_view(links: Links, capsules: robot.Capsules) -> Float[Array, "C 7"]:
    """Return the capsules that may stand before the camera: both ends and radius, m, world."""
    seen = np.flatnonzero(capsules.in_view)
    start, end = (
        kinematics.points(links, capsules.body[seen], ends[seen])
        for ends in (capsules.start, capsules.end)
    )
    return jnp.concatenate([start, end, jnp.asarray(capsules.radius)[seen, None]], axis=1)


def is_due(
    step: Int[ArrayLike, "*n"], camera: config.Camera, control_period: float
) -> Bool[Array, "*n"]:
    """Return whether a frame arrives at this control step: 20 Hz at 50 Hz is 3, 2, 3, 2 steps.

    Whether floor(step * rate * period) differs from that of the step before, in whole numbers.
    """
    frames, steps = _frames(camera, control_period)
    return (jnp.asarray(step) % steps) * frames % steps < frames


def most_frames(steps: int, camera: config.Camera, control_period: float) -> int:
    """Return the largest number of frames that arrive in any `steps` successive control steps."""
    frames, period = _frames(camera, control_period)
    return -(-steps * frames // period)


def longest_hold(camera: config.Camera, control_period: float) -> int:
    """Return the largest number of control steps from one frame to the next."""
    frames, steps = _frames(camera, control_period)
    return -(-steps // frames)


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


class _Ray(NamedTuple):
    """A direction, for one unit of depth, and the inverses that divide by it."""

    x: Float[Array, " W"]  # columns/m
    y: Float[Array, " W"]
    z: Float[Array, " W"]  # m/m
    per_x: Float[Array, " W"]  # m/column
    per_y: Float[Array, " W"]
    per_z: Float[Array, " W"]  # m/m; 0 for a ray that does not go down


def _frames(camera: config.Camera, control_period: float) -> tuple[int, int]:
    """Return how many frames arrive in how many control steps; never more than one a step."""
    ratio = min(Fraction(camera.rate * control_period).limit_denominator(10_000), Fraction(1))
    return ratio.numerator, ratio.denominator


def _slopes(pixels: int, view: float) -> Float[np.ndarray, " n"]:
    """Return the tangents of the pixels' angles from the optical axis, `view` in deg."""
    middles = 2.0 * (np.arange(pixels) + 0.5) / pixels - 1.0
    return (middles * math.tan(math.radians(0.5 * view))).astype(np.float32)


def _eye(
    ground: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    camera: config.Camera,
) -> _Eye:
    """Return a camera in columns."""
    place = (position[:2] - ground.origin) * (1.0 / ground.cell)
    column = jnp.floor(place)
    inside = (ground.first + column.astype(jnp.int32)) & (BLOCKS[-1] - 1)
    corner = column.astype(jnp.int32) - inside
    x, y = place - column + inside.astype(jnp.float32)
    scale = jnp.array([[1.0 / ground.cell], [1.0 / ground.cell], [1.0]])
    nudge = 1.2e-6 * (_reach(ground, camera) + BLOCKS[-1])  # ten times the rounding of a float
    return _Eye(corner[0], corner[1], x, y, position[2], rotation * scale, nudge)


def _reach(ground: Terrain, camera: config.Camera) -> float:
    """Return the number of columns in the longest ray."""
    corner = [math.tan(math.radians(0.5 * view)) for view in camera.view]
    return camera.d_max * math.hypot(1.0, *corner) / ground.cell


def _sweep(
    ground: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
    camera: config.Camera,
) -> Float[Array, "H W"]:
    """Return the depth of ground that is the same all across, m, or d_max where there is none.

    Only a ray's slope along x matters, s = dz/|dx|. Seen from the camera a column hides all behind
    it up to a slope m: that to its far upper edge if it is lower than the camera, to its near one
    if not. A ray's column is the first with s <= m, and as many come before it as have a lower
    running maximum of m. The columns are those forward from the camera's own, and those backward.
    """
    to_x, to_z = (row[0] * x + row[1] * y + row[2] for row in (rotation[0], rotation[2]))
    per_x = 1.0 / jnp.maximum(jnp.abs(to_x), _ALONG * ground.cell)
    slope, forward = to_z * per_x, to_x > 0.0

    place = (position[0] - ground.origin[0]) * (1.0 / ground.cell)
    own = jnp.floor(place)
    ahead = jnp.array([1.0, -1.0])[:, None] * np.arange(int(_reach(ground, camera)) + 2.0)
    middle = ground.origin[0] + (own + ahead + 0.5) * ground.cell
    across = jnp.broadcast_to(position[1], middle.shape)
    rise = terrain.height_at(ground, jnp.stack([middle, across], axis=-1)) - position[2]
    behind = jnp.stack([place - own, own + 1.0 - place])[:, None]  # columns, of the own one
    near = jnp.maximum(jnp.abs(ahead) - behind, 0.0) * ground.cell
    far = (jnp.abs(ahead) + 1.0 - behind) * ground.cell
    hidden = jax.lax.cummax(rise / jnp.where(rise < 0.0, far, near), axis=1)

    count = near.shape[1]
    first = jnp.where(forward, 0, count)
    hidden = hidden.reshape(-1)

    def halve(k: Int[Array, ""], column: Int[Array, "H W"]) -> Int[Array, "H W"]:
        after = column + (1 << (count.bit_length() - 1) >> k)
        passed = hidden.at[first + jnp.minimum(after, count) - 1].get(mode="promise_in_bounds")
        return jnp.where((passed < slope) & (after <= count), after, column)

    # the number of columns whose running maximum is below s
    column = jax.lax.fori_loop(0, count.bit_length(), halve, jnp.zeros(slope.shape, jnp.int32))
    index = first + jnp.minimum(column, count - 1)
    of_ray = lambda values: values.reshape(-1)[index]
    top = jnp.where(slope < 0.0, of_ray(rise) / slope, 0.0)
    depth = jnp.maximum(of_ray(near), top) * per_x
    seen = (column < count) & (depth < camera.d_max)  # not NaN, either
    return jnp.where(seen, depth, camera.d_max)


def _march(
    ground: Terrain,
    eye: _Eye,
    x: Float[np.ndarray, " W"],
    y: Float[Array, ""],
    camera: config.Camera,
) -> Float[Array, " W"]:
    """Return the depth of the ground along one row of rays, m, or d_max where there is none."""
    state = jnp.full(x.shape, len(BLOCKS) - 1, jnp.int32)
    # a ray crosses two borders a column at most, and may go down through all levels before each
    most = int(2 * len(BLOCKS) * (_reach(ground, camera) + 2))
    farthest = int(np.float32(camera.d_max).view(np.int32))

    def is_short(carry: tuple) -> Bool[Array, ""]:
        count, _, state = carry  # a state below zero is large without its sign
        return (count < most) & jnp.any(state.astype(jnp.uint32) < farthest)

    def advance(carry: tuple) -> tuple:
        count, axes, state = carry
        following = _advance(ground, eye, _ray(eye._replace(axes=axes), x, y), state)
        # as if the axes changed: or XLA would store all rays, and reading them takes longer
        return count + 1, jnp.where(count < most, axes, 0.0), following

    _, _, state = jax.lax.while_loop(is_short, advance, (0, eye.axes, state))
    depth = -jax.lax.bitcast_convert_type(state, jnp.float32)
    return jnp.where((state < 0) & (depth < camera.d_max), depth, camera.d_max)  # not NaN, either


def _ray(eye: _Eye, x: Float[np.ndarray, " W"], y: Float[Array, ""]) -> _Ray:
    """Return the rays of a row of pixels."""
    to_x, to_y, to_z = (row[0] * x + row[1] * y + row[2] for row in eye.axes)
    to_x = jnp.where(jnp.abs(to_x) < _ALONG, _ALONG, to_x)
    to_y = jnp.where(jnp.abs(to_y) < _ALONG, _ALONG, to_y)
    down = jnp.where(to_z < 0.0, 1.0 / to_z, 0.0)
    return _Ray(to_x, to_y, to_z, 1.0 / to_x, 1.0 / to_y, down)


def _advance(ground: Terrain, eye: _Eye, ray: _Ray, state: Int[Array, " W"]) -> Int[Array, " W"]:
    """Return the state of each ray one block further, or one level down, or at the ground.

    The state is a depth and the level of BLOCKS to look at there, in one number: XLA makes a loop
    for each result and would do everything twice for two. It stays as it is once it is negative:
    then the depth is that of the ground.
    """
    depth, level = _depth(state), state & _LEVEL
    east, north = ray.x > 0.0, ray.y > 0.0
    i = jnp.floor(depth * ray.x + jnp.where(east, eye.x + eye.nudge, eye.x - eye.nudge))
    j = jnp.floor(depth * ray.y + jnp.where(north, eye.y + eye.nudge, eye.y - eye.nudge))
    i, j = i.astype(jnp.int32), j.astype(jnp.int32)
    top, is_level = block_top(ground, level, eye.i + i, eye.j + j)

    side = _of_level(level, BLOCKS)
    border_x = (i & -side) + jnp.where(east, side, 0)
    border_y = (j & -side) + jnp.where(north, side, 0)
    depth_x = (border_x.astype(jnp.float32) - eye.x) * ray.per_x
    depth_y = (border_y.astype(jnp.float32) - eye.y) * ray.per_y
    out = jnp.minimum(depth_x, depth_y)
    lowest = eye.z + ray.z * jnp.where(ray.z < 0.0, out, depth)

    border = jnp.where(depth_x <= depth_y, border_x, border_y)
    after = jnp.zeros_like(level)  # the level of the largest block that begins at this border
    for k, larger in enumerate(BLOCKS):
        after = jnp.where(border & (larger - 1) == 0, k, after)
    hit = jnp.maximum(depth, (top - eye.z) * ray.per_z)  # on its side, or on its top
    following = jnp.where(lowest <= top, state - 1, (_bits(out) & ~_LEVEL) | after)
    following = jnp.where(state < 0, state, following)
    # the state itself must not be what this last choice offers: so vmap's choice between it and the
    # result, one for a row, stays a branch around all of the above for rows that are done
    return jnp.where((lowest <= top) & is_level & (state >= 0), _bits(-hit), following)


def _of_level(level: Int[Array, "*n"], values: tuple[int, ...]) -> Int[Array, "*n"]:
    """Return the value of each ray's level."""
    chosen = jnp.full_like(level, values[0])
    for k, value in enumerate(values[1:], start=1):
        chosen = jnp.where(level == k, value, chosen)
    return chosen


def _depth(state: Int[Array, "*n"]) -> Float[Array, "*n"]:
    """Return the depth in a march's state, m; rounded to 2 um at 3 m."""
    return jax.lax.bitcast_convert_type(state & ~_LEVEL, jnp.float32)


def _bits(depth: Float[Array, "*n"]) -> Int[Array, "*n"]:
    """Return the bits of a depth; as an integer a depth below zero, -0 too, is below zero."""
    return jax.lax.bitcast_convert_type(depth, jnp.int32)


def _links(
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    capsules: Float[Array, "C 7"],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
) -> Float[Array, "H W"]:
    """Return the depth of the nearest capsule along each ray d = (x, y, 1), m, or infinity."""
    # highest: a GPU would round the factors to 10 bits
    turn = lambda v: jnp.matmul(v, rotation, precision=jax.lax.Precision.HIGHEST)
    start = turn(capsules[:, :3] - position)  # m, in the camera's frame
    axis = turn(capsules[:, 3:6] - capsules[:, :3])
    length = jnp.sqrt(jnp.sum(axis * axis, axis=1))
    axis = axis / jnp.maximum(length, geometry.SMALL)[:, None]
    nearest = jnp.full((y.size, x.size), jnp.inf)
    for c in range(capsules.shape[0]):
        hit = _capsule(start[c], axis[c], length[c], capsules[c, 6], x, y)
        nearest = jnp.minimum(nearest, hit)
    return nearest


def _capsule(
    start: Float[Array, "3"],
    axis: Float[Array, "3"],
    length: Float[Array, ""],
    radius: Float[Array, ""],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
) -> Float[Array, "H W"]:
    """Return where rays from the origin meet a capsule first, m of depth, or infinity.

    A ray enters the endless cylinder at t, from |t d - start|^2 - (axis . (t d - start))^2 = r^2.
    The sphere inside of the capsule there, or at the nearer end, is where it enters the capsule.
    """
    d_d = x * x + y * y + 1.0
    d_axis = x * axis[0] + y * axis[1] + axis[2]
    d_start = x * start[0] + y * start[1] + start[2]
    along = jnp.sum(start * axis)
    square = jnp.sum(start * start) - radius * radius

    a = jnp.maximum(d_d - d_axis * d_axis, _PARALLEL)
    b = d_start - along * d_axis
    t = (b - jnp.sqrt(jnp.maximum(b * b - a * (square - along * along), 0.0))) / a
    at = jnp.clip(t * d_axis - along, 0.0, length)  # m along the axis, the sphere's centre

    d_centre = d_start + at * d_axis
    rest = d_centre * d_centre - d_d * (square + at * (2.0 * along + at))
    depth = (d_centre - jnp.sqrt(jnp.maximum(rest, 0.0))) / d_d
    return jnp.where((rest >= 0.0) & (depth > 0.0), depth, jnp.inf)
