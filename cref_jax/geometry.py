"""Rotations of single vectors, with any leading batch axes.

Quaternions are unit [w, x, y, z] and rotate vectors from the body frame to the parent frame.
"""

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

SMALL = 1e-12  # keeps divisions finite; far below any relevant length


def quat_multiply(a: Float[Array, "*#n 4"], b: Float[Array, "*#n 4"]) -> Float[Array, "*n 4"]:
    """Compute the Hamilton product a b: the rotation b followed by the rotation a."""
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
    """Rotate v by q, body to parent: v + 2 w (u x v) + 2 u x (u x v)."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * _cross(u, v)
    return v + w * t + _cross(u, t)


def rotate_inverse(q: Float[Array, "*#n 4"], v: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Rotate v by the inverse of q: parent to body."""
    w, u = q[..., :1], q[..., 1:]
    t = 2.0 * _cross(u, v)
    return v - w * t + _cross(u, t)


def quat_from_axis_angle(
    axis: Float[Array, "*#n 3"], angle: Float[Array, "*#n"]
) -> Float[Array, "*n 4"]:
    """Compute the rotation by `angle`, rad, about the unit vector `axis`."""
    half = 0.5 * angle[..., None]
    vector = jnp.sin(half) * axis
    return jnp.concatenate([jnp.broadcast_to(jnp.cos(half), vector[..., :1].shape), vector], -1)


def quat_to_matrix(q: Float[Array, "*n 4"]) -> Float[Array, "*n 3 3"]:
    """Compute the rotation matrix; its columns are the body axes in the parent frame."""
    w, x, y, z = _components(q)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def yaw(q: Float[Array, "*n 4"]) -> Float[Array, "*n"]:
    """Compute the heading of the body's x axis in the parent's xy plane, rad in [-pi, pi]."""
    w, x, y, z = _components(q)
    return jnp.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def rotate_yaw(angle: Float[Array, "*#n"], v: Float[Array, "*#n d"]) -> Float[Array, "*n d"]:
    """Rotate v, of two or three components, by `angle`, rad, about +z."""
    xy = jnp.stack(rotate_yaw_xy(angle, v[..., 0], v[..., 1]), axis=-1)
    z = jnp.broadcast_to(v[..., 2:], (*xy.shape[:-1], v.shape[-1] - 2))
    return jnp.concatenate([xy, z], axis=-1)


def rotate_yaw_xy(
    angle: Float[ArrayLike, "*#n"], x: Float[ArrayLike, "*#n"], y: Float[ArrayLike, "*#n"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Rotate the vectors (x, y) by `angle`, rad, about +z; return x and y separately."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def quat_from_z(normal: Float[Array, "*n 3"]) -> Float[Array, "*n 4"]:
    """Compute a rotation that takes +z to the unit vector `normal`.

    For normals in the upper half space it is the shortest one; in the lower half, a half turn about
    x followed by the shortest one from -z. So no divisor is near 0, and the result is exact at -z.
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
    """Split a quaternion into w, x, y, z."""
    return q[..., 0], q[..., 1], q[..., 2], q[..., 3]


def _cross(a: Float[Array, "*#n 3"], b: Float[Array, "*#n 3"]) -> Float[Array, "*n 3"]:
    """Compute a x b, written out because jnp.cross uses gathers."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return jnp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)
