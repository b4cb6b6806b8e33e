"""Faults of a depth camera: noise, a wrong scale, dead columns, holes and a narrower view.

What is missing is filled in from around it, as the runtime does on the robot. Faults are drawn from
where the episode began, as structures are, so that the state holds nothing of them.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from cref_jax import config
from cref_jax.env import structures
from cref_jax.env.state import EnvState
from cref_jax.env.world import World

REGIONS = 3  # holes at a time; assumed
REGION_STEPS = 25  # control steps that they last, 0.5 s; assumed


def has_faults(c: config.Randomisation) -> bool:
    """Check whether images have any faults."""
    most = c.depth_noise, c.depth_scale, c.depth_dead, c.depth_holes, c.narrow_view
    return c.enabled and any(most)


def misread(world: World, state: EnvState, depth: Float[Array, "H W"]) -> Float[Array, "H W"]:
    """Compute what a camera with this episode's faults reports of a depth image, m, holes filled.

    Their size is drawn up to `state.spread.camera` of the settings.
    """
    c, far = world.config.randomisation, world.config.camera.d_max
    keys = jax.random.split(structures.episode_key(world, state, salt=1), 5)
    u = state.spread.camera * jax.random.uniform(keys[0], (4,), minval=jnp.array([0, -1, 0, 0]))
    grain = jax.random.normal(jax.random.fold_in(keys[1], state.step), depth.shape)
    read = (1.0 + c.depth_scale * u[1]) * depth + c.depth_noise * u[0] * depth**2 * grain
    read = jnp.where(depth < far, jnp.clip(read, 0.0, far), far)
    dead = jax.random.uniform(keys[2], depth.shape[1:]) < c.depth_dead * u[2]
    period = jax.random.fold_in(keys[3], state.step // REGION_STEPS)
    holes = sample_holes(period, depth.shape, c.depth_holes * u[3])
    is_narrow = jax.random.uniform(keys[4]) < c.narrow_view * state.spread.camera
    known = (read > 0.0) & ~dead & ~holes & ~(is_narrow & _outside_narrow_view(world.config.camera))
    # 1 / depth of a plane is linear in the image
    return jnp.where(known, read, 1.0 / fill_holes(1.0 / read, known))


def sample_holes(
    key: PRNGKeyArray, shape: tuple[int, ...], share: Float[Array, ""]
) -> Bool[Array, "H W"]:
    """Draw ellipses that cover at most `share` of an image, each as much as the others."""
    centre, form = jax.random.uniform(key, (2, REGIONS, 2))
    aspect = 2.0 ** (2.0 * form[:, 0] - 1.0)  # height / width, from 1/2 to 2
    width = jnp.sqrt(share * math.prod(shape) / (REGIONS * math.pi * aspect))
    pixels = jnp.stack(jnp.mgrid[: shape[0], : shape[1]], axis=-1) + 0.5
    away = pixels - (centre * jnp.array(shape))[:, None, None]
    size = jnp.maximum(jnp.stack([width * aspect, width], axis=-1), 1e-6)[:, None, None]
    return (jnp.square(away / size).sum(axis=-1) < 1.0).any(axis=0)


def fill_holes(values: Float[Array, "H W"], known: Bool[Array, "H W"]) -> Float[Array, "H W"]:
    """Interpolate an image linearly between known pixels: along rows, then columns."""
    lines = jax.vmap(_interpolate)(values, known)
    return jax.vmap(_interpolate, in_axes=(1, None), out_axes=1)(lines, known.any(axis=1))


def _interpolate(values: Float[Array, " N"], known: Bool[Array, " N"]) -> Float[Array, " N"]:
    """Interpolate linearly between known values; beyond the outermost, they go on."""
    count = values.size
    at = jnp.arange(count)
    before = jax.lax.cummax(jnp.where(known, at, -1))
    after = jax.lax.cummin(jnp.where(known, at, count), reverse=True)
    left = jnp.clip(jnp.where(before < 0, after, before), 0, count - 1)
    right = jnp.clip(jnp.where(after == count, before, after), 0, count - 1)
    share = (at - left) / jnp.maximum(right - left, 1)
    return jnp.where(known, values, (1.0 - share) * values[left] + share * values[right])


def _outside_narrow_view(camera: config.Camera) -> Bool[np.ndarray, "H W"]:
    """Compute the mask of pixels that a stream of 4:3 does not show."""
    tangent = lambda angle: math.tan(math.radians(0.5 * angle))
    rows, columns = (
        np.abs((2.0 * np.arange(count) + 1.0) / count - 1.0) * tangent(ours) > tangent(theirs)
        for count, ours, theirs in zip(camera.shape, camera.view, config.NARROW_VIEW, strict=True)
    )
    return rows[:, None] | columns
