"""The robot and the world in a mirror that stands along its way: left becomes right.

y and the rotations about x and z change sign, left joints and feet change places with right ones,
and images are turned over. The robot and every lane that is level across are their own mirror
image, so what a state does in a step is what its mirror image does, mirrored.
"""

import functools
from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Float16, Int

from cref_jax import config, network
from cref_jax.env import observations
from cref_jax.physics.records import Body
from cref_jax.ppo import Mirror

POLAR = np.array([1.0, -1.0, 1.0], np.float32)  # of a velocity, a force, a place
AXIAL = np.array([-1.0, 1.0, -1.0], np.float32)  # of a rotation
ROTATION = np.array([1.0, -1.0, 1.0, -1.0], np.float32)  # of a quaternion w, x, y, z
COMMAND = np.array([1.0, -1.0, -1.0], np.float32)  # m/s ahead, m/s to the left, rad/s to the left


class Joints(NamedTuple):
    """Which joint each one becomes, and with which sign."""

    partner: Int[np.ndarray, " M"]
    sign: Float[np.ndarray, " M"]

    def flipped(self, values: Float[Array, "*n J"]) -> Float[Array, "*n J"]:
        """Return angles, rates or actions of the first J joints, mirrored."""
        first = values.shape[-1]
        return values[..., self.partner[:first]] * self.sign[:first]


def joints(model: mujoco.MjModel) -> Joints:
    """Read the partner of each hinge off its name, and the sign off both axes.

    Raises:
        ValueError: a joint has no partner, or one that does not turn about the mirrored axis.
    """
    names = [model.joint(j).name for j in range(1, model.njnt)]  # joint 0 is the pelvis's freejoint
    swapped = [_other_side(name) for name in names]
    if missing := sorted(set(swapped) - set(names)):
        raise ValueError(f"the model is not its own mirror image: it has no {missing[0]}")
    partner = np.array([names.index(name) for name in swapped])
    axes = model.jnt_axis[1:]
    sign = np.sum(AXIAL * axes * axes[partner], axis=1)
    if not np.allclose(np.abs(sign), 1.0, atol=1e-6):
        raise ValueError(f"{names[int(np.abs(sign).argmin())]} does not turn about a mirrored axis")
    return Joints(partner, np.sign(sign).astype(np.float32))


def of(model: mujoco.MjModel, c: config.Network) -> Mirror:
    """Return the mirror of this robot for the actor of this network."""
    legs = joints(model)
    turned = functools.partial(frame, c=c)
    return Mirror(
        obs=lambda seen: proprioception(seen, legs),
        frames=turned,
        sight=lambda sight: sight and sight.replace(frames=turned(sight.frames)),
        action=legs.flipped,
    )


def body(state: Body, of: Joints) -> Body:
    """Return the mirror image of a state."""
    q, v, w = state.qpos, state.qvel, state.warmstart
    speeds = lambda x: jnp.concatenate([POLAR * x[:3], AXIAL * x[3:6], of.flipped(x[6:])])
    place = jnp.concatenate([POLAR * q[:3], ROTATION * q[3:7], of.flipped(q[7:])])
    return Body(place, speeds(v), speeds(w))


def proprioception(seen: Float[Array, "*n O"], of: Joints) -> Float[Array, "*n O"]:
    """Return M o^p: what the robot's mirror image senses."""
    where = observations.slices(observations.num_joints_of(seen.shape[-1]))
    signs = {"angular_velocity": AXIAL, "gravity": POLAR, "command": COMMAND}
    parts = [
        signs[name] * seen[..., part] if name in signs else of.flipped(seen[..., part])
        for name, part in where.items()
    ]
    return jnp.concatenate(parts, axis=-1)


def frame(
    seen: Float16[Array, "*n rows columns pixels"], c: config.Network
) -> Float16[Array, "*n rows columns pixels"]:
    """Return what the mirror image's camera sees, in the order in which the network reads it."""
    return network.in_patches(c, jnp.flip(network.as_image(c, seen), axis=-1))


def scan(heights: Float[Array, "*n M"], c: config.Scan) -> Float[Array, "*n M"]:
    """Return the critic's heights m_t around the mirror image."""
    grid = heights.reshape(*heights.shape[:-1], c.x[2], c.y[2])
    return jnp.flip(grid, axis=-1).reshape(heights.shape)


def _other_side(name: str) -> str:
    left, right = name.startswith("left_"), name.startswith("right_")
    return f"right_{name[5:]}" if left else f"left_{name[6:]}" if right else name
