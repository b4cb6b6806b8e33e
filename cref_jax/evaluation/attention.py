"""Ground edges and self-occlusion in a depth image, per pixel and per token.

The N tokens cover equal blocks of pixels, row by row from the top left.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cref_jax import depth
from cref_jax.config import Camera, Config
from cref_jax.env.world import World
from cref_jax.robot import kinematics

EDGE = 0.03  # m off the plane of the neighbours; assumed: above rounding and a slope's columns
LINK = 0.02  # m nearer than the ground; assumed: above 16-bit rounding


def token_grid(c: Config) -> tuple[int, int]:
    """Compute the number of token rows and columns."""
    shrink = math.prod(stride for _, _, stride in c.network.convolutions)
    return c.camera.shape[0] // shrink, c.camera.shape[1] // shrink


def is_edge(metres: Float[Array, "*n H W"], camera: Camera) -> Bool[Array, "*n H W"]:
    """Mark pixels more than EDGE off the plane of their neighbours in the row or the column.

    On a plane 1 / depth is linear over the image. Depth beyond d_max reads d_max: where a plane
    only leaves the range, one side of a pixel predicts the other, so it is not an edge.
    """
    least = 1.0 / camera.d_max
    w = 1.0 / jnp.maximum(metres, 1e-3)

    def deviation(axis: int) -> Float[Array, "*n H W"]:
        a, b, c = (jnp.roll(w, shift, axis) for shift in (1, 0, -1))
        forward = jnp.abs(jnp.maximum(2.0 * b - a, least) - c)
        backward = jnp.abs(jnp.maximum(2.0 * b - c, least) - a)
        inner = np.zeros(w.shape[axis], bool)
        inner[1:-1] = True
        inner = jnp.asarray(inner).reshape((-1, 1) if axis == -2 else (1, -1))
        return jnp.where(inner & (b > least * 1.001), jnp.minimum(forward, backward) / (b * b), 0.0)

    return jnp.maximum(deviation(-2), deviation(-1)) > EDGE


def pool_to_tokens(pixels: Bool[Array, "*n H W"], shape: tuple[int, int]) -> Bool[Array, "*n N"]:
    """Mark tokens with at least one marked pixel, row by row from the top left."""
    *lead, height, width = pixels.shape
    blocks = pixels.reshape(*lead, shape[0], height // shape[0], shape[1], width // shape[1])
    return blocks.any(axis=(-3, -1)).reshape(*lead, -1)


def compute_shares(
    attention: Float[np.ndarray, "F N"], tokens: Bool[np.ndarray, "F N"]
) -> tuple[float, float]:
    """Compute the marked share of all tokens and of the attention; means over the frames."""
    return float(tokens.mean()), float((attention * tokens).sum(axis=1).mean())


def upsample(
    weights: Float[np.ndarray, " N"], shape: tuple[int, int], image: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """Spread each token's weight evenly over its pixels, preserving the sum."""
    block = (image[0] // shape[0], image[1] // shape[1])
    return np.kron(weights.reshape(shape), np.ones(block)) / (block[0] * block[1])


def ground_distances(world: World) -> Float[np.ndarray, " rows"]:
    """Compute where the centre of each token row meets level ground, m ahead of the pelvis.

    The robot stands in its nominal pose.
    """
    robot, camera = world.physics.robot, world.config.camera
    base = [0.0, 0.0, robot.standing_height, 1.0, 0.0, 0.0, 0.0]
    qpos = jnp.concatenate([jnp.array(base), jnp.asarray(robot.rest_pose)])
    links = kinematics.links(world.physics.tree, qpos, jnp.zeros(qpos.size - 1))
    position, axes = depth.pose(links, robot.camera, camera, 0.0, jnp.zeros(3))
    count, _ = token_grid(world.config)
    middle = 2.0 * (np.arange(count) + 0.5) / count - 1.0
    slope = middle * np.tan(np.deg2rad(0.5 * camera.view[0]))
    rays = np.asarray(axes) @ np.stack([np.zeros(count), slope, np.ones(count)])
    at, eye = -float(position[2]) / rays[2], float(position[0])
    return np.where(at > 0.0, eye + at * rays[0], np.inf)
