"""Foothold candidates: numbers worked by hand, and numpy's eigh in float64 as the oracle."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compilation import AS_SHIPPED
from hypothesis import given, settings
from hypothesis import strategies as st

from cref_jax import config, geometry, robot, terrain
from cref_jax.env import footholds
from cref_jax.robot import kinematics
from cref_jax.terrain import lanes

C = robot.fill_in(config.Config()).foothold
X = 0.12 + 0.04 * np.arange(25)  # m, means of the windows: 24 cm from 0 on, every 4 cm
ACROSS = 0.007  # m, y of the soles: no point of the buffer lies on the border of two columns

windows = jax.jit(
    lambda z, c=C: footholds.windows(z, c), static_argnums=1, compiler_options=AS_SHIPPED
)


@jax.jit
def candidates(ground, sole, heading, command):
    return footholds.candidates(ground, sole, heading, command, C)


def lane(height_of_x) -> terrain.Terrain:
    """Return 4 m x 2 m of columns of 2 cm, as high as a function of their middle's x says, m."""
    x = -1.0 + 0.02 * (np.arange(200) + 0.5)
    heights = np.repeat(np.vectorize(height_of_x)(x)[:, None], 100, axis=1)
    return terrain.from_heights(heights, 0.02, (-1.0, -1.0))


def soles(x=0.0, y=ACROSS, z=0.0):
    """Return both soles at one place."""
    return jnp.broadcast_to(jnp.array([x, y, z], jnp.float32), (2, 3))


def ahead(ground, command=0.0, sole=None, heading=0.0):
    """Return what the feet may step on that stand before the ground's obstacle."""
    sole = soles() if sole is None else sole
    return candidates(ground, sole, jnp.full(2, heading), jnp.float32(command))


def check(found, numbers, z) -> None:
    """Assert that the windows of these numbers and no others are accepted, at these heights."""
    for foot in range(2):
        assert list(np.flatnonzero(found.accepted[foot])) == list(numbers)
        np.testing.assert_allclose(found.x[foot], X, atol=1e-6)
        np.testing.assert_allclose(found.z[foot][np.array(numbers, int)], z, atol=1e-6)


def reference(z, c):
    """Return mean z, roughness, |v_1z| and how far apart the two smallest eigenvalues are, f64."""
    x = (np.arange(c.points[0]) + 0.5) * c.spacing[0]
    y = np.linspace(-0.5, 0.5, c.points[1]) * (c.points[1] - 1) * c.spacing[1]
    found = []
    for first in range(0, c.points[0] - c.window[0] + 1, c.stride):
        rows = slice(first, first + c.window[0])
        part = np.asarray(z, np.float64)[rows]
        points = np.stack([*np.meshgrid(x[rows], y, indexing="ij"), part], -1).reshape(-1, 3)
        size, v = np.linalg.eigh(np.cov(points.T))  # of divisor n - 1
        mean, roughness = points.mean(axis=0), math.sqrt(max(size[0], 0.0))
        found.append([mean[0], mean[2], roughness, abs(v[2, 0]), size[1] - size[0]])
    return np.array(found).T


def agrees(z, c=C) -> None:
    """Assert that the windows of one buffer are those of the reference."""
    found = windows(jnp.asarray(z, jnp.float32), c)
    mean_x, mean_z, roughness, verticality, apart = reference(np.asarray(z, np.float32), c)
    np.testing.assert_allclose(found.x, mean_x, atol=1e-6)
    np.testing.assert_allclose(found.z, mean_z, atol=1e-6)
    np.testing.assert_allclose(found.roughness, roughness, atol=1e-4, rtol=1e-4)
    clear = apart > 1e-5  # m^2; nearer to each other, either direction is right
    np.testing.assert_allclose(found.verticality[clear], verticality[clear], atol=3e-4)


@given(
    seed=st.integers(0, 2**32 - 1),
    noise=st.sampled_from([0.0, 1e-3, 0.01, 0.05, 0.3]),  # m
    step=st.sampled_from([0.0, 0.05, 0.23, 1.0]),  # m
    slope=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)),
    level=st.floats(-1.0, 1.0),  # m
)
@settings(max_examples=150, deadline=None)
def test_any_patch_has_the_eigenvalues_of_eigh(seed, noise, step, slope, level):
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(0.01 + 0.02 * np.arange(60), 0.025 * np.arange(-2, 3), indexing="ij")
    edge = x + rng.uniform(-1, 1) * y > rng.uniform(0.0, 1.2)
    agrees(
        level + slope[0] * x + slope[1] * y + step * edge + rng.normal(0.0, 1.0, x.shape) * noise
    )


def test_steep_and_rough_ground_has_the_eigenvalues_of_eigh():
    # the hardest for the iteration: lambda_1 near b, and p large
    rng = np.random.default_rng(0)
    x = 0.01 + 0.02 * np.arange(60)[:, None]
    for _ in range(20):
        agrees(x + rng.normal(0.0, 0.05, (60, 5)))


@pytest.mark.parametrize(
    ("kind", "size"), [("rough", 0.1), ("slope", 0.35), ("stairs_up", 0.2), ("stairs_down", 0.23)]
)
def test_the_ground_of_a_lane_has_the_eigenvalues_of_eigh(kind, size):
    ground = lanes.build_single(config.Terrain(name="mixed"), kind, size).tile(0, 0)
    for x in (1.3, 2.017, 3.9):
        grid = np.stack(np.meshgrid(*footholds._lattice(C), indexing="ij"), -1)
        points = jnp.array([x, 0.003]) + geometry.rotate_yaw(jnp.float32(0.3), jnp.asarray(grid))
        agrees(terrain.height_at(ground, points))


@pytest.mark.parametrize("level", [0.0, 0.7, -0.93])
def test_level_ground_is_smooth_and_vertical(level):
    found = windows(jnp.full((60, 5), level, jnp.float32))
    assert float(found.roughness.max()) < 1e-6
    np.testing.assert_array_equal(found.verticality, 1.0)


def test_a_slope_is_smooth():
    # z = 0.4 x - 0.3 y: normal ~ (-0.4, 0.3, 1), |v_z| = 1 / sqrt(1.25) = 0.8944
    x, y = footholds._lattice(C)
    found = windows(jnp.asarray(0.5 + 0.4 * x[:, None] - 0.3 * y))
    assert float(found.roughness.max()) < 1e-4
    np.testing.assert_allclose(found.verticality, 1.0 / math.sqrt(1.25), atol=1e-5)


def test_noise_of_known_size_is_the_roughness():
    # z = +- 1 mm from row to row: mean of a window 0, sum z^2 / 59 = 60 mm^2 / 59. Rows have
    # x_i - mu_x = (i - 5.5) 2 cm: sum_i (-1)^i (i - 5.5) = -6, so p = 5 * (-6 * 0.02) * 1e-3 / 59
    # and a = 5 * 143 * 0.02^2 / 59: p^2 / a = (5 * 36 / 143 / 59) mm^2 comes off.
    rows = jnp.where(jnp.arange(60) % 2 == 0, 1e-3, -1e-3)
    found = windows(jnp.repeat(rows[:, None], 5, axis=1))
    expected = 1e-3 * math.sqrt((60 - 5 * 36 / 143) / 59)
    np.testing.assert_allclose(found.roughness, expected, rtol=1e-3)


def test_a_window_that_ends_at_a_wall_has_no_flat_direction_but_across():
    # The last of its rows, at 11 cm from the mean, is 1 m higher: a = 5 * 143 * 0.02^2 / 59,
    # zz = 60 * 11/144 / 59 = 0.078, p = 5 * 0.11 / 59, so in the x-z plane the smaller eigenvalue
    # is (a zz - p^2) / (a + zz) = 0.0035. q = 0, so b = 0.025^2 * 2 * 60 / 59 = 0.0013 is one, too,
    # of direction y: the smallest
    rows = jnp.where(jnp.arange(60) >= 11, 1.0, 0.0)
    found = windows(jnp.repeat(rows[:, None], 5, axis=1))
    np.testing.assert_allclose(found.roughness[0], 0.025 * math.sqrt(120 / 59), rtol=1e-5)
    assert float(found.verticality[0]) == 0.0


def test_three_like_eigenvalues_give_numbers():
    rng = np.random.default_rng(0)
    cube = rng.choice([-1.0, 1.0], (8, 60, 5)) * np.sqrt([[[0.00127119]]])  # var y
    lucky = np.tile([1.0, -1.0, 0.0, -1.0, 1.0], (60, 1)) * 0.0398617  # zz = b, p = q = 0
    for z in [*cube, lucky, np.full((60, 5), 1e30), np.full((60, 5), -1e-30)]:
        found = windows(jnp.asarray(z, jnp.float32))
        assert np.isfinite(found.roughness).all() and np.isfinite(found.verticality).all()


def test_candidates_before_stairs_up():
    # Treads of 30 cm from x = 0 on are 15 rows each. Window k has the rows 2k to 2k + 11 and is
    # accepted within one tread t: 15 t <= 2k and 2k + 11 <= 15 t + 14. t = 0: k = 0, 1;
    # t = 1: 8, 9; t = 2: 15, 16; t = 3: 23, 24. A window with one row of twelve on the next tread
    # already deviates by more than 1 cm: sqrt(0.15^2 * 11/144 * 60/59 - p^2/a) = 3.7 cm
    found = ahead(lane(lambda x: 0.15 * max(0.0, math.floor(x / 0.3))))
    check(found, [0, 1, 8, 9, 15, 16, 23, 24], [0, 0, 0.15, 0.15, 0.30, 0.30, 0.45, 0.45])


def test_the_third_high_step_down_is_too_far_down():
    # steps of 23 cm: the second tread down lies at -0.46 > h_min = -0.5, the third at -0.69
    found = ahead(lane(lambda x: -0.23 * max(0.0, math.floor(x / 0.3))))
    check(found, [0, 1, 8, 9, 15, 16], [0, 0, -0.23, -0.23, -0.46, -0.46])


def test_candidates_before_a_gap():
    # from x = 0.3 to 0.8, 1 m deep: rows 15 to 39. Before it k = 0, 1; beyond it 2k >= 40; within
    # it k = 8 ... 14 are as flat, but recessed: -1 < h_min
    ground = lane(lambda x: -1.0 if 0.3 < x < 0.8 else 0.0)
    check(ahead(ground), [0, 1, 20, 21, 22, 23, 24], 0.0)
    inside = windows(
        jnp.where((jnp.arange(60) >= 15) & (jnp.arange(60) < 40), -1.0, 0.0)[:, None] * jnp.ones(5)
    )
    assert float(inside.roughness[8:15].max()) < 1e-6


def test_every_window_of_a_slope_counts_until_it_is_too_steep():
    # |v_z| = 1 / sqrt(1 + s^2): 0.958 at 0.3, 0.894 < 0.9 at 0.5. The mean's z is s times its x
    check(ahead(lane(lambda x: 0.3 * x)), range(25), 0.3 * X)
    check(ahead(lane(lambda x: 0.5 * x)), [], 0.0)


def test_heights_are_taken_from_the_sole():
    # the sole 0.6 m up: the ground is at -0.6 < h_min; 0.4 m up: at -0.4
    check(ahead(lane(lambda x: 0.0), sole=soles(z=0.6)), [], 0.0)
    check(ahead(lane(lambda x: 0.0), sole=soles(z=0.4)), range(25), -0.4)


def test_with_the_gate_on_windows_those_with_a_point_that_is_too_near_go():
    # 0.4 m/s * 0.5 s = 0.2 m. The first point of window k is at 0.01 + 0.04 k: 0.17 for k = 4 and
    # 0.21 for k = 5. 0.8 m/s: 0.4 m, 0.37 for k = 9 and 0.41 for k = 10
    c = dataclasses.replace(C, gate="windows")
    ground, zero = lane(lambda x: 0.0), jnp.zeros(2)
    found = lambda command: footholds.candidates(ground, soles(), zero, jnp.float32(command), c)
    check(found(0.4), range(5, 25), 0.0)
    check(found(0.8), range(10, 25), 0.0)
    check(found(-1.0), range(25), 0.0)


def test_points_nearer_than_half_a_second_of_the_command_go_and_windows_are_of_the_rest():
    # 0.4 m/s: 0.2 m. Row i is at 0.01 + 0.02 i, so rows 10 on remain. Window k has rows 2k to
    # 2k + 11: of window 0 two remain, which are enough, and their mean is at 0.22; from 5 on all
    found = ahead(lane(lambda x: 0.0), command=0.4)
    assert found.accepted.all()
    np.testing.assert_allclose(found.x[0, :6], [0.22, 0.24, 0.26, 0.28, 0.30, 0.32], atol=1e-6)
    np.testing.assert_allclose(found.x[0, 5:], X[5:], atol=1e-6)
    # 0.8 m/s: rows 20 on remain, of window 5 two, and of those before it none
    found = ahead(lane(lambda x: 0.0), command=0.8)
    assert np.flatnonzero(found.accepted[0]).tolist() == list(range(5, 25))
    np.testing.assert_allclose(found.x[0, 5:7], [0.42, 0.44], atol=1e-6)


def test_what_was_removed_does_not_make_a_window_rough():
    # a tread of 30 cm from 0.1 m on, 15 cm up, seen at 0.5 m/s: 0.25 m. Rows 12 on remain, of
    # the tread 12 to 19: windows 1 (12 and 13) to 4 (12 to 19) are on it alone
    ground = lane(lambda x: 0.15 * max(0.0, math.floor((x + 0.2) / 0.3)))
    found = ahead(ground, command=0.5)
    assert np.flatnonzero(found.accepted[0])[:4].tolist() == [1, 2, 3, 4]
    np.testing.assert_allclose(found.z[0, 1:5], 0.15, atol=1e-6)
    np.testing.assert_allclose(found.x[0, 1:5], [0.26, 0.28, 0.30, 0.32], atol=1e-6)


def test_the_next_tread_is_a_candidate_at_walking_speed():
    # treads of 30 cm, 20 cm high, the foot on the middle of one at 0.6 m/s. The next tread begins
    # at 0.15 m and ends at 0.45; 0.30 m is removed, so its last 15 cm, about 0.37, are left. A
    # gate on windows leaves none before the tread after it, whose middle is at 0.60
    ground = lane(lambda x: 0.2 * max(0.0, math.floor((x + 0.15) / 0.3)))
    middle = soles(x=0.30, z=0.2)
    nearest = lambda found: float(footholds.distance(found, middle)[0])
    assert nearest(ahead(ground, command=0.6)) < 0.05
    c = dataclasses.replace(C, gate="windows")
    whole = footholds.candidates(ground, soles(), jnp.zeros(2), jnp.float32(0.6), c)
    assert nearest(whole) > 0.25


@pytest.mark.parametrize(("points", "ahead_of_foot"), [(10, [0.33, 0.35]), (30, [])])
def test_a_strip_at_a_nosing_is_a_candidate_if_few_points_are_enough(points, ahead_of_foot):
    # down, 0.1 m behind a nosing: of the next tread, 0.1 to 0.4 m ahead, 0.3 m on are left. The
    # windows from 0.12 and 0.16 m on have 0.30 to 0.36 and 0.30 to 0.40 of it, 15 and 25 points
    ground = lane(lambda x: -0.2 * max(0.0, math.floor((x - 0.1) / 0.3) + 1.0))
    c = dataclasses.replace(C, min_points=points)
    found = footholds.candidates(ground, soles(), jnp.zeros(2), jnp.float32(0.6), c)
    on_next = found.accepted[0] & (jnp.abs(found.z[0] + 0.2) < 0.01)
    np.testing.assert_allclose(found.x[0][on_next], ahead_of_foot, atol=1e-6)
    assert bool((found.accepted[0] & (jnp.abs(found.z[0] + 0.4) < 0.01)).any())


def test_a_window_of_remaining_points_has_the_eigenvalues_of_eigh():
    z = np.random.default_rng(3).normal(0.0, 0.02, (60, 5)).astype(np.float32)
    x, y = footholds._lattice(C)
    remain = x[footholds._rows(C)] >= 0.45  # m; row 22 is the first
    found = footholds._windows([jnp.asarray(z[:, j]) for j in range(5)], remain, C)
    for k in range(6, 25):  # of window 6 two rows are left
        rows = footholds._rows(C)[k][remain[k]]
        points = np.stack([*np.meshgrid(x[rows], y, indexing="ij"), z[rows]], -1).reshape(-1, 3)
        size, v = np.linalg.eigh(np.cov(points.astype(np.float64).T))
        np.testing.assert_allclose(found.roughness[k], math.sqrt(size[0]), rtol=1e-3)
        np.testing.assert_allclose(found.verticality[k], abs(v[2, 0]), atol=1e-3)


def test_a_foot_that_points_left_looks_left():
    # the ground falls off at y = 0.3, whatever x: rows 0 to 14 are good, as windows 0 and 1
    x = -1.0 + 0.02 * (np.arange(100) + 0.5)
    ground = terrain.from_heights(
        np.tile(np.where(x < 0.3, 0.0, -1.0), (100, 1)), 0.02, (-1.0, -1.0)
    )
    place = jnp.broadcast_to(jnp.array([ACROSS, 0.0, 0.0]), (2, 3))
    check(ahead(ground, sole=place, heading=math.pi / 2), [0, 1], 0.0)
    check(ahead(ground, sole=place, heading=-math.pi / 2), range(25), 0.0)
    check(ahead(ground, sole=place, heading=0.0), range(25), 0.0)


def test_each_foot_has_its_own_windows():
    ground = lane(lambda x: 0.0 if x < 0.3 else -1.0)
    sole = jnp.array([[0.0, ACROSS, 0.0], [-0.08, ACROSS, 0.0]])  # two windows further back
    found = candidates(ground, sole, jnp.zeros(2), jnp.float32(0.0))
    assert [list(np.flatnonzero(row)) for row in found.accepted] == [[0, 1], [0, 1, 2, 3]]


def test_turning_and_shifting_robot_and_ground_changes_nothing():
    rng = np.random.default_rng(4)
    heights = np.kron(rng.choice([0.0, 0.004, 0.03, -0.7], (17, 17)), np.ones((9, 9)))
    heights = heights + rng.uniform(0.0, 0.006, heights.shape)
    side, shift = 153 * 0.02, 37.0  # m
    sole = np.array([[1.0043, 1.2077, 0.01], [1.1061, 0.9032, -0.02]])
    heading = np.array([0.3, -0.2])
    before = candidates(
        terrain.from_heights(heights, 0.02),
        jnp.asarray(sole, jnp.float32),
        jnp.asarray(heading, jnp.float32),
        0.3,
    )
    # x' = side - y, y' = x: column (i, j) comes to (152 - j, i)
    turned = terrain.from_heights(np.flip(heights.T, axis=0), 0.02, (shift, 0.0))
    moved = np.stack([shift + side - sole[:, 1], sole[:, 0], sole[:, 2]], -1)
    after = candidates(
        turned,
        jnp.asarray(moved, jnp.float32),
        jnp.asarray(heading + math.pi / 2, jnp.float32),
        0.3,
    )
    assert 0 < int(before.accepted.sum()) < before.accepted.size
    np.testing.assert_array_equal(after.accepted, before.accepted)
    np.testing.assert_allclose(after.z, before.z, atol=1e-6)
    step = np.array([0.4, 0.05, 0.02])  # m, the same for both
    spun = np.array([-0.05, 0.4, 0.02])
    here = footholds.distance(before, jnp.asarray(sole + step, jnp.float32))
    there = footholds.distance(after, jnp.asarray(moved + spun, jnp.float32))
    np.testing.assert_allclose(there, here, atol=1e-4)


def test_candidates_stay_during_the_swing_and_are_new_on_the_ground():
    stairs = lane(lambda x: 0.15 * max(0.0, math.floor(x / 0.3)))
    before = ahead(stairs)
    now = ahead(stairs, command=0.6, sole=soles(x=0.31, z=0.2), heading=0.4)
    touchdown = soles(x=0.45, z=0.15)
    held = footholds.update_candidates(before, now, jnp.array([False, False]))
    jax.tree.map(np.testing.assert_array_equal, held, before)
    # window 8 is at x = 0.44: 1 cm off, wherever the foot has been since
    np.testing.assert_allclose(footholds.distance(held, touchdown), 0.01, atol=1e-6)
    left = footholds.update_candidates(before, now, jnp.array([True, False]))
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[0], b[0]), left, now)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[1], b[1]), left, before)
    assert (left.accepted[0] != left.accepted[1]).any() and (left.origin[0] != left.origin[1]).any()


def test_distance_is_in_the_plane_of_the_liftoffs_heading():
    # heading 90 degrees from (1, 2, 3): the candidate 0.4 ahead and 0.1 up is at (1, 2.4, 3.1).
    # (1.3, 2.46, 3.02) is 0.06 further along and 0.08 lower, sqrt(...) = 0.1; the 0.3 are across
    frozen = footholds.no_candidates(C).replace(
        x=jnp.full((2, 25), 0.4),
        z=jnp.full((2, 25), 0.1),
        accepted=jnp.zeros((2, 25), bool).at[:, 7].set(True),
        origin=jnp.broadcast_to(jnp.array([1.0, 2.0, 3.0]), (2, 3)),
        heading=jnp.full(2, math.pi / 2),
    )
    at = lambda x: jnp.broadcast_to(jnp.array([x, 2.46, 3.02]), (2, 3))
    np.testing.assert_allclose(footholds.distance(frozen, at(1.3)), 0.1, atol=1e-6)
    np.testing.assert_allclose(footholds.distance(frozen, at(0.2)), 0.1, atol=1e-6)


def test_the_nearest_accepted_candidate_counts():
    # before the gap windows are at 0.12 and 0.16, beyond it from 0.92 on: x = 0.56 is 0.36 from
    # 0.92 and 0.40 from 0.16
    found = ahead(lane(lambda x: -1.0 if 0.3 < x < 0.8 else 0.0))
    np.testing.assert_allclose(footholds.distance(found, soles(x=0.56)), 0.36, atol=1e-6)


def test_without_a_candidate_the_distance_is_infinite_and_the_reward_0():
    empty = footholds.no_candidates(C)
    np.testing.assert_array_equal(footholds.distance(empty, soles()), np.inf)

    def reward(sole):
        return jnp.exp(-footholds.distance(empty, sole) / 0.08).sum()

    value, gradient = jax.value_and_grad(reward)(soles(x=0.3))
    assert float(value) == 0.0
    np.testing.assert_array_equal(gradient, 0.0)


def feet(x=0.0, z=0.0, heading=0.0) -> footholds.Soles:
    """Return feet with their ankles at `x`, the soles' centres 3.5 cm in front and 7 cm below."""
    ankle = soles(x=x, z=z + 0.07)
    centre = ankle + jnp.array([0.035, 0.0, -0.07])
    return footholds.Soles(centre=centre, ankle=ankle, heading=jnp.full(2, heading))


def test_the_samples_of_the_sole_over_a_gap_count():
    # samples at x = -0.06, -0.0125, 0.035, 0.0825, 0.13 and y = -0.05, 0, 0.05 of the ankle. An
    # edge at 0.06 leaves two rows of three over the gap, an edge at 0.02 three, one at -1 all
    edge = lambda x: lane(lambda at: 0.0 if at < x else -1.0)
    for x, expected in [(0.06, 6), (0.02, 9), (-1.0, 15), (0.5, 0)]:
        np.testing.assert_array_equal(footholds.count_unsupported(edge(x), feet(), C), expected)
    # turned left the foot has all of its length on one side of the edge: 1 of 3 columns, at
    # x = +0.05, is over the gap behind 0.04
    turned = footholds.count_unsupported(edge(0.04), feet(heading=math.pi / 2), C)
    np.testing.assert_array_equal(turned, 5)


def test_what_is_2_cm_lower_bears_and_what_is_4_cm_lower_does_not():
    # epsilon = -3 cm from the sole, not from z = 0
    ground = lane(lambda x: 0.5)
    for above, expected in [(0.02, 0), (0.04, 15), (-0.04, 0)]:
        found = footholds.count_unsupported(ground, feet(z=0.5 + above), C)
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("actuated", ["legs", "all"])
def test_the_soles_of_a_robot_that_stands_and_turns(actuated):
    # the spheres, of radius 1 cm, lie from x = -5.5 to 12.5 cm about the ankle, 6.34 cm below it
    x2 = robot.load(config.Robot(actuated=actuated, held="none"))
    tree = kinematics.tree(robot.spec(actuated, config.Physics()).compile())
    turn = geometry.quat_from_axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.float32(0.7))
    qpos = jnp.concatenate([jnp.array([3.0, -2.0, x2.standing_height]), turn, x2.nominal_pose])
    found = footholds.soles(kinematics.links(tree, qpos, jnp.zeros(qpos.size - 1)), x2)
    np.testing.assert_allclose(found.centre[:, 2], 0.0, atol=1e-4)
    np.testing.assert_allclose(found.heading, 0.7, atol=1e-4)
    ahead = geometry.rotate_yaw(-found.heading, found.centre - found.ankle)
    np.testing.assert_allclose(ahead, [[0.035, 0.0, -0.0734]] * 2, atol=1e-4)
    across = geometry.rotate_yaw(jnp.float32(-0.7), found.centre[0] - found.centre[1])
    assert float(across[1]) > 0.1  # the left foot is row 0


def test_each_sole_has_its_own_spheres_and_heading():
    # the spheres moved 1 cm forward on the right foot alone, the left hip turned to the left
    x2 = robot.load(config.Robot(held="none"))
    tree = kinematics.tree(robot.spec("legs", config.Physics()).compile())
    qpos = jnp.concatenate([jnp.array([0.0, 0.0, 0.6, 1.0, 0.0, 0.0, 0.0]), x2.nominal_pose])
    shift = 0.01 * (x2.spheres.foot == 1)[:, None] * np.array([1.0, 0.0, 0.0])
    moved = x2.spheres._replace(position=(x2.spheres.position + shift).astype(np.float32))
    x2 = dataclasses.replace(x2, spheres=moved)
    links = lambda qpos: kinematics.links(tree, qpos, jnp.zeros(qpos.size - 1))
    found = footholds.soles(links(qpos), x2)
    np.testing.assert_allclose((found.centre - found.ankle)[:, 0], [0.035, 0.045], atol=1e-4)
    turned = qpos.at[7 + x2.joint_names.index("left_hip_yaw_joint")].set(0.3)
    heading = footholds.soles(links(turned), x2).heading
    assert float(heading[0]) > 0.2
    np.testing.assert_allclose(heading[1], 0.0, atol=1e-5)


def test_a_window_is_as_wide_as_the_buffer():
    with pytest.raises(ValueError, match="as wide as the buffer"):
        footholds.windows(jnp.zeros((60, 5)), config.Foothold(window=(12, 3)))


@pytest.mark.parametrize(
    ("c", "count"),
    [
        # (20 - 6) // 3 + 1 = 5 windows
        (config.Foothold(points=(20, 4), spacing=(0.04, 0.02), window=(6, 4), stride=3), 5),
        # wider than long; (60 - 4) // 1 + 1 = 57 windows
        (config.Foothold(spacing=(0.02, 0.05), window=(4, 5), stride=1), 57),
    ],
)
def test_other_numbers_give_other_windows(c, count):
    rng = np.random.default_rng(0)
    assert footholds.no_candidates(c).accepted.shape == (2, count)
    for noise in (0.001, 0.01, 0.05):
        tilt = rng.uniform(-0.05, 0.05, (c.points[0], 1)) + rng.uniform(-0.05, 0.05, c.points[1])
        agrees(tilt + rng.normal(0.0, noise, c.points), c)
