"""Reflection of the robot and the world in the sagittal plane: left becomes right.

y and the rotations about x and z change sign, left joints and feet swap with right ones, and images
are flipped left to right. The robot and every lane that is level across are symmetric, so stepping
commutes with mirroring.
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

POLAR = np.array([1.0, -1.0, 1.0], np.float32)  # signs of a velocity, force or position
AXIAL = np.array([-1.0, 1.0, -1.0], np.float32)  # signs of a rotation
ROTATION = np.array([1.0, -1.0, 1.0, -1.0], np.float32)  # signs of a quaternion w, x, y, z
COMMAND = np.array([1.0, -1.0, -1.0], np.float32)  # m/s ahead, m/s to the left, rad/s to the left


class JointPairs(NamedTuple):
    """The mirrored partner and sign of each joint."""

    partner: Int[np.ndarray, " M"]
    sign: Float[np.ndarray, " M"]

    def flip(self, values: Float[Array, "*n J"]) -> Float[Array, "*n J"]:
        """Mirror angles, rates or actions of the first J joints."""
        first = values.shape[-1]
        return values[..., self.partner[:first]] * self.sign[:first]


def pair_joints(model: mujoco.MjModel) -> JointPairs:
    """Pair each hinge with its partner by name, and derive the sign from both axes.

    Raises:
        ValueError: a joint has no partner, or the partner's axis is not the mirrored one.
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
    return JointPairs(partner, np.sign(sign).astype(np.float32))


def make_mirror(model: mujoco.MjModel, c: config.Network) -> Mirror:
    """Build the reflections of this robot's observations and actions for this network."""
    joints = pair_joints(model)
    flip_frame = functools.partial(frame, c=c)
    return Mirror(
        obs=lambda obs: proprioception(obs, joints),
        frames=flip_frame,
        sight=lambda sight: sight and sight.replace(frames=flip_frame(sight.frames)),
        action=joints.flip,
    )


def body(state: Body, of: JointPairs) -> Body:
    """Mirror a state."""
    q, v, w = state.qpos, state.qvel, state.warmstart
    speeds = lambda x: jnp.concatenate([POLAR * x[:3], AXIAL * x[3:6], of.flip(x[6:])])
    place = jnp.concatenate([POLAR * q[:3], ROTATION * q[3:7], of.flip(q[7:])])
    return Body(place, speeds(v), speeds(w))


def proprioception(obs: Float[Array, "*n O"], of: JointPairs) -> Float[Array, "*n O"]:
    """Compute M o^p, the mirrored proprioception."""
    where = observations.slices(observations.num_joints_of(obs.shape[-1]))
    signs = {"angular_velocity": AXIAL, "gravity": POLAR, "command": COMMAND}
    parts = [
        signs[name] * obs[..., part] if name in signs else of.flip(obs[..., part])
        for name, part in where.items()
    ]
    return jnp.concatenate(parts, axis=-1)


def frame(
    frames: Float16[Array, "*n rows columns pixels"], c: config.Network
) -> Float16[Array, "*n rows columns pixels"]:
    """Mirror depth frames, keeping the network's patch order.

    A camera that is not in the robot's middle is taken to be as far on the other side.
    """
    return network.image_to_patches(c, jnp.flip(network.patches_to_image(c, frames), axis=-1))


def scan(heights: Float[Array, "*n M"], c: config.Scan) -> Float[Array, "*n M"]:
    """Mirror the critic's heights m_t around the robot."""
    grid = heights.reshape(*heights.shape[:-1], c.x[2], c.y[2])
    return jnp.flip(grid, axis=-1).reshape(heights.shape)


def _other_side(name: str) -> str:
    left, right = name.startswith("left_"), name.startswith("right_")
    return f"right_{name[5:]}" if left else f"left_{name[6:]}" if right else name
