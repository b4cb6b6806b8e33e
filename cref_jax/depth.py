"""The depth camera: what it sees of the ground and of the robot's own links, and when.

The image is the distance along the optical axis, as a RealSense reports it (Sec. II-D). Frames: the
camera's x right, y down, z forward; pixel (0, 0) is at the top left.
"""

import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cref_jax import config, geometry, march, robot, terrain
from cref_jax.robot import kinematics
from cref_jax.robot.kinematics import Links
from cref_jax.terrain import Terrain

_ALONG = 1e-6  # columns/m, no ray is more nearly parallel to the border of a column
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
    the same, and comes sooner.
    """
    height, width = camera.shape
    x, y = _slopes(width, camera.view[1])[None, :], _slopes(height, camera.view[0])[:, None]
    if is_profile:
        ground = _sweep(terrain, position, rotation, x, y, camera)
    else:
        ground = march.ground_depth(terrain, position, rotation, x, y, camera)
    links = _links(position, rotation, capsules, x, y)
    return jnp.minimum(jnp.minimum(ground, links), camera.d_max)


def nearest_around(depth: Float[Array, "H W"], window: int) -> Float[Array, "H W"]:
    """Return the nearest depth of the `window` x `window` pixels around each, at the rims of fewer.

    A stereo camera matches squares: what stands before a hole smaller than one covers it.
    """
    for axis, size in enumerate(depth.shape):
        reach = window // 2
        wide = jnp.pad(
            depth,
            [(reach, reach) if k == axis else (0, 0) for k in (0, 1)],
            constant_values=jnp.inf,
        )
        shifted = [jax.lax.slice_in_dim(wide, k, k + size, axis=axis) for k in range(window)]
        depth = functools.reduce(jnp.minimum, shifted)
    return depth


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


def _frames(camera: config.Camera, control_period: float) -> tuple[int, int]:
    """Return how many frames arrive in how many control steps; never more than one a step."""
    ratio = min(Fraction(camera.rate * control_period).limit_denominator(10_000), Fraction(1))
    return ratio.numerator, ratio.denominator


def _slopes(pixels: int, view: float) -> Float[np.ndarray, " n"]:
    """Return the tangents of the pixels' angles from the optical axis, `view` in deg."""
    middles = 2.0 * (np.arange(pixels) + 0.5) / pixels - 1.0
    return (middles * math.tan(math.radians(0.5 * view))).astype(np.float32)


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
    ahead = jnp.array([1.0, -1.0])[:, None] * np.arange(int(march.ray_reach(ground, camera)) + 2.0)
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
