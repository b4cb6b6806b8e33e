"""Rotations of single vectors, with any leading batch axes.

A quaternion is [w, x, y, z], of unit length, and turns a body's vector into its parent frame.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

SMALL = 1e-12  # keeps a division finite; far below any length that matters


def quat_multiply(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n 4"]:
    """Return the Hamilton product a b: the rotation b followed by the rotation a."""
    aw, ax, ay, az = _components(a)
    bw, bx, by, bz = _components(b)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotate(q: Float[Array, "*#n 4"], v: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Return v turned by q: body to parent, v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * _cross(u, v)
    return v + w * t + _cross(u, t)


def rotate_inverse(q: Float[Array, "*#n 4"], v: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Return v turned by the inverse of q: parent to body."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * _cross(u, v)
    return v - w * t + _cross(u, t)


def quat_from_axis_angle(
    axis: Float[Array, "*#n 3"], angle: Float[Array, "*#n"]
) -> Float[Array, "*n 4"]:
    """Return the rotation by `angle`, rad, about the unit vector `axis`."""
    half = 0.5 * angle[..., None]
    vector = jnp.sin(half) * axis
    return jnp.concatenate([jnp.broadcast_to(jnp.cos(half), vector[..., :1].shape), vector], -1)


def quat_to_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Return the rotation matrix; its columns are the body's axes in the parent frame."""
    w, x, y, z = _components(q)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def yaw(q: Float[Array, "*n 4"]) -> Float[Array, "*n"]:
    """Return the heading of the body's x axis in the parent's xy plane, rad in [-pi, pi]."""
    w, x, y, z = _components(q)
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def rotate_yaw(angle: Float[Array, "*#n"], v: Float[Array, "*#n d"]) -> Float[Array, "*n d"]:
    """Return v, of two or three components, turned by `angle`, rad, about +z."""
    turned = jnp.stack(turned_yaw(angle, v[..., 0], v[..., 1]), axis=-1)
    above = jnp.broadcast_to(v[..., 2:], (*turned.shape[:-1], v.shape[-1] - 2))
    return jnp.concatenate([turned, above], axis=-1)


def turned_yaw(
    angle: Float[ArrayLike, "*#n"], x: Float[ArrayLike, "*#n"], y: Float[ArrayLike, "*#n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Return the vectors (x, y) turned by `angle`, rad, about +z, as x and y apart."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def quat_from_z(normal: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Return a rotation that takes +z to the unit vector `normal`.

    It is the shortest one in the upper half, and in the lower half a half turn about x before the
    shortest one from -z: no length near 0 is ever divided by, and the result is exact at -z.
    """
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    upper = z >= 0.0
    w = jnp.sqrt(0.5 * (1.0 + jnp.abs(z)))  # cos of half the angle, >= 0.7
    u, v = 0.5 * x / w, 0.5 * y / w
    zero = jnp.zeros_like(w)
    from_above = jnp.stack([w, -v, u, zero], axis=-1)
    from_below = jnp.stack([-v, w, zero, u], axis=-1)
    return jnp.where(upper[..., None], from_above, from_below)


def _components(q: Float[Array, "*n 4"]) -> tuple[Float[Array, "*n"], ...]:
    """Return w, x, y, z apart."""
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def _cross(a: Float[Array, "*#n 3"], b: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Return a x b, written out: jnp.cross goes through gathers."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
