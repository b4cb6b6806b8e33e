"""When an episode is over."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from cref_jax import geometry
from cref_jax.env import stall
from cref_jax.env.state import Ending, EnvState
from cref_jax.env.world import World
from cref_jax.robot.kinematics import Links


def check_termination(
    world: World, state: EnvState, links: Links, unstable: Bool[Array, ""]
) -> Ending:
    """Check the reached state for every reason to end the episode."""
    c = world.config
    gravity_z = geometry.rotate_inverse(state.body.qpos[3:7], jnp.array([0.0, 0.0, -1.0]))[2]
    foot_z = links.position[world.physics.feet, 2]
    pelvis_z = state.body.qpos[2]
    has_end = jnp.asarray(~np.isin(world.lanes.kinds, c.command.open_kinds))[state.kind]
    return Ending(
        tilted=gravity_z > -jnp.cos(c.episode.max_tilt),
        low=pelvis_z - state.support_z < c.episode.min_height,
        hit=world.physics.is_hit(world.lanes.tile(state.level, state.kind, state.variant), links),
        dropped=foot_z.min() < state.support_z - c.episode.below_edge,
        unstable=unstable,
        stalled=has_end & _is_stall_check(world, state) & _has_stalled(world, state),
        finished=has_end & (state.body.qpos[0] > world.lanes.end - c.episode.lane_end),
        timeout=state.step >= round(c.episode.length / c.physics.control_period),
    )


def record_progress(world: World, state: EnvState) -> EnvState:
    """Record progress at each stall check."""
    here = jnp.stack([state.body.qpos[0], state.commanded])
    return state.replace(mark=jnp.where(_is_stall_check(world, state), here, state.mark))


def _is_stall_check(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether a stall check is due in this step."""
    c = world.config
    if c.episode.stall_time == 0.0:
        return jnp.zeros((), bool)
    return state.step % round(c.episode.stall_time / c.physics.control_period) == 0


def _has_stalled(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether the robot has hardly advanced since the last stall check.

    It is not judged where it was told to stand, or to go elsewhere, for a part of that time.
    """
    c = world.config
    came, asked = state.body.qpos[0] - state.mark[0], state.commanded - state.mark[1]
    least = c.command.lane_vx[0] * (c.episode.stall_time - 2.0 * c.physics.control_period)
    return (came < stall.STALL_SHARE * asked) & (asked >= least)
