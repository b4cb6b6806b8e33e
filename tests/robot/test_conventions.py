"""An MJCF that does not keep a convention is refused in one line that says which."""

import dataclasses

import mujoco
import numpy as np
import pytest
from biped import BIPED

from cref_jax import config, robot
from cref_jax.errors import ConfigError
from cref_jax.robot.conventions import check_conventions
from cref_jax.robot.registry import ROBOTS, describe

X2 = describe("x2_ultra")


def slide(spec):
    spec.joint("left_knee_joint").type = mujoco.mjtJoint.mjJNT_SLIDE


def off_its_origin(spec):
    spec.joint("left_knee_joint").pos = [0.0, 0.0, 0.1]


def without_range(spec):
    spec.joint("left_knee_joint").range = [0.0, 0.0]


def without_speed_limit(spec):
    spec.joint("left_knee_joint").userdata = [0.0]


def with_a_speed_in_degrees(spec):
    spec.joint("left_knee_joint").userdata = [860.0]


def with_ranges_in_degrees(spec):
    spec.compiler.degree = True


def without_a_motor(spec):
    spec.delete(spec.actuator("left_knee_joint"))


def without_a_torque_limit(spec):
    spec.actuator("left_knee_joint").forcerange = [0.0, 0.0]


def with_a_target_limit(spec):
    spec.actuator("left_knee_joint").ctrlrange = [-0.1, 0.1]


def with_a_gear(spec):
    spec.actuator("left_knee_joint").gear[0] = 50.0


def with_a_slow_motor(spec):
    spec.actuator("left_knee_joint").set_to_position(kp=100.0, kv=2.0, timeconst=0.1)


def without_damping(spec):
    spec.actuator("left_knee_joint").biasprm[2] = 0.0


def with_torques_for_targets(spec):
    spec.actuator("left_knee_joint").set_to_motor()


def with_speeds_for_targets(spec):
    spec.actuator("left_knee_joint").set_to_velocity(kv=2.0)


def with_more_torque_one_way(spec):
    spec.actuator("left_knee_joint").forcerange = [-5.0, 40.0]


def with_a_torque_limit_of_the_joint(spec):
    spec.joint("left_knee_joint").actfrcrange = [-1.0, 1.0]


def with_another_zero(spec):
    spec.joint("left_knee_joint").ref = 0.3


def with_a_spring(spec):
    spec.joint("right_knee_joint").stiffness[0] = 100.0


def without_gravity(spec):
    spec.option.gravity = [0.0, 0.0, 0.0]


def without_a_camera(spec):
    spec.delete(spec.site("depth_camera"))


def with_the_imu_turned(spec):
    spec.site("imu").quat = [0.5**0.5, 0.0, 0.0, 0.5**0.5]


def with_the_imu_upside_down(spec):
    spec.site("imu").quat = [0.0, 1.0, 0.0, 0.0]


def with_the_camera_pitched_twice(spec):
    spec.site("depth_camera").quat = [np.cos(0.436), 0.0, np.sin(0.436), 0.0]  # 50 deg down


def with_the_camera_in_its_own_axes(spec):
    spec.site("depth_camera").quat = [0.5, -0.5, 0.5, -0.5]  # z forward, x to the right


def with_the_camera_backwards(spec):
    spec.site("depth_camera").quat = [0.0, 0.0, 1.0, 0.0]


def without_a_sole(spec):
    for geom in [g for g in spec.geoms if g.name.startswith("left_sole")]:
        geom.name = geom.name.replace("sole", "tread")


def with_a_sole_on_another_link(spec):
    spec.delete(spec.geom("left_sole_0"))
    spec.body("left_ankle_pitch_link").add_geom(
        name="left_sole_0", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0.0, 0.0]
    )


def with_soles_on_the_other_foot(spec):
    for geom in [g for g in spec.geoms if "_sole_" in g.name]:
        geom.name = f"other_{geom.name}"
    for geom in [g for g in spec.geoms if "_sole_" in g.name]:
        side = "left" if "right" in geom.name else "right"
        geom.name = f"{side}_sole_{geom.name[-1]}"


def with_two_spheres_without_names(spec):
    for side in ("left", "right"):
        spec.geom(f"{side}_sole_0").name = ""


def with_a_lighter_shank(spec):
    spec.body("left_knee_link").mass = 1.5


def with_another_range(spec):
    spec.joint("left_hip_roll_joint").range = [-0.3, 2.9]


def with_a_knee_that_turns_the_other_way(spec):
    knee = spec.joint("right_knee_joint")
    knee.axis, knee.range = -knee.axis, -knee.range[::-1]


def with_a_turned_shank(spec):
    spec.body("right_knee_link").quat = [1.0, 0.0, 0.02, 0.0]


def with_another_inertia(spec):
    spec.body("right_hip_yaw_link").fullinertia *= 1.1


def with_a_centre_of_mass_aside(spec):
    spec.body("pelvis").ipos[1] += 0.02


def with_a_lower_sole(spec):
    spec.geom("right_sole_0").pos[2] -= 0.002


def with_a_thicker_thigh(spec):
    spec.geom("right_hip_yaw_link").size[0] += 0.002


def with_a_stronger_gain(spec):
    motor = spec.actuator("right_knee_joint")
    motor.gainprm[0] *= 1.01
    motor.biasprm[1] *= 1.01


def with_a_weaker_motor(spec):
    spec.actuator("right_knee_joint").forcerange = [-10.0, 10.0]


def with_a_slower_joint(spec):
    spec.joint("right_knee_joint").userdata = [1.0]


def with_a_heavier_rotor(spec):
    spec.joint("right_knee_joint").armature += 0.001


def with_more_friction(spec):
    spec.joint("right_knee_joint").frictionloss += 0.1


def with_more_damping(spec):
    spec.joint("right_knee_joint").damping[0] += 0.1


def with_a_collision(spec):
    spec.geom("pelvis").contype = 1


def with_a_sensor(spec):
    spec.add_sensor(
        name="gyro",
        type=mujoco.mjtSensor.mjSENS_GYRO,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname="imu",
    )


def with_one_arm_renamed(spec):
    spec.body("left_elbow_link").name = "left_forearm_link"


@pytest.mark.parametrize("name", ROBOTS)
def test_every_robot_keeps_the_conventions(name):
    check_conventions(mujoco.MjSpec.from_file(str(describe(name).xml)), describe(name))


@pytest.mark.parametrize(
    ("breach", "says"),
    [
        (slide, "'left_knee_joint' must be a hinge about its body's origin"),
        (off_its_origin, "'left_knee_joint' must be a hinge about its body's origin"),
        (without_range, "'left_knee_joint' must have a range"),
        (without_speed_limit, "'left_knee_joint' must have its speed limit"),
        (with_a_speed_in_degrees, "'left_knee_joint' must have a speed limit of 100 rad/s at most"),
        # -2.704 to 2.556, as degrees
        (
            with_ranges_in_degrees,
            "'left_hip_pitch_joint' goes -0.0472 to 0.0446 rad, never -0.42: is angle='radian'?",
        ),
        (without_a_motor, "actuators must be one per joint, in the joints' order"),
        (without_a_torque_limit, "actuator of 'left_knee_joint' must be a position one"),
        (with_a_target_limit, "actuator of 'left_knee_joint' must be a position one"),
        (with_a_gear, "actuator of 'left_knee_joint' must be a position one"),
        (with_a_slow_motor, "actuator of 'left_knee_joint' must be a position one"),
        (without_damping, "actuator of 'left_knee_joint' must be a position one"),
        (with_torques_for_targets, "actuator of 'left_knee_joint' must be a position one"),
        (with_speeds_for_targets, "actuator of 'left_knee_joint' must be a position one"),
        (with_more_torque_one_way, "actuator of 'left_knee_joint' must be a position one"),
        (
            with_a_torque_limit_of_the_joint,
            "'left_knee_joint' must have neither ref nor",
        ),
        (with_another_zero, "'left_knee_joint' must have neither ref nor actuatorfrcrange"),
        (
            with_a_spring,
            "'right_knee_joint' must have the motor, speed, armature, friction",
        ),
        (without_gravity, "gravity must be 0 0 -9.81"),
        (without_a_camera, "there is no site 'depth_camera'"),
        (with_the_imu_turned, "site 'imu' must have x forward and z up in the nominal pose"),
        (with_the_imu_upside_down, "site 'imu' must have x forward and z up in the nominal pose"),
        (with_the_camera_pitched_twice, "site 'depth_camera' must have x forward and z up: camera"),
        (with_the_camera_in_its_own_axes, "site 'depth_camera' must have x forward and z up"),
        (with_the_camera_backwards, "site 'depth_camera' must have x forward and z up"),
        (without_a_sole, "there is no sphere whose name begins with 'left_sole'"),
        (with_a_sole_on_another_link, "'left_sole_0' must be on 'left_ankle_roll_link' itself"),
        (with_soles_on_the_other_foot, "'left_sole_0' must be on 'left_ankle_roll_link' itself"),
        (with_two_spheres_without_names, "each sphere of 'left_ankle_roll_link' must have a name"),
        (with_a_lighter_shank, "'right_knee_link' must be the mirror image of the left one"),
        (with_another_range, "'right_hip_roll_joint' must have the mirrored axis and range"),
        (with_a_knee_that_turns_the_other_way, "'right_knee_joint' must turn the other way"),
        (with_a_turned_shank, "'right_knee_link' must be the mirror image of the left one"),
        (with_another_inertia, "'right_hip_yaw_link' must be the mirror image of the left one"),
        (with_a_centre_of_mass_aside, "'pelvis' must have its centre of mass in the middle"),
        (with_a_lower_sole, "a capsule or sphere of 'right_ankle_roll_link' must be the mirror"),
        (with_a_thicker_thigh, "a capsule or sphere of 'right_hip_yaw_link' must be"),
        (with_a_stronger_gain, "'right_knee_joint' must have the motor"),
        (with_a_weaker_motor, "'right_knee_joint' must have the motor"),
        (with_a_slower_joint, "'right_knee_joint' must have the motor, speed"),
        (with_a_heavier_rotor, "'right_knee_joint' must have the motor, speed, armature"),
        (
            with_more_friction,
            "'right_knee_joint' must have the motor, speed, armature, friction",
        ),
        (with_more_damping, "'right_knee_joint' must have the motor, speed, armature, friction"),
        (with_a_collision, "geom 'pelvis' must have contype and conaffinity 0"),
        (with_a_sensor, "it must have no sensors"),
        (with_one_arm_renamed, "'left_forearm_link' has no 'right_forearm_link'"),
    ],
)
def test_a_breach_is_named(breach, says):
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    breach(spec)
    with pytest.raises(ConfigError, match=says):
        check_conventions(spec, X2)


def weighed_by_its_shapes():
    """Return the biped with hands whose masses are those of their capsules alone."""
    spec = mujoco.MjSpec.from_file(str(BIPED.xml))
    for name in BIPED.hands:
        body = spec.body(name)
        body.explicitinertial = False
        body.mass, body.ipos, body.inertia = 0.0, [np.nan, 0.0, 0.0], [0.0, 0.0, 0.0]
        for geom in body.geoms:
            geom.mass = 0.4
    return spec


def test_bodies_that_weigh_what_their_shapes_do_are_compared():
    check_conventions(weighed_by_its_shapes(), BIPED)
    other = weighed_by_its_shapes()
    other.body(BIPED.hands[1]).geoms[0].mass = 0.3
    with pytest.raises(ConfigError, match=f"'{BIPED.hands[1]}' must be the mirror image of the"):
        check_conventions(other, BIPED)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (("</worldbody>", ""), "XML parse error"),
        (("<worldbody>", '<asset><mesh file="no.stl"/></asset><worldbody>'), "no.stl"),
        (('<inertial mass="0.8"', '<inertial mass="0"'), "mass and inertia of moving bodies must"),
    ],
)
def test_what_mujoco_cannot_read_is_said_in_one_line(monkeypatch, tmp_path, wrong, says):
    file = tmp_path / "mine.xml"
    file.write_text(BIPED.xml.read_text().replace(*wrong))
    monkeypatch.setitem(ROBOTS, "mine", dataclasses.replace(BIPED, xml=file))
    with pytest.raises(ConfigError, match=says) as error:
        robot.load(config.Robot("mine"))
    assert str(error.value).startswith("mine.xml: ") and "\n" not in str(error.value)


def test_a_file_that_is_missing_is_named(monkeypatch, tmp_path):
    absent = dataclasses.replace(BIPED, xml=tmp_path / "mine.xml")
    monkeypatch.setitem(ROBOTS, "mine", absent)
    with pytest.raises(ConfigError, match=r"^mine.xml: .*[^\n]*$"):
        robot.load(config.Robot("mine"))


def with_pads():
    """Return the biped whose soles are on bodies that are fixed to its feet."""
    spec = mujoco.MjSpec.from_file(str(BIPED.xml))
    for foot in BIPED.feet:
        pad = spec.body(foot).add_body(name=foot.replace("ankle_roll", "pad"))
        for sole in [g for g in spec.geoms if g.parent.name == foot and "sole" in g.name]:
            name, place, size = sole.name, sole.pos.copy(), sole.size.copy()
            spec.delete(sole)
            pad.add_geom(
                name=name, pos=place, size=size, type=mujoco.mjtGeom.mjGEOM_SPHERE,
                mass=0.0, contype=0, conaffinity=0,
            )  # fmt: skip
    return spec


def test_a_sole_may_be_fixed_to_its_foot():
    check_conventions(with_pads(), BIPED)


@pytest.mark.parametrize("role", ["feet", "hands"])
def test_the_link_that_a_foot_or_hand_is_fixed_to_is_named_instead(role):
    pads = dataclasses.replace(BIPED, **{role: ("left_pad_link", "right_pad_link")})
    with pytest.raises(ConfigError, match=r"'left_pad_link' has no joint: .*'left_ankle_roll_"):
        check_conventions(with_pads(), pads)


def test_a_camera_s_site_may_look_down_a_little():
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    spec.site("depth_camera").quat = [np.cos(0.15), 0.0, np.sin(0.15), 0.0]  # 17 deg, and 50
    check_conventions(spec, X2)


def test_a_leg_joint_without_a_side_is_named():
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    for joint in ("left_knee_joint", "right_knee_joint"):
        other = joint.replace("left_", "l_").replace("right_", "r_")
        spec.joint(joint).name = spec.actuator(joint).target = other
    with pytest.raises(ConfigError, match="'l_knee_joint' is one of the legs, and must begin with"):
        check_conventions(spec, X2)
