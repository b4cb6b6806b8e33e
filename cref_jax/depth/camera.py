"""The depth camera: its pose, the timing of its frames, and their normalisation."""

import functools
import math
from fractions import Fraction

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cref_jax import config, geometry, robot
from cref_jax.robot.kinematics import Links


def min_filter(depth: Float[Array, "H W"], window: int) -> Float[Array, "H W"]:
    """Compute the minimum depth over the `window` x `window` pixels around each; fewer at the rims.

    A stereo camera matches squares: anything in front of a hole smaller than one square hides it.
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


def normalize(depth: Float[Array, "*n H W"], camera: config.Camera) -> Float[Array, "*n H W"]:
    """Compute D / d_max - 0.5, the network's input image, in [-0.5, 0.5]."""
    return depth / camera.d_max - 0.5


def pose(
    links: Links,
    mount: robot.Mount,
    camera: config.Camera,
    pitch_error: Float[ArrayLike, ""],
    position_error: Float[ArrayLike, "3"],
) -> tuple[Float[Array, "3"], Float[Array, "3 3"]]:
    """Compute the camera's position, m, and axes in the world, the inputs of `render`.

    The optical axis points camera.pitch, deg, below the mount's x axis, and `pitch_error`, rad,
    further down. `position_error`, m, shifts the camera along the mount's axes.
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
    """Check whether a frame arrives at this control step; 20 Hz at 50 Hz: every 3, 2, 3, 2 steps.

    True where floor(step * rate * period) increases, in integer arithmetic.
    """
    frames, steps = _frame_ratio(camera, control_period)
    return (jnp.asarray(step) % steps) * frames % steps < frames


def max_frames(steps: int, camera: config.Camera, control_period: float) -> int:
    """Compute the maximum number of frames in any `steps` successive control steps."""
    frames, period = _frame_ratio(camera, control_period)
    return -(-steps * frames // period)


def longest_hold(camera: config.Camera, control_period: float) -> int:
    """Compute the maximum number of control steps from one frame to the next."""
    frames, steps = _frame_ratio(camera, control_period)
    return -(-steps // frames)


def _frame_ratio(camera: config.Camera, control_period: float) -> tuple[int, int]:
    """Compute (frames, steps), the ratio of frames to control steps; at most one frame per step."""
    ratio = min(Fraction(camera.rate * control_period).limit_denominator(10_000), Fraction(1))
    return ratio.numerator, ratio.denominator
