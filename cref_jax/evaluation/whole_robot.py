"""Lanes and starts of the training simulation, for trials of the whole robot."""

import numpy as np
from jaxtyping import Int

from cref_jax.env.world import World
from cref_jax.evaluation import crossing, trials
from cref_jax.rendering import robot_scene
from cref_jax.whole_body.ground import Lane
from cref_jax.whole_body.trial import Start


def to_lane(world: World, level: int = 0) -> Lane:
    """Convert a lane of a world with one kind."""
    ground = world.lanes.tile(level, 0)
    heights, origin = robot_scene.window(ground)
    return Lane(heights, origin, ground.cell, world.lanes.end - world.config.episode.lane_end)


def initial_states(world: World, seed: int, count: int) -> list[Start]:
    """Compute the initial poses and commands of the first trials of this seed."""
    return states_of_trials(world, seed, np.arange(count), crossing.crossing_lanes(count)[1])


def states_of_trials(
    world: World, seed: int, numbers: Int[np.ndarray, " N"], levels: Int[np.ndarray, " N"]
) -> list[Start]:
    """Compute the initial poses and commands of the trials of these numbers, on these lanes."""
    robots = trials.start_robots(world, seed, numbers, np.zeros_like(levels), levels)
    qpos, speeds = np.asarray(robots.env.body.qpos), np.asarray(robots.env.command[:, 0])
    driven = slice(7, 7 + world.physics.robot.num_joints)
    return [Start(x[:7], x[driven], float(v)) for x, v in zip(qpos, speeds, strict=True)]
