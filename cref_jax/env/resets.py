"""How an episode begins: a settled robot on a lane, with dynamics, command and camera drawn anew.

Coordinates are the lane's own: x along it from its start, y across, z = 0 at the start.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, PRNGKeyArray

from cref_jax import geometry
from cref_jax.env import commands, footholds, gait, randomization
from cref_jax.env.state import EnvState, Spread, even_spread
from cref_jax.env.world import World
from cref_jax.physics.records import Body


def reset(
    world: World,
    key: PRNGKeyArray,
    kind: Int[Array, ""],
    level: Int[Array, ""],
    spread: Spread | None = None,
) -> EnvState:
    """Put a robot on a lane of this kind and level; without a spread, fully randomised."""
    c = world.config
    keys = jax.random.split(key, 8)
    joints = world.physics.robot.num_joints
    spread = even_spread(1.0) if spread is None else spread
    variant = jax.random.randint(keys[7], (), 0, world.lanes.variants)
    body = _sample_start(world, keys[0], kind, level, variant)
    command, is_steered = commands.sample_command(world, keys[3], kind)
    dynamics, offset, delay = randomization.sample_dynamics(world, keys[1], spread)
    pitch, shift = randomization.sample_camera_mount(c.randomisation, keys[6])
    return EnvState(
        key=keys[2],
        body=body,
        spread=spread,
        dynamics=dynamics,
        joint_offset=offset,
        delay=delay,
        kind=kind,
        level=level,
        variant=variant,
        rank=level,
        start=body.qpos[:2],
        command=command,
        is_steered=is_steered,
        command_left=randomization.sample_steps(c, keys[4], c.command.period),
        push_left=randomization.sample_steps(c, keys[5], c.randomisation.push_period),
        commanded=jnp.zeros(()),
        mark=jnp.stack([body.qpos[0], 0.0]),
        action=jnp.zeros(joints),
        action_before=jnp.zeros(joints),
        foot_velocity=jnp.zeros((2, 3)),
        gait=gait.standing_gait(),
        since_single=jnp.zeros(()),
        support_z=body.qpos[2] - c.reward.base_height_target,
        candidates=footholds.no_candidates(c.foothold),
        foothold_distance=jnp.ones(2),
        camera_pitch=spread.camera * pitch,
        camera_shift=spread.camera * shift,
        step=jnp.zeros((), jnp.int32),
    )


def _sample_start(
    world: World,
    key: PRNGKeyArray,
    kind: Int[Array, ""],
    level: Int[Array, ""],
    variant: Int[Array, ""],
) -> Body:
    """Sample a settled state from the bank, turned a little.

    It stands somewhere on the lane's start, or for a share of the episodes on another level stretch
    of it.
    """
    c = world.config.episode
    key_pick, key_x, key_y, key_yaw, key_where = jax.random.split(key, 5)
    pick = jax.random.randint(key_pick, (), 0, c.bank_size)
    body = jax.tree.map(lambda x: x[pick], world.bank)
    uniform = lambda k, low, high: jax.random.uniform(k, (), minval=low, maxval=high)
    turn = uniform(key_yaw, -c.yaw_jitter, c.yaw_jitter)
    about_z = geometry.quat_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), turn)
    x, z = uniform(key_x, *c.start_x), jnp.zeros(())
    if c.start_anywhere > 0.0:
        there, height = world.lanes.sample_level_place(kind, level, variant, key_where)
        chance = jax.random.uniform(jax.random.fold_in(key_where, 1))
        elsewhere = (chance < c.start_anywhere) & jnp.isfinite(there)
        x, z = jnp.where(elsewhere, there, x), jnp.where(elsewhere, height, z)
    place = jnp.stack([x, uniform(key_y, *c.start_y), body.qpos[2] + z])
    return Body(
        qpos=body.qpos.at[:3]
        .set(place)
        .at[3:7]
        .set(geometry.quat_multiply(about_z, body.qpos[3:7])),
        qvel=body.qvel.at[:3].set(geometry.rotate_yaw(turn, body.qvel[:3])),
        warmstart=body.warmstart,
    )
