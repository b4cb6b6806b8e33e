import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from small_world import put
from tiny_policy import ROBOT, contents, policy

from cref_jax import deploy, depth, robot, sim2sim, terrain
from cref_jax.config import Config
from cref_jax.env import commands, environment, events
from cref_jax.evaluation import crossing, protocol
from cref_jax.physics.records import Body
from cref_jax.physics.simulation import Physics
from cref_jax.rendering import robot_scene
from cref_jax.training import mirror
from cref_jax.whole_body import termination
from cref_jax.whole_body.disturbances import Disturbance
from cref_jax.whole_body.ground import Lane
from cref_jax.whole_body.simulator import WholeBodySim
from cref_jax.whole_body.trial import Start, _initial_state, _is_due, lane_command, run_trial

C = protocol.evaluation_config(Config())
FLAT = Lane(np.zeros((600, 200), np.float32), np.array([0.0, -2.0], np.float32), 0.02, 11.0)
EACH = pytest.mark.parametrize("name", robot.ROBOTS)


def standing(driven: robot.Robot) -> Start:
    base = [0.7, 0.0, driven.standing_height, 1.0, 0.0, 0.0, 0.0]
    return Start(np.array(base, np.float32), driven.nominal_pose, 0.5)


STANDING = standing(ROBOT)


def on_lane(lane=FLAT, name=None):
    c = robot.fill_in(C, name)
    return WholeBodySim(c, lane, robot.load(c.robot).joint_names)


@pytest.fixture(scope="module")
def body():
    return on_lane()


def runtime(variant="full", name=None):
    return deploy.Policy(*contents(policy(variant, name=name)))


def placed(body, **changes):
    """Return the state with the base's position and rotation changed."""
    start = standing(robot.load(body.config.robot))
    base = np.array(start.base)
    for name, value in changes.items():
        base[{"x": 0, "y": 1, "z": 2, "rotation": slice(3, 7)}[name]] = value
    return _initial_state(body, start._replace(base=base))


def gap_world(name=None):
    c = robot.fill_in(C, name)
    c = dataclasses.replace(c, terrain=dataclasses.replace(c.terrain, name="gap"))
    return crossing.crossing_world(c, Physics(c.robot, c.physics, "mujoco"), "gap", 0.5)


@EACH
def test_it_sees_what_the_robot_sees_in_training(name):
    world = gap_world(name)
    body = on_lane(sim2sim.to_lane(world), name)
    heights = robot_scene.window(world.lanes.tile(0, 0))[0]
    edge = 0.02 * int(np.argmin(heights[:, 100] > -0.5))  # m, where the first gap begins
    turned = np.array([np.cos(0.1), 0.0, 0.0, np.sin(0.1)], np.float32)
    for x in (edge - 0.8, edge - 0.3):
        state = placed(body, x=x, rotation=turned)
        ours = body.image(state)
        at_start = jax.tree.map(lambda a: a[0], crossing.first_robots(world, 0, 1).env)
        own = world.physics.robot
        there = put(at_start, x=x, y=0.0, z=own.standing_height, rotation=jnp.array(turned))
        there = there.replace(
            body=there.body._replace(qpos=there.body.qpos.at[7:].set(own.rest_pose))
        )
        seen = jax.jit(environment.depth_image)(world, there)
        metres = (np.asarray(seen) + 0.5) * C.camera.d_max
        held = np.minimum(np.where(np.isfinite(ours), ours, np.inf), C.camera.d_max)
        assert np.mean(np.abs(metres - held) < 0.01) > 0.99
        assert np.ptp(held) > 0.5


def test_the_operator_steers_as_in_training():
    world = gap_world()
    state = jax.tree.map(lambda a: a[0], crossing.first_robots(world, 0, 1).env)
    state = state.replace(command_left=jnp.int32(1000))
    command = jax.jit(commands.update_command)
    draws = jax.jit(events.draw)(world, state, jax.random.key(0), jax.random.key(1))
    for y, angle in [(0.0, 0.0), (0.8, 0.3), (-3.0, 0.5), (0.2, 3.0), (0.0, -3.1)]:
        rotation = jnp.array([np.cos(angle / 2), 0.0, 0.0, np.sin(angle / 2)])
        there = put(state, y=y, rotation=rotation)
        expected = command(world, there, draws).command
        found = lane_command(C.command, float(state.command[0]), np.asarray(there.body.qpos))
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_frames_come_when_they_come_in_training():
    period = C.physics.control_period
    for step in range(1, 101):
        assert _is_due(step, C) == depth.is_due(step, C.camera, period)


@EACH
def test_the_ground_bears_the_robots_weight(name):
    body = on_lane(name=name)
    state = placed(body)
    for _ in range(60):  # 0.3 s under PD
        mujoco.mj_step(body.model, state)
    force = body.foot_force(state)
    weight = body.robot.mass * 9.81
    assert force[:, 2].sum() == pytest.approx(weight, rel=0.3)
    assert not body.is_hit(state)


@EACH
def test_force_on_the_feet_is_that_of_training(name):
    c, body = robot.fill_in(Config(), name), on_lane(name=name)
    physics = Physics(dataclasses.replace(c.robot, held="all"), c.physics, "mujoco")
    ground = terrain.from_heights(np.zeros((200, 100)), cell=0.02, origin=(0.0, -1.0))
    own = physics.robot
    state = placed(body, z=own.standing_height + 0.02)  # it lands within the second control step
    theirs = Body(*(jnp.asarray(x, jnp.float32) for x in (state.qpos, state.qvel, state.qacc)))
    target = jnp.tile(own.nominal_pose, (2, 1))
    step = jax.jit(physics.step)
    for _ in range(5):
        ours = body.advance(state, (own.nominal_pose, own.nominal_pose))
        theirs, force = step(ground, theirs, target, jnp.int32(0), physics.nominal_dynamics())
        np.testing.assert_allclose(ours, force, atol=0.05)
    assert ours[:, 2].min() > 50.0


def test_a_foot_relieved_for_a_moment_still_bears(body):
    """A foot lands 43 cm higher while the pelvis is 0.64 m above the other, which it relieves."""
    state = placed(body)
    state.xpos[body.feet, 2] = [0.51, 0.07]
    state.qpos[2] = 0.64
    landing, bearing = [0.0, 0.0, 400.0], [0.0, 0.0, 300.0]
    checker = termination.TerminationChecker(body, state)
    assert checker.check(state, np.array([landing, bearing])) is None
    assert checker.check(state, np.array([landing, [0.0, 0.0, 0.0]])) == "low"


@pytest.mark.parametrize(
    ("changes", "ending"),
    [
        ({}, None),
        ({"rotation": [np.cos(0.6), 0.0, np.sin(0.6), 0.0], "z": 1.5}, "tilted"),
        ({"z": 0.2}, "low"),
        ({"x": 11.5}, "finished"),
        ({"z": np.nan}, "unstable"),
    ],
)
def test_a_trial_ends_as_an_episode_does(body, changes, ending):
    checker = termination.TerminationChecker(body, placed(body))
    state = placed(body, **changes)
    if ending == "unstable":
        mujoco.mj_step(body.model, state)
    assert checker.check(state, body.foot_force(state)) == ending


def test_a_foot_far_below_the_last_support_has_dropped():
    heights = np.zeros((600, 200), np.float32)
    heights[60:] = -1.0
    body = on_lane(Lane(heights, FLAT.origin, FLAT.cell, FLAT.end))
    checker = termination.TerminationChecker(body, placed(body))
    checker._support += 0.6
    assert checker.check(placed(body, x=5.0), np.zeros((2, 3))) in ("low", "dropped")


def test_upper_body_on_the_ground_is_a_hit(body):
    lying = [np.cos(np.pi / 4), 0.0, np.sin(np.pi / 4), 0.0]  # face down
    state = placed(body, rotation=lying, z=0.05)
    assert body.is_hit(state)


@EACH
def test_a_mirrored_robot_sees_the_mirrored_image(name):
    # a camera beside the middle comes to the other side
    heights = np.zeros((600, 200), np.float32)
    heights[60:] = 0.2
    body = on_lane(FLAT._replace(heights=heights), name)
    joints, rng = mirror.pair_joints(body.model), np.random.default_rng(0)
    state = placed(body)
    state.qpos[7:] += 0.1 * rng.normal(size=body.model.nu)
    lifted = body.robot.joint_names.index("left_hip_pitch_joint")
    state.qpos[7 + lifted] -= 1.2  # rad: the thigh comes into view
    mujoco.mj_forward(body.model, state)
    look = lambda: np.minimum(body.image(state), C.camera.d_max)
    image = look()
    mount = body.robot.camera
    turned = mount._replace(position=mount.position * mirror.POLAR)
    body.robot = dataclasses.replace(body.robot, camera=turned)
    state.qpos[7:] = joints.flip(jnp.asarray(state.qpos[7:]))
    mujoco.mj_forward(body.model, state)
    assert np.mean(np.abs(look()[:, ::-1] - image) < 1e-4) > 0.995
    assert np.mean(np.abs(image[:, ::-1] - image) > 0.05) > 0.01


@EACH
def test_a_trial_is_the_same_twice_and_says_how_it_went(name):
    body = on_lane(name=name)
    start = standing(robot.load(body.config.robot))
    first, second = (run_trial(body, runtime(name=name), start, 0.5) for _ in range(2))
    np.testing.assert_array_equal(first.qpos, second.qpos)
    assert first.ending in ("late", "low", "tilted", "hit")
    assert first.seconds == pytest.approx(len(first.qpos) * 0.02)
    assert not first.status & (deploy.FAULTS | deploy.Status.STALE_DEPTH | deploy.Status.BAD_DEPTH)
    assert first.status & deploy.Status.NO_DEPTH  # the first frame comes after 60 ms


def test_frames_that_come_too_late_are_noticed(body):
    late = run_trial(body, runtime(), STANDING, 0.4, Disturbance(latency=8))
    assert late.status & deploy.Status.STALE_DEPTH


def test_a_blind_policy_walks_without_frames(body):
    trial = run_trial(body, runtime("blind"), STANDING, 0.2)
    assert trial.status & ~deploy.Status.RANGE_LIMITED & ~deploy.Status.RATE_LIMITED == 0


def test_nothing_of_jax_is_in_the_loop(body, monkeypatch):
    policy = runtime()

    def refuse(*_, **__):
        raise AssertionError("JAX was called")

    for name in ("jit", "device_put"):
        monkeypatch.setattr(jax, name, refuse)
    monkeypatch.setattr(jnp, "asarray", refuse)
    monkeypatch.setattr(jax._src.core.Primitive, "bind", refuse)
    run_trial(body, policy, STANDING, 0.1)
