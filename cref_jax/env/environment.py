"""The observation and the step of one environment.

Everything here is for one robot; `jax.vmap` over the state and the key makes thousands, with the
world shared by all.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, Shaped

from cref_jax import config, depth, geometry, terrain
from cref_jax.env import (
    commands,
    curriculum,
    depth_faults,
    events,
    footholds,
    gait,
    observations,
    perforations,
    resets,
    rewards,
    structures,
    terminations,
)
from cref_jax.env.footholds import Soles
from cref_jax.env.observations import Observation
from cref_jax.env.state import Draws, Ending, EnvState
from cref_jax.env.world import World
from cref_jax.physics.records import Body
from cref_jax.robot.kinematics import Links

FAR = 1.0  # m, of a foothold, for the critic; assumed: beyond, the reward is nothing


class Measures(NamedTuple):
    """Measurements of one step, for logs and evaluation."""

    terms: dict[str, Float[Array, ""]]  # weighted reward terms, per second
    speed_error: Float[Array, ""]  # m/s, of the planar velocity
    forward_speed: Float[Array, ""]  # m/s, body frame
    forward_command: Float[Array, ""]  # m/s
    airborne: Bool[Array, " F"]  # the foot is off the ground
    touchdown: Bool[Array, " F"]
    foothold_distance: Float[Array, " F"]  # m, from the nearest candidate; inf where there is none
    progress: Float[Array, ""]  # m from the start along the lane
    commanded: Float[Array, ""]  # m asked for
    steps: Int[Array, ""]  # control steps in the episode, this one included
    pushed: Bool[Array, ""]  # a push was due at the beginning of this step
    kind: Int[Array, ""]
    level: Int[Array, ""]
    rank: Int[Array, ""]


class Outcome(NamedTuple):
    """The result of a step, for the learner."""

    observation: Observation  # of the following state, which is a fresh one after an end
    last_privileged: Float[Array, " S"]  # s of the state reached, before any reset
    reward: Float[Array, ""]
    ending: Ending
    measures: Measures


def observe(world: World, state: EnvState, key: PRNGKeyArray) -> Observation:
    """Compute the observations of policy and critic in this state."""
    c, robot = world.config, world.physics.robot
    clean = observations.motion(state.body.qpos, state.body.qvel, state.action.size)
    sensed = clean._replace(joint_position=clean.joint_position + state.joint_offset)
    if c.randomisation.enabled:
        sensed = observations.with_noise(sensed, c.randomisation, state.spread.noise, key)
    see = lambda m: observations.proprioception(
        m, state.command, jnp.asarray(robot.nominal_pose), state.action
    )
    ground, qpos = _ground(world, state), state.body.qpos
    scan = observations.height_scan(ground, qpos, c.scan)
    heights = None
    if c.network.variant in config.HPL:
        heights = observations.teacher_heights(ground, qpos, state.support_z, c.scan)
    hidden = _hidden_state(world, state) if c.network.critic_sees == "all" else jnp.zeros(0)
    return Observation(
        proprioception=see(sensed),
        privileged=observations.privileged_state(see(clean), clean.velocity, hidden, scan),
        velocity=clean.velocity,
        heights=heights,
    )


def _hidden_state(world: World, state: EnvState) -> Float[Array, " H"]:
    """Gather what else decides rewards and motion: gait, footholds, a_{t-2}, sampled dynamics."""
    gait, dynamics = state.gait, state.dynamics
    row = observations.fine_row(_ground(world, state), state.body.qpos, world.config.scan)
    numbers = (state.since_single, dynamics.friction, dynamics.payload, state.delay)
    parts = (
        *(gait.down, gait.air_time, gait.last_air_time, state.foothold_distance),
        *(state.action_before, dynamics.com_shift, state.joint_offset, row),
    )
    return jnp.concatenate([jnp.stack([x.astype(jnp.float32) for x in numbers]), *parts])


def step(world: World, state: EnvState, action: Float[Array, " J"]) -> tuple[EnvState, Outcome]:
    """Advance 20 ms: push, physics, reward, end of episode, next command and observation.

    A new command comes after the reward, so the reward is for the command that the policy has seen.
    """
    keys = jax.random.split(state.key, 6)
    draws = events.draw(world, state, keys[1], keys[2])
    return _reset_if_over(world, *_step_without_reset(world, state, action, keys, draws))


def step_all(
    world: World, state: EnvState, action: Float[Array, "E J"]
) -> tuple[EnvState, Outcome]:
    """Step E environments, each as `step` does.

    Under `jax.vmap` a push, a command and an episode are drawn for every robot in every step; here,
    only in a step in which one of them is due.
    """
    keys = jax.vmap(lambda key: jax.random.split(key, 6))(state.key)
    each = functools.partial(jax.vmap, in_axes=(None, 0, 0, 0))
    drawn = lambda: each(events.draw)(world, state, keys[:, 1], keys[:, 2])
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(drawn))
    due = jax.vmap(events.is_draw_due, in_axes=(None, 0))(world, state)
    draws = jax.lax.cond(jnp.any(due), drawn, lambda: none)
    advance = jax.vmap(_step_without_reset, in_axes=(None, 0, 0, 0, 0))
    reached = advance(world, state, action, keys, draws)
    ending = reached.outcome.ending
    renew = lambda: each(_reset_if_over)(world, *reached)
    keep = lambda: (reached.state, reached.outcome)
    return jax.lax.cond(jnp.any(ending.terminated | ending.truncated), renew, keep)


class _Reached(NamedTuple):
    """The result of a step before any reset."""

    state: EnvState
    outcome: Outcome
    keys: Shaped[Array, "3 ..."]  # for the next level, the reset and the first observation


def _step_without_reset(
    world: World,
    state: EnvState,
    action: Float[Array, " J"],
    keys: Shaped[Array, "6 ..."],
    draws: Draws,
) -> _Reached:
    """Advance one control step as if the episode continued."""
    c = world.config
    pushed = events.is_push_due(world, state)
    state = events.apply_push(world, state.replace(key=keys[0]), draws)
    action = jnp.clip(action, -c.robot.action_clip, c.robot.action_clip)

    targets = jnp.stack([_target(world, state, state.action), _target(world, state, action)])
    body, force = world.physics.step(
        _ground(world, state), state.body, targets, state.delay, state.dynamics
    )
    unstable = _is_unstable(body, c.physics)
    body = jax.tree.map(lambda new, old: jnp.where(unstable, old, new), body, state.body)
    force = jnp.where(unstable, 0.0, force)

    links = world.physics.links(body)
    soles = footholds.soles(links, world.physics.robot)
    touching = rewards.is_touching(force, c.reward)
    feet, swings = gait.update_gait(
        state.gait, touching, c.physics.control_period, c.reward.debounce
    )
    state = state.replace(gait=feet)
    snapshot = _reward_snapshot(world, state, body, links, soles, force, swings, action)
    lived = _next_state(world, state, body, soles, snapshot)
    gained, terms = rewards.total(snapshot, c.reward, world.physics.robot)
    ending = terminations.check_termination(world, lived, links, unstable)
    measures = _measures(lived, snapshot, terms, pushed)
    lived = commands.update_command(world, terminations.record_progress(world, lived), draws)
    last = observe(world, lived, keys[5])

    gained = jnp.where(unstable, 0.0, gained)
    return _Reached(lived, Outcome(last, last.privileged, gained, ending, measures), keys[3:])


def _reset_if_over(
    world: World, lived: EnvState, outcome: Outcome, keys: Shaped[Array, "3 ..."]
) -> tuple[EnvState, Outcome]:
    """Reset the environment if its episode is over, and observe the fresh state."""
    key_level, key_reset, key_see = keys
    done = outcome.ending.terminated | outcome.ending.truncated
    rank, level = curriculum.next_level(world, lived, outcome.ending, key_level)
    fresh = resets.reset(world, key_reset, lived.kind, level, lived.spread).replace(rank=rank)
    first = observe(world, fresh, key_see)
    choose = lambda new, old: jnp.where(done, new, old)
    seen = jax.tree.map(choose, first, outcome.observation)
    return jax.tree.map(choose, fresh, lived), outcome._replace(observation=seen)


def depth_image(world: World, state: EnvState, is_profile: bool = False) -> Float[Array, "H W"]:
    """Render D, the normalised depth image of ground and links, with the camera's faults."""
    return _to_image(world, _misread(world, state, render_depth(world, state, is_profile)))


def depth_images(
    world: World, state: EnvState, is_profile: bool = False
) -> tuple[Float[Array, "H W"], Float[Array, "H W"]]:
    """Render D as `depth_image` does, and the same without the camera's faults."""
    metres = render_depth(world, state, is_profile)
    return _to_image(world, _misread(world, state, metres)), _to_image(world, metres)


def _misread(world: World, state: EnvState, metres: Float[Array, "H W"]) -> Float[Array, "H W"]:
    if not depth_faults.has_faults(world.config.randomisation):
        return metres
    return depth_faults.misread(world, state, metres)


def _to_image(world: World, metres: Float[Array, "H W"]) -> Float[Array, "H W"]:
    camera = world.config.camera
    return depth.normalize(depth.min_filter(metres, camera.window), camera)


def render_depth(
    world: World, state: EnvState, is_profile: bool = False, with_links: bool = True
) -> Float[Array, "H W"]:
    """Render the depth of the ground and, if wanted, of the robot's own links and structures, m.

    `is_profile` says that the robot's lane is level across: see depth.render.
    """
    robot, camera = world.physics.robot, world.config.camera
    links = world.physics.links(state.body)
    position, rotation = depth.pose(
        links, robot.camera, camera, state.camera_pitch, state.camera_shift
    )
    capsules = depth.capsules_in_view(links, robot.capsules) if with_links else jnp.zeros((0, 7))
    randomisation = world.config.randomisation
    if with_links and randomisation.enabled and randomisation.structures:
        capsules = jnp.concatenate([capsules, structures.sample_structures(world, state)])
    ground = _ground(world, state)
    if not (with_links and randomisation.enabled and randomisation.perforations):
        return depth.render(ground, position, rotation, capsules, camera, is_profile)
    whole = depth.render(ground, position, rotation, jnp.zeros((0, 7)), camera, is_profile)
    pierced = perforations.see_through(world, state, whole, position, rotation)
    return jnp.minimum(pierced, depth.render_capsules(position, rotation, capsules, camera))


def _ground(world: World, state: EnvState) -> terrain.Terrain:
    return world.lanes.tile(state.level, state.kind, state.variant)


def _target(world: World, state: EnvState, action: Float[Array, " J"]) -> Float[Array, " J"]:
    """q_target = q_0 + a, Eq. 4, per-joint scale; the encoder's offset shifts what is reached."""
    robot = world.physics.robot
    return robot.nominal_pose + robot.action_scale * action - state.joint_offset


def _is_unstable(body: Body, c: config.Physics) -> Bool[Array, ""]:
    finite = jnp.isfinite(body.qpos).all() & jnp.isfinite(body.qvel).all()
    return ~(finite & (jnp.abs(body.qvel).max() < c.velocity_limit))


def _reward_snapshot(
    world: World,
    state: EnvState,
    body: Body,
    links: Links,
    soles: Soles,
    force: Float[Array, "F 3"],
    swings: gait.Swings,
    action: Float[Array, " J"],
) -> rewards.Snapshot:
    """Collect the reward's inputs from the state before the step and the body after it.

    The feet's gait is that of after the step.
    """
    c, feet = world.config, world.physics.feet
    period = c.physics.control_period
    foot = links.position[feet]
    single = state.gait.down[0] ^ state.gait.down[1]
    now = observations.motion(body.qpos, body.qvel, action.size)
    across = geometry.rotate_yaw(-geometry.yaw(body.qpos[3:7]), foot[0] - foot[1])[1]
    return rewards.Snapshot(
        velocity=now.velocity,
        angular_velocity=now.angular_velocity,
        gravity=now.gravity,
        command=state.command,
        base_z=body.qpos[2],
        joint_position=now.joint_position,
        joint_velocity=now.joint_velocity,
        action=action,
        action_1=state.action,
        action_2=state.action_before,
        foot_z=foot[:, 2],
        feet_y=jnp.abs(across),
        foot_velocity=links.velocity[feet],
        foot_velocity_before=state.foot_velocity,
        foot_force=force,
        first_contact=swings.touchdown,
        air_time=swings.air_time,
        last_air_time=state.gait.last_air_time,
        foothold_distance=footholds.distance(state.candidates, soles.centre),
        unsupported=footholds.count_unsupported(_ground(world, state), soles, c.foothold),
        walls_touched=_count_walls_touched(world, state, links),
        since_single=jnp.where(single, 0.0, state.since_single + period),
        control_period=jnp.float32(period),
    )


def _count_walls_touched(world: World, state: EnvState, links: Links) -> Int[Array, ""]:
    """Count the contact spheres at a wall, if the reward asks for them."""
    if not world.config.reward.weights.wall_contact:
        return jnp.int32(0)
    return world.physics.at_wall(_ground(world, state), links).sum()


def _next_state(
    world: World, state: EnvState, body: Body, soles: Soles, s: rewards.Snapshot
) -> EnvState:
    """Compute the state after the step, if the episode continues."""
    c = world.config
    touching = rewards.is_touching(s.foot_force, c.reward)
    support = rewards.support_height(s.foot_z, s.foot_force, c.reward)
    ahead = footholds.candidates(
        _ground(world, state), soles.centre, soles.heading, state.command[0], c.foothold
    )
    return state.replace(
        body=body,
        action=s.action,
        action_before=s.action_1,
        foot_velocity=s.foot_velocity,
        since_single=s.since_single,
        support_z=jnp.where(touching.any(), support, state.support_z),
        foothold_distance=jnp.minimum(s.foothold_distance, FAR),
        candidates=footholds.update_candidates(state.candidates, ahead, touching & state.gait.down),
        step=state.step + 1,
    )


def _measures(
    state: EnvState,
    s: rewards.Snapshot,
    terms: dict[str, Float[Array, ""]],
    pushed: Bool[Array, ""],
) -> Measures:
    return Measures(
        terms=terms,
        speed_error=jnp.linalg.norm(s.command[:2] - s.velocity[:2]),
        forward_speed=s.velocity[0],
        forward_command=s.command[0],
        airborne=~state.gait.down,
        touchdown=s.first_contact,
        foothold_distance=s.foothold_distance,
        progress=state.body.qpos[0] - state.start[0],
        commanded=state.commanded,
        steps=state.step,
        pushed=pushed,
        kind=state.kind,
        level=state.level,
        rank=state.rank,
    )
