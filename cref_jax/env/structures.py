"""Structures beside and over a lane that the depth camera alone sees: rails, posts, walls, bars.

Training has none otherwise, and a policy must not take a hand-rail for ground. They are drawn from
where the episode began, so that the state holds nothing of them, and follow the ground's height.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from cref_jax import terrain
from cref_jax.env.state import EnvState
from cref_jax.env.world import World

PRESENT = 0.5  # chance of each to be there, fully randomised; assumed
FREE = 0.45  # m from the lane's middle to the nearest surface beside it; assumed: arms pass
ABSENT = np.array([0.0, 0.0, -100.0, 0.0, 0.0, -100.0, 0.0], np.float32)  # far below everything


def sample_structures(world: World, state: EnvState) -> Float[Array, "S 7"]:
    """Draw the capsules of an episode: both ends and radius, m, in the lane's coordinates."""
    count = world.config.randomisation.structures
    keys = jax.random.split(episode_key(world, state, salt=0), count)
    ground = world.lanes.tile(state.level, state.kind, state.variant)
    chance = PRESENT * state.spread.camera
    return jax.vmap(lambda k: _sample_structure(ground, world.lanes.end, chance, k))(keys)


def episode_key(world: World, state: EnvState, salt: int) -> PRNGKeyArray:
    """Derive a random key of an episode from where it began; each use has its own salt."""
    place = jax.lax.bitcast_convert_type(state.start, jnp.uint32)
    key = jax.random.key(world.config.terrain.seed)
    for number in (*place, state.kind, salt):
        key = jax.random.fold_in(key, number)
    return key


def _sample_structure(
    ground: terrain.Terrain, end: Float[Array, ""], chance: Float[Array, ""], key: PRNGKeyArray
) -> Float[Array, "7"]:
    """Draw one capsule of a kind drawn by chance, or none."""
    key_present, key_kind, key_shape = jax.random.split(key, 3)
    u = jax.random.uniform(key_shape, (5,))
    between = lambda k, low, high: low + (high - low) * u[k]
    side, x = jnp.where(u[0] < 0.5, -1.0, 1.0), between(1, 0.0, end)
    aside, thin = between(2, FREE, 1.3), between(4, 0.015, 0.05)
    on = lambda x, y, z: jnp.stack([x, y, z + terrain.height_at(ground, jnp.stack([x, 0.0 * y]))])
    rail_y, rail_z, far = side * (aside + thin), between(3, 0.5, 1.1), x + between(0, 2.0, 8.0)
    thick = between(4, 0.2, 0.5)
    wall_y, wall_z = side * (aside + thick), between(3, -0.2, 0.6)
    post_y, bar_z = side * (aside + 2.0 * thin), between(3, 1.4, 2.0)
    of_kind = [
        (on(x, rail_y, rail_z), on(far, rail_y, rail_z), thin),
        (on(x, wall_y, wall_z), on(far, wall_y, wall_z), thick),
        (on(x, post_y, 0.0 * x), on(x, post_y, between(3, 0.6, 2.0)), 2.0 * thin),
        (on(x, -1.3 + 0.0 * x, bar_z), on(x, 1.3 + 0.0 * x, bar_z), thin),
    ]
    drawn = jnp.stack([jnp.concatenate([*ends, radius[None]]) for *ends, radius in of_kind])
    kind = jax.random.randint(key_kind, (), 0, len(of_kind))
    return jnp.where(jax.random.uniform(key_present) < chance, drawn[kind], ABSENT)
