"""A description that does not fit its MJCF is refused in one line that names the field."""

import copy
import dataclasses
import re

import mujoco
import pytest

from cref_jax import config, robot
from cref_jax.errors import ConfigError
from cref_jax.robot.conventions import check_conventions
from cref_jax.robot.registry import describe

X2 = describe("x2_ultra")


def test_the_base_comes_first():
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    with pytest.raises(ConfigError, match="the first joint must be the free joint of 'torso'"):
        check_conventions(spec, dataclasses.replace(X2, base="torso"))


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("hip_xz", "hip_roll", "must be a tuple[str, ...], not 'hip_roll': one name needs a comma"),
        ("legs", "hip", "must be a tuple[str, ...], not 'hip': one name needs a comma too"),
        ("feet", X2.feet[0], "must be a tuple[str, str], not 'left_ankle_roll_link'"),
        ("hands", (), "must be a tuple[str, str], not ()"),
    ],
)
def test_a_name_without_its_comma_is_refused(field, value, says):
    robot = copy.copy(X2)
    object.__setattr__(robot, field, value)  # as tests check the types of what is made
    with pytest.raises(ConfigError, match=re.escape(f"{field} {says}")):
        check_conventions(mujoco.MjSpec.from_file(str(X2.xml)), robot)


@pytest.mark.parametrize(
    ("role", "says"),
    [
        ({"nominal_pose": {"knie": 0.6}}, "no joint is a 'knie' of the nominal pose"),
        ({"nominal_pose": {"knee": 34.0}}, "'left_knee_joint' goes .* rad, never 34: is angle"),
        ({"legs": ("leg",)}, "no joint is one of the legs, leg"),
        ({"waist": ("head",)}, "'head_yaw_joint' comes too late: the order is legs, waist"),
        ({"ankle_x": ("ankle_x",)}, "no joint has 'ankle_x' in its name"),
        ({"kept_clear": ("pelvis", "belly")}, "no capsule has 'belly' in its name"),
        ({"hands": ("left_hand", "right_hand")}, "there is no body 'left_hand'"),
        ({"feet": X2.feet[::-1]}, "feet must be named left_ first and then right_, not 'right_"),
        ({"soles": (X2.soles[0],) * 2}, "soles must be named left_ first and then right_"),
        ({"hands": (X2.hands[0], X2.feet[1])}, "hands must be named left_ first and then right_"),
    ],
)
def test_a_role_of_no_part_is_named(role, says):
    spec = mujoco.MjSpec.from_file(str(X2.xml))
    with pytest.raises(ConfigError, match=says):
        check_conventions(spec, dataclasses.replace(X2, **role))


def test_an_unknown_robot_is_refused_with_the_nearest_name():
    with pytest.raises(ConfigError, match="unknown robot 'x2_ultr'; did you mean 'x2_ultra'"):
        robot.load(config.Robot(name="x2_ultr"))
