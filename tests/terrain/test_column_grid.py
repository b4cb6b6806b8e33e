"""The column grid, against a slow reference that looks at every column in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cref_jax import terrain

CELL = 0.02  # m
SHAPE = (6, 5)
ORIGIN = (-0.05, 0.3)
BORDER = 6  # columns by which the reference continues the edge
ROUNDING = 4e-6  # m, float32 and the shortest distance that the search tells apart

heights_of = st.lists(
    st.sampled_from([-1.0, -0.2, 0.0, 0.005, 0.01, 0.02, 0.15])
    | st.floats(-0.03125, 0.03125, width=32),
    min_size=SHAPE[0] * SHAPE[1],
    max_size=SHAPE[0] * SHAPE[1],
).map(lambda values: np.reshape(values, SHAPE).astype(np.float32))
inner = st.floats(0.01, 0.99)  # of a column, away from its border
anywhere = inner | st.sampled_from([0.0, 1e-5, 0.5, 1.0 - 1e-5])  # on edges and in corners, too
above = st.floats(-0.03, 0.03) | st.sampled_from([0.0, 1e-6, -1e-6, 0.019, -0.019, 0.5])  # m
POSTS = np.full(SHAPE, -1.0, np.float32)
POSTS[3, 2] = POSTS[4, 2] = -0.2


def points(part):
    """Return a strategy for (column i, column j, fraction, fraction): up to 3 columns outside."""
    return st.tuples(st.integers(-3, SHAPE[0] + 2), st.integers(-3, SHAPE[1] + 2), part, part)


def place(point):
    i, j, u, v = point
    return np.array([ORIGIN[0] + (i + u) * CELL, ORIGIN[1] + (j + v) * CELL])


def reference_height(heights, i, j):
    return heights[np.clip(i, 0, SHAPE[0] - 1), np.clip(j, 0, SHAPE[1] - 1)]


def reference_distance(heights, p):
    """Return the signed distance of p to the surface of the grid and its continued edge, f64."""
    p = np.asarray(p, np.float64)
    wide = np.pad(heights.astype(np.float64), BORDER, mode="edge")
    low_x = ORIGIN[0] + (np.arange(wide.shape[0])[:, None] - BORDER) * CELL
    low_y = ORIGIN[1] + (np.arange(wide.shape[1])[None, :] - BORDER) * CELL
    dx = np.maximum(np.maximum(low_x - p[0], p[0] - low_x - CELL), 0.0)
    dy = np.maximum(np.maximum(low_y - p[1], p[1] - low_y - CELL), 0.0)
    to_ground = np.sqrt(dx**2 + dy**2 + np.maximum(p[2] - wide, 0.0) ** 2).min()
    to_air = np.sqrt(dx**2 + dy**2 + np.maximum(wide - p[2], 0.0) ** 2).min()
    return to_ground - to_air


height = jax.jit(lambda h, xy: terrain.height_at(terrain.from_heights(h, CELL, ORIGIN), xy))
closest = jax.jit(lambda h, p: terrain.closest_point(terrain.from_heights(h, CELL, ORIGIN), p))
planes = jax.jit(lambda h, p: terrain.contact_planes(terrain.from_heights(h, CELL, ORIGIN), p, 2))


def step_up(low=0.0, high=0.15):
    """Return a grid whose columns rise by a step between i = 2 and i = 3, at x = 0.01 m."""
    return np.where(np.arange(SHAPE[0])[:, None] < 3, low, high) * np.ones(SHAPE, np.float32)


RISER = ORIGIN[0] + 3 * CELL  # m, 0.01
MIDDLE = ORIGIN[1] + 2.5 * CELL  # m, in the middle of a column


@given(heights_of, points(inner))
@settings(max_examples=200, deadline=None)
def test_height_is_that_of_the_column_and_the_edge_continues(heights, point):
    expected = reference_height(heights, *point[:2])
    assert height(heights, place(point).astype(np.float32)) == expected


def test_height_takes_any_leading_axes():
    heights = np.arange(30, dtype=np.float32).reshape(SHAPE)
    i, j = np.meshgrid(np.arange(6), np.arange(5), indexing="ij")
    xy = np.stack([ORIGIN[0] + (i + 0.5) * CELL, ORIGIN[1] + (j + 0.5) * CELL], -1)
    np.testing.assert_array_equal(height(heights, xy.astype(np.float32)), heights)


@given(heights_of, points(anywhere), above)
@settings(max_examples=1000, deadline=None)
def test_closest_point_is_exact_within_a_cell(heights, point, over):
    z = reference_height(heights, *point[:2]) + over
    p = np.array([*place(point), z], np.float32)
    found, normal, distance = (np.asarray(a, np.float64) for a in closest(heights, p))
    expected = reference_distance(heights, p)
    if abs(expected) < CELL - ROUNDING:
        np.testing.assert_allclose(distance, expected, atol=ROUNDING)
        np.testing.assert_allclose(reference_distance(heights, found), 0.0, atol=ROUNDING)
    assert abs(distance) >= abs(expected) - ROUNDING
    np.testing.assert_allclose(np.linalg.norm(normal), 1.0, atol=1e-6)
    np.testing.assert_allclose(found + distance * normal, p, atol=ROUNDING)


@given(heights_of, points(anywhere), above)
@example(POSTS, (4, 1, 0.0, 0.625), 0.015625)
@settings(max_examples=300, deadline=None)
def test_first_contact_plane_is_the_closest_point_and_the_second_is_no_closer(heights, point, over):
    p = np.array([*place(point), reference_height(heights, *point[:2]) + over], np.float32)
    both, one = planes(heights, p), closest(heights, p)
    if all(1e-3 < part < 1.0 - 1e-3 for part in point[2:]):
        for of_both, alone in zip(both, one, strict=True):
            np.testing.assert_allclose(of_both[0], alone, atol=1e-7)
    else:  # on a column's edge the two programs may round it to either side
        np.testing.assert_allclose(both[0][0], one[0], atol=ROUNDING)
        np.testing.assert_allclose(both[2][0], one[2], atol=ROUNDING)
    found, normals, distances = (np.asarray(a, np.float64) for a in both)
    np.testing.assert_allclose(found[0] + distances[0] * normals[0], p, atol=ROUNDING)
    assert distances[1] >= abs(distances[0]) - 1e-7
    np.testing.assert_allclose(found[1] + distances[1] * normals[1], p, atol=ROUNDING)
    if distances[1] < terrain.FAR:
        assert normals[0] @ normals[1] < np.sqrt(0.5) + 1e-5


@pytest.mark.parametrize("gap_to_wall", [0.0, 1e-4, 0.005, 0.0199])
def test_a_riser_is_vertical(gap_to_wall):
    p = jnp.array([RISER - gap_to_wall, MIDDLE, 0.1])
    found, normal, distance = closest(step_up(), p)
    np.testing.assert_array_equal(normal[1:], 0.0)
    np.testing.assert_allclose(normal[0], -1.0, atol=1e-6)
    np.testing.assert_allclose(found, [RISER, MIDDLE, 0.1], atol=ROUNDING)
    np.testing.assert_allclose(distance, gap_to_wall, atol=ROUNDING)


def test_inside_a_step_the_nearest_way_out_is_taken():
    # 1 cm under the top and 0.5 cm behind the riser: out through the riser
    found, normal, distance = closest(step_up(), jnp.array([RISER + 0.005, MIDDLE, 0.14]))
    np.testing.assert_allclose(found, [RISER, MIDDLE, 0.14], atol=ROUNDING)
    np.testing.assert_allclose(normal, [-1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(distance, -0.005, atol=ROUNDING)
    # 0.4 cm under the top: out through the top
    found, normal, distance = closest(step_up(), jnp.array([RISER + 0.005, MIDDLE, 0.146]))
    np.testing.assert_allclose(found, [RISER + 0.005, MIDDLE, 0.15], atol=ROUNDING)
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(distance, -0.004, atol=ROUNDING)


@pytest.mark.parametrize("depth", [0.005, 0.025, 0.045, 0.059])
def test_a_foot_that_has_been_thrown_into_a_riser_comes_out_as_it_went_in(depth):
    # the top is further away; a foot at 8 m/s is 4 cm in after one substep
    found, normal, distance = closest(step_up(), jnp.array([RISER + depth, MIDDLE, 0.08]))
    np.testing.assert_allclose(found, [RISER, MIDDLE, 0.08], atol=ROUNDING)
    np.testing.assert_allclose(normal, [-1.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(distance, -depth, atol=ROUNDING)


def test_at_a_nosing_the_normal_points_from_the_edge_to_the_sphere():
    # 3 mm before the riser, 4 mm above the tread: 5 mm from the edge
    found, normal, distance = closest(step_up(), jnp.array([RISER - 0.003, MIDDLE, 0.154]))
    np.testing.assert_allclose(found, [RISER, MIDDLE, 0.15], atol=ROUNDING)
    np.testing.assert_allclose(normal, [-0.6, 0.0, 0.8], atol=1e-3)
    np.testing.assert_allclose(distance, 0.005, atol=ROUNDING)


def test_on_the_surface_the_normal_is_up():
    _, normal, distance = closest(step_up(), jnp.array([RISER - 0.03, MIDDLE, 0.0]))
    np.testing.assert_array_equal(normal, [0.0, 0.0, 1.0])
    np.testing.assert_allclose(distance, 0.0, atol=ROUNDING)


def test_level_ground_has_no_inner_edges_however_deep_the_point():
    heights = np.zeros(SHAPE, np.float32)
    for z in (0.02, 0.004, 0.0, -0.004, -0.015):
        for x in (RISER, RISER + 1e-4, RISER + 0.01):
            _, normals, distances = planes(heights, jnp.array([x, MIDDLE, z]))
            np.testing.assert_array_equal(normals, [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
            np.testing.assert_allclose(distances, [z, terrain.FAR], atol=ROUNDING)


def test_in_the_corner_of_a_stair_a_sphere_touches_tread_and_riser():
    found, normals, distances = planes(step_up(), jnp.array([RISER - 0.012, MIDDLE, 0.015]))
    np.testing.assert_allclose(normals, [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-6)
    np.testing.assert_allclose(distances, [0.012, 0.015], atol=ROUNDING)
    np.testing.assert_allclose(found[0], [RISER, MIDDLE, 0.015], atol=ROUNDING)
    np.testing.assert_allclose(found[1], [RISER - 0.012, MIDDLE, 0.0], atol=ROUNDING)


def test_over_a_nosing_there_is_one_contact():
    for x in (-0.005, 0.005):
        _, _, distances = planes(step_up(), jnp.array([RISER + x, MIDDLE, 0.155]))
        assert distances[1] == terrain.FAR


def test_far_above_the_ground_the_normal_is_up():
    found, normal, distance = closest(step_up(), jnp.array([0.05, MIDDLE, 40.0]))
    np.testing.assert_allclose(normal, [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(found[2], 0.15, atol=1e-5)
    np.testing.assert_allclose(distance, 39.85, atol=1e-4)


@pytest.mark.parametrize("p", [(1e9, -1e9, 1e3), (np.nan, 0.0, 0.0), (np.inf, -np.inf, 0.0)])
def test_a_point_that_has_blown_up_reads_no_memory_outside_of_the_grid(p):
    heights = np.full(SHAPE, 0.25, np.float32)
    assert height(heights, np.array(p[:2], np.float32)) == 0.25


def test_a_tile_does_not_see_its_neighbours():
    rng = np.random.default_rng(0)
    grid = rng.uniform(-0.03, 0.03, (4 * SHAPE[0], 3 * SHAPE[1])).astype(np.float32)
    cut = lambda row, column: grid[row * 6 : row * 6 + 6, column * 5 : column * 5 + 5]
    lanes = [[cut(row, column) for column in range(3)] for row in range(4)]
    whole = terrain.build_grid(lanes, CELL, ORIGIN, SHAPE)
    p = rng.uniform([-0.11, 0.24, -0.02], [0.13, 0.46, 0.04], (300, 3)).astype(np.float32)
    on_tile = jax.jit(lambda r, c, p: terrain.closest_point(terrain.tile(whole, r, c), p))
    for row, column in [(0, 0), (2, 1), (3, 2)]:
        expected = jax.vmap(lambda q, lane=lanes[row][column]: closest(lane, q))(p)
        found = jax.vmap(on_tile, (None, None, 0))(row, column, p)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-7)


def test_one_column_across_is_the_same_ground_as_all_of_them():
    # heights, contact planes, blocks and depth's tops beside one another, also outside of the lane
    rng = np.random.default_rng(3)
    profile = rng.uniform(-0.03, 0.03, (70, 1)).astype(np.float32)
    full = terrain.from_heights(np.repeat(profile, 5, axis=1), CELL, ORIGIN)
    thin = terrain.tile(terrain.build_grid([[profile]], CELL, ORIGIN, (70, 5)), 0, 0)
    np.testing.assert_array_equal(thin.heights, full.heights)
    low, high = np.array([-0.2, 0.2, -0.02]), np.array([1.6, 0.5, 0.04])
    p = jnp.asarray(rng.uniform(low, high, (400, 3)), jnp.float32)
    each = lambda f: lambda ground: jax.jit(jax.vmap(f, in_axes=(None, 0)))(ground, p)
    for ask in (
        each(lambda ground, q: terrain.contact_planes(ground, q, 2)),
        each(lambda ground, q: terrain.height_at(ground, q[:2])),
    ):
        jax.tree.map(np.testing.assert_array_equal, ask(thin), ask(full))
    i, j = map(jnp.asarray, np.meshgrid(np.arange(-3, 80), np.arange(-3, 9), indexing="ij"))
    for level in range(len(terrain.BLOCKS)):
        a, b = (terrain.block_top(ground, i, j, level) for ground in (thin, full))
        np.testing.assert_array_equal(a, b)
    bottoms = (terrain.block_bottom(ground, i, j) for ground in (thin, full))
    np.testing.assert_array_equal(*bottoms)


def test_robots_on_different_tiles_share_one_grid():
    whole = terrain.build_grid(2 * [[np.zeros((6, 5), np.float32)]], CELL, ORIGIN, (6, 5))
    tiled = lambda r, p: terrain.closest_point(terrain.tile(whole, r, 0), p)
    program = str(jax.make_jaxpr(jax.vmap(tiled))(jnp.arange(2), jnp.zeros((2, 3))))
    assert f"f32[{whole.tops.size}]" in program
    assert f"f32[2,{whole.tops.size}]" not in program


@pytest.mark.parametrize("shape", [(1, 1), (8, 32), (50, 77)])
def test_a_block_is_as_high_as_its_highest_column(shape):
    rng = np.random.default_rng(shape[0])
    heights = rng.uniform(-0.3, 0.1, shape).astype(np.float32)
    ground = terrain.from_heights(heights, CELL)
    i, j = np.meshgrid(*(np.arange(-3, n + 3) for n in shape), indexing="ij")
    inner_i, inner_j = np.clip(i, 0, shape[0] - 1), np.clip(j, 0, shape[1] - 1)
    block_top = jax.jit(terrain.block_top, static_argnames="level")
    bottom = terrain.block_bottom(ground, jnp.array(i), jnp.array(j))
    for level, side in enumerate(terrain.BLOCKS):
        top = block_top(ground, jnp.array(i), jnp.array(j), level=level)
        for n in np.ndindex(i.shape):
            a, b = inner_i[n] // side * side, inner_j[n] // side * side
            block = heights[a : a + side, b : b + side]
            assert top[n] == block.max()
            assert level < len(terrain.BLOCKS) - 1 or bottom[n] == block.min()


def test_a_tiles_blocks_hold_its_own_columns_and_no_others():
    heights = np.arange(60 * 60, dtype=np.float32).reshape(60, 60)
    lanes = [[heights[r : r + 20, c : c + 20] for c in (0, 20, 40)] for r in (0, 20, 40)]
    ground = terrain.tile(terrain.build_grid(lanes, CELL, (0.0, 0.0), (20, 20)), 1, 2)
    read = lambda level, i, j: float(terrain.block_top(ground, jnp.int32(i), jnp.int32(j), level))
    # column (5, 2) of the tile is (25, 42) of the grid; in the tile's blocks from (4, 0) and (0, 0)
    assert read(0, 5, 2) == 25 * 60 + 42
    assert read(1, 5, 2) == 27 * 60 + 43
    assert read(2, 5, 2) == 35 * 60 + 55
    assert read(3, 5, 2) == 39 * 60 + 59  # a block of 64 ends with the tile
    assert read(2, 18, 2) == 39 * 60 + 55  # and so does one of 16 that begins at 16
    assert float(terrain.block_bottom(ground, jnp.int32(5), jnp.int32(2))) == 20 * 60 + 40
    assert read(0, -50, 99) == 20 * 60 + 59  # outside of the tile its border goes on


def test_a_sphere_has_one_or_two_planes():
    ground = terrain.from_heights(np.zeros(SHAPE), CELL)
    with pytest.raises(ValueError, match="1 or 2 contact planes, not 3"):
        terrain.contact_planes(ground, jnp.zeros(3), 3)
