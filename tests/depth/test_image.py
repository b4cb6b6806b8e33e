"""The depth camera, against MuJoCo's rays on real boxes and capsules, and against hand."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.ndimage
from compilation import AS_SHIPPED

from cref_jax import config, depth, robot, terrain
from cref_jax.robot import kinematics
from cref_jax.terrain import lanes

CAMERA = robot.fill_in(config.Config()).camera
HEIGHT, WIDTH = CAMERA.shape
FAR = 12.0  # m, how far the oracle's boxes continue the border
NONE = np.zeros((0, 7), np.float32)
DOWN = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # image's top towards +x
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looks along +x
MIDDLE = (HEIGHT // 2, WIDTH // 2)  # the pixel right of and below the optical axis

render = functools.partial(depth.render, camera=CAMERA)
draw = jax.jit(render, compiler_options=AS_SHIPPED)


def see(ground, position, rotation, capsules=NONE):
    arrays = (np.asarray(a, np.float32) for a in (position, rotation, capsules))
    return np.asarray(draw(ground, *arrays), np.float64)


def turn(yaw, pitch, roll=0.0):
    """Return the axes of a camera that looks `pitch` below the horizon, rad."""
    about = lambda axis, angle: rotation_of(np.asarray(axis, float), angle)
    return about([0, 0, 1], yaw) @ about([0, 1, 0], pitch) @ about([1, 0, 0], roll) @ LEVEL


def rotation_of(axis, angle):
    q, matrix = np.zeros(4), np.zeros(9)
    mujoco.mju_axisAngle2Quat(q, axis, angle)
    mujoco.mju_quat2Mat(matrix, q)
    return matrix.reshape(3, 3)


def directions(offset=(0.0, 0.0)):
    """Return the rays of all pixels for a depth of 1, in the camera's frame, [H W, 3]."""
    tangent = [np.tan(np.radians(0.5 * view)) for view in CAMERA.view]
    x = (2.0 * (np.arange(WIDTH) + 0.5) / WIDTH - 1.0) * tangent[1] + offset[0]
    y = (2.0 * (np.arange(HEIGHT) + 0.5) / HEIGHT - 1.0) * tangent[0] + offset[1]
    y, x = np.meshgrid(y, x, indexing="ij")
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)


def boxes(heights):
    """Return rectangles [from i, from j, to i, to j] of equal columns that cover the grid."""
    left, found = np.ones(heights.shape, bool), []
    while left.any():
        i, j = np.unravel_index(np.argmax(left), left.shape)
        same = left & (heights == heights[i, j])
        to_j = j + (np.argmin(same[i, j:]) or len(same[i, j:]))
        rows = same[i:, j:to_j].all(1)
        to_i = i + (np.argmin(rows) or len(rows))
        left[i:to_i, j:to_j] = False
        found.append((i, j, to_i, to_j))
    return found


def scene(heights, cell, origin, capsules=NONE):
    """Return the model of a grid and of its border that goes on, as real geoms."""
    spec = mujoco.MjSpec()
    bottom, shape = heights.min() - 1.0, heights.shape
    for i, j, to_i, to_j in boxes(heights):
        low = np.array([origin[0] + i * cell, origin[1] + j * cell, bottom])
        high = np.array([origin[0] + to_i * cell, origin[1] + to_j * cell, heights[i, j]])
        low[:2] -= FAR * (np.array([i, j]) == 0)
        high[:2] += FAR * (np.array([to_i, to_j]) == shape)
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, pos=0.5 * (low + high), size=0.5 * (high - low)
        )
    for capsule in np.asarray(capsules, float):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=capsule[:6], size=[capsule[6], 0, 0]
        )
    model = spec.compile()
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    return model, state


def oracle(model, state, position, rotation, offset=(0.0, 0.0)):
    """Return the depth image by mj_multiRay, m."""
    rays = directions(offset)
    length = np.linalg.norm(rays, axis=1)
    world = (rays / length[:, None]) @ rotation.T
    found, distance = np.zeros(len(rays), np.int32), np.zeros(len(rays))
    mujoco.mj_multiRay(
        model, state, np.asarray(position, float), world.ravel(), None, True, -1, found, distance,
        None, len(rays), 1e3,
    )  # fmt: skip
    image = np.where(distance < 0.0, CAMERA.d_max, distance / length)
    return np.minimum(image, CAMERA.d_max).reshape(CAMERA.shape)


def check(ground, heights, position, rotation, capsules=NONE):
    """Assert that an image is the oracle's, within rounding where it is not an edge."""
    position = np.asarray(position, np.float32).astype(float)  # both see from the same point
    image = see(ground, position, rotation, capsules)
    world = scene(heights, ground.cell, np.asarray(ground.origin, float), capsules)
    expected = oracle(*world, position, rotation)
    around = [oracle(*world, position, rotation, 2e-4 * np.array(o)) for o in NEAR]
    smooth = np.ptp(around, axis=0) < 5e-3
    assert np.mean(abs(image - expected) < 0.01) >= 0.99
    np.testing.assert_allclose(image[smooth], expected[smooth], atol=2e-5)
    # an edge is seen in front of or behind by a pixel's breadth, never through
    assert (image <= np.max(around, axis=0) + 2e-3).all()
    assert (image >= np.min(around, axis=0) - 2e-3).all()
    return image


NEAR = [(-1, -1), (-1, 1), (1, -1), (1, 1), (0, 0)]


def around_pose(rng):
    """Return yaw, pitch and roll around the mount's."""
    pitch = np.radians(CAMERA.pitch) + rng.uniform(-0.6, 0.6)
    return turn(rng.uniform(-np.pi, np.pi), pitch, rng.uniform(-0.6, 0.6))


def some_capsules(rng, position, rotation, count):
    """Return capsules before the camera, behind it and beside it."""
    start = rng.uniform([-0.6, -0.6, -0.5], [0.6, 0.6, 1.5], (count, 3)) @ rotation.T + position
    end = start + rng.uniform(-0.3, 0.3, (count, 3))
    radius = rng.uniform(0.02, 0.1, (count, 1))
    found = np.concatenate([start, end, radius], 1).astype(np.float32)
    axis = (found[:, 3:6] - found[:, :3]).astype(float)
    along = np.sum((position - found[:, :3]) * axis, 1) / np.sum(axis * axis, 1)
    nearest = found[:, :3] + np.clip(along, 0.0, 1.0)[:, None] * axis
    outside = np.linalg.norm(position - nearest, axis=1) > found[:, 6] + 0.01
    return np.where(outside[:, None], found, found + np.float32(5.0))


LANES = {
    "stairs_up": 0.2, "stairs_down": 0.15, "gap": 0.5, "platform": 0.3, "slope": 0.2, "rough": 0.06,
}  # fmt: skip


@pytest.mark.parametrize("kind", LANES)
def test_a_lane_looks_as_mujocos_rays_see_it(kind):
    short = {"rough": {"lane_length": 4.0, "lane_width": 0.8, "cell": 0.05}}
    c = dataclasses.replace(config.Terrain(name="mixed", lane_width=1.0), **short.get(kind, {}))
    ground = lanes.build_single(c, kind, LANES[kind]).tile(0, 0)
    heights = np.asarray(ground.heights, float)
    rng = np.random.default_rng(len(kind))
    for x in (0.9, 1.6, 2.4):
        place = np.array([x, rng.uniform(-0.3, 0.3)])
        over = terrain.height_at(ground, place) + rng.uniform(0.9, 1.2)
        image = check(ground, heights, [*place, over], turn(rng.normal(0, 0.2), np.radians(50)))
        assert np.ptp(image) > 0.2


@pytest.mark.parametrize("kind", [kind for kind in LANES if kind != "rough"])
def test_a_profile_is_swept_as_it_is_marched(kind):
    atlas = lanes.build_single(config.Terrain(name="mixed", lane_width=1.0), kind, LANES[kind])
    assert atlas.is_profile == (True,)
    ground = atlas.tile(0, 0)
    sweep = jax.jit(functools.partial(depth.render, camera=CAMERA, is_profile=True))
    rng = np.random.default_rng(len(kind))
    for x in (-0.3, 0.9, 2.4, 5.0, 11.5):  # the first and the last see past the lane's ends
        place = np.array([x, rng.uniform(-0.3, 0.3)])
        over = terrain.height_at(ground, place) + rng.uniform(0.3, 1.2)
        position, rotation = np.array([*place, over], np.float32), around_pose(rng)
        marched = see(ground, position, rotation)
        swept = np.asarray(sweep(ground, position, rotation.astype(np.float32), NONE))
        # but for rays that graze an edge the two are one
        assert np.mean(abs(swept - marched) < 1e-4) > 0.998
        edge = np.ptp(np.lib.stride_tricks.sliding_window_view(marched, (3, 3)), (2, 3)) > 0.02
        np.testing.assert_allclose(swept[1:-1, 1:-1][~edge], marched[1:-1, 1:-1][~edge], atol=1e-4)


def test_only_a_lane_that_is_level_across_is_a_profile():
    c = config.Terrain(name="mixed", lane_width=1.0, levels=2)
    atlas = lanes.build(c)
    level = dict(zip(atlas.kinds, atlas.is_profile, strict=True))
    assert not level.pop("rough") and all(level.values())


@pytest.mark.parametrize(
    "shape, cell", [((11, 9), 0.1), ((40, 33), 0.02), ((1, 1), 0.05), ((5, 64), 0.05)]
)
def test_random_grids_and_capsules_look_as_mujocos_rays_see_them(shape, cell):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        coarse = rng.uniform(-0.5, 0.4, shape) * (rng.random(shape) < rng.choice([0.02, 0.1, 0.5]))
        heights = coarse.astype(np.float32).astype(float)
        origin = rng.uniform(-1.0, 1.0, 2).astype(np.float32)
        ground = terrain.from_heights(heights, cell, (float(origin[0]), float(origin[1])))
        spread = np.array(shape) * cell
        place = origin + rng.uniform(-0.3, 1.3, 2) * spread
        over = float(terrain.height_at(ground, place.astype(np.float32)))
        position = np.array([*place, over + rng.uniform(0.6, 1.4)])
        rotation = around_pose(rng)
        capsules = some_capsules(rng, position, rotation, 4 * (seed % 2))
        check(ground, heights, position, rotation, capsules)


def flat(z=0.0):
    return terrain.from_heights(np.full((1, 1), z), 0.02)


def test_depth_is_along_the_axis_and_not_along_the_ray():
    np.testing.assert_allclose(see(flat(), [0.3, 0.1, 1.0], DOWN), 1.0, atol=1e-6)
    np.testing.assert_allclose(see(flat(-0.5), [0.3, 0.1, 1.0], DOWN), 1.5, atol=1e-6)


def test_nothing_within_reach_reads_d_max():
    assert (see(flat(), [0.0, 0.0, 1.0], turn(0.0, -1.2)) == CAMERA.d_max).all()  # up
    assert (see(flat(), [0.0, 0.0, 3.01], DOWN) == CAMERA.d_max).all()
    assert (see(flat(), [0.0, 0.0, 2.99], DOWN) < CAMERA.d_max).all()


def test_row_0_is_the_top_and_column_0_the_left():
    # a step up, from 0 to 0.5 m, beyond x = 1 and beyond y = 1, seen from (1, 1, 1.5): 1.5 or 1 m
    heights = np.zeros((100, 100))
    for far, axis in ((np.s_[50:, :], 0), (np.s_[:, 50:], 1)):
        step = heights.copy()
        step[far] = 0.5
        image = see(terrain.from_heights(step, 0.02), [1.0, 1.0, 1.5], DOWN)
        high = image[: HEIGHT // 2] if axis == 0 else image[:, : WIDTH // 2]
        low = image[HEIGHT // 2 :] if axis == 0 else image[:, WIDTH // 2 :]
        np.testing.assert_allclose(high, 1.0, atol=1e-6)
        np.testing.assert_allclose(low, 1.5, atol=1e-6)


def wall(columns):
    """Return flat ground with a wall from 1 m to 1 m + `columns` of 2 cm, 3 m high."""
    heights = np.zeros((200, 1))
    heights[100 : 100 + columns] = 3.0
    return terrain.from_heights(heights, 0.02, (-1.0, 0.0))


def test_a_wall_a_metre_ahead_reads_a_metre_above_the_horizon():
    image = see(wall(50), [0.0, 0.0, 1.0], LEVEL)
    np.testing.assert_allclose(image[: HEIGHT // 2], 1.0, atol=3e-6)
    # row 47: tan(29 deg) 47 / 48 = 0.5427 down, on the ground at 1 m / 0.5427 = 1.84 m: the wall
    np.testing.assert_allclose(image, 1.0, atol=3e-6)


@pytest.mark.parametrize("yaw", np.linspace(-1.2, 1.2, 13))
def test_a_wall_one_column_thin_is_never_looked_through(yaw):
    for x in (0.0, 0.013, 0.4):
        rotation = turn(yaw, 0.3, 0.4)
        image = see(wall(1), [x, 0.01, 1.0], rotation)
        ahead = (directions() @ rotation.T).reshape(*CAMERA.shape, 3)
        with np.errstate(divide="ignore"):
            to_wall = np.where(ahead[..., 0] > 0.0, (1.0 - x) / ahead[..., 0], np.inf)
            to_ground = np.where(ahead[..., 2] < 0.0, -1.0 / ahead[..., 2], np.inf)
        over = (ahead[..., 0] > 0.0) & (1.0 + np.minimum(to_wall, 9.0) * ahead[..., 2] > 2.999)
        expected = np.minimum(np.where(over, np.inf, np.minimum(to_wall, to_ground)), CAMERA.d_max)
        np.testing.assert_allclose(image[~over], expected[~over], atol=3e-5)
        assert (expected < CAMERA.d_max).any()


def test_a_capsule_stands_before_the_wall():
    # upright, 5 cm thick, its axis 0.5 m ahead: the pixels beside the optical axis read
    # 0.5 - 0.05 m, those at the border of the image the wall
    capsule = [[0.5, 0.0, 0.0, 0.5, 0.0, 2.0, 0.05]]
    image = see(wall(50), [0.0, 0.0, 1.0], LEVEL, capsule)
    np.testing.assert_allclose(image[MIDDLE], 0.45, atol=2e-3)
    np.testing.assert_allclose(image[:, [0, -1]], 1.0, atol=3e-6)


def test_a_capsule_without_length_is_a_sphere():
    image = see(flat(-9.0), [0.0, 0.0, 0.0], LEVEL, [[1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.2]])
    np.testing.assert_allclose(image[MIDDLE], 0.8, atol=2e-3)
    # |t d - c|^2 = r^2 with d = (x, y, 1), c = (0, 0, 1): hit where x^2 + y^2 < r^2 / (1 - r^2)
    x, y, _ = directions().T
    hit = (x * x + y * y < 0.04 / 0.96).reshape(CAMERA.shape)
    np.testing.assert_array_equal(image < CAMERA.d_max, hit)


def test_a_capsule_seen_end_on_shows_its_cap():
    image = see(flat(-9.0), [0.0, 0.0, 0.0], LEVEL, [[0.5, 0.0, 0.0, 2.5, 0.0, 0.0, 0.1]])
    np.testing.assert_allclose(image[MIDDLE], 0.4, atol=2e-3)
    backward = see(flat(-9.0), [0.0, 0.0, 0.0], LEVEL, [[2.5, 0.0, 0.0, 0.5, 0.0, 0.0, 0.1]])
    np.testing.assert_allclose(backward, image, atol=1e-5)


def test_a_capsule_behind_or_around_the_camera_is_not_seen():
    empty = see(wall(50), [0.0, 0.0, 1.0], LEVEL)
    for x in (-0.5, 0.0, 0.04):
        capsule = [[x, 0.0, 0.5, x, 0.0, 1.5, 0.1]]
        np.testing.assert_array_equal(see(wall(50), [0.0, 0.0, 1.0], LEVEL, capsule), empty)


def test_a_camera_in_the_ground_reads_zero():
    np.testing.assert_array_equal(see(flat(0.5), [0.0, 0.0, 0.4], turn(0.3, 0.2)), 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e9, 1e30])
def test_a_pose_that_has_blown_up_ends_and_gives_no_nan(bad):
    for place in ([bad, 0.0, 1.0], [0.0, -bad, 1.0], [0.0, 0.0, bad]):
        image = see(wall(1), place, LEVEL)
        assert ((image >= 0.0) & (image <= CAMERA.d_max)).all()


def test_the_border_continues():
    # ground 0 at x < 0 and 0.5 at x > 0.02, seen from 5 m before and 5 m behind this grid of 2
    ground = terrain.from_heights(np.array([[0.0], [0.5]]), 0.02)
    np.testing.assert_allclose(see(ground, [-5.0, 7.0, 1.0], DOWN), 1.0, atol=1e-6)
    np.testing.assert_allclose(see(ground, [5.0, -7.0, 1.0], DOWN), 0.5, atol=1e-6)


def random_scene(seed, shape=(64, 64), cell=0.0625):
    """Return heights, position and rotation in numbers that a shift in binary leaves exact."""
    rng = np.random.default_rng(seed)
    heights = rng.choice([-0.5, 0.0, 0.0, 0.0, 0.125, 0.25], shape).repeat(2, 0)[: shape[0]]
    position = np.array([rng.integers(100, 150), rng.integers(100, 150), 90]) / 64 + 1 / 128
    return heights, position, turn(rng.uniform(-3, 3), 0.9, rng.uniform(-0.3, 0.3)), cell


@pytest.mark.parametrize("seed", range(3))
def test_shifting_robot_and_ground_together_changes_nothing(seed):
    heights, position, rotation, cell = random_scene(seed)
    image = see(terrain.from_heights(heights, cell), position, rotation)
    for shift in ([8.0, -16.0], [0.0625, 3.0]):  # m
        ground = terrain.from_heights(heights, cell, tuple(shift))
        moved = see(ground, position + np.array([*shift, 0.0]), rotation)
        np.testing.assert_allclose(moved, image, atol=1e-5)
    # the same columns as a part of a larger grid, where blocks begin elsewhere
    padded = np.pad(heights, ((5, 9), (3, 2)), mode="edge")
    moved = see(terrain.from_heights(padded, cell), position + np.array([5, 3, 0]) * cell, rotation)
    np.testing.assert_allclose(moved, image, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_turning_robot_and_ground_together_changes_little_more_than_edges(seed):
    heights, position, rotation, cell = random_scene(seed)
    image = see(terrain.from_heights(heights, cell), position, rotation)
    for quarters in (1, 2, 3):
        ground = terrain.from_heights(np.rot90(heights, -quarters), cell)
        about = rotation_of(np.array([0.0, 0.0, 1.0]), quarters * np.pi / 2)
        centre = np.array([2.0, 2.0, 0.0])
        # np.rot90(h, -1) takes column (i, j) to (j, 63 - i): x to -y, a turn by -90 degrees
        turned = see(ground, about.T @ (position - centre) + centre, about.T @ rotation)
        assert np.mean(abs(turned - image) > 1e-5) < 2e-3


def test_on_flat_ground_the_heading_does_not_matter():
    rng = np.random.default_rng(0)
    position, rotation = np.array([0.0, 0.0, 1.1]), turn(0.0, 0.8, 0.2)
    capsules = some_capsules(rng, position, rotation, 5)
    image = see(flat(), position, rotation, capsules)
    for yaw in (0.7, 2.0, -2.9):
        about = rotation_of(np.array([0.0, 0.0, 1.0]), yaw)
        ends = [capsules[:, :3] @ about.T, capsules[:, 3:6] @ about.T, capsules[:, 6:]]
        turned = see(flat(), position, about @ rotation, np.concatenate(ends, 1))
        assert np.mean(abs(turned - image) > 2e-5) < 2e-3


def test_every_tile_looks_as_if_it_were_alone():
    c = config.Terrain(name="mixed", levels=2, lane_width=0.9)  # 45 columns: blocks straddle lanes
    atlas = lanes.build(c)
    kinds, rng = len(atlas.kinds), np.random.default_rng(0)
    level, kind = np.divmod(np.arange(2 * kinds), kinds)
    position = rng.uniform([0.8, -0.4, 0.9], [2.2, 0.4, 1.2], (2 * kinds, 3)).astype(np.float32)
    rotation = np.stack([turn(rng.uniform(-2, 2), 0.9) for _ in level]).astype(np.float32)
    look = lambda level, kind, p, r: render(atlas.tile(level, kind), p, r, jnp.asarray(NONE))
    images = jax.jit(jax.vmap(look))(level, kind, position, rotation)
    across = atlas.terrain.size[1]
    for n in range(2 * kinds):
        cut = atlas.tile(level[n], kind[n]).heights
        alone = terrain.from_heights(cut, c.cell, (0.0, -0.5 * across * c.cell))
        np.testing.assert_allclose(images[n], see(alone, position[n], rotation[n]), atol=1e-5)


def test_cameras_on_different_tiles_share_one_grid():
    whole = terrain.build_grid(2 * [[np.zeros((6, 5), np.float32)]], 0.02, (0.0, 0.0), (6, 5))
    look = lambda row, p: depth.render(
        terrain.tile(whole, row, 0), p, jnp.eye(3), jnp.asarray(NONE), CAMERA
    )
    program = str(jax.make_jaxpr(jax.vmap(look))(jnp.arange(2), jnp.zeros((2, 3))))
    assert f"f32[{whole.tops.size}]" in program
    assert f"f32[2,{whole.tops.size}]" not in program


def test_a_normalised_image_lies_around_zero():
    image = jnp.array([[0.0, 1.5, 3.0]])
    np.testing.assert_allclose(depth.normalize(image, CAMERA), [[-0.5, 0.0, 0.5]])


@pytest.mark.parametrize("window", [1, 3, 5])
def test_a_pixel_is_the_nearest_of_those_around_it(window):
    image = np.random.default_rng(0).uniform(0.2, 3.0, (48, 64)).astype(np.float32)
    expected = scipy.ndimage.minimum_filter(image, window, mode="constant", cval=np.inf)
    np.testing.assert_array_equal(depth.min_filter(jnp.asarray(image), window), expected)


def due(steps, camera=CAMERA, period=0.02):
    return np.asarray(depth.is_due(jnp.arange(steps), camera, period))


def test_frames_come_after_3_2_3_2_steps():
    # 20 Hz at 50 Hz: 2 frames in 5 steps. floor(0.4 step) grows at 0, 3, 5, 8, 10
    np.testing.assert_array_equal(np.flatnonzero(due(16)), [0, 3, 5, 8, 10, 13, 15])
    np.testing.assert_array_equal(np.diff(np.flatnonzero(due(10_001))), [3, 2] * 2000)


def test_the_clock_is_exact_for_ever():
    late = 2**31 - 1 - np.arange(5)  # all five phases
    np.testing.assert_array_equal(
        depth.is_due(late.astype(np.int32), CAMERA, 0.02), np.isin(late % 5, [0, 3])
    )


@pytest.mark.parametrize("rate, period", [(20.0, 0.02), (30.0, 0.02), (15.0, 0.02), (7.0, 0.01)])
def test_most_frames_is_the_most_over_all_phases(rate, period):
    camera = dataclasses.replace(CAMERA, rate=rate)
    flags = due(2000, camera, period)
    for steps in (1, 2, 3, 5, 24, 100):
        found = np.convolve(flags, np.ones(steps), mode="valid").max()
        assert depth.max_frames(steps, camera, period) == found
    assert flags.mean() == pytest.approx(rate * period, abs=1e-3)


def test_a_camera_faster_than_the_control_loop_gives_one_frame_a_step():
    fast = dataclasses.replace(CAMERA, rate=90.0)
    assert due(20, fast).all()
    assert depth.max_frames(24, fast, 0.02) == 24


def links_at(position, q):
    """Return two links, the world and one at this pose."""
    position = jnp.array([[0.0, 0.0, 0.0], position], jnp.float32)
    rotation = jnp.array([[1.0, 0.0, 0.0, 0.0], q], jnp.float32)
    return kinematics.Links(position, rotation, jnp.zeros((2, 3)), jnp.zeros((2, 3)))


UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
LEFT = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)], np.float32)  # +x to +y


def test_the_camera_looks_down_from_its_mount():
    mount = robot.Mount(1, np.array([0.1, 0.0, 0.5], np.float32), UPRIGHT)
    camera = dataclasses.replace(CAMERA, pitch=30.0)
    position, axes = depth.pose(links_at([1.0, 2.0, 3.0], UPRIGHT), mount, camera, 0.0, np.zeros(3))
    np.testing.assert_allclose(position, [1.1, 2.0, 3.5], atol=1e-6)
    c, s = np.cos(np.pi / 6), 0.5
    np.testing.assert_allclose(axes[:, 0], [0, -1, 0], atol=1e-6)  # right is -y
    np.testing.assert_allclose(axes[:, 1], [-s, 0, -c], atol=1e-6)  # down, and back
    np.testing.assert_allclose(axes[:, 2], [c, 0, -s], atol=1e-6)  # ahead, and down


def test_the_camera_turns_with_its_link_and_its_errors_are_in_the_mounts_frame():
    # the link is turned to the left, and the mount on it once more: the mount's x is the world's -x
    mount = robot.Mount(1, np.array([0.1, 0.0, 0.5], np.float32), LEFT)
    camera = dataclasses.replace(CAMERA, pitch=60.0)
    error = np.array([0.01, 0.02, 0.03], np.float32)
    position, axes = depth.pose(links_at([0.0, 0.0, 0.0], LEFT), mount, camera, np.pi / 6, error)
    np.testing.assert_allclose(position, [-0.01, 0.1 - 0.02, 0.5 + 0.03], atol=1e-6)
    np.testing.assert_allclose(axes[:, 2], [0, 0, -1], atol=1e-6)  # 60 and 30 degrees down
    np.testing.assert_allclose(axes[:, 1], [1, 0, 0], atol=1e-6)  # the image's bottom is behind


def test_capsules_in_view_are_those_of_the_limbs_in_the_world():
    x2 = robot.load(config.Robot())
    moves = robot.moving(config.Robot())
    model = robot.spec(moves, config.Physics()).compile()
    qpos = np.concatenate([[1.0, 2.0, 0.7], LEFT, x2.rest_pose]).astype(np.float32)
    tree = kinematics.tree(model)
    links = kinematics.links(tree, jnp.asarray(qpos), jnp.zeros(len(qpos) - 1))
    found = np.asarray(depth.capsules_in_view(links, x2.capsules))
    names = np.array(x2.capsules.names)[x2.capsules.in_view]
    assert found.shape == (len(names), 7)
    state = mujoco.MjData(robot.spec(moves, config.Physics(), 0, visual=True).compile())
    state.qpos[:] = qpos
    mujoco.mj_kinematics(state.model, state)
    for row, name in zip(found, names, strict=True):
        geom = state.geom(name)
        radius, half = state.model.geom(name).size[:2]
        axis = geom.xmat.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(row[:3], geom.xpos - half * axis, atol=1e-5)
        np.testing.assert_allclose(row[3:6], geom.xpos + half * axis, atol=1e-5)
        np.testing.assert_allclose(row[6], radius, atol=1e-6)
