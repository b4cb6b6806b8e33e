import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cref_jax import config, geoms, robot, terrain
from cref_jax.errors import ConfigError
from cref_jax.physics.records import Body
from cref_jax.physics.simulation import Physics
from cref_jax.rendering import robot_scene
from cref_jax.terrain import lanes

BOXED = [("flat", 0.0), ("stairs_up", 0.2), ("stairs_down", 0.05), ("gap", 0.75), ("platform", 0.4)]
SMOOTH = [("slope", 0.2), ("rough", 0.06)]


def lane(kind, size):
    return lanes.build_single(config.Terrain(), kind, size).tile(0, 0)


def heights_seen(model, points):
    """Return where rays from far above meet the lane or the plain, m."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ground = np.array([1, 0, 0, 0, 0, 0], np.uint8)  # geom groups
    down, top, hit = np.array([0.0, 0.0, -1.0]), 20.0, np.zeros(1, np.int32)
    starts = [np.array([x, y, top]) for x, y in points]
    return np.array(
        [top - mujoco.mj_ray(model, data, p, down, ground, True, -1, hit) for p in starts]
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_boxes_cover_every_column_once_at_its_height(seed):
    rng = np.random.default_rng(seed)
    heights = rng.choice([0.0, 0.1, -1.0], (13, 9), p=[0.8, 0.1, 0.1]).astype(np.float32)
    found = geoms.merge_boxes(heights, tile=4)
    assert found is not None
    times, painted = np.zeros(heights.shape, int), np.full(heights.shape, np.nan)
    for (i, j), (along, across), height, _ in zip(*found, strict=True):
        times[i : i + along, j : j + across] += 1
        painted[i : i + along, j : j + across] = height
    assert (times == 1).all()
    np.testing.assert_array_equal(painted, heights)


def test_tones_take_turns_at_risers_and_tiles():
    # one row; a tile is 3 columns. Level: 3 + 2, a step: 2, a landing: 3 + 3 + 1
    profile = np.array([0, 0, 0, 0, 0, 1, 1, 2, 2, 2, 2, 2, 2, 2], np.float32)
    found = geoms.merge_boxes(profile[:, None], tile=3)
    assert found is not None
    assert found.size[:, 0].tolist() == [3, 2, 2, 3, 3, 1]
    assert found.tone.tolist() == [0, 1, 0, 1, 0, 1]


@pytest.mark.parametrize(("kind", "size"), BOXED)
def test_a_lane_of_level_pieces_takes_few_boxes(kind, size):
    heights, _ = robot_scene.window(lane(kind, size))
    found = geoms.merge_boxes(heights, tile=50)
    assert found is not None
    assert len(found.tone) <= (50 if "stairs" in kind else 25)


@pytest.mark.parametrize(("kind", "size"), SMOOTH)
def test_a_slope_and_noise_become_a_height_field(kind, size):
    model = robot_scene.build("legs", config.Physics(), lane(kind, size))
    assert (model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD).sum() == 1


@pytest.mark.parametrize(("kind", "size"), BOXED)
def test_the_boxes_show_the_ground_that_the_robot_feels(kind, size):
    ground = lane(kind, size)
    rng = np.random.default_rng(0)
    columns = rng.integers(0, ground.size, (200, 2)) + rng.uniform(0.01, 0.99, (200, 2))
    points = np.asarray(ground.origin) + columns * ground.cell
    seen = heights_seen(robot_scene.build("legs", config.Physics(), ground), points)
    np.testing.assert_allclose(seen, terrain.height_at(ground, points), atol=1e-5)


@pytest.mark.parametrize(("kind", "size"), SMOOTH)
def test_the_field_goes_through_the_middles_of_the_columns(kind, size):
    ground = lane(kind, size)
    columns = np.random.default_rng(0).integers(1, np.array(ground.size) - 1, (200, 2))
    # off the middle by a hair, since a ray through an edge of two triangles may meet neither
    points = np.asarray(ground.origin) + (columns + 0.5003) * ground.cell
    seen = heights_seen(robot_scene.build("legs", config.Physics(), ground), points)
    np.testing.assert_allclose(seen, terrain.height_at(ground, points), atol=1e-4)


def test_a_huge_map_is_thinned_out(monkeypatch):
    monkeypatch.setattr(robot_scene, "MOST_VERTICES", 100)
    x = np.arange(40) * 0.05
    ground = terrain.from_heights(np.sin(x)[:, None] + 0.1 * x, 0.05, (-0.3, 0.2))
    model = robot_scene.build("legs", config.Physics(), ground)
    assert model.hfield_nrow[0] * model.hfield_ncol[0] <= 100
    # every 4th column; column 20 has its middle at x = -0.3 + 20.5 * 0.05, y = 0.2 + 20.5 * 0.05
    seen = heights_seen(model, [(-0.3 + 20.503 * 0.05, 0.2 + 20.503 * 0.05)])
    np.testing.assert_allclose(seen, np.sin(1.0) + 0.1, atol=1e-3)


@pytest.mark.parametrize("held", ["none", "waist", "all"])
def test_the_links_are_drawn_where_the_physics_has_them(held):
    c = config.Robot(held=held)
    physics = Physics(c, config.Physics(), "mujoco", threads=1)
    rng = np.random.default_rng(0)
    joints = physics.robot.rest_pose + rng.uniform(-0.3, 0.3, len(physics.robot.rest_pose))
    turn = rng.normal(size=4)
    qpos = np.concatenate([[1.0, -0.2, 0.7], turn / np.linalg.norm(turn), joints])
    qpos = qpos.astype(np.float32)
    still = np.zeros(len(joints) + 6, np.float32)
    links = physics.links(Body(jnp.asarray(qpos), jnp.asarray(still), jnp.asarray(still)))

    model = robot_scene.build(robot.moving(c), config.Physics(), lane("flat", 0.0))
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    names = [physics.model.body(b).name for b in physics.feet] + ["pelvis"]
    for name in names:
        body = physics.model.body(name).id
        np.testing.assert_allclose(links.position[body], data.body(name).xpos, atol=1e-5)


def test_the_camera_keeps_up_with_a_steady_walk_and_ignores_the_bobbing():
    t = np.arange(200) * 0.04  # s
    steady = np.stack([0.6 * t, 0.0 * t, 0.6 + 0.1 * t], axis=1)
    np.testing.assert_allclose(robot_scene.camera_path(steady, 0.04), steady, atol=1e-9)
    bobbing = steady + 0.03 * np.sin(2 * np.pi * 2.0 * t)[:, None]  # 2 steps/s
    middle = slice(20, -20)
    error = robot_scene.camera_path(bobbing, 0.04)[middle] - steady[middle]
    assert np.abs(error).max() < 0.003


@pytest.mark.parametrize("count", [1, 2, 5])
def test_the_camera_follows_a_short_film(count):
    qpos = np.linspace(0.0, 1.0, count)[:, None] * np.ones(9)
    np.testing.assert_allclose(robot_scene.camera_path(qpos, 0.02), qpos[:, :3], atol=1e-9)


def test_the_robot_stands_in_the_middle_of_the_picture():
    data = robot.load(config.Robot())
    moves = robot.moving(config.Robot())
    model = robot_scene.build(moves, config.Physics(), lane("stairs_up", 0.15))
    qpos = np.concatenate([[0.75, 0, data.standing_height, 1, 0, 0, 0], data.rest_pose])
    try:
        canvas = robot_scene.Canvas(model, 192, 108)
    except ConfigError as error:
        pytest.skip(str(error))
    with canvas:
        there = canvas.draw(qpos, qpos[:3]).astype(float)
        qpos[0] += 50.0
        gone = canvas.draw(qpos, np.array([0.75, 0.0, data.standing_height])).astype(float)
    assert there.shape == (108, 192, 3)
    changed = np.argwhere(np.abs(there - gone).max(axis=2) > 30)
    np.testing.assert_allclose(changed.mean(axis=0), [54, 96], atol=12)
    assert len(changed) > 300
