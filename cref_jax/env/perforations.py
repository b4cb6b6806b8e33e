"""Ground that is seen through: slats, grates, open stairs, in the depth image alone.

A foot stands on what has holes narrower than itself as on any ground; what is under the holes is
drawn from where the episode began, as structures are.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from cref_jax import depth
from cref_jax.env import structures
from cref_jax.env.state import EnvState
from cref_jax.env.world import World

SHARE = 0.5  # of the episodes; assumed
OPEN_STAIRS = 0.5  # of those with holes in treads, the share with no risers, too; assumed
NARROWEST = 0.02  # m, of a hole; assumed
WEBS = (0.02, 0.10)  # m, what is left between two holes; assumed
BELOW = (0.1, 0.6)  # m from the ground to what is seen through it; assumed
LEAST_FALL = 0.01  # m, of a ray that meets the ground; higher ground stays as it is


def see_through(
    world: World,
    state: EnvState,
    metres: Float[Array, "H W"],
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
) -> Float[Array, "H W"]:
    """Compute the depth of the ground, m, seen from there, with the holes of this episode.

    A ray that meets a hole goes on to a level below. Steps may have no risers, too: their edge
    remains, as thick as a pixel.
    """
    c = world.config
    kinds = np.isin(world.lanes.kinds, c.terrain.slit_kinds or world.lanes.kinds)
    keys = jax.random.split(structures.episode_key(world, state, salt=2), 2)
    u, pattern = jax.random.uniform(keys[0], (9,)), jax.random.randint(keys[1], (), 0, 4)
    between = lambda k, low, high: low + (high - low) * u[k]
    x, y, z = depth.locate_pixels(metres, position, rotation, c.camera)
    width = between(1, NARROWEST, jnp.maximum(NARROWEST, c.randomisation.perforations))
    across = _is_in_hole(x + u[2], width, between(3, *WEBS))
    along = _is_in_hole(y + u[4], width, between(5, *WEBS))
    is_riser = _is_on_riser(x, y, z)
    hole = jnp.stack([across, along, across & along, is_riser])[pattern]
    is_hole = hole | (is_riser & (u[8] < OPEN_STAIRS))
    is_seen = (u[0] < SHARE) & jnp.asarray(kinds)[state.kind]
    falls = position[2] - z  # m, from the camera to where the ray ends
    farther = metres * (1.0 + between(6, *BELOW) / jnp.maximum(falls, LEAST_FALL))
    is_open = is_seen & is_hole & (falls > LEAST_FALL)
    return jnp.where(is_open, jnp.minimum(farther, c.camera.d_max), metres)


def _is_in_hole(
    place: Float[Array, "H W"], hole: Float[Array, ""], web: Float[Array, ""]
) -> Bool[Array, "H W"]:
    """Check which places, m, are in one of the holes that alternate with webs."""
    period = hole + web
    turns = place / period
    return (turns - jnp.floor(turns)) * period < hole


def _is_on_riser(
    x: Float[Array, "H W"], y: Float[Array, "H W"], z: Float[Array, "H W"]
) -> Bool[Array, "H W"]:
    """Check from which places, m, the ground rises steeply to the next row of the image."""
    ahead, aside, up = (-jnp.diff(a, axis=0, prepend=a[:1]) for a in (x, y, z))
    return up > jnp.hypot(ahead, aside)
