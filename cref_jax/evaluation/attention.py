"""What lies in a depth image where attention may look: edges of the ground, by pixel and by token.

N tokens stand for equal blocks of pixels, row by row from the top left.
"""

import math

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cref_jax import depth
from cref_jax.config import Camera, Config
from cref_jax.env.state import EnvState
from cref_jax.env.world import World
from cref_jax.robot import kinematics

EDGE = 0.03  # m off the plane of the neighbours; assumed: above rounding and a slope's columns
LINK = 0.02  # m nearer than the ground; assumed: above the rounding of 16 bits


def grid(c: Config) -> tuple[int, int]:
    """Return the rows and columns of the tokens."""
    shrink = math.prod(stride for _, _, stride in c.network.convolutions)
    return c.camera.shape[0] // shrink, c.camera.shape[1] // shrink


def ground_alone(world: World, state: EnvState) -> Float[Array, "H W"]:
    """Return one robot's depth image without its own links, m."""
    robot, camera = world.physics.robot, world.config.camera
    links = world.physics.links(state.body)
    position, rotation = depth.pose(
        links, robot.camera, camera, state.camera_pitch, state.camera_shift
    )
    ground = world.lanes.tile(state.level, state.kind, state.variant)
    return depth.render(ground, position, rotation, jnp.zeros((0, 7)), camera)


def is_edge(metres: Float[Array, "*n H W"], camera: Camera) -> Bool[Array, "*n H W"]:
    """Return which pixels lie more than EDGE off the plane of their neighbours, up-down or across.

    On a plane 1 / depth is linear over the image. What is beyond d_max reads d_max: where a plane
    only leaves the range, one side of a pixel foretells the other, and it is no edge.
    """
    least = 1.0 / camera.d_max
    w = 1.0 / jnp.maximum(metres, 1e-3)

    def off(axis: int) -> Float[Array, "*n H W"]:
        a, b, c = (jnp.roll(w, shift, axis) for shift in (1, 0, -1))
        onward = jnp.abs(jnp.maximum(2.0 * b - a, least) - c)
        back = jnp.abs(jnp.maximum(2.0 * b - c, least) - a)
        inner = np.zeros(w.shape[axis], bool)
        inner[1:-1] = True
        inner = jnp.asarray(inner).reshape((-1, 1) if axis == -2 else (1, -1))
        return jnp.where(inner & (b > least * 1.001), jnp.minimum(onward, back) / (b * b), 0.0)

    return jnp.maximum(off(-2), off(-1)) > EDGE


def in_tokens(pixels: Bool[Array, "*n H W"], shape: tuple[int, int]) -> Bool[Array, "*n N"]:
    """Return which tokens have such a pixel, row by row from the top left."""
    *lead, height, width = pixels.shape
    blocks = pixels.reshape(*lead, shape[0], height // shape[0], shape[1], width // shape[1])
    return blocks.any(axis=(-3, -1)).reshape(*lead, -1)


def shares(
    attention: Float[np.ndarray, "F N"], tokens: Bool[np.ndarray, "F N"]
) -> tuple[float, float]:
    """Return the share of the tokens, and that of the attention on them; means over the frames."""
    return float(tokens.mean()), float((attention * tokens).sum(axis=1).mean())


def upsampled(
    weights: Float[np.ndarray, " N"], shape: tuple[int, int], image: tuple[int, int]
) -> Float[np.ndarray, "H W"]:
    """Return each token's weight spread evenly over its pixels: the sum stays."""
    block = (image[0] // shape[0], image[1] // shape[1])
    return np.kron(weights.reshape(shape), np.ones(block)) / (block[0] * block[1])


def ahead(world: World) -> Float[np.ndarray, " rows"]:
    """Return where the middle of each row of tokens meets level ground, m before the pelvis.

    The robot stands at its nominal pose.
    """
    robot, camera = world.physics.robot, world.config.camera
    base = [0.0, 0.0, robot.standing_height, 1.0, 0.0, 0.0, 0.0]
    qpos = jnp.concatenate([jnp.array(base), jnp.asarray(robot.rest_pose)])
    links = kinematics.links(world.physics.tree, qpos, jnp.zeros(qpos.size - 1))
    position, axes = depth.pose(links, robot.camera, camera, 0.0, jnp.zeros(3))
    count, _ = grid(world.config)
    middle = 2.0 * (np.arange(count) + 0.5) / count - 1.0
    slope = middle * np.tan(np.deg2rad(0.5 * camera.view[0]))
    rays = np.asarray(axes) @ np.stack([np.zeros(count), slope, np.ones(count)])
    at, eye = -float(position[2]) / rays[2], float(position[0])
    return np.where(at > 0.0, eye + at * rays[0], np.inf)
