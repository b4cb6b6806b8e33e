"""Depth images of the ground and the robot's own links.

Depth is measured along the optical axis, as by a RealSense (Sec. II-D). Frames: the camera's x
right, y down, z forward; pixel (0, 0) is at the top left.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from cref_jax import config, geometry, robot
from cref_jax.depth import raymarch, sweep
from cref_jax.robot import kinematics
from cref_jax.robot.kinematics import Links
from cref_jax.terrain import Terrain

_PARALLEL = 1e-9  # lower bound of the sine squared of the angle between a ray and a capsule


def render(
    terrain: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    capsules: Float[Array, "C 7"],
    camera: config.Camera,
    is_profile: bool = False,
) -> Float[Array, "H W"]:
    """Render the depth image of one camera, m.

    The columns of `rotation` are the camera's axes in the world; a capsule is two ends and a
    radius, m, in the world. Rays that hit nothing within d_max read d_max. A camera inside the
    ground reads 0; a capsule around the camera is invisible.

    `is_profile` promises that heights are constant across the lane (along y), as on stairs: the
    image is the same, but faster to render.
    """
    x, y = _pixel_rays(camera)
    if is_profile:
        ground = sweep.profile_depth(terrain, position, rotation, x, y, camera)
    else:
        ground = raymarch.ground_depth(terrain, position, rotation, x, y, camera)
    links = render_capsules(position, rotation, capsules, camera)
    return jnp.minimum(jnp.minimum(ground, links), camera.d_max)


def locate_pixels(
    metres: Float[Array, "H W"],
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    camera: config.Camera,
) -> tuple[Float[Array, "H W"], Float[Array, "H W"], Float[Array, "H W"]]:
    """Compute where in the world the pixels of a depth image lie: x, y and z, m."""
    x, y = _pixel_rays(camera)
    along, aside, up = (
        start + metres * (row[0] * x + row[1] * y + row[2])
        for start, row in zip(position, rotation, strict=True)
    )
    return along, aside, up


def capsules_in_view(links: Links, capsules: robot.Capsules) -> Float[Array, "C 7"]:
    """Compute both ends and the radius of each capsule that the camera may see, m, world."""
    visible = np.flatnonzero(capsules.in_view)
    start, end = (
        kinematics.points(links, capsules.body[visible], ends[visible])
        for ends in (capsules.start, capsules.end)
    )
    return jnp.concatenate([start, end, jnp.asarray(capsules.radius)[visible, None]], axis=1)


def _pixel_rays(
    camera: config.Camera,
) -> tuple[Float[np.ndarray, "1 W"], Float[np.ndarray, "H 1"]]:
    """Compute x and y of the ray of each pixel, d = (x, y, 1), in the camera's frame."""
    height, width = camera.shape
    x, y = _pixel_slopes(width, camera.view[1]), _pixel_slopes(height, camera.view[0])
    return x[None, :], y[:, None]


def _pixel_slopes(pixels: int, view: float) -> Float[np.ndarray, " n"]:
    """Compute the tangents of the pixels' angles from the optical axis; `view` in deg."""
    middles = 2.0 * (np.arange(pixels) + 0.5) / pixels - 1.0
    return (middles * math.tan(math.radians(0.5 * view))).astype(np.float32)


def render_capsules(
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    capsules: Float[Array, "C 7"],
    camera: config.Camera,
) -> Float[Array, "H W"]:
    """Render the depth of the nearest capsule, m, as `render` does; infinity where none is."""
    x, y = _pixel_rays(camera)
    # highest precision: a GPU would otherwise round the factors to 10 bits
    turn = lambda v: jnp.matmul(v, rotation, precision=jax.lax.Precision.HIGHEST)
    start = turn(capsules[:, :3] - position)  # m, in the camera's frame
    axis = turn(capsules[:, 3:6] - capsules[:, :3])
    length = jnp.sqrt(jnp.sum(axis * axis, axis=1))
    axis = axis / jnp.maximum(length, geometry.SMALL)[:, None]
    nearest = jnp.full((y.size, x.size), jnp.inf)
    for c in range(capsules.shape[0]):
        hit = _intersect_capsule(start[c], axis[c], length[c], capsules[c, 6], x, y)
        nearest = jnp.minimum(nearest, hit)
    return nearest


def _intersect_capsule(
    start: Float[Array, "3"],
    axis: Float[Array, "3"],
    length: Float[Array, ""],
    radius: Float[Array, ""],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
) -> Float[Array, "H W"]:
    """Compute the depth at which rays from the origin enter a capsule, m, or infinity.

    A ray enters the infinite cylinder at t, from |t d - start|^2 - (axis . (t d - start))^2 = r^2.
    It enters the capsule where it enters the sphere centred there, or at the nearer end.
    """
    d_d = x * x + y * y + 1.0
    d_axis = x * axis[0] + y * axis[1] + axis[2]
    d_start = x * start[0] + y * start[1] + start[2]
    along = jnp.sum(start * axis)
    square = jnp.sum(start * start) - radius * radius

    a = jnp.maximum(d_d - d_axis * d_axis, _PARALLEL)
    b = d_start - along * d_axis
    t = (b - jnp.sqrt(jnp.maximum(b * b - a * (square - along * along), 0.0))) / a
    at = jnp.clip(t * d_axis - along, 0.0, length)  # m along the axis, centre of the sphere

    d_centre = d_start + at * d_axis
    rest = d_centre * d_centre - d_d * (square + at * (2.0 * along + at))
    depth = (d_centre - jnp.sqrt(jnp.maximum(rest, 0.0))) / d_d
    return jnp.where((rest >= 0.0) & (depth > 0.0), depth, jnp.inf)
