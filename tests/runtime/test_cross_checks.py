"""A robot whose motion is known exactly, with one sense wrong at a time."""

import numpy as np
import pytest
from tiny_policy import ROBOT, J, contents, policy

from cref_jax.deploy import Status
from cref_jax.runtime.cross_checks import FROZEN_STEPS, CrossChecks
from cref_jax.runtime.joints import read_joints
from cref_jax.runtime.legs import Legs
from cref_jax.runtime.senses import Senses
from cref_jax.runtime.tables import Table

PERIOD = 0.02
ANKLES = [ROBOT.joint_names.index(f"{side}_ankle_{axis}_joint")
          for side in ("left", "right") for axis in ("pitch", "roll")]  # fmt: skip
LEGS_SWAPPED = np.r_[6:12, 0:6]
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # the IMU's axes by 90 deg


def about_y(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def about_x(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


@pytest.fixture(scope="module")
def legs():
    return Legs(Table(contents(policy("full"))[0], "manifest"), ROBOT.joint_names)


def motion(steps=150):
    """Return gyro, gravity, q, qd and targets of a base that sways on ankles, feet level [T, ...].

    The soles' rotation in the base's frame is Ry(pitch) Rx(roll), so the base's is its inverse.
    """
    t = np.arange(steps) * PERIOD
    pitch, roll = 0.08 * np.sin(7.0 * t), 0.06 * np.sin(5.0 * t + 1.0)
    rates = 0.56 * np.cos(7.0 * t), 0.3 * np.cos(5.0 * t + 1.0)
    q, qd = np.zeros((steps, J)), np.zeros((steps, J))
    q[:, ANKLES[::2]], qd[:, ANKLES[::2]] = pitch[:, None], rates[0][:, None]
    q[:, ANKLES[1::2]], qd[:, ANKLES[1::2]] = roll[:, None], rates[1][:, None]
    q[:, 0], qd[:, 0] = 0.3 * np.sin(6.0 * t), 1.8 * np.cos(6.0 * t)  # a hip swings
    gravity, gyro = np.zeros((steps, 3)), np.zeros((steps, 3))
    for k in range(steps):
        sole = about_y(pitch[k]) @ about_x(roll[k])
        gravity[k] = sole @ [0.0, 0.0, -1.0]
        # with the sole at rest, the base turns by minus what its ankle turns it
        gyro[k] = -(rates[0][k] * np.array([0, 1, 0]) + rates[1][k] * about_y(pitch[k])[:, 0])
    q[:, 0] -= pitch  # so that the sole of this leg stays level, too
    qd[:, 0] -= rates[0]
    swing = 0.3 * np.sin(6.0 * t)
    q[:, ANKLES[0]] -= swing - pitch
    qd[:, ANKLES[0]] -= 1.8 * np.cos(6.0 * t) - rates[0]
    return gyro, gravity, q, qd, q.copy()


def compare(legs, senses, noise=0.0, seed=0):
    """Return what is wrong after all steps, the step at which it showed, and the checks."""
    rng, checks, first = np.random.default_rng(seed), CrossChecks(PERIOD, J, legs), None
    widths = np.array([0.2, 0.05, 0.02, 1.5, 0.0]) * noise  # rad/s, 1, rad, rad/s, as in training
    for k, row in enumerate(zip(*senses, strict=True)):
        noisy = [x + w * rng.uniform(-1, 1, x.shape) for x, w in zip(row, widths, strict=True)]
        wrong = checks.compare(*noisy)
        first = k if wrong and first is None else first
    return checks.wrong, first, checks


def test_the_motion_is_a_true_one(legs):
    gyro, gravity, q, qd, _ = motion()
    np.testing.assert_allclose(np.gradient(q, PERIOD, axis=0)[5:-5], qd[5:-5], atol=0.02)
    turned = -np.cross(gyro, gravity)
    np.testing.assert_allclose(np.gradient(gravity, PERIOD, axis=0)[5:-5], turned[5:-5], atol=0.01)
    for k in range(0, 150, 10):  # level soles
        np.testing.assert_allclose(legs.down(q[k].astype(np.float32)), [gravity[k]] * 2, atol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.5, 1.0])
def test_right_senses_raise_no_alarm(legs, noise):
    for seed in range(5):
        assert compare(legs, motion(), noise, seed)[0] == Status.OK


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_robot_that_stands_raises_no_alarm(legs, noise):
    still = [np.repeat(x[:1], 400, axis=0) for x in motion()]
    still[0], still[3] = 0.0 * still[0], 0.0 * still[3]
    assert compare(legs, still, noise)[0] == Status.OK


@pytest.mark.parametrize(
    ("gyro", "gravity", "flag", "within"),
    [
        (-1, 1, Status.GYRO_WRONG, 30),
        ([-1, 1, 1], 1, Status.GYRO_WRONG, 60),
        ([1, -1, 1], 1, Status.GYRO_WRONG, 30),
        (0, 1, Status.GYRO_WRONG, 30),
        (180 / np.pi, 1, Status.GYRO_WRONG, 30),
        (1, [-1, -1, 1], Status.GRAVITY_WRONG, 30),
        (1, [-1, 1, 1], Status.GRAVITY_WRONG, 30),
        (1, [1, -1, 1], Status.GRAVITY_WRONG, 60),
        ([-1, -1, 1], [-1, -1, 1], Status.IMU_TURNED, 60),
    ],
)
def test_a_sign_or_unit_of_the_imu_is_found_and_mended(legs, gyro, gravity, flag, within):
    true = motion()
    wrong, first, checks = compare(legs, [true[0] * gyro, true[1] * gravity, *true[2:]])
    assert wrong == flag and first <= within
    if gyro != 0:  # a gyro that says nothing is no better when turned
        mended = checks.mend(checks.wrong)
        np.testing.assert_allclose(mended[0][:2], true[0][-1, :2], atol=0.02)
        np.testing.assert_allclose(mended[1], true[1][-1], atol=1e-6)


@pytest.mark.parametrize("axes", [TURN, TURN.T])
def test_an_imu_turned_by_a_quarter_is_found_and_turned_back(legs, axes):
    true = motion()
    wrong, _, checks = compare(legs, [true[0] @ axes, true[1] @ axes, *true[2:]])
    assert wrong == Status.IMU_TURNED
    np.testing.assert_allclose(checks.mend(checks.wrong)[0], true[0][-1], atol=1e-6)
    np.testing.assert_allclose(checks.mend(checks.wrong)[1], true[1][-1], atol=1e-6)


@pytest.mark.parametrize("which", ["gyro", "gravity"])
def test_exchanged_axes_of_one_sense_are_found_and_mended(legs, which):
    true, exchanged = motion(), [1, 0, 2]
    senses = list(true)
    index = 0 if which == "gyro" else 1
    senses[index] = true[index][:, exchanged]
    wrong, _, checks = compare(legs, senses)
    assert wrong == (Status.GYRO_WRONG if which == "gyro" else Status.GRAVITY_WRONG)
    np.testing.assert_allclose(checks.mend(checks.wrong)[index][:2], true[index][-1, :2], atol=1e-4)


def test_gravity_of_the_world_in_place_of_the_bases_is_found(legs):
    true = motion()
    fixed = np.tile([0.0, 0.0, -1.0], (len(true[0]), 1))
    assert compare(legs, [true[0], fixed, *true[2:]])[0] == Status.GRAVITY_WRONG


@pytest.mark.parametrize("wrong", [lambda qd: -qd, lambda qd: 0 * qd, np.rad2deg])
def test_wrong_joint_speeds_are_found_and_replaced(legs, wrong):
    true = motion()
    found, _, checks = compare(legs, [*true[:3], wrong(true[3]), true[4]])
    assert found == Status.JOINT_SPEEDS_WRONG
    np.testing.assert_allclose(checks.mend(checks.wrong)[2], true[3][-1], atol=0.2)


def test_the_sign_of_a_single_joints_speed_is_found(legs):
    true = motion()
    qd = true[3] * np.where(np.arange(J) == 0, -1.0, 1.0)
    assert compare(legs, [*true[:3], qd, true[4]])[0] == Status.JOINT_SPEEDS_WRONG


def test_joints_that_move_against_their_targets_are_mixed_up(legs):
    gyro, gravity, q, qd, target = motion()
    assert compare(legs, [gyro, gravity, q, qd, -target])[0] == Status.JOINTS_MIXED_UP
    walking = q.copy()
    walking[:, :6] += 0.3 * np.sin(0.2 * np.arange(150))[:, None]
    walking[:, 6:] -= 0.3 * np.sin(0.2 * np.arange(150))[:, None]
    speeds = np.gradient(walking, PERIOD, axis=0)
    found = compare(None, [gyro, gravity, walking, speeds, walking[:, LEGS_SWAPPED]])[0]
    assert found & Status.JOINTS_MIXED_UP


def test_noise_hides_no_wrong_sign_for_long(legs):
    true = motion(250)
    for seed in range(3):
        wrong, first, _ = compare(legs, [-true[0], *true[1:]], 0.5, seed)
        assert wrong & (Status.GYRO_WRONG | Status.GRAVITY_WRONG) and first < 150


def test_before_a_start_what_was_wrong_is_forgotten_when_it_is_right(legs):
    true, checks = motion(600), CrossChecks(PERIOD, J, legs)
    seen = []
    for k, (w, g, q, qd, target) in enumerate(zip(*true, strict=True)):
        seen.append(checks.compare(-w if k < 60 else w, g, q, qd, target, forget=True))
    assert seen[50] == Status.GYRO_WRONG and seen[-1] == Status.OK


def test_joint_angles_that_are_impossible_once_make_no_wrong_sense_right(legs):
    joints = read_joints(Table(contents(policy("full"))[0], "manifest"))
    senses, said, turned = Senses(joints, legs, PERIOD, careful=True), [], []
    for k, (w, g, q, qd, target) in enumerate(zip(*motion(), strict=True)):
        q_read = q + 10.0 * (k == 100)
        said.append(senses.take([-w, g, np.zeros(3), q_read, qd], target.astype(np.float32)))
        turned.append(senses.angular_velocity)
    assert said[99] == Status.GYRO_WRONG and said[100] == Status.BAD_INPUT
    assert set(said[101:]) == {Status.GYRO_WRONG}
    turns = motion()[0][101, :2]
    np.testing.assert_allclose(turned[101][:2], turns, atol=1e-6)  # turned back at once
    senses.reset()
    again = zip(*motion(), strict=True)
    assert {senses.take([w, g, w, q, qd], q) for w, g, q, qd, _ in again} == {Status.OK}


@pytest.mark.parametrize(
    ("which", "found"),
    [
        (0, Status.GYRO_WRONG),  # gravity turns
        (1, Status.GRAVITY_WRONG),  # the gyro tells of a turn
        (2, Status.JOINTS_MIXED_UP),  # the targets move
        (3, Status.JOINT_SPEEDS_WRONG),  # the joints move
        (None, Status.OK),
    ],
)
def test_a_sense_that_says_the_same_while_another_tells_of_motion_is_frozen(legs, which, found):
    senses = list(motion())
    if which is not None:
        senses[which] = np.broadcast_to(senses[which][0], senses[which].shape)
    checks = CrossChecks(PERIOD, J, legs)
    for k in range(FROZEN_STEPS + 1):
        assert checks._judge_frozen() == Status.OK
        checks.compare(*(x[k] for x in senses))
    assert checks._judge_frozen() == found
