"""How an episode of one robot begins, what disturbs it, how it ends and what follows.

Coordinates are the lane's own: x along it from its start, y across, z = 0 at the start.
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from cref_jax import config, foothold, geometry, stall
from cref_jax.foothold import Candidates
from cref_jax.host_physics import Dynamics
from cref_jax.kinematics import Links
from cref_jax.physics import Body
from cref_jax.world import World


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class EnvState:
    """One robot between two control steps."""

    key: PRNGKeyArray
    body: Body
    dynamics: Dynamics
    joint_offset: Float[Array, " J"]  # rad, encoder zero
    delay: Int[Array, ""]  # substeps until a new target arrives
    kind: Int[Array, ""]  # of terrain
    level: Int[Array, ""]  # of difficulty, of the lane that it is on
    rank: Int[Array, ""]  # the hardest level that it has earned
    start: Float[Array, "2"]  # m, where the episode began
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    command_left: Int[Array, ""]  # control steps until the next draw
    push_left: Int[Array, ""]  # control steps until the next push
    commanded: Float[Array, ""]  # m, distance asked for so far
    mark: Float[Array, "2"]  # m, x and the distance asked for at the last look for a stall
    action: Float[Array, " J"]  # a_{t-1}
    action_before: Float[Array, " J"]  # a_{t-2}
    foot_velocity: Float[Array, "F 3"]  # m/s, world
    air_time: Float[Array, " F"]  # s since each foot touched
    since_single: Float[Array, ""]  # s since one foot alone touched
    support_z: Float[Array, ""]  # m, height of the last support
    candidates: Candidates  # where each foot may step, since its last liftoff
    camera_pitch: Float[Array, ""]  # rad, error of the camera's mount
    camera_shift: Float[Array, "3"]  # m, error of the camera's mount
    step: Int[Array, ""]  # control steps into the episode


class Ending(NamedTuple):
    """Why an episode is over; the first five are failures."""

    tilted: Bool[Array, ""]
    low: Bool[Array, ""]  # the pelvis is too near to the support
    hit: Bool[Array, ""]  # torso, head, pelvis or thigh is in the terrain
    dropped: Bool[Array, ""]  # a foot is far below the last support
    unstable: Bool[Array, ""]  # the physics has blown up
    stalled: Bool[Array, ""]  # it hardly moves, though it is told to walk
    finished: Bool[Array, ""]  # at the lane's end
    timeout: Bool[Array, ""]

    @property
    def terminated(self) -> Bool[ArrayLike, "..."]:
        """The robot has failed: no value follows."""
        return self.tilted | self.low | self.hit | self.dropped | self.unstable

    @property
    def truncated(self) -> Bool[ArrayLike, "..."]:
        """The episode was cut although the robot could have gone on."""
        return (self.finished | self.timeout | self.stalled) & ~self.terminated


def reset(world: World, key: PRNGKeyArray, kind: Int[Array, ""], level: Int[Array, ""]) -> EnvState:
    """Return a robot at the start of a lane of that kind and level."""
    c = world.config
    keys = jax.random.split(key, 7)
    joints = len(world.physics.robot.joint_names)
    body = _placed(world, keys[0])
    dynamics, offset, delay = _drawn_dynamics(world, keys[1])
    pitch, shift = _drawn_mount(c.randomisation, keys[6])
    return EnvState(
        key=keys[2],
        body=body,
        dynamics=dynamics,
        joint_offset=offset,
        delay=delay,
        kind=kind,
        level=level,
        rank=level,
        start=body.qpos[:2],
        command=_drawn_command(world, keys[3], kind),
        command_left=_drawn_steps(c, keys[4], c.command.period),
        push_left=_drawn_steps(c, keys[5], c.randomisation.push_period),
        commanded=jnp.zeros(()),
        mark=jnp.stack([body.qpos[0], 0.0]),
        action=jnp.zeros(joints),
        action_before=jnp.zeros(joints),
        foot_velocity=jnp.zeros((2, 3)),
        air_time=jnp.zeros(2),
        since_single=jnp.zeros(()),
        support_z=body.qpos[2] - c.reward.base_height_target,
        candidates=foothold.none(c.foothold),
        camera_pitch=pitch,
        camera_shift=shift,
        step=jnp.zeros((), jnp.int32),
    )


class Draws(NamedTuple):
    """The next push and the next command, and the control steps until those after them."""

    shove: Float[Array, "2"]  # m/s
    push_left: Int[Array, ""]
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    command_left: Int[Array, ""]


def needs_draws(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether a push or a new command is due in this step."""
    due = state.command_left <= 0
    return due | (state.push_left <= 0) if world.config.randomisation.enabled else due


def draw(world: World, state: EnvState, key_push: PRNGKeyArray, key_command: PRNGKeyArray) -> Draws:
    """Draw what `pushed` and `commanded` take where it is due."""
    c = world.config
    (key_shove, key_after), most = jax.random.split(key_push), c.randomisation.push_velocity
    key_next, key_left = jax.random.split(key_command)
    return Draws(
        shove=jax.random.uniform(key_shove, (2,), minval=-most, maxval=most),
        push_left=_drawn_steps(c, key_after, c.randomisation.push_period),
        command=_drawn_command(world, key_next, state.kind),
        command_left=_drawn_steps(c, key_left, c.command.period),
    )


def pushed(world: World, state: EnvState, draws: Draws) -> EnvState:
    """Add a sudden planar velocity to the base when a push is due."""
    if not world.config.randomisation.enabled:
        return state
    due = state.push_left <= 0
    qvel = state.body.qvel.at[:2].add(jnp.where(due, draws.shove, 0.0))
    return state.replace(
        body=state.body._replace(qvel=qvel),
        push_left=jnp.where(due, draws.push_left, state.push_left - 1),
    )


def commanded(world: World, state: EnvState, draws: Draws) -> EnvState:
    """Take a new command when one is due; on a lane, steer back to its middle and direction."""
    c = world.config
    due = state.command_left <= 0
    command = jnp.where(due, draws.command, state.command)

    heading = geometry.yaw(state.body.qpos[3:7])
    wanted = jnp.clip(-c.command.lane_gain * state.body.qpos[1], -0.5, 0.5)  # rad
    error = jnp.mod(wanted - heading + jnp.pi, 2 * jnp.pi) - jnp.pi
    limit = c.command.lane_yaw_rate
    steer = jnp.clip(c.command.heading_gain * error, -limit, limit)
    is_open = jnp.asarray(np.isin(world.lanes.kinds, c.command.open_kinds))[state.kind]
    command = command.at[2].set(jnp.where(is_open, command[2], steer))
    return state.replace(
        command=command,
        command_left=jnp.where(due, draws.command_left, state.command_left - 1),
        commanded=state.commanded + jnp.linalg.norm(command[:2]) * c.physics.control_period,
    )


def ending(world: World, state: EnvState, links: Links, unstable: Bool[Array, ""]) -> Ending:
    """Judge the state that a step has led to."""
    c = world.config
    gravity_z = geometry.rotate_inverse(state.body.qpos[3:7], jnp.array([0.0, 0.0, -1.0]))[2]
    foot_z = links.position[world.physics.feet, 2]
    pelvis_z = state.body.qpos[2]
    has_end = jnp.asarray(~np.isin(world.lanes.kinds, c.command.open_kinds))[state.kind]
    return Ending(
        tilted=gravity_z > -jnp.cos(c.episode.max_tilt),
        low=pelvis_z - state.support_z < c.episode.min_height,
        hit=world.physics.is_hit(world.lanes.tile(state.level, state.kind), links),
        dropped=foot_z.min() < state.support_z - c.episode.below_edge,
        unstable=unstable,
        stalled=has_end & _looks(world, state) & _stands(state),
        finished=has_end & (state.body.qpos[0] > world.lanes.end - c.episode.lane_end),
        timeout=state.step >= round(c.episode.length / c.physics.control_period),
    )


def marked(world: World, state: EnvState) -> EnvState:
    """Note where the robot is when it is looked at for a stall."""
    here = jnp.stack([state.body.qpos[0], state.commanded])
    return state.replace(mark=jnp.where(_looks(world, state), here, state.mark))


def promoted(
    world: World, state: EnvState, over: Ending, key: PRNGKeyArray
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Return the rank after an episode, and the level of the next.

    A good episode on the level of its rank earns the robot the next one, a poor one costs it this
    one: it went less than a share of what the whole episode asked for, however it ended. Most
    episodes are on that level; some, and all after the hardest one has been passed, are on any
    level up to it, since a robot forgets what it no longer meets.
    """
    c, top = world.config.curriculum, world.lanes.levels - 1
    if not c.enabled:
        return state.rank, state.level
    walked = state.body.qpos[0] - state.start[0]
    up = ~over.terminated & ~over.stalled & (over.finished | (walked > c.up * world.lanes.length))
    down = ~up & (walked < c.down * _asked(world, state))
    earned = state.rank + (up.astype(jnp.int32) - down) * (state.level == state.rank)
    rank = jnp.clip(earned, 0, top)
    key_review, key_level = jax.random.split(key)
    review = (earned > top) | (jax.random.uniform(key_review) < c.review)
    return rank, jnp.where(review, jax.random.randint(key_level, (), 0, rank + 1), rank)


def _looks(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether this is a step at which a robot is looked at for a stall."""
    c = world.config
    if c.episode.stall_time == 0.0:
        return jnp.zeros((), bool)
    return state.step % round(c.episode.stall_time / c.physics.control_period) == 0


def _stands(state: EnvState) -> Bool[Array, ""]:
    """Return whether the robot has hardly come forward since the last look."""
    came, asked = state.body.qpos[0] - state.mark[0], state.commanded - state.mark[1]
    return came < stall.STALL_SHARE * asked


def _asked(world: World, state: EnvState) -> Float[Array, ""]:
    """Return the distance that the command asks for in a whole episode, at most the lane, m."""
    c = world.config
    left = c.episode.length - state.step * c.physics.control_period
    asked = state.commanded + left * jnp.linalg.norm(state.command[:2])
    return jnp.minimum(asked, world.lanes.end - c.episode.lane_end - state.start[0])


def _placed(world: World, key: PRNGKeyArray) -> Body:
    """Return a settled state from the bank, somewhere on the lane's start, turned a little."""
    c = world.config.episode
    key_pick, key_x, key_y, key_yaw = jax.random.split(key, 4)
    pick = jax.random.randint(key_pick, (), 0, c.bank_size)
    body = jax.tree.map(lambda x: x[pick], world.bank)
    uniform = lambda k, low, high: jax.random.uniform(k, (), minval=low, maxval=high)
    turn = uniform(key_yaw, -c.yaw_jitter, c.yaw_jitter)
    about_z = geometry.quat_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), turn)
    place = jnp.stack([uniform(key_x, *c.start_x), uniform(key_y, *c.start_y)])
    return Body(
        qpos=body.qpos.at[:2]
        .set(place)
        .at[3:7]
        .set(geometry.quat_multiply(about_z, body.qpos[3:7])),
        qvel=body.qvel.at[:3].set(geometry.rotate_yaw(turn, body.qvel[:3])),
        warmstart=body.warmstart,
    )


def _drawn_dynamics(
    world: World, key: PRNGKeyArray
) -> tuple[Dynamics, Float[Array, " J"], Int[Array, ""]]:
    """Draw the robot's dynamics, its encoder offsets and its action delay in substeps."""
    c, nominal = world.config.randomisation, world.physics.nominal_dynamics()
    if not c.enabled:
        return nominal, jnp.zeros_like(nominal.kp), jnp.zeros((), jnp.int32)
    keys = jax.random.split(key, 7)
    draw = lambda k, shape, low, high: jax.random.uniform(k, shape, minval=low, maxval=high)
    joints = nominal.kp.shape
    dynamics = Dynamics(
        friction=draw(keys[0], (), *c.friction),
        payload=draw(keys[1], (), -c.trunk_mass, c.trunk_mass),
        com_shift=draw(keys[2], (3,), -c.trunk_com, c.trunk_com),
        kp=nominal.kp * draw(keys[3], joints, *c.gains),
        kd=nominal.kd * draw(keys[4], joints, *c.gains),
    )
    most = round(c.action_delay / world.config.physics.timestep)
    return (
        dynamics,
        draw(keys[5], joints, -c.joint_offset, c.joint_offset),
        jax.random.randint(keys[6], (), 0, most + 1),
    )


def _drawn_mount(
    c: config.Randomisation, key: PRNGKeyArray
) -> tuple[Float[Array, ""], Float[Array, "3"]]:
    """Draw the errors of the camera's mount: pitch, rad, and position, m."""
    if not c.enabled:
        return jnp.zeros(()), jnp.zeros(3)
    key_pitch, key_shift = jax.random.split(key)
    pitch = np.deg2rad(c.camera_pitch)
    return (
        jax.random.uniform(key_pitch, (), minval=-pitch, maxval=pitch),
        jax.random.uniform(key_shift, (3,), minval=-c.camera_position, maxval=c.camera_position),
    )


def _drawn_command(world: World, key: PRNGKeyArray, kind: Int[Array, ""]) -> Float[Array, "3"]:
    """Draw a velocity command: any direction on open ground, forward along a lane."""
    c = world.config.command
    keys = jax.random.split(key, 5)
    draw = lambda k, span: jax.random.uniform(k, (), minval=span[0], maxval=span[1])
    free = jnp.stack([draw(keys[0], c.vx), draw(keys[1], c.vy), draw(keys[2], c.yaw_rate)])
    free = jnp.where(jax.random.uniform(keys[3]) < c.standing, jnp.zeros(3), free)
    along = jnp.stack([draw(keys[4], c.lane_vx), jnp.zeros(()), jnp.zeros(())])
    is_open = np.isin(world.lanes.kinds, c.open_kinds)
    return jnp.where(jnp.asarray(is_open)[kind], free, along)


def _drawn_steps(c: config.Config, key: PRNGKeyArray, span: tuple[float, float]) -> Int[Array, ""]:
    """Draw a time within `span` s, in control steps."""
    low, high = (round(t / c.physics.control_period) for t in span)
    return jax.random.randint(key, (), low, high + 1)
