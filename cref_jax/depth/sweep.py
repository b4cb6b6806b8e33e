"""Depth of ground that is level across, such as stairs, by one sweep over its columns."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from cref_jax import config, terrain
from cref_jax.depth import raymarch
from cref_jax.terrain import Terrain


def profile_depth(
    ground: Terrain,
    position: Float[Array, "3"],
    rotation: Float[Array, "3 3"],
    x: Float[np.ndarray, "1 W"],
    y: Float[np.ndarray, "H 1"],
    camera: config.Camera,
) -> Float[Array, "H W"]:
    """Render the depth of ground that is level across, m; d_max where a ray hits none.

    Only a ray's slope along x matters, s = dz/|dx|. Seen from the camera, a column hides everything
    behind it up to a slope m: that of its far upper edge if it is lower than the camera, else of
    its near one. A ray hits the first column with s <= m; its index is the number of columns whose
    running maximum of m is below s. The columns run forward and backward from the camera's own.
    """
    to_x, to_z = (row[0] * x + row[1] * y + row[2] for row in (rotation[0], rotation[2]))
    per_x = 1.0 / jnp.maximum(jnp.abs(to_x), raymarch.ALONG * ground.cell)
    slope, forward = to_z * per_x, to_x > 0.0

    place = (position[0] - ground.origin[0]) * (1.0 / ground.cell)
    own = jnp.floor(place)
    ahead = jnp.array([1.0, -1.0])[:, None] * np.arange(
        int(raymarch.ray_reach(ground, camera)) + 2.0
    )
    middle = ground.origin[0] + (own + ahead + 0.5) * ground.cell
    across = jnp.broadcast_to(position[1], middle.shape)
    rise = terrain.height_at(ground, jnp.stack([middle, across], axis=-1)) - position[2]
    behind = jnp.stack([place - own, own + 1.0 - place])[:, None]  # columns, part of the own one
    near = jnp.maximum(jnp.abs(ahead) - behind, 0.0) * ground.cell
    far = (jnp.abs(ahead) + 1.0 - behind) * ground.cell
    hidden = jax.lax.cummax(rise / jnp.where(rise < 0.0, far, near), axis=1)

    count = near.shape[1]
    first = jnp.where(forward, 0, count)
    hidden = hidden.reshape(-1)

    def halve(k: Int[Array, ""], column: Int[Array, "H W"]) -> Int[Array, "H W"]:
        after = column + (1 << (count.bit_length() - 1) >> k)
        maximum = hidden.at[first + jnp.minimum(after, count) - 1].get(mode="promise_in_bounds")
        return jnp.where((maximum < slope) & (after <= count), after, column)

    # the number of columns whose running maximum is below s
    column = jax.lax.fori_loop(0, count.bit_length(), halve, jnp.zeros(slope.shape, jnp.int32))
    index = first + jnp.minimum(column, count - 1)
    of_ray = lambda values: values.reshape(-1)[index]
    top = jnp.where(slope < 0.0, of_ray(rise) / slope, 0.0)
    depth = jnp.maximum(of_ray(near), top) * per_x
    is_hit = (column < count) & (depth < camera.d_max)  # False for NaN
    return jnp.where(is_hit, depth, camera.d_max)
