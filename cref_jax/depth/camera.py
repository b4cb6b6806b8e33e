"""The depth camera: where it is, when its frames come, and how they are normalised."""

import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cref_jax import config, geometry, robot
from cref_jax.robot.kinematics import Links


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
