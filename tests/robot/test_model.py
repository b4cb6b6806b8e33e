import itertools
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from cref_jax import config, robot
from cref_jax.robot.registry import ROBOTS, describe

FACTS = json.loads((Path(__file__).parents[1] / "data" / "x2_facts.json").read_text())
ACTUATED = ["legs", "legs+waist", "all"]
EACH = pytest.mark.parametrize("name", ROBOTS)
JOINTS = {"x2_ultra": (12, 15, 31), "g1": (12, 15, 29)}  # of legs, with the waist, of all
OURS = pytest.mark.parametrize("name", JOINTS)


def load(name: str, **which) -> robot.Robot:
    return robot.load(config.Robot(name, **which))


def whole(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(describe(name).xml))


def mean_of_sides(values: dict[str, float], name: str) -> float:
    left, right = name.replace("right_", "left_"), name.replace("left_", "right_")
    return 0.5 * (values[left] + values[right])


def left_and_right(names: list[str]) -> list[tuple[str, str]]:
    return [(n, n.replace("left_", "right_")) for n in names if n.startswith("left_")]


def at_nominal_pose(
    name: str, actuated: robot.Actuated, height: float
) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Every shape kept, on its own planes at z = 0."""
    model = robot.spec(actuated, config.Physics(), visual=True, name=name).compile()
    state = mujoco.MjData(model)
    state.qpos[:7] = [0.0, 0.0, height, 1.0, 0.0, 0.0, 0.0]
    state.qpos[7:] = load(name, actuated=actuated).nominal_pose
    mujoco.mj_forward(model, state)
    return model, state


def inertia_tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    axes = np.zeros(9)
    mujoco.mju_quat2Mat(axes, model.body(body).iquat)
    return axes.reshape(3, 3) @ np.diag(model.body(body).inertia) @ axes.reshape(3, 3).T


@OURS
@pytest.mark.parametrize("actuated", ACTUATED)
def test_the_robot_weighs_the_same_whatever_is_actuated(name, actuated):
    # the G1: pelvis 3.813, legs 2 (1.35 + 1.52 + 1.702 + 1.932 + 0.074 + 0.608), waist and torso
    # 0.214 + 0.086 + 7.818, arms 2 (0.718 + 0.643 + 0.734 + 0.6 + 0.085445 + 0.48405 + 0.254576)
    expected = {"x2_ultra": FACTS["total_mass"], "g1": 33.341142}[name]
    compiled = robot.spec(actuated, config.Physics(), name=name).compile()
    assert compiled.body_mass.sum() == pytest.approx(expected, abs=1e-3)
    assert load(name, actuated=actuated).mass == pytest.approx(expected, abs=1e-3)


def test_the_g1_is_as_tall_and_as_long_of_leg_as_its_vendor_says():
    # upright 1.32 m tall, and 0.6 m from the hip to the ankle
    model = whole("g1")
    state = mujoco.MjData(model)
    mujoco.mj_kinematics(model, state)
    named = lambda beginning: [g for g in range(model.ngeom) if beginning in model.geom(g).name]
    ends = lambda geoms: np.array(  # highest and lowest of each, m
        [
            state.geom_xpos[g, 2]
            + np.array([1.0, -1.0])
            * (model.geom_size[g, 0] + model.geom_size[g, 1] * abs(state.geom_xmat[g, 8]))
            for g in geoms
        ]
    )
    tall = ends(named("head"))[:, 0].max() - ends(named("sole"))[:, 1].min()
    assert tall == pytest.approx(1.32, abs=0.01)
    hip, knee, ankle = (
        state.body(f"left_{part}_link").xpos for part in ("hip_roll", "knee", "ankle_pitch")
    )
    leg = np.linalg.norm(hip - knee) + np.linalg.norm(knee - ankle)
    assert leg == pytest.approx(0.6, abs=0.01)


def test_masses_are_the_vendors_averaged_over_the_sides():
    model = whole("x2_ultra")
    for name in FACTS["mass"]:
        expected = mean_of_sides(FACTS["mass"], name)
        assert model.body(name).mass[0] == pytest.approx(expected, abs=1e-5), name


def test_the_joints_and_their_limits_are_the_vendors():
    r = load("x2_ultra", actuated="all")
    assert list(r.joint_names) == list(FACTS["joints"])
    for i, facts in enumerate(FACTS["joints"].values()):
        np.testing.assert_allclose([r.range_low[i], r.range_high[i]], facts["range"], atol=1e-6)
        np.testing.assert_allclose(r.effort[i], facts["effort"], atol=1e-6)
        # one ankle's 13.087 against 13.088 rad/s of the other
        np.testing.assert_allclose(r.velocity_limit[i], facts["velocity"], atol=2e-3)


@EACH
def test_the_right_side_mirrors_the_left_in_mass_and_shape(name):
    model = whole(name)
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


@EACH
def test_the_right_side_mirrors_the_left_in_pose_and_limits(name):
    r = load(name, actuated="all")
    model = whole(name)
    for left, right in left_and_right(list(r.joint_names)):
        i, j = r.joint_names.index(left), r.joint_names.index(right)
        for same in (r.kp, r.kd, r.effort, r.velocity_limit, r.action_scale):
            assert same[i] == same[j]
        about_y = model.jnt_axis[model.joint(left).id][1] != 0.0
        low_high = np.array([r.range_low[i], r.range_high[i]])
        mirrored = low_high if about_y else -low_high[::-1]
        np.testing.assert_allclose(mirrored, [r.range_low[j], r.range_high[j]], atol=1e-6)
        assert r.nominal_pose[j] == (1 if about_y else -1) * r.nominal_pose[i]


@OURS
@pytest.mark.parametrize("actuated", ACTUATED)
def test_only_the_actuated_joints_move(name, actuated):
    nu = JOINTS[name][ACTUATED.index(actuated)]
    compiled = robot.spec(actuated, config.Physics(), name=name).compile()
    r = load(name, actuated=actuated, held="none")
    assert (compiled.nv, compiled.nu, r.num_joints) == (6 + nu, nu, nu)
    # motor i turns joint i, behind the freejoint
    np.testing.assert_array_equal(compiled.actuator_trnid[:, 0], np.arange(1, nu + 1))


@OURS
@pytest.mark.parametrize("held", ["none", "waist", "all"])
def test_joints_that_are_held_come_after_those_that_the_policy_drives(name, held):
    r, complete = load(name, held=held), load(name, actuated="all")
    assert r.joint_names == complete.joint_names[:12]
    count = JOINTS[name][["none", "waist", "all"].index(held)]
    np.testing.assert_array_equal(r.rest_pose, complete.nominal_pose[:count])
    for what in ("nominal_pose", "kp", "kd", "effort", "velocity_limit", "range_low", "range_high"):
        np.testing.assert_array_equal(getattr(r, what), getattr(complete, what)[:12])


@EACH
def test_the_nominal_pose_is_well_inside_every_joints_range(name):
    r = load(name, actuated="all")
    margin = 0.025 * (r.range_high - r.range_low)  # of the soft limit of Table I
    inside = (r.nominal_pose >= r.range_low + margin) & (r.nominal_pose <= r.range_high - margin)
    on_its_stop = r.nominal_pose == np.clip(0.0, r.range_low, r.range_high)
    assert (inside | on_its_stop).all()


@EACH
@pytest.mark.parametrize("end", ["low", "high"])
def test_every_motor_turns_its_joint_to_both_ends_of_its_range(name, end):
    r = load(name, actuated="all")
    spec = robot.spec("all", config.Physics(), 0, name=name)
    spec.delete(spec.joints[0])  # the base is held
    spec.option.gravity = [0.0, 0.0, 0.0]
    model = spec.compile()
    state = mujoco.MjData(model)
    state.qpos[:], state.ctrl[:] = r.nominal_pose, getattr(r, f"range_{end}")
    mujoco.mj_step(model, state, nstep=1000)  # 5 s
    np.testing.assert_allclose(state.qpos, getattr(r, f"range_{end}"), atol=0.02)


@EACH
def test_no_link_is_inside_another_in_the_nominal_pose(name):
    # but for neighbours and theirs, whose capsules overlap at the joint
    model, state = at_nominal_pose(name, "all", 1.0)
    capsules = [model.geom(n).id for n in load(name).capsules.names]

    def ancestors(body: int) -> list[int]:
        return [body, *ancestors(model.body_parentid[body])] if body else [0]

    for g, h in itertools.combinations(capsules, 2):
        a, b = (ancestors(model.geom_bodyid[x]) for x in (g, h))
        meet = next(body for body in a if body in b)
        if a.index(meet) + b.index(meet) > 2:
            gap = mujoco.mj_geomDistance(model, state, g, h, 1.0, None)
            assert gap > 0.005, (model.geom(g).name, model.geom(h).name)


def test_what_is_driven_is_not_held():
    r = load("x2_ultra", actuated="legs+waist", held="waist")
    assert r.num_joints == len(r.rest_pose) == 15


@EACH
@pytest.mark.parametrize("actuated", ["legs", "legs+waist"])
def test_welding_leaves_every_shape_and_site_where_the_nominal_pose_has_it(name, actuated):
    free_model, free = at_nominal_pose(name, "all", 0.7)
    welded_model, welded = at_nominal_pose(name, actuated, 0.7)
    for g in range(free_model.ngeom):
        if shape := free_model.geom(g).name:
            expected = free.geom(shape)
            np.testing.assert_allclose(welded.geom(shape).xpos, expected.xpos, atol=1e-6)
            np.testing.assert_allclose(welded.geom(shape).xmat, expected.xmat, atol=1e-6)
    for site in (describe(name).camera, describe(name).imu):
        np.testing.assert_allclose(welded.site(site).xpos, free.site(site).xpos, atol=1e-6)
    assert free_model.ngeom == welded_model.ngeom


@EACH
@pytest.mark.parametrize("actuated", ["legs", "legs+waist"])
def test_welding_keeps_the_inertia_of_the_whole(name, actuated):
    free_model, free = at_nominal_pose(name, "all", 0.7)
    welded_model, welded = at_nominal_pose(name, actuated, 0.7)
    np.testing.assert_allclose(welded.subtree_com[1], free.subtree_com[1], atol=1e-6)
    expected, found = np.zeros((free_model.nv,) * 2), np.zeros((welded_model.nv,) * 2)
    mujoco.mj_fullM(free_model, free, expected)
    mujoco.mj_fullM(welded_model, welded, found)
    moved = slice(6 + load(name).num_joints)  # the base and the legs
    np.testing.assert_allclose(found[moved, moved], expected[moved, moved], atol=1e-5)


@EACH
def test_the_nominal_pose_stands_flat_with_the_weight_over_the_soles(name):
    r, data = load(name), describe(name)
    _, state = at_nominal_pose(name, "legs", r.standing_height)
    names = np.array(r.spheres.names)[r.spheres.foot >= 0]
    soles = np.array([state.geom(n).xpos for n in names])
    radius = r.spheres.radius[r.spheres.foot >= 0]
    np.testing.assert_allclose(soles[:, 2], radius, atol=1e-5)
    ankles = state.xpos[list(r.ankles)]
    above = state.xpos[r.pelvis, 2] - ankles[:, 2]
    np.testing.assert_allclose(above, data.base_above_ankles, atol=1e-3)
    ahead = state.subtree_com[r.pelvis, 0] - ankles[:, 0]
    assert np.all((ahead > 0.0) & (ahead < 0.5 * (soles[:, 0].max() - ankles[0, 0])))


@OURS
@pytest.mark.parametrize("actuated", ACTUATED)
def test_it_stands_for_10_s_when_the_ankles_balance_it(name, actuated):
    # Held at q0 alone any robot with these gains topples: its two ankles give 80 N m/rad and
    # gravity takes m g h = 42 * 9.81 * 0.6 = 247 N m/rad. So the ankles push against the sway.
    r = load(name, actuated=actuated)
    model, state = at_nominal_pose(name, actuated, r.standing_height)
    ankles = [i for i, joint in enumerate(r.joint_names) if "ankle_pitch" in joint]
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


@EACH
@pytest.mark.parametrize("actuated", ["legs", "all"])
def test_held_at_the_nominal_pose_it_stays_upright_for_a_second(name, actuated):
    r = load(name, actuated=actuated)
    model, state = at_nominal_pose(name, actuated, r.standing_height)
    state.ctrl[:] = r.nominal_pose
    mujoco.mj_step(model, state, nstep=200)
    assert np.hypot(*state.qpos[:2]) < 0.05
    assert state.qpos[2] > r.standing_height - 0.03


@EACH
def test_each_plane_touches_its_own_sphere_only(name):
    r = load(name)
    model, state = at_nominal_pose(name, "legs", r.standing_height - 0.002)
    soles = set(np.array(r.spheres.names)[r.spheres.foot >= 0])
    pairs = [[model.geom(g).name for g in pair] for pair in state.contact.geom]
    assert {sphere for _, sphere in pairs} == soles
    assert all(plane == f"plane_{sphere}_0" for plane, sphere in pairs)


def test_mocap_bodies_come_in_the_order_sphere_then_plane():
    spheres = robot.load(config.Robot()).spheres.names
    model = robot.spec("legs", config.Physics(), contact_planes=2).compile()
    names = [model.body(b).name for b in np.flatnonzero(model.body_mocapid >= 0)]
    assert names == [f"plane_{sphere}_{k}" for sphere in spheres for k in range(2)]
    np.testing.assert_allclose(model.pair_friction[:, :2], robot.FRICTION)


@OURS
def test_the_shanks_spheres_lie_in_the_front_of_the_shank(name):
    spheres, capsules = (lambda r: (r.spheres, r.capsules))(load(name))
    shank = capsules.names.index("left_knee_link")
    for sphere in ("left_shank_0", "left_shank_1"):
        i = spheres.names.index(sphere)
        axis = capsules.end[shank] - capsules.start[shank]
        across = np.cross(spheres.position[i] - capsules.start[shank], axis)
        depth = np.linalg.norm(across) / np.linalg.norm(axis)
        assert depth + spheres.radius[i] == pytest.approx(capsules.radius[shank], abs=1e-3)
        assert spheres.position[i, 0] > 0.0


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        # hip 0.25 * 120 / 100, knee 0.25 * 120 / 150, ankle 0.25 * 36 / 40 and 0.25 * 24 / 30
        ("x2_ultra", [0.3, 0.3, 0.3, 0.2, 0.225, 0.2]),
        # hip 0.25 * 88 / 100 and 0.25 * 139 / 100, knee 0.25 * 139 / 150, ankle 0.25 * 35 / 40
        ("g1", [0.22, 0.3475, 0.22, 0.231667, 0.21875, 0.21875]),
    ],
)
def test_a_unit_action_turns_a_joint_by_a_quarter_of_effort_over_kp(name, expected):
    np.testing.assert_allclose(load(name).action_scale, expected * 2, atol=1e-6)


@OURS
def test_hip_xz_and_ankle_x_are_the_joints_of_table_i(name):
    r = load(name)
    np.testing.assert_array_equal(r.hip_xz, [0, 1, 1, 0, 0, 0] * 2)
    np.testing.assert_array_equal(r.ankle_x, [0, 0, 0, 0, 0, 1] * 2)


@pytest.mark.parametrize(
    ("name", "above"),  # m, from the pelvis
    [
        # head_pitch_link: 0.06706 + 0.08801 + 0.3094 + 0.0889 = 0.55337 m over the pelvis
        ("x2_ultra", [0.00835 + 0.0576, 0.0, 0.55337 - 0.0484]),
        ("g1", [-0.0039635 + 0.0576235, 0.01753, 0.044 + 0.42987]),  # torso_link, and in it
    ],
)
def test_the_camera_sits_in_the_face(name, above):
    r = load(name, held="none")
    _, state = at_nominal_pose(name, "legs", r.standing_height)
    expected = np.array([0.0, 0.0, r.standing_height]) + above
    np.testing.assert_allclose(state.site("depth_camera").xpos, expected, atol=1e-5)
    np.testing.assert_allclose(state.xpos[r.camera.body] + r.camera.position, expected, atol=1e-5)


def test_torque_speed_and_rotor_of_the_g1s_motors():
    # rotor inertia through two planetary stages: J0 (g1 g2)^2 + J1 g2^2 + J2, kg m^2, of a knee
    # 0.489e-4 (4.5 * 5)^2 + 0.109e-4 * 5^2 + 0.738e-4; of two ankle motors
    # 2 (0.139e-4 (3.5556 * 4.5)^2 + 0.017e-4 * 4.5^2 + 0.169e-4)
    r = load("g1", actuated="all")
    model = whole("g1")
    for joint, effort, speed, rotor in [
        ("left_knee_joint", 139.0, 20.0, 0.0251019),
        ("right_ankle_roll_joint", 35.0, 30.0, 0.0072195),
        ("waist_pitch_joint", 35.0, 30.0, 0.0072195),
        ("left_wrist_yaw_joint", 5.0, 22.0, 0.00425),
    ]:
        i = r.joint_names.index(joint)
        assert (r.effort[i], r.velocity_limit[i]) == (effort, speed)
        assert model.dof_armature[model.joint(joint).dofadr[0]] == pytest.approx(rotor, abs=1e-6)
