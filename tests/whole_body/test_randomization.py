"""A robot that differs from the nominal one, its sensors' noise, and pushes."""

import dataclasses

import mujoco
import numpy as np
import pytest
from tiny_policy import ROBOT, contents, policy

from cref_jax import config, deploy
from cref_jax.config import Config
from cref_jax.evaluation import protocol
from cref_jax.whole_body.ground import Lane
from cref_jax.whole_body.randomization import Deviation, Perturbation, sample_deviation
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Start, _initial_state, run_trial

C = protocol.randomise(protocol.evaluation_config(Config()))
FLAT = Lane(np.zeros((600, 200), np.float32), np.array([0.0, -2.0], np.float32), 0.02, 11.0)
STANDING = Start(
    np.array([0.7, 0.0, ROBOT.standing_height, 1.0, 0.0, 0.0, 0.0]), ROBOT.nominal_pose, 0.5
)
JOINTS = len(ROBOT.nominal_pose)


@pytest.fixture(scope="module")
def body():
    return WholeBodySim(C, FLAT, ROBOT.joint_names)


def test_every_number_of_a_robot_is_drawn_within_the_range_of_training():
    r, rng = config.Randomisation(), np.random.default_rng(0)
    drawn = [sample_deviation(C, JOINTS, rng) for _ in range(300)]
    every = lambda name: np.array([getattr(d, name) for d in drawn])
    for name, low, high in [
        ("friction", *r.friction),
        ("payload", -r.trunk_mass, r.trunk_mass),
        ("com_shift", -r.trunk_com, r.trunk_com),
        ("kp", *r.gains),
        ("kd", *r.gains),
        ("offset", -r.joint_offset, r.joint_offset),
        ("camera_pitch", -np.deg2rad(r.camera_pitch), np.deg2rad(r.camera_pitch)),
        ("camera_shift", -r.camera_position, r.camera_position),
    ]:
        values, width = every(name), high - low
        assert low <= values.min() < low + 0.05 * width
        assert high - 0.05 * width < values.max() <= high
    assert set(every("delay")) == {0, 1, 2, 3, 4}  # 20 ms of substeps of 5 ms


def test_a_deviation_changes_the_numbers_it_names_and_not_the_robot_it_came_from(body):
    before, trunk = body.model.body_mass.copy(), body.robot.trunk
    other = body.deviate(Deviation(friction=0.4, payload=2.0, kp=1.5, kd=0.5)).model
    assert set(other.geom_friction[:, 0]) == {0.4}
    assert other.body_mass[trunk] == pytest.approx(before[trunk] + 2.0)
    knee = list(ROBOT.joint_names).index("left_knee_joint")
    motor = body.driven[knee]
    assert other.actuator_gainprm[motor, 0] == pytest.approx(1.5 * ROBOT.kp[knee])
    assert other.actuator_biasprm[motor, 1] == pytest.approx(-1.5 * ROBOT.kp[knee])
    assert other.actuator_biasprm[motor, 2] == pytest.approx(-0.5 * ROBOT.kd[knee])
    np.testing.assert_array_equal(body.model.body_mass, before)


def test_late_targets_reach_the_motors_after_so_many_substeps(body):
    seen, zero, one = [], np.zeros(JOINTS), np.ones(JOINTS)
    for delay in (0, 1, 4):
        late = body.deviate(Deviation(delay=delay, offset=0.25))
        state, at = _initial_state(late, STANDING), []

        def note(model, data, at=at):
            at.append(data.ctrl[body.driven[0]])

        mujoco.set_mjcb_passive(note)
        try:
            late.advance(state, (zero, one))
        finally:
            mujoco.set_mjcb_passive(None)
        seen.append(at[: C.physics.substeps])
    # an encoder that reads 0.25 too much stops the motor 0.25 short of its target
    assert seen == [[0.75] * 4, [-0.25] + [0.75] * 3, [-0.25] * 4]


def test_a_pitched_camera_sees_nearer_ground(body):
    state = _initial_state(body, STANDING)
    level = body.image(state)
    pitched = body.deviate(Deviation(camera_pitch=0.03)).image(state)
    raised = body.deviate(Deviation(camera_shift=np.array([0.0, 0.0, 0.01]))).image(state)
    seen = np.isfinite(level) & (level < C.camera.d_max)
    assert np.mean(pitched[seen] < level[seen]) > 0.9
    assert np.mean(raised[seen] > level[seen]) > 0.9


def test_noise_is_within_its_widths_and_adds_nothing_on_average():
    clean = [np.zeros(3), np.zeros(3), np.zeros(JOINTS), np.zeros(JOINTS)]
    perturbation = Perturbation(C, np.random.default_rng(0))
    drawn = [perturbation.measure(*clean) for _ in range(400)]
    for k, width in enumerate((0.2, 0.05, 0.01, 1.5)):
        values = np.stack([d[k] for d in drawn])
        assert 0.95 * width < np.abs(values).max() <= width
        assert abs(values.mean()) < 0.1 * width


def test_pushes_come_in_their_time_and_take_from_a_held_hand_half_a_push(body):
    state, perturbation = _initial_state(body, STANDING), Perturbation(C, np.random.default_rng(3))
    kicks, impulse, pulls, last = [], 0.0, [], np.zeros(2)
    for t in range(20000):  # 400 s
        perturbation.push(state, 50.0, body.hands)
        kick = state.qvel[:2] - last
        if np.any(kick):
            kicks.append((t, kick))
        force = state.xfrc_applied[body.hands, :3].sum(axis=0)
        impulse = impulse + force * 0.02 if np.any(force) else impulse
        if not np.any(force) and np.any(impulse):
            pulls.append((t, impulse))
            impulse = 0.0
        last = state.qvel[:2].copy()
    assert len(kicks) > 10 and len(pulls) > 10
    assert 400 / 10.0 <= len(kicks) + len(pulls) <= 400 / 5.0
    assert 0.8 < max(np.abs(kick).max() for _, kick in kicks) <= 1.0
    assert 20.0 < max(np.abs(pull).max() for _, pull in pulls) <= 25.0  # N s: half of 50 kg m/s


def test_a_randomised_trial_is_the_same_twice_and_not_the_nominal_one(body):
    def run(seed):
        rng = np.random.default_rng(seed)
        robot = body.deviate(sample_deviation(C, JOINTS, rng))
        runtime = deploy.Policy(*contents(policy("full")))
        return run_trial(robot, runtime, STANDING, 0.4, perturbation=Perturbation(C, rng)).qpos

    np.testing.assert_array_equal(run(1), run(1))
    assert np.abs(run(1)[-1] - run(2)[-1]).max() > 1e-4
    quiet = dataclasses.replace(C, randomisation=config.Randomisation(
        noise_angular_velocity=0.0, noise_gravity=0.0, noise_joint_position=0.0,
        noise_joint_velocity=0.0, push_velocity=0.0,
    ))  # fmt: skip
    runtime = deploy.Policy(*contents(policy("full")))
    still = Perturbation(quiet, np.random.default_rng(0))
    plain = run_trial(body, runtime, STANDING, 0.4).qpos
    np.testing.assert_array_equal(
        run_trial(body, runtime, STANDING, 0.4, perturbation=still).qpos, plain
    )
