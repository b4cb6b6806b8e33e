"""A robot that answers the swing of its hips on both feet, with one mistake at a time."""

import numpy as np
import pytest
from tiny_policy import ROBOT, J, contents, policy

from cref_jax.deploy import Status
from cref_jax.runtime.joints import read_joints
from cref_jax.runtime.legs import Legs
from cref_jax.runtime.nudge import Nudge
from cref_jax.runtime.tables import Table

PERIOD = 0.02
JOINTS = read_joints(Table(contents(policy("full"))[0], "manifest"))
OTHER_LEG = np.r_[6:12, 0:6]
HIP_PITCH, HIP_ROLL, HIP_YAW, KNEE, ANKLE_PITCH, ANKLE_ROLL = range(6)  # of the left leg


@pytest.fixture(scope="module")
def legs():
    return Legs(Table(contents(policy("full"))[0], "manifest"), ROBOT.joint_names)


class Standing:
    """Joint angles and gyro of a base whose hips answer a tenth of their targets, two steps late.

    Both soles stay flat where they are: the ankles make up for the hips, and the hip yaws for the
    base's yaw, which is three times as far as the left hip goes back and the right one forward.
    """

    def __init__(self):
        self.asked = [np.zeros(J)] * 3
        self.before = np.zeros(2)

    def answer(self, target):
        """Return q and the angular velocity in the step in which `target` is given, rad, rad/s."""
        moved = 0.1 * self.asked[-2]
        self.asked.append(target)
        scissor, lean = moved[HIP_PITCH] - moved[6 + HIP_PITCH], moved[HIP_ROLL]
        lean_right = moved[6 + HIP_ROLL]
        yaw, roll = -1.5 * scissor, -(lean + lean_right)
        q = np.zeros(J)
        q[[HIP_PITCH, 6 + HIP_PITCH]] = scissor / 2, -scissor / 2
        q[[ANKLE_PITCH, 6 + ANKLE_PITCH]] = -scissor / 2, scissor / 2
        q[[HIP_YAW, 6 + HIP_YAW]] = -yaw
        q[[HIP_ROLL, 6 + ANKLE_ROLL]] = lean, lean
        q[[6 + HIP_ROLL, ANKLE_ROLL]] += lean_right
        rate = (np.array([roll, yaw]) - self.before) / PERIOD
        self.before = np.array([roll, yaw])
        return q, np.array([rate[0], 0.0, rate[1]])


def flip(*joints):
    sign = np.ones(J)
    sign[list(joints)] = -1.0
    return lambda x: x * sign


def same(x):
    return x


def swing(legs, sense=same, gyro=same, act=same, noise=0.0, seed=0, sinks=0.0, moves=1.0):
    """Return the swing after a robot of which one thing is wrong has answered it."""
    rng, nudge = np.random.default_rng(seed), Nudge(legs, JOINTS, PERIOD)
    robot, target = Standing(), np.zeros(J)
    for k in range(10):
        q, w = robot.answer(moves * act(target))
        q[[HIP_PITCH, 6 + HIP_PITCH]] += sinks * k, -sinks * k
        q[[ANKLE_PITCH, 6 + ANKLE_PITCH]] += 0.01 * k  # the base tips back as the held knees yield
        w[1] = -0.01 / PERIOD
        q, w = sense(q), gyro(w)
        q, w = (x + noise * rng.uniform(-1, 1, x.shape) * s for x, s in ((q, 0.02), (w, 0.2)))
        nudge.add(q.astype(np.float32), w.astype(np.float32))
        target = nudge.offset()
    return nudge


def test_the_swing_goes_to_and_fro_once_and_ends(legs):
    nudge = Nudge(legs, JOINTS, PERIOD)
    targets = []
    for _ in range(10):
        nudge.add(np.zeros(J, np.float32), np.zeros(3, np.float32))
        targets.append(nudge.offset())
    targets = np.array(targets)
    left, right, roll = targets[:, HIP_PITCH], targets[:, 6 + HIP_PITCH], targets[:, HIP_ROLL]
    # 0.083 and 0.125 of 120 N m at 100 N m/rad
    np.testing.assert_allclose(left[:3], 0.0996 * np.array([0.0, 0.5**0.5, 1.0]), atol=1e-6)
    np.testing.assert_allclose([left[6], roll[2]], [-0.0996, 0.15], atol=1e-6)
    np.testing.assert_allclose(targets[8:], 0.0, atol=1e-6)
    np.testing.assert_array_equal(left, -right)
    np.testing.assert_array_equal(targets[:, ANKLE_PITCH], right)  # the soles stay level


def test_a_robot_that_is_right_is_found_right(legs):
    assert swing(legs).judge() == Status.OK
    assert swing(legs, sinks=0.005).judge() == Status.OK  # 0.1 rad apart in 0.2 s


@pytest.mark.parametrize(
    ("wrong", "flag", "words"),
    [
        ({"gyro": lambda w: w * [1, 1, -1]}, Status.GYRO_WRONG, "angular_velocity's z"),
        ({"gyro": lambda w: w[[1, 0, 2]] * [-1, 1, 1]}, Status.IMU_TURNED, "about the IMU's x"),
        ({"gyro": lambda w: w[[1, 0, 2]] * [1, -1, 1]}, Status.IMU_TURNED, "about the IMU's x"),
        ({"sense": flip(HIP_ROLL)}, Status.JOINTS_MIXED_UP, "left_hip_roll_joint or left_ankle"),
        (
            {"sense": flip(6 + ANKLE_ROLL)},
            Status.JOINTS_MIXED_UP,
            "right_hip_roll_joint or right_ankle",
        ),
        (
            {"sense": flip(HIP_ROLL), "act": flip(HIP_ROLL)},
            Status.JOINTS_MIXED_UP,
            "left_hip_roll_joint or left_ankle",
        ),
        (
            {"sense": lambda q: q[OTHER_LEG], "act": lambda q: q[OTHER_LEG]},
            Status.JOINTS_MIXED_UP,
            "turns the other way",
        ),
        ({"sense": lambda q: q[OTHER_LEG]}, Status.JOINTS_MIXED_UP, "turns the other way"),
        ({"act": lambda q: q[OTHER_LEG]}, Status.JOINTS_MIXED_UP, "asked of the other"),
    ],
)
def test_a_sign_or_a_side_that_is_wrong_is_named(legs, wrong, flag, words):
    nudge = swing(legs, **wrong)
    assert nudge.judge() == flag and words in nudge.detail
    nudge.reset()
    assert nudge.judge() == Status.OK and nudge.detail == ""


def test_noise_of_training_is_no_mistake(legs):
    assert {swing(legs, noise=1.0, seed=seed).judge() for seed in range(300)} == {Status.OK}


def test_a_robot_whose_base_is_held_is_no_mistake(legs):
    held = {swing(legs, gyro=lambda w: 0 * w, noise=0.2, seed=k).judge() for k in range(300)}
    assert held == {Status.OK}


def test_a_robot_that_is_not_held_on_both_feet_says_nothing(legs):
    other = {"act": lambda q: q[OTHER_LEG]}
    lifted = lambda q: q + 0.12 * (np.arange(J) == ANKLE_PITCH)
    assert swing(legs, **other, sense=lifted).judge() == Status.OK
    assert swing(legs, gyro=lambda w: w * [1, 1, -1], sinks=0.04).judge() == Status.OK


def test_legs_without_a_yaw_joint_may_turn_either_way():
    manifest = contents(policy("full"))[0]
    for leg in manifest["legs"]:
        del leg["joints"][HIP_YAW]
    legs = Legs(Table(manifest, "manifest"), ROBOT.joint_names)
    for way in (1, -1):
        assert swing(legs, gyro=lambda w, way=way: w * [1, 1, way]).judge() == Status.OK
    exchanged = swing(legs, act=lambda q: q[OTHER_LEG])
    assert exchanged.judge() == Status.JOINTS_MIXED_UP and "asked of the other" in exchanged.detail


def test_half_a_swing_says_nothing(legs):
    nudge = swing(legs, gyro=lambda w: w * [1, 1, -1])
    nudge._q, nudge._w = nudge._q[:6], nudge._w[:6]
    assert nudge.judge() == Status.OK


def test_a_robot_with_other_legs_is_not_moved():
    manifest = contents(policy("full"))[0]
    for leg in manifest["legs"]:
        leg["joints"] = leg["joints"][:2]
    nudge = Nudge(Legs(Table(manifest, "manifest"), ROBOT.joint_names), JOINTS, PERIOD)
    nudge.add(np.zeros(J, np.float32), np.zeros(3, np.float32))
    assert not nudge.possible and not nudge.offset().any() and nudge.judge() == Status.OK
