import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cref_jax import config, robot
from cref_jax.robot.x2_ultra import X2_ULTRA

FACTS = json.loads((Path(__file__).parents[1] / "data" / "x2_facts.json").read_text())
ACTUATED = ["legs", "legs+waist", "all"]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(X2_ULTRA.xml))


def mean_of_sides(values: dict[str, float], name: str) -> float:
    left, right = name.replace("right_", "left_"), name.replace("left_", "right_")
    return 0.5 * (values[left] + values[right])


def left_and_right(names: list[str]) -> list[tuple[str, str]]:
    return [(n, n.replace("left_", "right_")) for n in names if n.startswith("left_")]


def at_nominal_pose(
    actuated: robot.Actuated, height: float
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Every shape kept, on its own planes at z = 0."""
    model = robot.spec(actuated, config.Physics(), visual=True).compile()
    state = mujoco.MjData(model)
    state.qpos[:7] = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]
    state.qpos[7:] = robot.load(config.Robot(actuated=actuated)).nominal_pose
    mujoco.mj_forward(model, state)
    return model, state


def inertia_tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body(body).iquat)
    return axes.reshape(3, 3) @ np.diag(model.body(body).inertia) @ axes.reshape(3, 3).T


@pytest.mark.parametrize("actuated", ACTUATED)
def test_the_robot_weighs_41_97_kg_whatever_is_actuated(actuated):
    compiled = robot.spec(actuated, config.Physics()).compile()
    assert compiled.body_mass.sum() == pytest.approx(FACTS["total_mass"], abs=1e-3)
    assert robot.load(config.Robot(actuated=actuated)).mass == pytest.approx(41.967, abs=1e-3)


def test_masses_are_the_vendors_averaged_over_the_sides(model):
    for name in FACTS["mass"]:
        expected = mean_of_sides(FACTS["mass"], name)
        assert model.body(name).mass[0] == pytest.approx(expected, abs=1e-5), name


def test_the_joints_and_their_limits_are_the_vendors():
    r = robot.load(config.Robot(actuated="all"))
    assert list(r.joint_names) == list(FACTS["joints"])
    for i, facts in enumerate(FACTS["joints"].values()):
        np.testing.assert_allclose([r.range_low[i], r.range_high[i]], facts["range"], atol=1e-6)
        np.testing.assert_allclose(r.effort[i], facts["effort"], atol=1e-6)
        # one ankle's 13.087 against 13.088 rad/s of the other
        np.testing.assert_allclose(r.velocity_limit[i], facts["velocity"], atol=2e-3)


def test_the_right_side_mirrors_the_left_in_mass_and_shape(model):
    flip = np.diag([1.0, -1.0, 1.0])
    for left, right in left_and_right([model.body(b).name for b in range(model.nbody)]):
        a, b = model.body(left), model.body(right)
        np.testing.assert_allclose(a.mass, b.mass)
        np.testing.assert_allclose(flip @ a.pos, b.pos, atol=1e-9)
        np.testing.assert_allclose(a.quat * [1, -1, 1, -1], b.quat, atol=1e-9)
        np.testing.assert_allclose(flip @ a.ipos, b.ipos, atol=1e-9)
        mirrored = flip @ inertia_tensor(model, left) @ flip
        np.testing.assert_allclose(mirrored, inertia_tensor(model, right), atol=1e-9)
    for left, right in left_and_right([model.geom(g).name for g in range(model.ngeom)]):
        np.testing.assert_allclose(flip @ model.geom(left).pos, model.geom(right).pos, atol=1e-9)
        np.testing.assert_allclose(model.geom(left).size, model.geom(right).size)


def test_the_right_side_mirrors_the_left_in_pose_and_limits():
    r = robot.load(config.Robot(actuated="all"))
    for left, right in left_and_right(list(r.joint_names)):
        i, j = r.joint_names.index(left), r.joint_names.index(right)
        for same in (r.kp, r.kd, r.effort, r.velocity_limit, r.action_scale):
            assert same[i] == same[j]
        about_y = "pitch" in left or "knee" in left or "elbow" in left
        low_high = np.array([r.range_low[i], r.range_high[i]])
        mirrored = low_high if about_y else -low_high[::-1]
        np.testing.assert_allclose(mirrored, [r.range_low[j], r.range_high[j]], atol=1e-6)
        assert r.nominal_pose[j] == (1 if about_y else -1) * r.nominal_pose[i]


@pytest.mark.parametrize(
    ("actuated", "nv", "nu"), [("legs", 18, 12), ("legs+waist", 21, 15), ("all", 37, 31)]
)
def test_only_the_actuated_joints_move(actuated, nv, nu):
    compiled = robot.spec(actuated, config.Physics()).compile()
    r = robot.load(config.Robot(actuated=actuated, held="none"))
    assert (compiled.nv, compiled.nu, r.num_joints) == (nv, nu, nu)
    # motor i turns joint i, behind the freejoint
    np.testing.assert_array_equal(compiled.actuator_trnid[:, 0], np.arange(1, nu + 1))


@pytest.mark.parametrize(("held", "count"), [("none", 12), ("waist", 15), ("all", 31)])
def test_joints_that_are_held_come_after_those_that_the_policy_drives(held, count):
    r, whole = robot.load(config.Robot(held=held)), robot.load(config.Robot(actuated="all"))
    assert r.joint_names == whole.joint_names[:12]
    np.testing.assert_array_equal(r.rest_pose, whole.nominal_pose[:count])
    for name in ("nominal_pose", "kp", "kd", "effort", "velocity_limit", "range_low", "range_high"):
        np.testing.assert_array_equal(getattr(r, name), getattr(whole, name)[:12])


def test_what_is_driven_is_not_held():
    r = robot.load(config.Robot(actuated="legs+waist", held="waist"))
    assert r.num_joints == len(r.rest_pose) == 15


@pytest.mark.parametrize("actuated", ["legs", "legs+waist"])
def test_welding_leaves_every_shape_and_site_where_the_nominal_pose_has_it(actuated):
    whole_model, whole = at_nominal_pose("all", 0.7)
    welded_model, welded = at_nominal_pose(actuated, 0.7)
    for g in range(whole_model.ngeom):
        if name := whole_model.geom(g).name:
            expected = whole.geom(name)
            np.testing.assert_allclose(welded.geom(name).xpos, expected.xpos, atol=1e-6)
            np.testing.assert_allclose(welded.geom(name).xmat, expected.xmat, atol=1e-6)
    for site in ("depth_camera", "imu"):
        np.testing.assert_allclose(welded.site(site).xpos, whole.site(site).xpos, atol=1e-6)
    assert whole_model.ngeom == welded_model.ngeom


@pytest.mark.parametrize("actuated", ["legs", "legs+waist"])
def test_welding_keeps_the_inertia_of_the_whole(actuated):
    whole_model, whole = at_nominal_pose("all", 0.7)
    welded_model, welded = at_nominal_pose(actuated, 0.7)
    np.testing.assert_allclose(welded.subtree_com[1], whole.subtree_com[1], atol=1e-6)
    expected, found = np.zeros((37, 37)), np.zeros((welded_model.nv,) * 2)
    mujoco.mj_fullM(whole_model, whole, expected)
    mujoco.mj_fullM(welded_model, welded, found)
    np.testing.assert_allclose(found[:18, :18], expected[:18, :18], atol=1e-5)


def test_the_nominal_pose_stands_flat_with_the_pelvis_0_55_m_above_the_ankles():
    r = robot.load(config.Robot())
    _, state = at_nominal_pose("legs", r.standing_height)
    soles = [state.geom(name).xpos for name in r.spheres.names if "sole" in name]
    np.testing.assert_allclose(np.array(soles)[:, 2], 0.01, atol=1e-5)  # on their radius
    ankles = state.xpos[list(r.ankles)]
    np.testing.assert_allclose(state.xpos[r.pelvis, 2] - ankles[:, 2], 0.55, atol=1e-3)
    ahead = state.subtree_com[r.pelvis, 0] - ankles[:, 0]
    assert np.all((ahead > 0.0) & (ahead < 0.06))  # the sole reaches from -0.065 to 0.135 m


@pytest.mark.parametrize("actuated", ACTUATED)
def test_it_stands_for_10_s_when_the_ankles_balance_it(actuated):
    # Held at q0 alone any robot with these gains topples: its two ankles give 80 N m/rad and
    # gravity takes m g h = 42 * 9.81 * 0.6 = 247 N m/rad. So the ankles push against the sway.
    r = robot.load(config.Robot(actuated=actuated))
    model, state = at_nominal_pose(actuated, r.standing_height)
    ankles = [i for i, name in enumerate(r.joint_names) if "ankle_pitch" in name]
    start, farthest = state.subtree_com[1, 0], np.zeros(3)
    for _ in range(2000):
        mujoco.mj_subtreeVel(model, state)
        sway, speed = state.subtree_com[1, 0] - start, state.subtree_linvel[1, 0]
        state.ctrl[:] = r.nominal_pose
        state.ctrl[ankles] += 12.0 * sway + 4.0 * speed
        mujoco.mj_step(model, state)
        farthest = np.maximum(farthest, np.abs(state.qpos[:3] - [0, 0, r.standing_height]))
    assert state.time == pytest.approx(10.0)
    assert farthest[0] < 0.02
    assert farthest[1] < 1e-3
    assert farthest[2] < 0.03  # the knees yield 0.15 rad under the weight


@pytest.mark.parametrize("actuated", ["legs", "all"])
def test_held_at_the_nominal_pose_it_stays_upright_for_a_second(actuated):
    r = robot.load(config.Robot(actuated=actuated))
    model, state = at_nominal_pose(actuated, r.standing_height)
    state.ctrl[:] = r.nominal_pose
    mujoco.mj_step(model, state, nstep=200)
    assert np.hypot(*state.qpos[:2]) < 0.05
    assert state.qpos[2] > r.standing_height - 0.03


def test_each_plane_touches_its_own_sphere_only():
    r = robot.load(config.Robot())
    model, state = at_nominal_pose("legs", r.standing_height - 0.002)
    soles = {name for name in r.spheres.names if "sole" in name}
    pairs = [[model.geom(g).name for g in pair] for pair in state.contact.geom]
    assert {sphere for _, sphere in pairs} == soles
    assert all(plane == f"plane_{sphere}_0" for plane, sphere in pairs)


def test_mocap_bodies_come_in_the_order_sphere_then_plane():
    spheres = robot.load(config.Robot()).spheres.names
    model = robot.spec("legs", config.Physics(), contact_planes=2).compile()
    names = [model.body(b).name for b in np.flatnonzero(model.body_mocapid >= 0)]
    assert names == [f"plane_{sphere}_{k}" for sphere in spheres for k in range(2)]
    np.testing.assert_allclose(model.pair_friction[:, :2], robot.FRICTION)


def test_the_shanks_spheres_lie_in_the_front_of_the_shank(model):
    spheres, capsules = (lambda r: (r.spheres, r.capsules))(robot.load(config.Robot()))
    shank = capsules.names.index("left_knee_link")
    for name in ("left_shank_0", "left_shank_1"):
        i = spheres.names.index(name)
        axis = capsules.end[shank] - capsules.start[shank]
        across = np.cross(spheres.position[i] - capsules.start[shank], axis)
        depth = np.linalg.norm(across) / np.linalg.norm(axis)
        assert depth + spheres.radius[i] == pytest.approx(capsules.radius[shank], abs=1e-3)
        assert spheres.position[i, 0] > 0.0


def test_a_unit_action_turns_a_joint_by_a_quarter_of_effort_over_kp():
    r = robot.load(config.Robot())
    # hip 0.25 * 120 / 100, knee 0.25 * 120 / 150, ankle 0.25 * 36 / 40 and 0.25 * 24 / 30
    expected = [0.3, 0.3, 0.3, 0.2, 0.225, 0.2] * 2
    np.testing.assert_allclose(r.action_scale, expected, atol=1e-6)


def test_hip_xz_and_ankle_x_are_the_joints_of_table_i():
    r = robot.load(config.Robot())
    np.testing.assert_array_equal(r.hip_xz, [0, 1, 1, 0, 0, 0] * 2)
    np.testing.assert_array_equal(r.ankle_x, [0, 0, 0, 0, 0, 1] * 2)


def test_the_camera_sits_in_the_face():
    r = robot.load(config.Robot(held="none"))
    _, state = at_nominal_pose("legs", r.standing_height)
    # head_pitch_link: 0.06706 + 0.08801 + 0.3094 + 0.0889 = 0.55337 m over the pelvis
    expected = [0.00835 + 0.0576, 0.0, r.standing_height + 0.55337 - 0.0484]
    np.testing.assert_allclose(state.site("depth_camera").xpos, expected, atol=1e-5)
    np.testing.assert_allclose(state.xpos[r.camera.body] + r.camera.position, expected, atol=1e-5)
