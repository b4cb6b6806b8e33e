"""A recording of a robot that stands: what is odd in it, and what a policy says to it again."""

import os
import subprocess
import sys

import numpy as np
import pytest
from test_deploy_mistakes import ground

from cref_jax import deploy
from cref_jax.deploy import PolicyFormatError, Status
from cref_jax.policy.sources import bundled_policy

POLICY = bundled_policy("robust")


def standing(tmp_path, seconds=6.0, change=lambda name, value, k: value, stop_at=None, **options):
    """Record a robot that stands before level ground; `change` makes one input wrong."""
    policy, rng = deploy.load(POLICY, **options), np.random.default_rng(0)
    q = policy.joints.default
    for k in range(round(50 * seconds)):
        if k % 5 == 0:
            frame = ground() + rng.normal(0.0, 1e-3, (48, 64)).astype(np.float32)
            policy.on_depth(change("frame", frame, k), change("stamp", 0.02 * k - 0.02, k))
        inputs = {
            "angular_velocity": rng.normal(0.0, 0.01, 3),
            "gravity": np.array([0.0, 0.0, -1.0]) + rng.normal(0.0, 0.002, 3),
            "command": np.zeros(3),
            "q": q + rng.normal(0.0, 1e-3, len(q)),
            "qd": rng.normal(0.0, 0.02, len(q)),
            "now": 0.02 * k,
            "commanded": 0.02 * k,
        }
        if k == stop_at:
            policy.stop()
        policy.step(*(change(name, value, k) for name, value in inputs.items()))
    policy.recorder.write(tmp_path / "standing.npz")
    return tmp_path / "standing.npz"


def one(which, by):
    return lambda name, value, k: by(value) if name == which else value


def test_of_a_robot_that_stands_nothing_is_odd(tmp_path):
    assert deploy.check(POLICY, standing(tmp_path)) == []


@pytest.mark.parametrize(
    ("which", "by", "words"),
    [
        ("gravity", lambda g: g + np.array([0.2, 0.0, 0.0]), "deg from (0, 0, -1)"),
        ("gravity", lambda g: np.array([0.0, 0.0, -1.0]), "gravity never changes"),
        ("angular_velocity", lambda w: w + np.array([0.0, 0.1, 0.0]), "the gyro says"),
        ("q", lambda q: q + 0.3 * (np.arange(12) == 4), "left_ankle_pitch_joint is +0.30 rad"),
        ("q", lambda q: q + 0.15 * (np.arange(12) == 5), "the soles are"),
        ("qd", lambda v: v + 1.0 * (np.arange(12) == 3), "left_knee_joint turns by +1.00"),
        ("now", lambda t: 1.5 * t, "a step every 0.03 s"),
        ("now", lambda t: t + 0.015 * (round(50 * t) % 7 == 0), "ms early or late"),
        ("stamp", lambda t: t - 5.0, "5.02 s old"),
        ("frame", lambda f: f[::-1], "looks down by"),
        ("frame", lambda f: f + 9.0, "0 % of the pixels"),
        ("qd", lambda v: None, "not always numbers: qd"),
        ("q", lambda q: np.arange(31) / 31, "q has the shape (31,) in a step, in place of (12,)"),
        ("gravity", lambda g: np.r_[1.0, 0, 0, 0], "gravity has the shape (4,) in a step, in"),
        ("command", lambda c: np.zeros(2), "300 of 300 steps: an input cannot be used"),
        ("gravity", lambda g: 9.81 * g, "300 of 300 steps: an input cannot be used"),
        ("gravity", lambda g: -g, "300 of 300 steps: gravity must be near (0, 0, -1)"),
    ],
)
def test_what_is_odd_is_named(tmp_path, which, by, words):
    odd = deploy.check(POLICY, standing(tmp_path, change=one(which, by)))
    assert any(words in line for line in odd), odd


@pytest.mark.parametrize("nose_down", [4.0, -4.0])
def test_a_robot_that_leans_forward_looks_down_by_as_much_more(tmp_path, nose_down):
    lean = np.radians(nose_down)  # gravity points to where the robot leans
    by_lean = np.array([np.sin(lean), 0.0, 1.0 - np.cos(lean)])
    changes = {
        "gravity": lambda gravity: gravity + by_lean,
        "frame": lambda frame: frame + ground(pitch=50.0 + nose_down) - ground(),
    }
    change = lambda name, value, k: changes.get(name, lambda same: same)(value)
    assert deploy.check(POLICY, standing(tmp_path, change=change)) == []


def test_a_step_that_was_refused_is_counted(tmp_path):
    glitch = lambda name, value, k: value + 10.0 * (k == 200) if name == "q" else value
    odd = deploy.check(POLICY, standing(tmp_path, change=glitch))
    assert odd[0] == "1 of 300 steps: an input cannot be used"


def walk(name, value, k):
    return np.array([0.4, 0.0, 0.0]) if name == "command" else value


@pytest.mark.parametrize("options", [{"start_after": 2.0}, {"stop_at": 150}, {"careful": False}])
def test_a_replay_loads_and_stops_the_policy_as_it_was(tmp_path, options):
    kept = standing(tmp_path, change=walk, **options)
    assert deploy.replay(POLICY, kept)[1] == 0.0
    with np.load(kept) as file:  # as it was written before these were kept
        left = {name: file[name] for name in {*file} - {"careful", "start_after", "told_to_stop"}}
    np.savez(tmp_path / "old.npz", **left)
    assert deploy.replay(POLICY, tmp_path / "old.npz")[1] > 0.01


def test_whole_numbers_now_and_then_are_kept_beside_fractions(tmp_path):
    command = lambda k: (0, 0, 0) if k < 200 else (0.5, 0.0, 0.0)
    kept = standing(tmp_path, change=lambda name, x, k: command(k) if name == "command" else x)
    np.testing.assert_array_equal(np.load(kept)["command"][:, 0], np.repeat([0.0, 0.5], [200, 100]))
    assert deploy.replay(POLICY, kept)[1] == 0.0


class Stamp:
    def __float__(self):
        raise RuntimeError


def test_a_stamp_that_is_no_number_spoils_no_recording(tmp_path):
    kept = standing(tmp_path, change=one("stamp", lambda t: Stamp() if t > 1.0 else t))
    # every 0.1 s one of 20 ms before: the 11th is of 0.98 s
    np.testing.assert_array_equal(np.isnan(np.load(kept)["stamps"]), np.arange(60) > 10)
    lines, largest = deploy.replay(POLICY, kept)
    assert any("BAD_DEPTH" in line for line in lines) and largest == 0.0


def test_frames_take_no_more_than_64_mib(tmp_path):
    policy = deploy.load(POLICY)
    for k in range(20):  # of 4 MiB
        policy.on_depth(np.zeros((1024, 1024), np.float32), 0.1 * k)
    policy.step(*[np.zeros(3)] * 5, 0.0)
    policy.recorder.write(tmp_path / "large.npz")
    np.testing.assert_allclose(np.load(tmp_path / "large.npz")["stamps"], 0.1 * np.arange(4, 20))


def test_a_recording_knows_the_unit_of_raw_frames(tmp_path):
    raw = one("frame", lambda f: np.round(f * 1e4).astype(np.uint16))
    kept = standing(tmp_path, change=raw, depth_scale=1e-4)
    assert deploy.check(POLICY, kept) == []
    lines, largest = deploy.replay(POLICY, kept)
    assert largest == 0.0 and not any("SEES" in line for line in lines)


def test_a_recording_knows_when_commands_came(tmp_path):
    lines, largest = deploy.replay(POLICY, standing(tmp_path, change=one("commanded", lambda t: 0)))
    assert any("0.32 s  STALE_COMMAND" in line for line in lines) and largest == 0.0


def test_a_short_recording_is_not_enough(tmp_path):
    assert "only 2.0 s" in deploy.check(POLICY, standing(tmp_path, 2.0))[0]


def test_a_replay_says_what_was_said_and_when(tmp_path):
    wrong = lambda name, value, k: -value if name == "gravity" and k >= 100 else value
    lines, largest = deploy.replay(POLICY, standing(tmp_path, change=wrong))
    assert largest == 0.0
    said = [line.split() for line in lines]
    assert ["2.00", "s", "GRAVITY_TURNED:"] in [words[:3] for words in said]
    assert ["2.10", "s", "DAMPING:"] in [words[:3] for words in said]


def test_what_is_no_recording_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no recording")
    with pytest.raises(PolicyFormatError, match="no recording"):
        deploy.replay(POLICY, tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", now=np.zeros(3))
    with pytest.raises(PolicyFormatError, match="no angular_velocity"):
        deploy.check(POLICY, tmp_path / "other.npz")


def test_the_command_line_says_it_with_its_exit_code(tmp_path):
    recording = str(standing(tmp_path))
    ask = lambda *of: subprocess.run(
        [sys.executable, "-m", "cref_jax.deploy", *of], capture_output=True, text=True
    )
    assert ask("--check", recording, str(POLICY)).stdout == "nothing is odd\n"
    done = ask("--replay", recording, str(POLICY))
    assert done.returncode == 0 and Status.NO_DEPTH.name not in done.stdout
    command = [sys.executable, "-m", "cref_jax.deploy", "--replay", recording, str(POLICY)]
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")  # nobody reads
    missing = ask("--check", "nothing.npz", str(POLICY))
    assert missing.returncode == 2 and missing.stderr.startswith("error: nothing.npz: no recording")
