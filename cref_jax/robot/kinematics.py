"""Forward kinematics of one robot in plain JAX.

Both engines hand over only the state; what the reward, the camera and the ground contacts want to
know of the links is worked out here, so it cannot differ between them.
"""

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Int

from cref_jax import geometry


class Level(NamedTuple):
    """Links of equal depth, one hinge each, computed together; N = 2 for legs alone."""

    body: Int[np.ndarray, " N"]  # body id
    parent: Int[np.ndarray, " N"]  # row in the level above
    offset: Float[np.ndarray, "N 3"]  # m, parent frame: position of the joint and of the link
    turn: Float[np.ndarray, "N 4"]  # rotation in the parent frame at joint angle 0
    axis: Float[np.ndarray, "N 3"]  # of the hinge, link frame
    joint: Int[np.ndarray, " N"]  # index of its angle behind the seven numbers of the pelvis


@dataclass(frozen=True, eq=False)
class Tree:
    """The robot's links, by depth under the pelvis; constants of a compiled program."""

    levels: tuple[Level, ...]
    row: Int[np.ndarray, " B"]  # where body id b stands in world, pelvis, level 1, level 2, ...


class Links(NamedTuple):
    """Pose and motion of the link frames in the world, by MuJoCo's body id; row 0 is the world."""

    position: Float[Array, "B 3"]  # m
    rotation: Float[Array, "B 4"]  # quaternion w, x, y, z, link to world
    velocity: Float[Array, "B 3"]  # m/s, of the link's origin
    angular_velocity: Float[Array, "B 3"]  # rad/s, world axes


def tree(model: mujoco.MjModel) -> Tree:
    """Read the tree of a model of `robot.spec`: a free base, then one hinge per link."""
    bodies = [b for b in range(1, model.nbody) if model.body_rootid[b] == 1]
    if bodies != list(range(1, len(bodies) + 1)) or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise ValueError("the robot must come first in the model, with a free pelvis")
    if np.any(model.body_jntnum[bodies] != 1) or np.any(model.jnt_pos):
        raise ValueError("each link must turn about its origin, on one hinge")
    levels, above = [], [1]
    while below := [b for b in bodies if model.body_parentid[b] in above and b not in above]:
        ids = np.array(below)
        joint = model.body_jntadr[ids]
        levels.append(
            Level(
                body=ids,
                parent=np.array([above.index(p) for p in model.body_parentid[ids]]),
                offset=model.body_pos[ids].astype(np.float32),
                turn=model.body_quat[ids].astype(np.float32),
                axis=model.jnt_axis[joint].astype(np.float32),
                joint=joint - 1,
            )
        )
        above = below
    return Tree(tuple(levels), np.argsort(np.concatenate([[0, 1], *(lv.body for lv in levels)])))


def links(tree: Tree, qpos: Float[Array, " Q"], qvel: Float[Array, " V"]) -> Links:
    """Compute pose and velocity of every link.

    qpos is the pelvis's position and quaternion, then the joints; qvel is the pelvis's linear
    velocity in the world frame, its angular velocity in its own (MuJoCo's free joint), then the
    joints. Down the tree, with r the step from the parent's origin to the link's:

        v = v_parent + w_parent x r,    w = w_parent + axis * qd
    """
    rotation = qpos[3:7] / jnp.linalg.norm(qpos[3:7])
    spin = geometry.rotate(rotation, qvel[3:6])
    pelvis = Links(*(x[None] for x in (qpos[:3], rotation, qvel[:3], spin)))
    world = Links(*(jnp.zeros_like(x) for x in pelvis))
    world = world._replace(rotation=jnp.array([[1.0, 0.0, 0.0, 0.0]], qpos.dtype))
    found = [world, pelvis]
    for level in tree.levels:
        found.append(_descend(level, found[-1], qpos[7 + level.joint], qvel[6 + level.joint]))
    return jax.tree.map(lambda *parts: jnp.concatenate(parts)[tree.row], *found)


def points(
    links: Links, body: Int[np.ndarray, " P"], offset: Float[np.ndarray, "P 3"]
) -> Float[Array, "P 3"]:
    """Compute the world positions of points fixed to links at `offset`, m in the link's frame."""
    return links.position[body] + geometry.rotate(links.rotation[body], jnp.asarray(offset))


def _descend(
    level: Level, above: Links, angle: Float[Array, " N"], speed: Float[Array, " N"]
) -> Links:
    """Compute the links of one level from those of the level above."""
    parent = Links(*(x[level.parent] for x in above))
    step = geometry.rotate(parent.rotation, jnp.asarray(level.offset))
    axis = jnp.asarray(level.axis)
    turned = geometry.quat_from_axis_angle(axis, angle)
    if np.any(level.turn[:, 0] != 1.0):
        turned = geometry.quat_multiply(jnp.asarray(level.turn), turned)
    rotation = geometry.quat_multiply(parent.rotation, turned)
    spin = geometry.rotate(rotation, axis) * speed[:, None]
    return Links(
        position=parent.position + step,
        rotation=rotation,
        velocity=parent.velocity + jnp.cross(parent.angular_velocity, step),
        angular_velocity=parent.angular_velocity + spin,
    )
