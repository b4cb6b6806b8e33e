"""The policy in C says what the policy in numpy says, step by step and flag by flag."""

import dataclasses
import functools
import re
import subprocess

import numpy as np
import pytest
from c_policy import (
    STRICT,
    Both,
    Calls,
    assert_equal,
    build,
    compiler,
    leave_out_cross_checks,
    write,
)
from robot_faults import Robot, ground
from tiny_policy import SMALL, J, contents, metres, policy, recorded

from cref_jax import deploy
from cref_jax.deploy import Status
from cref_jax.errors import ConfigError
from cref_jax.policy import c_files, sources
from cref_jax.runtime.status import STOPPING, WHY

PERIOD = 0.02
OVERLAPPING = dataclasses.replace(SMALL, convolutions=((4, 6, 4), (8, 5, 2)), actor=(9,))


def tiny(variant="full", net=SMALL, **guards):
    """Return manifest and weights of a small random policy."""
    manifest, arrays = contents(policy(variant, net))
    manifest["guards"].update(guards)
    return manifest, arrays


@pytest.fixture(scope="module")
def programs(tmp_path_factory):
    """Return a function that compiles a policy, once."""
    folder = tmp_path_factory.mktemp("c")

    @functools.cache
    def program(name):
        bundled = name in ("combined", "mixed", "robust")
        made = {"overlapping": lambda: tiny("full", OVERLAPPING)}.get(name, lambda: tiny(name))
        source = deploy.contents(sources.bundled_policy(name)) if bundled else made()
        return build(write(*source, folder / name))

    return program


@pytest.mark.slow
@pytest.mark.parametrize("name", ["combined", "mixed", "robust"])
def test_a_bundled_policy_says_in_c_what_it_said_in_training(name, programs, monkeypatch):
    path = sources.bundled_policy(name)
    vectors, calls = np.load(path / "testvectors.npz"), Calls(J)
    leave_out_cross_checks(monkeypatch)
    both, expected, steps = Both(*deploy.contents(path), calls, at_once=True), [], []
    for t, reset in enumerate(vectors["reset"]):
        if reset and t:
            both.reset()
        for k in np.flatnonzero(vectors["frame_step"] == t):
            expected.append(both.on_depth(vectors["frames"][k], float(vectors["stamps"][k])))
        inputs = (vectors[k][t] for k in (*deploy.TERMS[:3], "q", "qd"))
        now = float(vectors["now"][t])
        steps.append(both.step(*inputs, now=now, commanded=now))
        expected.append(steps[-1])
    answers = [answer for answer in calls.answer(programs(name)) if answer is not None]
    assert_equal(answers, expected)
    said = [answer for answer in answers if isinstance(answer, tuple)]
    of_training = zip(vectors["expect/target"], vectors["expect/velocity"], strict=True)
    assert_equal(said, [(step[0], *x) for step, x in zip(steps, of_training, strict=True)])


@pytest.mark.parametrize("variant", c_files.VARIANTS)
def test_every_variant_of_the_network_says_in_c_what_it_says_in_numpy(
    variant, programs, monkeypatch
):
    leave_out_cross_checks(monkeypatch)
    assert_says_the_same(tiny(variant), programs(variant))


def test_a_network_that_c_does_not_have_is_refused_in_one_line():
    with pytest.raises(
        ConfigError, match=r"C has the networks full, .*, blind, not hpl; use numpy"
    ):
        c_files.write_c(*tiny("hpl"))


def test_filters_that_overlap_are_padded_as_in_numpy(programs, monkeypatch):
    leave_out_cross_checks(monkeypatch)
    assert_says_the_same(tiny("full", OVERLAPPING), programs("overlapping"))


def assert_says_the_same(source, program):
    """Give both 300 steps of random inputs, with resets and frames."""
    calls, expected = Calls(J), []
    both = Both(*source, calls, at_once=True)
    steps = recorded(300, sees=not both.blind)
    for t in range(300):
        if steps.reset[t]:
            both.reset()
        if steps.fresh[t]:
            expected.append(both.on_depth(metres(steps.image[t]), t * PERIOD))
        now = t * PERIOD
        expected.append(both.step(*(x[t] for x in steps[:5]), now=now, commanded=now))
    assert not any(step[0] & deploy.FAULTS for step in expected if isinstance(step, tuple))
    answers = [answer for answer in calls.answer(program) if answer is not None]
    assert_equal(answers, expected)
    assert np.std([step[1] for step in expected if isinstance(step, tuple)], axis=0).min() > 1e-3


def live(both: Both, robot: Robot, expected: list, rng) -> None:
    """Let a step of a robot's life pass, with all that can go wrong in it."""
    robot.pass_time()
    if rng.random() < (0.1 if both.damping else 0.006):
        both.reset()
        robot.stand_up()
    if rng.random() < 0.002:
        both.stop()
    frame = robot.see()
    if frame and not both.blind:
        expected.append(both.on_depth(*frame))
    inputs, now, commanded = robot.measure()
    step = both.step(*inputs, now=now, commanded=commanded)
    expected.append(step)
    robot.q += np.float32(0.3) * (np.clip(step[1], -2.0, 2.0) - robot.q)
    expected.append(both.on_both_feet())


def compare_lives(source, program, seeds, steps, near=False) -> int:
    """Let robots live side by side, in numpy and in C; return all flags that were seen."""
    calls, expected = Calls(J), []
    pairs = []
    for which, seed in enumerate(seeds):
        both = Both(*source, calls, which, near=near)
        pairs.append((both, Robot(both.joints, seed), np.random.default_rng(seed)))
    for _ in range(steps):
        for both, robot, rng in pairs:
            live(both, robot, expected, rng)
    answers = [answer for answer in calls.answer(program) if answer is not None]
    # such noise lets rounding grow, in C no more than in numpy
    within = 1e-5 + 3.0 * max(both.sensitivity for both, _, _ in pairs)
    assert_equal(answers, expected, within)
    seen = [step[0] if isinstance(step, tuple) else step for step in expected]
    return int(np.bitwise_or.reduce([flags for flags in seen if not isinstance(flags, bool)]))


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["full", "blind"])
def test_two_robots_side_by_side_with_every_fault_get_the_same_flags_and_targets(
    variant, tmp_path, monkeypatch
):
    leave_out_cross_checks(monkeypatch)
    source = tiny(variant, rate_rad=[0.3] * J, beyond_rad=[0.0] * J)
    for joint in source[0]["joints"]:
        joint["action_scale_rad"] = 10.0  # the targets reach every limit
    source[0]["action"]["clip"] = 0.1
    program = build(write(*source, tmp_path))
    seen = compare_lives(source, program, (1, 2), 1000) | compare_lives(
        source, program, (5, 6), 1000
    )
    never = STOPPING | Status.BAD_ACTION | (of_frames() if variant == "blind" else Status.OK)
    assert Status(seen) == ~(never | Status.OK) & Status(sum(WHY))


def of_frames() -> Status:
    """Return the flags of a policy that takes frames."""
    return Status(sum(flag for flag in Status if re.search("DEPTH|SEES|CAMERA", str(flag.name))))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["combined", "mixed", "robust"])
def test_a_bundled_policy_bears_faults_in_c_as_in_numpy(name, programs, monkeypatch):
    leave_out_cross_checks(monkeypatch)
    source = deploy.contents(sources.bundled_policy(name))
    compare_lives(source, programs(name), seeds=(3, 4), steps=500, near=True)


def test_an_action_that_is_not_finite_is_a_fault(tmp_path, monkeypatch):
    leave_out_cross_checks(monkeypatch)
    manifest, arrays = tiny()
    arrays = {k: np.array(x) for k, x in arrays.items()}
    arrays["action_head/layer_2/bias"][:] = 3e38
    arrays["action_head/layer_2/kernel"][:] = 3e38
    arrays["action_head/layer_1/bias"][:] = 10.0
    calls = Calls(J)
    both = Both(manifest, arrays, calls, at_once=True)
    robot = Robot(both.joints, 0)
    expected, poses = [], []
    for k in range(8):
        inputs, _, _ = robot.measure()
        poses.append(inputs[3])
        expected.append(both.step(*inputs, now=k * PERIOD, commanded=k * PERIOD))
    answers = calls.answer(build(write(manifest, arrays, tmp_path)))
    assert_equal(answers[2:], expected)
    assert expected[0][0] & Status.BAD_ACTION and expected[7][0] & Status.DAMPING
    np.testing.assert_array_equal(expected[0][1], poses[0])  # the joints are held where they are


def test_begun_at_once_without_a_usable_input_it_holds_the_default_pose(programs, monkeypatch):
    leave_out_cross_checks(monkeypatch)
    calls, nothing = Calls(J), np.full(3, np.nan)
    both = Both(*tiny("blind"), calls, at_once=True)
    unknown = np.full(J, np.nan)
    expected = [both.step(*[nothing] * 3, unknown, unknown, now=0.0, commanded=0.0)]
    np.testing.assert_array_equal(expected[0][1], both.joints.default)
    assert_equal(calls.answer(programs("blind"))[2:], expected)


def test_a_frozen_camera_is_noticed_by_its_joints_though_its_frames_have_holes(
    programs, monkeypatch
):
    leave_out_cross_checks(monkeypatch)
    calls, expected, frame = Calls(J), [], ground()
    both, still = Both(*tiny(), calls), np.zeros(3, np.float32)
    frame[20:24, 30:40] = np.nan
    for k in range(8):
        q = both.joints.default + np.float32(0.02 * k)  # more than 0.05 rad away from the fourth on
        now = k * PERIOD
        expected.append(both.on_depth(frame, now))
        inputs = (still, np.float32([0.0, 0.0, -1.0]), still, q, np.zeros(J, np.float32))
        expected.append(both.step(*inputs, now=now, commanded=now))
    # a frame comes before the step's joints: those of the fourth step count for the fifth frame
    assert expected[::2] == [Status.OK] * 4 + [Status.FROZEN_DEPTH] * 4
    assert_equal(calls.answer(programs("full"))[1:], expected)


@pytest.mark.parametrize(
    ("turned", "angle", "flag"),
    [
        ((0, 6), 0.15, Status.NOT_ON_FEET),  # both hips by more than gravity may lean, 0.08
        ((0, 6), 0.30, Status.OK),  # beyond 0.23 the robot moves by itself
        ((0,), 0.15, Status.OK),  # soles more than 0.08 apart do not both stand
    ],
)
def test_legs_that_turn_without_gravity_are_noticed_where_both_feet_stand(
    turned, angle, flag, programs, monkeypatch
):
    leave_out_cross_checks(monkeypatch)
    calls, expected = Calls(J), []
    both = Both(*tiny("blind"), calls)
    upright, still = np.float32([0.0, 0.0, -1.0]), np.zeros(3, np.float32)
    for k in range(10):
        q = both.joints.default.copy()
        q[list(turned)] += np.float32(angle) * (k >= 5)
        now = k * PERIOD
        inputs = (still, upright, still, q, np.zeros(J, np.float32))
        expected.append(both.step(*inputs, now=now, commanded=now))
    assert [Status(step[0]) & Status.NOT_ON_FEET for step in expected] == [Status.OK] * 9 + [flag]
    assert_equal(calls.answer(programs("blind"))[1:], expected)


def halves() -> np.ndarray:
    """Return every float16, what is between two of them, and the float32 on both sides."""
    every = np.arange(0x7C01, dtype=np.uint16).view(np.float16).astype(np.float32)
    every[-1] = 65536.0  # the next one, if there were one
    middle = 0.5 * (every[1:] + every[:-1])
    points = np.concatenate([every, middle])
    around = [points, np.nextafter(points, np.float32(np.inf)), np.nextafter(points, -points)]
    bits = np.random.default_rng(0).integers(0, 1 << 32, 20_000, np.uint32)
    numbers = np.concatenate([*around, bits.view(np.float32)])
    return np.concatenate([numbers, -numbers, np.float32([np.inf, np.nan, 1e-45, 65519.9, 3e38])])


def test_float16_is_rounded_as_by_numpy_ties_subnormals_and_overflow_included(programs):
    calls, numbers = Calls(J), halves()
    calls.add("round_to_half", len(numbers), numbers)
    found = calls.answer(programs("full"))[0]
    with np.errstate(over="ignore", invalid="ignore"):
        right = numbers.astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(found, right)
    np.testing.assert_array_equal(np.signbit(found), np.signbit(right))
    assert np.isinf(found).sum() > 100 and (np.abs(found) < 6e-5).sum() > 2000


def test_every_flag_has_the_runtimes_name_number_and_words(programs, tmp_path):
    calls = Calls(J)
    for flag in (0, *WHY, 1 << 31, Status.LATE | Status.STALE_DEPTH):
        calls.add("text", int(flag))
    fine, *words, none, of_two = calls.answer(programs("full"))
    assert fine == "all is right" and none == "no such status"
    assert of_two.startswith("STALE_DEPTH: ")
    for (flag, why), said in zip(WHY.items(), words, strict=True):
        assert said == f"{flag.name}: {why.partition(' (load(')[0]}"
    header = (write(*tiny(), tmp_path) / "cref_policy.h").read_text()
    numbers = re.findall(r"CREF_(\w+) = 1 << (\d+),", header)
    assert {name: 1 << int(bit) for name, bit in numbers} == {f.name: int(f) for f in WHY}


def test_the_header_names_the_joints_in_order_and_what_is_not_checked(tmp_path):
    manifest, arrays = tiny()
    header = (write(manifest, arrays, tmp_path) / "cref_policy.h").read_text()
    listed = re.findall(r"^ +(\d+) (\w+_joint)", header, re.MULTILINE)
    assert listed == [(str(j), joint["name"]) for j, joint in enumerate(manifest["joints"])]
    assert "does not compare the senses with each other" in header[: header.index("*/")]


CALLER = """
#include "cref_policy.h"
int main() {
    static cref_policy policy;
    float vector[3] = {0.0f, 0.0f, -1.0f}, q[CREF_JOINTS], target[CREF_JOINTS];
    for (int j = 0; j < CREF_JOINTS; j++)
        q[j] = cref_joints[j].default_pose;
    cref_reset(&policy);
    unsigned status = cref_step(&policy, vector, vector, vector, q, q, 0.0, 0.0, target);
    return status == CREF_NO_DEPTH && target[0] == q[0] ? 0 : 1;
}
"""


@pytest.mark.parametrize("language", ["c", "c++"])
def test_a_robots_program_in_c_or_c_plus_plus_compiles_and_links_with_it(language, tmp_path):
    folder = write(*tiny(), tmp_path)
    (folder / "caller.txt").write_text(CALLER)
    standard = STRICT[0] if language == "c" else "-std=c++11"
    flags = (*STRICT[1:], f"-I{folder}", "-o")
    compile_c = [compiler("gcc", "cc"), "-c", str(folder / "cref_policy.c"), STRICT[0], *flags]
    subprocess.run([*compile_c, str(folder / "policy.o")], check=True)
    other = compiler("gcc", "cc") if language == "c" else compiler("g++", "c++")
    source = ["-x", language, standard, str(folder / "caller.txt"), "-x", "none"]
    subprocess.run(
        [other, *source, str(folder / "policy.o"), *flags, str(folder / "caller"), "-lm"],
        check=True,
    )
    assert subprocess.run([str(folder / "caller")], check=False).returncode == 0


def test_arithmetic_that_forgets_nan_does_not_compile(tmp_path):
    folder = write(*tiny("blind"), tmp_path)
    command = [compiler("gcc", "cc"), "-c", str(folder / "cref_policy.c"), "-o", "/dev/null"]
    done = subprocess.run([*command, "-ffast-math"], capture_output=True, text=True, check=False)
    assert done.returncode and "NaN must be noticed" in done.stderr
