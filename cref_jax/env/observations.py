"""Observations of the policy and of the critic: Eq. 1-3."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray

from cref_jax import config, geometry, terrain

GRAVITY = np.array([0.0, 0.0, -1.0], np.float32)


class Motion(NamedTuple):
    """The robot's motion as its own sensors would report it without noise. Body frame, SI units."""

    velocity: Float[Array, "3"]  # m/s
    angular_velocity: Float[Array, "3"]  # rad/s
    gravity: Float[Array, "3"]  # direction
    joint_position: Float[Array, " J"]  # rad
    joint_velocity: Float[Array, " J"]  # rad/s


class Observation(NamedTuple):
    """One robot's observation."""

    proprioception: Float[Array, " O"]  # o^p_t, Eq. 2
    privileged: Float[Array, " S"]  # s_t, Eq. 3
    velocity: Float[Array, "3"]  # m/s, the velocity estimator's target
    heights: Float[Array, " G"] | None = None  # m, above the last support; a teacher's alone


class Part(NamedTuple):
    """A part of o^p_t."""

    name: str
    size: int  # numbers; 0: one per joint
    unit: str
    frame: str


BASE = "base: x forward, y left, z up"
PARTS = (  # Eq. 2, in its order
    Part("angular_velocity", 3, "rad/s", BASE),
    Part("gravity", 3, "unit vector; (0, 0, -1) upright", BASE),
    Part("command", 3, "m/s forward, m/s to the left, rad/s to the left", BASE),
    Part("joint_position", 0, "rad from default_rad", "joints"),
    Part("joint_velocity", 0, "rad/s", "joints"),
    Part("action", 0, "the clipped action of the step before; 0 at first", "joints"),
)


def slices(num_joints: int) -> dict[str, slice]:
    """Compute the slice of each part of o^p_t."""
    widths = [part.size or num_joints for part in PARTS]
    ends = np.cumsum(widths).tolist()
    return {
        part.name: slice(end - width, end)
        for part, width, end in zip(PARTS, widths, ends, strict=True)
    }


def num_joints_of(size: int) -> int:
    """Compute the number of joints from the size of o^p_t."""
    fixed = sum(part.size for part in PARTS)
    return (size - fixed) // sum(part.size == 0 for part in PARTS)


def motion(qpos: Float[Array, " Q"], qvel: Float[Array, " V"], joints: int) -> Motion:
    """Compute the motion in the body frame; MuJoCo's free joint has its velocity in the world's.

    `joints` is J, how many the policy drives; those that are held come after them.
    """
    rotation = qpos[3:7]
    return Motion(
        velocity=geometry.rotate_inverse(rotation, qvel[:3]),
        angular_velocity=qvel[3:6],
        gravity=geometry.rotate_inverse(rotation, jnp.asarray(GRAVITY)),
        joint_position=qpos[7 : 7 + joints],
        joint_velocity=qvel[6 : 6 + joints],
    )


def with_noise(
    clean: Motion, c: config.Randomisation, spread: Float[ArrayLike, ""], key: PRNGKeyArray
) -> Motion:
    """Add a share of the uniform sensor noise; no sensor measures the velocity."""
    keys = jax.random.split(key, 4)
    draw = lambda k, x, width: jax.random.uniform(k, x.shape, minval=-width, maxval=width)
    noise = lambda k, x, width: x + spread * draw(k, x, width)
    return clean._replace(
        angular_velocity=noise(keys[0], clean.angular_velocity, c.noise_angular_velocity),
        gravity=noise(keys[1], clean.gravity, c.noise_gravity),
        joint_position=noise(keys[2], clean.joint_position, c.noise_joint_position),
        joint_velocity=noise(keys[3], clean.joint_velocity, c.noise_joint_velocity),
    )


def proprioception(
    sensed: Motion,
    command: Float[Array, "3"],
    nominal_pose: Float[Array, " J"],
    previous_action: Float[Array, " J"],
) -> Float[Array, " O"]:
    """o^p_t = [omega, r_grav, u_cmd, q - q_0, dq/dt, a_{t-1}], Eq. 2."""
    values = {
        "angular_velocity": sensed.angular_velocity,
        "gravity": sensed.gravity,
        "command": command,
        "joint_position": sensed.joint_position - nominal_pose,
        "joint_velocity": sensed.joint_velocity,
        "action": previous_action,
    }
    return jnp.concatenate([values[part.name] for part in PARTS])


def height_scan(
    ground: terrain.Terrain, qpos: Float[Array, " Q"], c: config.Scan
) -> Float[Array, " M"]:
    """m_t: height of the base above a grid of ground points around it, less `base_height`, m."""
    x, y = np.meshgrid(np.linspace(*c.x), np.linspace(*c.y), indexing="ij")
    return _clearance(ground, qpos, x.ravel(), y.ravel(), c)


def fine_row(
    ground: terrain.Terrain, qpos: Float[Array, " Q"], c: config.Scan
) -> Float[Array, " A"]:
    """Compute the same along a row straight ahead, fine enough to locate the edge of a tread."""
    x = np.linspace(*c.ahead)
    return _clearance(ground, qpos, x, np.zeros_like(x), c)


def teacher_heights(
    ground: terrain.Terrain, qpos: Float[Array, " Q"], support_z: Float[Array, ""], c: config.Scan
) -> Float[Array, " G"]:
    """Compute the ground's height above the last support, m, on the grid of a privileged teacher.

    Row by row from behind. Not below the base: on level ground that says how high the base is, and
    a teacher that has learned to balance by it falls where the ground first ends.
    """
    x, y = np.meshgrid(np.linspace(*c.teacher_x), np.linspace(*c.teacher_y), indexing="ij")
    height = _heights_around(ground, qpos, x.ravel(), y.ravel())
    return jnp.clip(height - support_z, -c.clip, c.clip)


def _clearance(
    ground: terrain.Terrain,
    qpos: Float[Array, " Q"],
    x: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
    c: config.Scan,
) -> Float[Array, " N"]:
    clearance = qpos[2] - _heights_around(ground, qpos, x, y)
    return jnp.clip(clearance - c.base_height, -c.clip, c.clip)


def _heights_around(
    ground: terrain.Terrain,
    qpos: Float[Array, " Q"],
    x: Float[np.ndarray, " N"],
    y: Float[np.ndarray, " N"],
) -> Float[Array, " N"]:
    grid = (x.astype(np.float32), y.astype(np.float32))
    by_x, by_y = geometry.rotate_yaw_xy(geometry.yaw(qpos[3:7]), *grid)
    return terrain.height_under(ground, qpos[0] + by_x, qpos[1] + by_y)


def privileged_state(
    clean: Float[Array, " O"],
    velocity: Float[Array, "3"],
    hidden: Float[Array, " H"],
    scan: Float[Array, " M"],
) -> Float[Array, " S"]:
    """s_t = [o^p_t, v_t, hidden, m_t] without sensor noise; Eq. 3 has no hidden."""
    return jnp.concatenate([clean, velocity, hidden, scan])
