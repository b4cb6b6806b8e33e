"""How an episode of one robot begins, what disturbs it, how it ends and what follows.

Coordinates are the lane's own: x along it from its start, y across, z = 0 at the start.
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PRNGKeyArray

from cref_jax import config, foothold, gait, geometry, stall
from cref_jax.foothold import Candidates
from cref_jax.gait import Gait
from cref_jax.physics.records import Body, Dynamics
from cref_jax.robot.kinematics import Links
from cref_jax.world import World


class Spread(NamedTuple):
    """What share of its ranges each part of the randomisation has, 0 to 1."""

    friction: Float[ArrayLike, ""]
    mass: Float[ArrayLike, ""]  # of the trunk, and where its centre is
    gains: Float[ArrayLike, ""]
    offsets: Float[ArrayLike, ""]  # of encoders
    delay: Float[ArrayLike, ""]
    noise: Float[ArrayLike, ""]
    pushes: Float[ArrayLike, ""]
    camera: Float[ArrayLike, ""]  # how it is mounted


def evenly(share: Float[ArrayLike, "*n"]) -> Spread:
    """Return the same share of every part."""
    return Spread(*[jnp.asarray(share, jnp.float32)] * len(Spread._fields))


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class EnvState:
    """One robot between two control steps."""

    key: PRNGKeyArray
    body: Body
    spread: Spread
    dynamics: Dynamics
    joint_offset: Float[Array, " J"]  # rad, encoder zero
    delay: Int[Array, ""]  # substeps until a new target arrives
    kind: Int[Array, ""]  # of terrain
    level: Int[Array, ""]  # of difficulty, of the lane that it is on
    variant: Int[Array, ""]  # which lane of that level
    rank: Int[Array, ""]  # the hardest level that it has earned
    start: Float[Array, "2"]  # m, where the episode began
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    is_steered: Bool[Array, ""]  # its yaw rate leads along the lane
    command_left: Int[Array, ""]  # control steps until the next draw
    push_left: Int[Array, ""]  # control steps until the next push
    commanded: Float[Array, ""]  # m, distance asked for so far, along the lane where there is one
    mark: Float[Array, "2"]  # m, x and the distance asked for at the last look for a stall
    action: Float[Array, " J"]  # a_{t-1}
    action_before: Float[Array, " J"]  # a_{t-2}
    foot_velocity: Float[Array, "F 3"]  # m/s, world
    gait: Gait
    since_single: Float[Array, ""]  # s since one foot alone touched
    support_z: Float[Array, ""]  # m, height of the last support
    candidates: Candidates  # where each foot may step, as seen when it last bore on the ground
    foothold_distance: Float[Array, " F"]  # m, of each sole from the nearest of them, up to a limit
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


def reset(
    world: World,
    key: PRNGKeyArray,
    kind: Int[Array, ""],
    level: Int[Array, ""],
    spread: Spread | None = None,
) -> EnvState:
    """Return a robot on a lane of that kind and level; the whole randomisation without a spread."""
    c = world.config
    keys = jax.random.split(key, 8)
    joints = len(world.physics.robot.joint_names)
    spread = evenly(1.0) if spread is None else spread
    variant = jax.random.randint(keys[7], (), 0, world.lanes.variants)
    body = _placed(world, keys[0], kind, level, variant)
    command, is_steered = _drawn_command(world, keys[3], kind)
    dynamics, offset, delay = _drawn_dynamics(world, keys[1], spread)
    pitch, shift = _drawn_mount(c.randomisation, keys[6])
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
        command_left=_drawn_steps(c, keys[4], c.command.period),
        push_left=_drawn_steps(c, keys[5], c.randomisation.push_period),
        commanded=jnp.zeros(()),
        mark=jnp.stack([body.qpos[0], 0.0]),
        action=jnp.zeros(joints),
        action_before=jnp.zeros(joints),
        foot_velocity=jnp.zeros((2, 3)),
        gait=gait.standing(),
        since_single=jnp.zeros(()),
        support_z=body.qpos[2] - c.reward.base_height_target,
        candidates=foothold.none(c.foothold),
        foothold_distance=jnp.ones(2),
        camera_pitch=spread.camera * pitch,
        camera_shift=spread.camera * shift,
        step=jnp.zeros((), jnp.int32),
    )


class Draws(NamedTuple):
    """The next push and the next command, and the control steps until those after them."""

    shove: Float[Array, "2"]  # m/s
    push_left: Int[Array, ""]
    command: Float[Array, "3"]  # m/s, m/s, rad/s
    is_steered: Bool[Array, ""]
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
    command, is_steered = _drawn_command(world, key_next, state.kind)
    return Draws(
        shove=jax.random.uniform(key_shove, (2,), minval=-most, maxval=most),
        push_left=_drawn_steps(c, key_after, c.randomisation.push_period),
        command=command,
        is_steered=is_steered,
        command_left=_drawn_steps(c, key_left, c.command.period),
    )


def pushed(world: World, state: EnvState, draws: Draws) -> EnvState:
    """Add a sudden planar velocity to the base when a push is due."""
    if not world.config.randomisation.enabled:
        return state
    due = state.push_left <= 0
    qvel = state.body.qvel.at[:2].add(jnp.where(due, state.spread.pushes * draws.shove, 0.0))
    return state.replace(
        body=state.body._replace(qvel=qvel),
        push_left=jnp.where(due, draws.push_left, state.push_left - 1),
    )


def commanded(world: World, state: EnvState, draws: Draws) -> EnvState:
    """Take a new command when one is due; if it leads along the lane, steer back to its middle."""
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
        hit=world.physics.is_hit(world.lanes.tile(state.level, state.kind, state.variant), links),
        dropped=foot_z.min() < state.support_z - c.episode.below_edge,
        unstable=unstable,
        stalled=has_end & _looks(world, state) & _stands(world, state),
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

    A good episode on the level of its rank, from the start of the lane, earns the robot the next
    one, a poor one costs it this one: it went less than a share of what the whole episode asked
    for, however it ended. Most episodes are on that level; some, and all after the hardest one has
    been passed, are on any level up to it, since a robot forgets what it no longer meets.
    """
    c, top = world.config.curriculum, world.lanes.levels - 1
    if not c.enabled:
        return state.rank, state.level
    walked = state.body.qpos[0] - state.start[0]
    from_start = state.start[0] <= world.config.episode.start_x[1]
    passed = over.finished | (walked > c.up * world.lanes.length)
    up = from_start & ~over.terminated & ~over.stalled & passed
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


def _stands(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether the robot has hardly come forward since the last look.

    It is not judged where it was told to stand, or to go elsewhere, for a part of that time.
    """
    c = world.config
    came, asked = state.body.qpos[0] - state.mark[0], state.commanded - state.mark[1]
    least = c.command.lane_vx[0] * (c.episode.stall_time - 2.0 * c.physics.control_period)
    return (came < stall.STALL_SHARE * asked) & (asked >= least)


def _asked(world: World, state: EnvState) -> Float[Array, ""]:
    """Return the distance that the command asks for in a whole episode, at most the lane, m."""
    c = world.config
    left = c.episode.length - state.step * c.physics.control_period
    asked = state.commanded + left * state.is_steered * jnp.linalg.norm(state.command[:2])
    return jnp.minimum(asked, world.lanes.end - c.episode.lane_end - state.start[0])


def _placed(
    world: World,
    key: PRNGKeyArray,
    kind: Int[Array, ""],
    level: Int[Array, ""],
    variant: Int[Array, ""],
) -> Body:
    """Return a settled state from the bank, turned a little.

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
        there, height = world.lanes.level_place(kind, level, variant, key_where)
        elsewhere = (jax.random.uniform(key_x) < c.start_anywhere) & jnp.isfinite(there)
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


def _drawn_dynamics(
    world: World, key: PRNGKeyArray, spread: Spread
) -> tuple[Dynamics, Float[Array, " J"], Int[Array, ""]]:
    """Draw the robot's dynamics, its encoder offsets and its action delay in substeps."""
    c, nominal = world.config.randomisation, world.physics.nominal_dynamics()
    if not c.enabled:
        return nominal, jnp.zeros_like(nominal.kp), jnp.zeros((), jnp.int32)
    keys = jax.random.split(key, 7)
    draw = lambda k, shape, low, high: jax.random.uniform(k, shape, minval=low, maxval=high)
    within = lambda middle, share, drawn: middle + share * (drawn - middle)
    joints = nominal.kp.shape
    dynamics = Dynamics(
        friction=within(nominal.friction, spread.friction, draw(keys[0], (), *c.friction)),
        payload=spread.mass * draw(keys[1], (), -c.trunk_mass, c.trunk_mass),
        com_shift=spread.mass * draw(keys[2], (3,), -c.trunk_com, c.trunk_com),
        kp=nominal.kp * within(1.0, spread.gains, draw(keys[3], joints, *c.gains)),
        kd=nominal.kd * within(1.0, spread.gains, draw(keys[4], joints, *c.gains)),
    )
    most = round(c.action_delay / world.config.physics.timestep)
    delay = jax.random.randint(keys[6], (), 0, most + 1)
    return (
        dynamics,
        spread.offsets * draw(keys[5], joints, -c.joint_offset, c.joint_offset),
        jnp.round(spread.delay * delay).astype(jnp.int32),
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


def _drawn_command(
    world: World, key: PRNGKeyArray, kind: Int[Array, ""]
) -> tuple[Float[Array, "3"], Bool[Array, ""]]:
    """Draw a velocity command, and whether the robot is steered along the lane meanwhile.

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


def _drawn_steps(c: config.Config, key: PRNGKeyArray, span: tuple[float, float]) -> Int[Array, ""]:
    """Draw a time within `span` s, in control steps."""
    low, high = (round(t / c.physics.control_period) for t in span)
    return jax.random.randint(key, (), low, high + 1)
