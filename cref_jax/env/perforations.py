"""Ground that is seen through: slats, grates and perforated plates, in the depth image alone.

A foot stands on what has holes narrower than itself as on any ground; what is under the holes is
drawn from where the episode began, as structures are.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cref_jax import depth, terrain
from cref_jax.env import structures
from cref_jax.env.state import EnvState
from cref_jax.env.world import World

SHARE = 0.5  # of the episodes; assumed
NARROWEST = 0.02  # m, of a hole; assumed
WEBS = (0.02, 0.10)  # m, what is left between two holes; assumed
BELOW = (0.1, 0.6)  # m from the ground to what is seen through it; assumed
CLOSE = 0.01  # m, how far behind a ray's end, and above the ground, a point still is of it; assumed


def see_through(
    world: World,
    state: EnvState,
    metres: Float[Array, "H W"],
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
) -> Float[Array, "H W"]:
    """Compute the depth image, m, of a camera there where the ground has this episode's holes.

    A ray that meets a hole goes on to a level below; steps without risers are of holes there, too.
    """
    c = world.config
    kinds = np.isin(world.lanes.kinds, c.terrain.slit_kinds or world.lanes.kinds)
    keys = jax.random.split(structures.episode_key(world, state, salt=2), 2)
    u, pattern = jax.random.uniform(keys[0], (8,)), jax.random.randint(keys[1], (), 0, 3)
    between = lambda k, low, high: low + (high - low) * u[k]
    points = depth.locate_pixels(metres, position, rotation, c.camera)
    width = between(1, NARROWEST, jnp.maximum(NARROWEST, c.randomisation.perforations))
    across = (points[..., 0] + u[2]) % (width + between(3, *WEBS)) < width
    along = (points[..., 1] + u[4]) % (width + between(5, *WEBS)) < width
    is_hole = jnp.stack([across, along, across & along])[pattern]
    is_seen = (u[0] < SHARE) & jnp.asarray(kinds)[state.kind]
    falls = position[2] - points[..., 2]  # m, from the camera to where the ray ends
    farther = metres * (1.0 + between(6, *BELOW) / jnp.maximum(falls, CLOSE))
    is_open = is_seen & is_hole & (falls > CLOSE) & _is_ground(world, state, points, position)
    return jnp.where(is_open, jnp.minimum(farther, c.camera.d_max), metres)


def _is_ground(
    world: World, state: EnvState, points: Float[Array, "H W 3"], position: Float[Array, "3"]
) -> Bool[Array, "H W"]:
    """Check which points are of the ground, not of a link: where it is as high, behind them."""
    ray = points[..., :2] - position[:2]
    behind = points[..., :2] + CLOSE * ray / jnp.linalg.norm(ray, axis=-1, keepdims=True)
    ground = world.lanes.tile(state.level, state.kind, state.variant)
    return points[..., 2] < terrain.height_at(ground, behind) + CLOSE
