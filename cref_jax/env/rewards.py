"""Table I: one pure function per row. The weight and the log key have the function's name.

A function is the paper's expression; its sign and size are in the weight (config.RewardWeights).
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from cref_jax import config
from cref_jax.robot import Robot


class Snapshot(NamedTuple):
    """Inputs of the reward. SI units; F = 2 feet (left, right), J joints.

    The base's velocities and gravity are in the body frame, the feet in the world frame.
    """

    velocity: Float[Array, "3"]  # m/s
    angular_velocity: Float[Array, "3"]  # rad/s
    gravity: Float[Array, "3"]  # direction
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    base_z: Float[Array, ""]  # m
    joint_position: Float[Array, " J"]  # rad
    joint_velocity: Float[Array, " J"]  # rad/s
    action: Float[Array, " J"]  # a_t
    action_1: Float[Array, " J"]  # a_{t-1}
    action_2: Float[Array, " J"]  # a_{t-2}
    foot_z: Float[Array, " F"]  # m, ankle-roll frame
    feet_y: Float[Array, ""]  # m, distance of the feet across the heading
    foot_velocity: Float[Array, "F 3"]  # m/s
    foot_velocity_before: Float[Array, "F 3"]  # m/s, one control step ago
    foot_force: Float[Array, "F 3"]  # N, mean over the control step
    first_contact: Bool[Array, " F"]  # the foot's touchdown was confirmed in this step
    air_time: Float[Array, " F"]  # s, length of the swing that it ended
    last_air_time: Float[Array, " F"]  # s, of each foot's last swing, this one included
    foothold_distance: Float[Array, " F"]  # m, d_xz to the nearest candidate; inf: there is none
    unsupported: Int[Array, " F"]  # samples of the sole that are over nothing
    walls_touched: Int[Array, ""]  # contact spheres at a wall; 0 if their weight is
    since_single: Float[Array, ""]  # s since exactly one foot was down, a lift of one step left out
    control_period: Float[Array, ""]  # s


Term = Callable[[Snapshot, config.Reward, Robot], Float[Array, ""]]
_EVENTS: set[Term] = set()


def at_touchdown(term: Term) -> Term:
    """Mark a term that is nonzero only in the step of a touchdown; see `total`."""
    _EVENTS.add(term)
    return term


def is_standing(command: Float[Array, "3"], c: config.Reward) -> Bool[Array, ""]:
    """I_stand = I(||u_cmd||_2 < u_s)."""
    return jnp.linalg.norm(command) < c.standing


def is_touching(force: Float[Array, "F 3"], c: config.Reward) -> Bool[Array, " F"]:
    """I(||F^f|| > 5 N)."""
    return jnp.linalg.norm(force, axis=-1) > c.contact_force


def support_height(
    foot_z: Float[Array, " F"], force: Float[Array, "F 3"], c: config.Reward
) -> Float[Array, ""]:
    """z_supp, the mean height of the supporting feet, Eq. 5.

    With no foot in support the paper leaves it undefined; the lower foot stands in.
    """
    support = force[:, 2] > c.support_force
    mean = jnp.sum(support * foot_z) / jnp.maximum(support.sum(), 1)
    return jnp.where(support.any(), mean, foot_z.min())


def linear_velocity_tracking(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """exp(-(I_s ||e_v||_1 + (1 - I_s) ||e_v||_2^2) / sigma_v), e_v the planar velocity error."""
    error = s.command[:2] - s.velocity[:2]
    slow = jnp.linalg.norm(s.command[:2]) < c.low_speed
    size = jnp.where(slow, jnp.abs(error).sum(), jnp.square(error).sum())
    return jnp.exp(-size / c.sigma_v)


def angular_velocity_tracking(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """exp(-(omega_z - omega_z_cmd)^2 / sigma_omega)."""
    return jnp.exp(-jnp.square(s.angular_velocity[2] - s.command[2]) / c.sigma_omega)


def orientation(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """exp(-10 ||r_grav_xy||_2)."""
    return jnp.exp(-10.0 * jnp.linalg.norm(s.gravity[:2]))


def feet_contact(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """I_stand + (1 - I_stand) I_single: one foot alone was down within the last 0.2 s."""
    single = s.since_single <= c.single_contact_window + 1e-6
    return jnp.where(is_standing(s.command, c), 1.0, single.astype(jnp.float32))


def feet_y_distance(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """exp(-10 |d_y - 0.27|)."""
    return jnp.exp(-10.0 * jnp.abs(s.feet_y - c.feet_y_target))


@at_touchdown
def foothold_placement(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of I_td exp(-d_xz / s_xz), Sec. II-C; 0 for a foot without a candidate."""
    return jnp.sum(s.first_contact * jnp.exp(-s.foothold_distance / c.foothold_tolerance))


@at_touchdown
def foothold_missed(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of I_td (1 - exp(-d_xz / s_xz)), 0 without a candidate; not in Table I.

    With it footholds can weigh more without paying for more steps, as their reward alone does.
    """
    missed = 1.0 - jnp.exp(-s.foothold_distance / c.foothold_tolerance)
    return jnp.sum(s.first_contact * jnp.isfinite(s.foothold_distance) * missed)


def foot_contact_quality(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of C_i sum_j I(d_ij < epsilon), BeamDojo's term (arXiv 2502.10363)."""
    return jnp.sum(is_touching(s.foot_force, c) * s.unsupported).astype(jnp.float32)


def base_height(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """exp(-10 |(z_base - z_supp) - 0.55|)."""
    height = s.base_z - support_height(s.foot_z, s.foot_force, c)
    return jnp.exp(-10.0 * jnp.abs(height - c.base_height_target))


def linear_velocity_z(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """v_z^2."""
    return jnp.square(s.velocity[2])


def angular_velocity_xy(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """||omega_xy||^2."""
    return jnp.square(s.angular_velocity[:2]).sum()


def joint_velocity(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """||dq/dt||^2."""
    return jnp.square(s.joint_velocity).sum()


def action_rate(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """||a_t - a_{t-1}||^2."""
    return jnp.square(s.action - s.action_1).sum()


def action_smoothness(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """||a_t - 2 a_{t-1} + a_{t-2}||^2."""
    return jnp.square(s.action - 2.0 * s.action_1 + s.action_2).sum()


@at_touchdown
def feet_air_time(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of I_first (0.5 - T_air)."""
    return jnp.sum(s.first_contact * (c.air_time_target - s.air_time))


@at_touchdown
def air_time_variance(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """I_first of any foot times the variance of the feet's last air times, s^2; not in Table I.

    It is 0 until both feet have swung.
    """
    both = (s.last_air_time > 0.0).all()
    return jnp.where(both & s.first_contact.any(), jnp.var(s.last_air_time), 0.0)


def foot_up_when_standing(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """I_stand times the number of feet that do not touch; not in Table I."""
    return is_standing(s.command, c) * jnp.sum(~is_touching(s.foot_force, c)).astype(jnp.float32)


def foot_slip(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of I(||F|| > 5) ||v_xyz||; the table says xyz, although its name says slip."""
    touching = is_touching(s.foot_force, c)
    return jnp.sum(touching * jnp.linalg.norm(s.foot_velocity, axis=-1))


def foot_impact_acceleration(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of [|dv_z/dt| - a_0]_+, the change over one control step."""
    change = s.foot_velocity[:, 2] - s.foot_velocity_before[:, 2]
    return jnp.sum(jnp.maximum(jnp.abs(change) / s.control_period - c.impact_acceleration, 0.0))


def foot_impact_velocity(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over feet of [|v_z| - v_0]_+."""
    return jnp.sum(jnp.maximum(jnp.abs(s.foot_velocity[:, 2]) - c.impact_velocity, 0.0))


def joint_position_limits(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over joints of [q_min - q]_+ + [q - q_max]_+, the range shrunk about its middle."""
    middle = 0.5 * (robot.range_low + robot.range_high)
    half = 0.5 * c.soft_limit * (robot.range_high - robot.range_low)
    return jnp.sum(jnp.maximum(jnp.abs(s.joint_position - middle) - half, 0.0))


def joint_velocity_limits(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over joints of [|dq/dt| - dq/dt_max]_+."""
    return jnp.sum(jnp.maximum(jnp.abs(s.joint_velocity) - robot.velocity_limit, 0.0))


def hip_position(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over hip x and z of (q - q_0)^2."""
    return jnp.sum(robot.hip_xz * jnp.square(s.joint_position - robot.nominal_pose))


def ankle_position(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Sum over ankle x of (q - q_0)^2."""
    return jnp.sum(robot.ankle_x * jnp.square(s.joint_position - robot.nominal_pose))


def stumble(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """I(a foot has ||F_xy|| > 5 |F_z|): it has run into a wall."""
    across = jnp.linalg.norm(s.foot_force[:, :2], axis=-1)
    hit = across > c.stumble_ratio * jnp.abs(s.foot_force[:, 2])
    return hit.any().astype(jnp.float32)


def wall_contact(s: Snapshot, c: config.Reward, robot: Robot) -> Float[Array, ""]:
    """Number of contact spheres of feet and shanks that touch a wall; not in Table I."""
    return s.walls_touched.astype(jnp.float32)


TERMS: dict[str, Term] = {
    weight.name: globals()[weight.name] for weight in dataclasses.fields(config.RewardWeights)
}
EVENTS = tuple(name for name, term in TERMS.items() if term in _EVENTS)


def total(
    s: Snapshot, c: config.Reward, robot: Robot
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Compute the reward of a step, and each weighted term by name for the log.

    The sum is scaled by the control period, touchdowns by their own time instead. The sum of the
    other terms is cut at 0 from below; touchdowns are not: cut off, a short step would cost nothing
    and one long and one short step would be worth more than two equal ones. They count for nothing
    while the robot is told to stand.
    """
    parts = {name: getattr(c.weights, name) * term(s, c, robot) for name, term in TERMS.items()}
    walking = 1.0 - is_standing(s.command, c)
    worth = walking * (c.event_time / s.control_period if c.times_dt else 1.0)
    parts |= {name: parts[name] * worth for name in EVENTS}
    events = sum((parts[name] for name in EVENTS), start=jnp.zeros(()))
    dense = sum((x for name, x in parts.items() if name not in EVENTS), start=jnp.zeros(()))
    if c.clip_touchdowns:
        dense, events = dense + events, jnp.zeros(())
    if c.clip_at_zero:
        dense = jnp.maximum(dense, 0.0)
    return (dense + events) * (s.control_period if c.times_dt else 1.0), parts
