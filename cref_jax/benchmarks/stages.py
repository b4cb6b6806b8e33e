"""The stages of a training iteration as separate programs for the benchmark.

Each does the work of `STEPS` control steps for the given robots, with a dependency between steps,
so that XLA can neither eliminate the work nor hoist it out of the loop.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp

from cref_jax import depth, ppo
from cref_jax.env import environment, footholds
from cref_jax.env.world import World
from cref_jax.training import camera_feed, iteration, rollout

STEPS = 24  # control steps per call, as in one horizon


def step_environment(world: World, robots: rollout.Robots) -> Any:
    """Step the whole environment with small random actions."""
    joints = robots.env.action.shape[-1]

    def step(state: environment.EnvState, key: jax.Array) -> tuple[environment.EnvState, Any]:
        action = 0.3 * jax.random.normal(key, (*state.step.shape, joints))
        state, outcome = environment.step_all(world, state, action)
        return state, (outcome.reward.sum(), outcome.observation.privileged.sum())

    return jax.lax.scan(step, robots.env, jax.random.split(jax.random.key(1), STEPS))


def step_physics(world: World, robots: rollout.Robots) -> Any:
    """Step only the physics, including its terrain queries."""
    target = jnp.asarray(world.physics.robot.nominal_pose)

    def one(state: environment.EnvState, body: Any) -> Any:
        ground = world.lanes.tile(state.level, state.kind, state.variant)
        return world.physics.step(
            ground, body, jnp.stack([target, target]), state.delay, state.dynamics
        )[0]

    step = lambda body, _: (jax.vmap(one)(robots.env, body), None)
    return jax.lax.scan(step, robots.env.body, None, length=STEPS)[0]


def query_terrain(world: World, robots: rollout.Robots) -> Any:
    """Query the tangent planes of all spheres once per physics substep."""

    def one(state: environment.EnvState, body: Any) -> Any:
        return world.physics.planes(world.lanes.tile(state.level, state.kind, state.variant), body)

    def query(body: Any, _: None) -> tuple[Any, None]:
        position, rotation = jax.vmap(one)(robots.env, body)
        moved = 1e-6 * (position.sum(axis=(1, 2)) + rotation.sum(axis=(1, 2)))
        return body._replace(qpos=body.qpos.at[:, 0].add(moved)), None  # prevents hoisting

    count = STEPS * world.config.physics.substeps
    return jax.lax.scan(query, robots.env.body, None, length=count)[0]


def render_frames(world: World, robots: rollout.Robots) -> Any:
    """Render the depth frames of `STEPS` control steps."""
    c = world.config
    count = depth.max_frames(STEPS, c.camera, c.physics.control_period)

    def render(state: environment.EnvState, _: None) -> tuple[environment.EnvState, None]:
        images = camera_feed.render_frames(world, state)
        moved = 1e-9 * images.sum(axis=(1, 2, 3), dtype=jnp.float32)  # prevents hoisting
        return state.replace(camera_pitch=state.camera_pitch + moved), None

    return jax.lax.scan(render, robots.env, None, length=count)[0]


def find_footholds(world: World, robots: rollout.Robots) -> Any:
    """Compute foothold candidates and their distances, as in each control step."""
    c = world.config.foothold

    def one(state: environment.EnvState, body: Any) -> Any:
        ground = world.lanes.tile(state.level, state.kind, state.variant)
        soles = footholds.soles(world.physics.links(body), world.physics.robot)
        near = footholds.distance(state.candidates, soles.centre)
        ahead = footholds.candidates(ground, soles.centre, soles.heading, state.command[0], c)
        lost = footholds.count_unsupported(ground, soles, c)
        return near.sum() + ahead.z.sum() + ahead.accepted.sum() + lost.sum()

    def find(body: Any, _: None) -> tuple[Any, None]:
        sums = jax.vmap(one)(robots.env, body)
        moved = 1e-9 * jnp.where(jnp.isfinite(sums), sums, 0.0)
        return body._replace(qpos=body.qpos.at[:, 0].add(moved)), None  # prevents hoisting

    return jax.lax.scan(find, robots.env.body, None, length=STEPS)[0]


def run_policy(world: World, state: iteration.RunState) -> Any:
    """Run only the policy, which encodes frames at the camera rate."""
    c = world.config
    nets = rollout.networks(c.network, state.robots.env.action.shape[-1])

    def step(robots: rollout.Robots, clock: Any) -> tuple[rollout.Robots, Any]:
        due = depth.is_due(clock, c.camera, c.physics.control_period)
        feed = robots.feed and robots.feed.replace(fresh=due)
        memory, policy = rollout.apply_policy(nets, state.train, robots.replace(feed=feed))
        return robots.replace(memory=memory), policy.mean.sum()

    return jax.lax.scan(step, state.robots, jnp.arange(STEPS))


def update(world: World, state: iteration.RunState) -> Any:
    """Run one update epoch on a rollout of zeros with the right shapes."""
    c = world.config
    c = dataclasses.replace(c, ppo=dataclasses.replace(c.ppo, horizon=STEPS))
    nets = rollout.networks(c.network, state.robots.env.action.shape[-1])
    collect = functools.partial(rollout.collect, dataclasses.replace(world, config=c), nets)
    shapes = jax.eval_shape(collect, state.train, state.robots, jax.random.key(0))[1]
    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    return ppo.update(state.train, zeros, jax.random.key(0), c.ppo, nets.functions, iteration.AXIS)
