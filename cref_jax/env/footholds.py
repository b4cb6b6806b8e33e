"""Where a foot may step, Sec. II-C: windows of level ground ahead of it, frozen at liftoff.

The foot frame lies at the centre of the sole and is turned by the foot's yaw alone: x forward, z
up. F = 2 feet (left, right), K = 25 windows.
"""

from typing import NamedTuple, no_type_check

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from cref_jax import config, geometry, terrain
from cref_jax.robot import Robot, kinematics
from cref_jax.robot.kinematics import Links
from cref_jax.terrain import Terrain

_PASSES = 3  # of the eigenvalue's iteration; one is exact for a plane, three for float32
_TINY = 1e-30  # keeps 0 / 0 at 0


@no_type_check  # vmap and tree.map fill it with batches, and with what is no array
@flax.struct.dataclass
class Candidates:
    """Points where each foot may step, in its frame at its last liftoff."""

    x: Float[Array, "F K"]  # m, mean of the window
    z: Float[Array, "F K"]  # m, mean of the window
    accepted: Bool[Array, "F K"]
    origin: Float[Array, "F 3"]  # m, world: centre of the sole at liftoff
    heading: Float[Array, " F"]  # rad, world: yaw of the foot at liftoff


class Windows(NamedTuple):
    """Mean and shape of the points in each window."""

    x: Float[Array, "*n K"]  # m
    z: Float[Array, "*n K"]  # m
    roughness: Float[Array, "*n K"]  # m, rho: deviation from the plane that fits best
    verticality: Float[Array, "*n K"]  # |v_1z|, of the unit normal of that plane


class Soles(NamedTuple):
    """Poses of the feet in the world."""

    centre: Float[Array, "F 3"]  # m, of the sole
    ankle: Float[Array, "F 3"]  # m, origin of the ankle-roll frame
    heading: Float[Array, " F"]  # rad, yaw


def soles(links: Links, robot: Robot) -> Soles:
    """Compute the soles' poses; a centre is the mean of the contact spheres' lowest points."""
    spheres, ankles = robot.spheres, np.array(robot.ankles)
    lowest = spheres.position - np.array([0.0, 0.0, 1.0], np.float32) * spheres.radius[:, None]
    centre = np.stack([lowest[spheres.foot == foot].mean(axis=0) for foot in range(2)])
    return Soles(
        centre=kinematics.points(links, ankles, centre),
        ankle=links.position[ankles],
        heading=geometry.yaw(links.rotation[ankles]),
    )


def no_candidates(c: config.Foothold) -> Candidates:
    """Return candidates of which none is accepted, as before the first liftoff."""
    shape = (2, _count(c))
    return Candidates(
        x=jnp.zeros(shape),
        z=jnp.zeros(shape),
        accepted=jnp.zeros(shape, bool),
        origin=jnp.zeros((2, 3)),
        heading=jnp.zeros(2),
    )


def candidates(
    ground: Terrain,
    sole: Float[Array, "F 3"],
    heading: Float[Array, " F"],
    forward_command: Float[Array, ""],
    c: config.Foothold,
) -> Candidates:
    """Find the windows ahead of each foot that are planar, level and not recessed.

        rho < r_th,    |v_1z| > eta_th,    mu_z > h_min

    Points nearer than half a second of the forward command are removed, and a window has those that
    remain, if they are `min_points`. With the gate on windows, one that has such a point goes.
    """
    gate = c.gate_time * jnp.maximum(forward_command, 0.0)  # m
    x, _ = _lattice(c)
    left = x[_rows(c)] >= gate
    if c.gate == "points":
        remain, enough = left, c.window[1] * left.sum(axis=1) >= c.min_points
    else:
        remain, enough = np.ones(left.shape, bool), left.all(axis=1)
    found = _windows(_heights(ground, sole, heading, c), remain, c)
    accepted = (
        enough
        & (found.roughness < c.roughness)
        & (found.verticality > c.verticality)
        & (found.z > c.min_height)
    )
    return Candidates(found.x, found.z, accepted, sole, heading)


def windows(z: Float[Array, "*n X Y"], c: config.Foothold) -> Windows:
    """Compute mean, roughness and verticality of each window of points at heights `z`.

        mu = 1/n sum p_i,    Sigma = 1/max(n - 1, 1) sum (p_i - mu)(p_i - mu)^T
        Sigma v_j = lambda_j v_j,    rho = sqrt(max(lambda_1, 0))

    x and y of the points are a lattice, so only the sums with z are worked out; those of squares
    are split into a part within the rows across the foot and a part between them.
    """
    whole = np.ones((_count(c), c.window[0]), bool)
    return _windows([z[..., j] for j in range(c.points[1])], whole, c)


def _windows(
    columns: list[Float[Array, "*n X"]], remain: Bool[ArrayLike, "K L"], c: config.Foothold
) -> Windows:
    """Compute the same from the heights of each column of points along the foot.

    `remain` says which rows of each window count; one without any has no shape.
    """
    x, y = _lattice(c)
    rows, (_, width) = _rows(c), c.window
    if width != c.points[1]:
        raise ValueError(f"a window must be as wide as the buffer: {width}, not {c.points[1]}")
    # summed one by one: a reduction over 5 is slow
    row_z = sum(columns, start=jnp.zeros(())) / width
    off_row = [column - row_z for column in columns]
    row_y = sum((off * float(at) for off, at in zip(off_row, y, strict=True)), jnp.zeros(()))
    off_square = sum((jnp.square(off) for off in off_row), jnp.zeros(()))

    weight = jnp.asarray(remain, jnp.float32)
    count = weight.sum(axis=1)
    among = lambda of_rows: jnp.sum(weight * of_rows, axis=-1)
    mean = lambda of_rows: among(of_rows) / jnp.maximum(count, 1.0)
    mean_x, mean_z = mean(x[rows]), mean(row_z[..., rows])
    dx, dz = x[rows] - mean_x[:, None], row_z[..., rows] - mean_z[..., None]
    divisor = jnp.maximum(width * count - 1.0, 1.0)
    xx, xz = width * among(dx * dx) / divisor, width * among(dx * dz) / divisor
    yy, yz = count * float(np.sum(y**2)) / divisor, among(row_y[..., rows]) / divisor
    zz = (width * among(dz * dz) + among(off_square[..., rows])) / divisor

    smallest, verticality = _flattest((xx, xz), (yy, yz), zz)
    return Windows(
        x=jnp.broadcast_to(mean_x, mean_z.shape),
        z=mean_z,
        roughness=jnp.sqrt(jnp.maximum(smallest, 0.0)),
        verticality=verticality,
    )


def update_candidates(before: Candidates, now: Candidates, bears: Bool[Array, " F"]) -> Candidates:
    """Take new candidates for the feet on the ground, and keep the others' old ones.

    So a foot that has lifted off has those of its last contact, where they were in the world, until
    it is down again.
    """
    choose = lambda new, old: jnp.where(bears.reshape(-1, *[1] * (new.ndim - 1)), new, old)
    return jax.tree.map(choose, now, before)


def distance(frozen: Candidates, sole: Float[Array, "F 3"]) -> Float[Array, " F"]:
    """d_xz, m: from each sole's centre to the nearest accepted candidate, across y not counted.

    It is infinite where none is accepted.
    """
    moved = geometry.rotate_yaw(-frozen.heading, sole - frozen.origin)
    square = jnp.square(moved[:, :1] - frozen.x) + jnp.square(moved[:, 2:] - frozen.z)
    return jnp.sqrt(jnp.where(frozen.accepted, square, jnp.inf).min(axis=-1))


def points(frozen: Candidates) -> Float[Array, "F K 3"]:
    """Compute the accepted candidates in the world, m, for drawing; NaN where refused."""
    ahead = jnp.stack([frozen.x, jnp.zeros_like(frozen.x), frozen.z], axis=-1)
    place = frozen.origin[:, None] + geometry.rotate_yaw(frozen.heading[:, None], ahead)
    return jnp.where(frozen.accepted[..., None], place, jnp.nan)


def count_unsupported(ground: Terrain, feet: Soles, c: config.Foothold) -> Int[Array, " F"]:
    """Count each sole's samples without support: d_ij = z_ground - z_sole < epsilon.

    After BeamDojo (arXiv 2502.10363). The samples lie about the ankle's origin, turned by the
    foot's yaw; z_sole is the centre's.
    """
    assert c.quality_x and c.quality_y  # by robot.fill_in
    grid = np.stack(np.meshgrid(np.linspace(*c.quality_x), np.linspace(*c.quality_y)), axis=-1)
    offsets = jnp.asarray(grid.reshape(-1, 2), jnp.float32)
    points = geometry.rotate_yaw(feet.heading[:, None], offsets) + feet.ankle[:, None, :2]
    depth = terrain.height_at(ground, points) - feet.centre[:, 2:]
    return jnp.sum(depth < c.quality_depth, axis=-1)


def _count(c: config.Foothold) -> int:
    """Return the number of windows, K."""
    return (c.points[0] - c.window[0]) // c.stride + 1


def _rows(c: config.Foothold) -> Int[np.ndarray, "K L"]:
    """Return the buffer rows of each window."""
    return c.stride * np.arange(_count(c))[:, None] + np.arange(c.window[0])


def _lattice(c: config.Foothold) -> tuple[Float[np.ndarray, " X"], Float[np.ndarray, " Y"]]:
    """Compute x and y of the buffer's points in the foot frame, m; x starts at half a spacing."""
    x = (np.arange(c.points[0]) + 0.5) * c.spacing[0]
    y = (np.arange(c.points[1]) - 0.5 * (c.points[1] - 1)) * c.spacing[1]
    return x.astype(np.float32), y.astype(np.float32)


def _heights(
    ground: Terrain, sole: Float[Array, "F 3"], heading: Float[Array, " F"], c: config.Foothold
) -> list[Float[Array, "F X"]]:
    """Look up the ground's height above each sole at each column of its buffer, m."""
    x, y = _lattice(c)
    # the points of one column after the other, as `_windows` takes them
    ahead, aside = np.tile(x, len(y)), np.repeat(y, len(x))
    by_x, by_y = geometry.rotate_yaw_xy(heading[:, None], ahead[None], aside[None])
    z = terrain.height_under(ground, sole[:, :1] + by_x, sole[:, 1:2] + by_y)
    return list((z - sole[:, 2:]).reshape(2, len(y), len(x)).swapaxes(0, 1))


def _flattest(
    along: tuple[Float[Array, " K"], Float[Array, "*n"]],
    across: tuple[Float[Array, " K"], Float[Array, "*n"]],
    zz: Float[Array, "*n"],
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Compute lambda_1 of the covariance [[a, 0, p], [0, b, q], [p, q, zz]] and |v_1z|.

    `along` is (a, p) and `across` (b, q). With b <= a, lambda_1 is the one root up to b of

        zz - s - h(s) - q^2 / (b - s) = 0,    h(s) = p^2 / (a - s)

    and v_1 ~ (-p / (a - s), -q / (b - s), 1). Each pass puts h's tangent in the place of h, which
    leaves a quadratic equation for b - s; from the first on, s comes down on the root from above.
    """
    swapped = along[0] < across[0]
    b, a = jnp.minimum(along[0], across[0]), jnp.maximum(along[0], across[0])
    q, p = (jnp.where(swapped, *pair) for pair in ((along[1], across[1]), (across[1], along[1])))
    s, gap = jnp.zeros_like(zz), jnp.broadcast_to(b, zz.shape)  # b - s
    for _ in range(_PASSES):
        slope = jnp.square(p / (a - s))  # of h
        corner = (zz - jnp.square(p) / (a - s) + slope * s) / (1.0 + slope)
        half = 0.5 * (b - corner)
        gap = half + jnp.sqrt(jnp.square(half) + jnp.square(q) / (1.0 + slope))
        s = b - gap
    slope = jnp.square(p / (a - s))
    length = jnp.square(gap) * (1.0 + slope) + jnp.square(q)
    return s, gap / jnp.sqrt(jnp.maximum(length, _TINY))
