"""Which level of difficulty the next episode has."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from cref_jax.env.state import Ending, EnvState
from cref_jax.env.world import World


def next_level(
    world: World, state: EnvState, over: Ending, key: PRNGKeyArray
) -> tuple[Int[Array, ""], Int[Array, ""]]:
    """Update the rank after an episode and draw the level of the next.

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
    asked = _commanded_distance(world, state)
    # nothing is asked of a robot that was told to stand all the time, however it drifts
    down = ~up & (asked > 0.0) & (walked < c.down * asked)
    earned = state.rank + (up.astype(jnp.int32) - down) * (state.level == state.rank)
    rank = jnp.clip(earned, 0, top)
    key_review, key_level = jax.random.split(key)
    review = (earned > top) | (jax.random.uniform(key_review) < c.review)
    return rank, jnp.where(review, jax.random.randint(key_level, (), 0, rank + 1), rank)


def _commanded_distance(world: World, state: EnvState) -> Float[Array, ""]:
    """Compute the distance commanded over a whole episode, at most the lane's length, m."""
    c = world.config
    left = c.episode.length - state.step * c.physics.control_period
    asked = state.commanded + left * state.is_steered * jnp.linalg.norm(state.command[:2])
    return jnp.minimum(asked, world.lanes.end - c.episode.lane_end - state.start[0])
