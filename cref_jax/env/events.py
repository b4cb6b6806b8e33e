"""Pushes and new commands, drawn only in the steps in which one is due."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, PRNGKeyArray

from cref_jax.env import commands, randomization
from cref_jax.env.state import Draws, EnvState
from cref_jax.env.world import World


def is_draw_due(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether a push or a new command is due in this step."""
    return (state.command_left <= 0) | is_push_due(world, state)


def is_push_due(world: World, state: EnvState) -> Bool[Array, ""]:
    """Return whether a push is due in this step."""
    return world.config.randomisation.enabled & (state.push_left <= 0)


def draw(world: World, state: EnvState, key_push: PRNGKeyArray, key_command: PRNGKeyArray) -> Draws:
    """Draw the next push and the next command, used where they are due."""
    c = world.config
    most, turn = c.randomisation.push_velocity, c.randomisation.push_yaw_rate
    key_shove, key_after = jax.random.split(key_push)
    key_next, key_left = jax.random.split(key_command)
    command, is_steered = commands.sample_command(world, key_next, state.kind)
    return Draws(
        shove=jax.random.uniform(key_shove, (2,), minval=-most, maxval=most),
        turn=jax.random.uniform(jax.random.fold_in(key_shove, 0), minval=-turn, maxval=turn),
        push_left=randomization.sample_steps(c, key_after, c.randomisation.push_period),
        command=command,
        is_steered=is_steered,
        command_left=randomization.sample_steps(c, key_left, c.command.period),
    )


def apply_push(world: World, state: EnvState, draws: Draws) -> EnvState:
    """Add a sudden planar velocity, and a turn, to the base when a push is due."""
    if not world.config.randomisation.enabled:
        return state
    due = is_push_due(world, state)
    share = jnp.where(due, state.spread.pushes, 0.0)
    qvel = state.body.qvel.at[:2].add(share * draws.shove)
    if world.config.randomisation.push_yaw_rate > 0.0:
        qvel = qvel.at[5].add(share * draws.turn)
    return state.replace(
        body=state.body._replace(qvel=qvel),
        push_left=jnp.where(due, draws.push_left, state.push_left - 1),
    )
