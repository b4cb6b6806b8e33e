"""A recording of a robot that stands: what is odd in it, and what a policy says to it again."""

import subprocess
import sys

import numpy as np
import pytest
from test_deploy_mistakes import ground

from cref_jax import deploy
from cref_jax.deploy import PolicyFormatError, Status
from cref_jax.policy.sources import bundled_policy

POLICY = bundled_policy("robust")


def standing(tmp_path, seconds=6.0, change=lambda name, value, k: value, **options):
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
        ("stamp", lambda t: t - 5.0, "5.02 s old"),
        ("frame", lambda f: f[::-1], "looks down by"),
        ("frame", lambda f: f + 9.0, "0 % of the pixels"),
        ("qd", lambda v: None, "not always numbers: qd"),
    ],
)
def test_what_is_odd_is_named(tmp_path, which, by, words):
    odd = deploy.check(POLICY, standing(tmp_path, change=one(which, by)))
    assert any(words in line for line in odd), odd


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
    missing = ask("--check", "nothing.npz", str(POLICY))
    assert missing.returncode == 2 and missing.stderr.startswith("error: nothing.npz: no recording")
