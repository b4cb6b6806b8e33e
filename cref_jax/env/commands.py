"""Velocity commands: drawn at intervals, and steered back to the middle of a lane."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from cref_jax import geometry
from cref_jax.env.state import Draws, EnvState
from cref_jax.env.world import World


def update_command(world: World, state: EnvState, draws: Draws) -> EnvState:
    """Take a new command when due; along a lane, steer back to its middle."""
    c = world.config
    due = state.command_left <= 0
    command = jnp.where(due, draws.command, state.command)
    is_steered = jnp.where(due, draws.is_steered, state.is_steered)

    heading = geometry.yaw(state.body.qpos[3:7])
    wanted = jnp.clip(-c.command.lane_gain * state.body.qpos[1], -0.5, 0.5)  # rad
    error = jnp.mod(wanted - heading + jnp.pi, 2 * jnp.pi) - jnp.pi
    limit = c.command.lane_yaw_rate
    steer = jnp.clip(c.command.heading_gain * error, -limit, limit)
    is_open = jnp.asarray(np.isin(world.lanes.kinds, c.command.open_kinds))[state.kind]
    command = command.at[2].set(jnp.where(is_steered, steer, command[2]))
    asked = (is_steered | is_open) * jnp.linalg.norm(command[:2])  # m/s
    return state.replace(
        command=command,
        is_steered=is_steered,
        command_left=jnp.where(due, draws.command_left, state.command_left - 1),
        commanded=state.commanded + asked * c.physics.control_period,
    )


def sample_command(
    world: World, key: PRNGKeyArray, kind: Int[Array, ""]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Draw a velocity command, and whether the robot is then steered along its lane.

    In the open it is any direction, or to stand; on a lane forward, and at times as in the open, to
    stand as often as to go elsewhere.
    """
    c = world.config.command
    keys = jax.random.split(key, 6)
    draw = lambda k, span: jax.random.uniform(k, (), minval=span[0], maxval=span[1])
    free = jnp.stack([draw(keys[0], c.vx), draw(keys[1], c.vy), draw(keys[2], c.yaw_rate)])
    along = jnp.stack([draw(keys[4], c.lane_vx), jnp.zeros(()), jnp.zeros(())])
    is_open = jnp.asarray(np.isin(world.lanes.kinds, c.open_kinds))[kind]
    stands = jax.random.uniform(keys[3]) < jnp.where(is_open, c.standing, 0.5)
    if c.zero > 0.0:
        free *= jax.random.uniform(jax.random.fold_in(key, len(keys)), (3,)) >= c.zero
    free = jnp.where(stands, jnp.zeros(3), free)
    is_steered = ~is_open & (jax.random.uniform(keys[5]) >= c.lane_free)
    return jnp.where(is_steered, along, free), is_steered
