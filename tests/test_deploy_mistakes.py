"""Mistakes of a robot's program: each has a status of its own, and words."""

import numpy as np
import pytest
from test_deploy import PERIOD, frame, runtime, still
from tiny_policy import ROBOT, J, contents, policy

from cref_jax import deploy
from cref_jax.config import folders
from cref_jax.deploy import Status
from cref_jax.runtime.senses import TILTS
from cref_jax.runtime.status import WHY

POLICIES = [folders.data_folder("policies") / name for name in ("combined", "mixed", "robust")]


def ground(height=0.95, pitch=50.0):
    """Return level ground as the camera of a standing robot sees it, m."""
    down = np.tan(np.radians(29.0)) * ((2 * np.arange(48) + 1) / 48 - 1)
    falls = np.sin(np.radians(pitch)) + down * np.cos(np.radians(pitch))
    return np.broadcast_to((height / falls)[:, None], (48, 64)).astype(np.float32)


def said(robot, **changes) -> Status:
    robot.step(*still(**changes))
    return robot.status & ~(Status.NO_DEPTH | Status.HOLDING | Status.DAMPING | Status.NOT_STARTED)


@pytest.mark.parametrize(
    ("changes", "flag", "words"),
    [
        ({"gravity": [0.0, 0.0, 1.0]}, Status.GRAVITY_TURNED, "accelerometer at rest"),
        ({"gravity": [0.0, -1.0, 0.0]}, Status.GRAVITY_TURNED, "axis or frame"),
        ({"gravity": [-1.0, 0.0, 0.0]}, Status.GRAVITY_TURNED, "axis or frame"),
        ({"angular_velocity": np.rad2deg([0.0, 0.5, 0.1])}, Status.GYRO_TOO_FAST, "deg/s"),
        ({"qd": np.rad2deg(np.full(12, 1.0))}, Status.JOINTS_TOO_FAST, "deg/s"),
        ({"gravity": [0.0, 0.0, -9.81]}, Status.BAD_INPUT, "length is 9.81"),
        ({"q": np.rad2deg(ROBOT.nominal_pose)}, Status.BAD_INPUT, "left_hip_pitch_joint: degrees"),
        ({"qd": np.zeros(11), "command": None}, Status.BAD_INPUT, "command, qd: not as many"),
        ({"now": "noon"}, Status.BAD_INPUT, "must be times in s"),
    ],
)
def test_an_input_of_another_unit_sign_or_axis_is_named(changes, flag, words):
    robot = runtime()
    robot.step(*still())
    assert said(robot, **changes) & ~Status.LATE == flag
    mended = Status.GYRO_TOO_FAST | Status.JOINTS_TOO_FAST
    assert robot.status & (mended | Status.HOLDING) and words in robot.why
    assert said(robot, now=PERIOD) == Status.OK  # and forgotten when it is right


def test_a_speed_that_is_done_without_is_that_of_this_step_alone():
    robot, told = runtime(), runtime()
    for k in range(100):
        q = ROBOT.nominal_pose + np.float32(0.001 * k)  # rad in 0.02 s: 0.05 rad/s
        too_fast = k in (20, 99)
        ours = robot.step(*still(q=q, qd=np.full(J, 60.0 if too_fast else 0.0), now=k * PERIOD))
        theirs = told.step(*still(q=q, qd=np.full(J, 0.05 * too_fast), now=k * PERIOD))
        assert bool(robot.status & Status.JOINTS_TOO_FAST) == too_fast
        np.testing.assert_allclose(ours, theirs, atol=1e-4)


def test_before_a_first_good_input_the_pose_measured_first_is_held():
    robot, first = runtime(), ROBOT.nominal_pose + np.float32(0.02)
    upside_down = {"gravity": [0.0, 0.0, 1.0]}
    for moved in (0.0, 0.1):  # the robot sinks, and is held where it was
        target = robot.step(*still(q=first + np.float32(moved), **upside_down))
        np.testing.assert_array_equal(target, first)
        assert robot.status & Status.NOT_STARTED and "pose measured first" in robot.why
    robot.step(*still())
    assert not robot.status & (Status.NOT_STARTED | Status.DAMPING)


@pytest.mark.parametrize(
    ("wrong", "flag", "words"),
    [
        (lambda g: (g * 1e4).astype(np.uint16), Status.SEES_NOTHING, "depth_scale=1e-4"),
        (lambda g: (g * 4e3).astype(np.uint16), Status.SEES_NOTHING, "raw unit is smaller"),
        (lambda g: 1e3 * g, Status.SEES_NOTHING, "raw unit is smaller"),
        (lambda g: g + 9.0, Status.SEES_NOTHING, "covered or looks away"),
        (lambda g: 1e-3 * g, Status.SEES_TOO_NEAR, "unit is larger"),
        (lambda g: np.full_like(g, 0.1), Status.SEES_TOO_NEAR, "covers the camera"),
        (lambda g: g[::-1], Status.CAMERA_TURNED, "upside down"),
        (lambda g: g[::-1, ::-1], Status.CAMERA_TURNED, "upside down"),
        (lambda g: g[..., None], Status.BAD_DEPTH, "48 x 64, rows x columns, not (48, 64, 1)"),
        (lambda g: g.T, Status.BAD_DEPTH, "48 x 64, rows x columns, not (64, 48)"),
        (lambda g: g.astype(np.int16), Status.BAD_DEPTH, "times depth_scale, not int16"),
        (lambda g: 0.0 * g, Status.INVALID_DEPTH, "0 or NaN"),
    ],
)
def test_a_camera_that_shows_no_ground_ahead_is_named_and_not_used(wrong, flag, words):
    robot = runtime()
    robot.on_depth(frame(), 0.0)  # of a wall: the camera may still be turned
    robot.step(*still())
    before = robot.tensors()["tokens"]
    assert robot.on_depth(wrong(ground()), PERIOD) == flag
    robot.step(*still(now=PERIOD))
    assert robot.status == flag and words in robot.why
    np.testing.assert_array_equal(robot.tensors()["tokens"], before)
    assert robot.on_depth(ground(), 2 * PERIOD) == Status.OK
    robot.step(*still(now=2 * PERIOD))
    assert robot.status == Status.OK and robot.why == ""


def test_what_hangs_before_a_camera_that_is_the_right_way_up_is_seen():
    robot = runtime()
    assert robot.on_depth(ground(), 0.0) == Status.OK
    assert robot.on_depth(ground()[::-1], 0.05) == Status.OK


@pytest.mark.parametrize(
    ("hole", "unit", "kind"), [(1.5, 1.0, "f4"), (np.nan, 1.0, "f4"), (0.0, 1e3, "u2")]
)
def test_the_same_frame_again_and_again_is_a_frozen_camera(hole, unit, kind):
    robot, rng = runtime(), np.random.default_rng(0)
    for k in range(30):
        noisy = ground() + rng.normal(0.0, 1e-3, (48, 64)).astype(np.float32)
        noisy[20:24, 30:40] = hole
        noisy = (unit * noisy).astype(kind)
        assert robot.on_depth(noisy, 0.05 * k) == Status.OK
    assert {robot.on_depth(noisy, 2.0 + 0.05 * k) for k in range(12)} == {Status.OK}  # it stands
    robot.step(*still(q=ROBOT.nominal_pose + np.float32(0.06)))
    assert {robot.on_depth(noisy, 2.0 + 0.05 * k) for k in range(12)} == {Status.FROZEN_DEPTH}
    robot.step(*still(now=3.0))
    assert robot.status & ~Status.LATE == Status.STALE_DEPTH | Status.FROZEN_DEPTH
    assert "same frame again" in robot.why


def test_raw_values_have_the_unit_that_load_is_told():
    policy_folder = POLICIES[0]
    thin, usual = deploy.load(policy_folder, depth_scale=1e-4), deploy.load(policy_folder)
    raw = np.round(ground() * 1e4)
    assert thin.on_depth(raw.astype(np.uint16), 0.0) == Status.OK
    assert usual.on_depth((raw / 1e4).astype(np.float32), 0.0) == Status.OK
    for robot in (thin, usual):
        for k in range(15):  # until it has begun
            robot.step(*still(now=k * PERIOD))
    np.testing.assert_allclose(thin.tensors()["tokens"], usual.tensors()["tokens"], atol=1e-5)
    for bad in (0.0, float("nan"), 1000.0):
        with pytest.raises(deploy.PolicyFormatError, match="depth_scale must be 1e-6 to 1 m"):
            deploy.load(policy_folder, depth_scale=bad)


def test_every_status_has_words():
    single = [flag for flag in Status if flag]
    assert set(WHY) == set(single)
    assert deploy.Policy(*contents(policy("full"))).why == ""


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.name)
def test_the_policys_own_vectors_raise_no_alarm(path):
    robot, vectors = deploy.load(path), np.load(path / "testvectors.npz")
    inputs = ("angular_velocity", "gravity", "command", "q", "qd", "now")
    alarms, begin = Status.OK, 0
    for t in range(len(vectors["now"])):
        if vectors["reset"][t]:
            robot.reset()
            begin = t
        for k in np.flatnonzero(vectors["frame_step"] == t):
            alarms |= robot.on_depth(vectors["frames"][k], vectors["stamps"][k])
        robot.step(*(vectors[name][t] for name in inputs))
        # An episode's robot leans by 7 degrees at first and rocks on its soles, which is refused
        # before the start as soon as there are samples enough.
        rocks = Status.NOT_ON_FEET | Status.NOT_STARTED if t - begin >= 2 * TILTS - 1 else Status.OK
        alarms |= robot.status & ~rocks
    assert alarms & ~(Status.NO_DEPTH | Status.RATE_LIMITED | Status.RANGE_LIMITED) == Status.OK


def test_without_a_usable_frame_for_long_it_is_told_to_stand():
    robot, told = runtime(), runtime()
    for k in range(60):
        now, late = k * PERIOD, k >= 15  # the 16th step without a frame: more than 0.3 s
        ours = robot.step(*still(now=now))
        theirs = told.step(*still(now=now, **({"command": np.zeros(3)} if late else {})))
        np.testing.assert_array_equal(ours, theirs)
        assert bool(robot.status & Status.STOPPED) == late
    robot.on_depth(ground(), 60 * PERIOD)
    robot.step(*still(now=60 * PERIOD))
    assert robot.status == Status.OK  # and walks on
    for k in range(61, 62 + 40):  # frames stop again: 0.1 s until one is old, and 0.3 s
        robot.step(*still(now=k * PERIOD))
        assert bool(robot.status & Status.STOPPED) == (k > 60 + 5 + 15)


def test_a_command_that_is_old_is_taken_as_zero():
    robot, told = runtime(), runtime()
    for k in range(30):
        ours = robot.step(*still(now=k * PERIOD), 0.1)  # the operator's link is lost
        old = k > 5 + 15
        theirs = told.step(*still(now=k * PERIOD, **({"command": np.zeros(3)} if old else {})))
        if not robot.status & Status.STALE_COMMAND:
            assert k <= 5 + 15
        np.testing.assert_array_equal(ours, theirs)
    assert robot.status & Status.STOPPED and "command is too old" in robot.why


def test_told_to_stop_it_stands_until_the_reset():
    robot, told = runtime(), runtime()
    robot.stop()
    np.testing.assert_array_equal(robot.step(*still()), told.step(*still(command=np.zeros(3))))
    assert robot.status & Status.STOPPED and robot.on_both_feet()
    robot.step(*still(qd=np.full(J, 2.0), now=PERIOD))
    assert not robot.on_both_feet()  # it still moves
    robot.reset()
    robot.step(*still())
    assert not robot.status & Status.STOPPED


def test_a_clock_in_milliseconds_is_late_at_every_step():
    robot = runtime()
    robot.step(*still())
    for k in range(5):
        assert said(robot, now=20.0 * (k + 1)) & Status.LATE
        assert "not in seconds" in robot.why
    for k in range(5, 30):  # and no frame is new enough on it: the robot stands
        robot.on_depth(ground(), 20.0 * k)
        robot.step(*still(now=20.0 * (k + 1)))
    assert robot.status & Status.STOPPED


def careful(variant="full", **options):
    return deploy.Policy(*contents(policy(variant)), **options)


def noisy_still(rng, now, **changes):
    """Return inputs of a standing robot with a little noise, without which a sensor is dead."""
    q = ROBOT.nominal_pose + rng.normal(0.0, 1e-3, J)
    return still(q=q, now=now, **changes)


def test_it_does_not_start_before_a_frame():
    robot, rng = careful(), np.random.default_rng(0)
    first = noisy_still(rng, 0.0)
    for k in range(30):
        target = robot.step(*first[:-1], k * PERIOD)
        np.testing.assert_allclose(target, first[3], atol=1e-6)
        assert robot.status & Status.NO_DEPTH
    for k in range(30, 41):
        robot.on_depth(ground() + rng.normal(0.0, 1e-3, (48, 64)), k * PERIOD)
        target = robot.step(*noisy_still(rng, k * PERIOD))
        assert robot.status & ~Status.STOPPED == Status.OK
    assert np.abs(target - first[3]).max() > 0.01  # after 0.2 s, by the network


def test_no_start_comes_before_the_hips_have_swung():
    soon, usual, rng = (
        careful("blind", start_after=0.04),
        careful("blind"),
        np.random.default_rng(0),
    )
    for k in range(15):  # the swing takes 0.16 s and two steps: 0.2 s in all, as long as usual
        inputs = noisy_still(rng, k * PERIOD)
        np.testing.assert_array_equal(soon.step(*inputs), usual.step(*inputs))
        assert soon.status == usual.status == Status.OK


@pytest.mark.parametrize("joint", [3, 4])
def test_a_robot_whose_feet_are_not_level_does_not_start(joint):
    robot, rng = careful("blind"), np.random.default_rng(0)
    turned = np.where(np.arange(J) == joint, -1.0, 1.0)  # the sign of a knee or an ankle
    q = np.maximum(ROBOT.nominal_pose * turned, ROBOT.range_low)
    for k in range(30):
        robot.step(*still(q=q + rng.normal(0.0, 1e-3, J), now=k * PERIOD))
        assert robot.status & Status.NOT_STARTED and robot.status & Status.NOT_ON_FEET
    assert "stand the robot on both feet" in robot.why
    robot.reset()
    for k in range(30, 45):
        robot.step(*noisy_still(rng, k * PERIOD))
        assert robot.status == Status.OK


def test_from_a_pose_far_away_it_moves_slowly_to_the_default_one():
    robot, rng = careful("blind"), np.random.default_rng(0)
    deep = ROBOT.nominal_pose.copy()
    for side in (0, 6):  # a squat with level feet: hip and ankle take back what the knee bends
        deep[side : side + 5] += np.array([-0.5, 0.0, 0.0, 1.0, -0.5], np.float32)
    q, targets = deep, []
    for k in range(200):
        target = robot.step(*still(q=q + rng.normal(0.0, 1e-3, J), now=k * PERIOD))
        if robot.status & Status.STARTING:
            q = target
            targets.append(q)
    moved = np.abs(np.diff(targets, axis=0)).max()
    assert 0.009 < moved < 0.0101  # 0.5 rad/s
    np.testing.assert_allclose(targets[-1], ROBOT.nominal_pose, atol=0.02)


def test_a_mirrored_camera_is_found_by_the_tilt_of_the_ground():
    def look(mirrored):
        robot, across = careful(), np.linspace(-1.0, 1.0, 64)
        seen = Status.OK
        for k in range(60):
            roll = 0.05 * np.sin(0.5 * k)
            gravity = [0.0, np.sin(roll), -np.cos(roll)]  # to the left: the left is nearer
            tilted = 1.0 / (1.0 / ground() - 0.3 * np.sin(roll) * across)
            robot.step(*still(gravity=gravity, now=k * 0.05))
            seen |= robot.on_depth(tilted[:, ::-1] if mirrored else tilted, k * 0.05)
        return seen

    assert look(mirrored=False) == Status.OK
    assert look(mirrored=True) == Status.CAMERA_MIRRORED


def test_what_is_recorded_can_be_read_again(tmp_path):
    robot = careful()
    for k in range(1600):  # 32 s
        if k % 10 == 0:
            robot.on_depth(ground(), k * PERIOD)
        robot.step(*still(now=k * PERIOD))
    robot.step(None, "x", object(), [1.0], np.zeros((3, 3)), "noon")
    robot.on_depth("no frame", None)
    robot.recorder.write(tmp_path / "last.npz")
    kept = np.load(tmp_path / "last.npz")
    assert kept["now"].shape == (1500,) and kept["lost"] == 101
    assert kept["now"][0] == pytest.approx(101 * PERIOD) and np.isnan(kept["now"][-1])
    assert kept["q"].shape == (1500, J) and kept["frames"].shape[1:] == (48, 64)
    assert kept["status"][-1] & Status.BAD_INPUT
