"""An MJCF that does not keep a convention is refused in one line that says which."""

import dataclasses

import mujoco
import pytest

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


def without_a_motor(spec):
    spec.delete(spec.actuator("left_knee_joint"))


def without_a_torque_limit(spec):
    spec.actuator("left_knee_joint").forcerange = [0.0, 0.0]


def without_a_camera(spec):
    spec.delete(spec.site("depth_camera"))


def without_a_sole(spec):
    for geom in [g for g in spec.geoms if g.name.startswith("left_sole")]:
        geom.name = geom.name.replace("sole", "tread")


def with_a_lighter_shank(spec):
    spec.body("left_knee_link").mass = 1.5


def with_another_range(spec):
    spec.joint("left_hip_roll_joint").range = [-0.3, 2.9]


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
        (without_a_motor, "actuators must be one per joint, in the joints' order"),
        (without_a_torque_limit, "actuator of 'left_knee_joint' must be a position one"),
        (without_a_camera, "there is no site 'depth_camera'"),
        (without_a_sole, "there is no sphere whose name begins with 'left_sole'"),
        (with_a_lighter_shank, "'right_knee_link' must be the mirror image of the left one"),
        (with_another_range, "'right_hip_roll_joint' must have the mirrored axis and range"),
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


def test_the_base_comes_first():
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    with pytest.raises(ConfigError, match="the first joint must be the free joint of 'torso'"):
        check_conventions(spec, dataclasses.replace(X2, base="torso"))


@pytest.mark.parametrize(
    ("role", "says"),
    [
        ({"nominal_pose": {"knie": 0.6}}, "no joint is a 'knie' of the nominal pose"),
        ({"legs": ("leg",)}, "no joint is one of the legs, leg"),
        ({"waist": ("head",)}, "'head_yaw_joint' comes too late: the order is legs, waist"),
        ({"ankle_x": ("ankle_x",)}, "no joint has 'ankle_x' in its name"),
        ({"kept_clear": ("pelvis", "belly")}, "no capsule has 'belly' in its name"),
        ({"hands": ("left_hand", "right_hand")}, "there is no body 'left_hand'"),
    ],
)
def test_a_role_of_no_part_is_named(role, says):
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    with pytest.raises(ConfigError, match=says):
        check_conventions(spec, dataclasses.replace(X2, **role))


def test_an_unknown_robot_is_refused_with_the_nearest_name():
    with pytest.raises(ConfigError, match="unknown robot 'x2_ultr'; did you mean 'x2_ultra'"):
        robot.load(config.Robot(name="x2_ultr"))
