"""The mirror against the simulation: a mirrored state does what the state does, mirrored."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import small_world
from small_world import ROBOTS, C, on, one

from cref_jax import config, network, robot
from cref_jax.env import environment
from cref_jax.physics.records import Body
from cref_jax.training import iteration, mirror, rollout

MODEL_NAMES = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
SIGNS = (1, -1, -1, 1, 1, -1)


@pytest.fixture
def joints(world):
    return mirror.pair_joints(world.physics.model)


def test_legs_change_places_and_rolls_and_yaws_their_sign(world, joints):
    names = world.physics.robot.joint_names
    for j, name in enumerate(names):
        side, part = name.removesuffix("_joint").split("_", 1)
        other = {"left": "right", "right": "left"}[side]
        assert names[joints.partner[j]] == name.replace(side, other)
        assert joints.sign[j] == SIGNS[MODEL_NAMES.index(part)]


def test_a_mirror_image_of_a_mirror_image_is_the_thing_itself(world, robots, joints):
    for values in (robots.body.qpos[:, 7:], robots.body.qvel[:, 6:]):
        np.testing.assert_array_equal(joints.flip(joints.flip(values)), values)
    twice = jax.vmap(lambda b: mirror.body(mirror.body(b, joints), joints))(robots.body)
    jax.tree.map(np.testing.assert_array_equal, twice, robots.body)
    seen = jax.random.normal(jax.random.key(0), (5, 45))
    again = mirror.proprioception(mirror.proprioception(seen, joints), joints)
    np.testing.assert_array_equal(again, seen)


def test_an_image_is_turned_over(world):
    image = jax.random.uniform(jax.random.key(1), (2, 48, 64)).astype(jnp.float16)
    c = C.network
    found = network.patches_to_image(c, mirror.frame(network.image_to_patches(c, image), c))
    np.testing.assert_array_equal(found, image[..., ::-1])


def test_a_model_with_one_leg_more_is_refused(world):
    lame = mujoco.MjModel.from_xml_string("""
      <mujoco><worldbody><body><freejoint/><geom size=".1"/>
        <body><joint name="left_knee_joint" axis="0 1 0"/><geom size=".1"/></body>
      </body></worldbody></mujoco>""")
    with pytest.raises(ValueError, match="no right_knee_joint"):
        mirror.pair_joints(lame)


def test_the_simulation_commutes_with_the_mirror(world, robots, joints):
    # on lanes that are level across, without randomisation; a few control steps, since contact
    # magnifies rounding
    state = jax.tree.map(lambda x: jnp.stack([x] * ROBOTS), on("stairs_up", one(robots), level=2))
    rng = np.random.default_rng(0)
    body = state.body._replace(
        qpos=state.body.qpos.at[:, 7:].add(0.05 * rng.normal(size=state.body.qpos[:, 7:].shape)),
        qvel=state.body.qvel + 0.2 * rng.normal(size=state.body.qvel.shape).astype(np.float32),
    )
    state = state.replace(
        body=body,
        dynamics=jax.tree.map(lambda x: jnp.stack([x] * ROBOTS), world.physics.nominal_dynamics()),
        joint_offset=jnp.zeros_like(state.joint_offset),
        delay=jnp.zeros_like(state.delay),
        push_left=jnp.full(ROBOTS, 99),
        command_left=jnp.full(ROBOTS, 99),
        spread=jax.tree.map(jnp.zeros_like, state.spread),  # no sensor noise
    )
    image = state.replace(
        body=jax.vmap(lambda b: mirror.body(b, joints))(state.body),
        command=mirror.COMMAND * state.command,
    )
    step = jax.jit(jax.vmap(environment.step, in_axes=(None, 0, 0)))
    look = jax.jit(jax.vmap(environment.depth_image, in_axes=(None, 0)))
    for _ in range(3):
        action = jnp.asarray(0.5 * rng.normal(size=state.action.shape), jnp.float32)
        state, real = step(world, state, action)
        image, imagined = step(world, image, joints.flip(action))
        there, here = real.observation, imagined.observation
        np.testing.assert_allclose(
            here.proprioception, mirror.proprioception(there.proprioception, joints), atol=2e-3
        )
        np.testing.assert_allclose(here.velocity, mirror.POLAR * there.velocity, atol=1e-3)
        np.testing.assert_allclose(imagined.reward, real.reward, atol=1e-3)
        heights = lambda seen: seen.privileged[:, -C.scan.x[2] * C.scan.y[2] :]
        np.testing.assert_allclose(heights(here), mirror.scan(heights(there), C.scan), atol=1e-3)
        feet = imagined.measures.airborne[:, ::-1]
        np.testing.assert_array_equal(feet, real.measures.airborne)
    difference = np.abs(np.asarray(look(world, image))[..., ::-1] - np.asarray(look(world, state)))
    assert np.mean(difference < 0.01) > 0.99  # of the pixels; rounding decides at edges


@pytest.mark.parametrize("name", robot.ROBOTS)
def test_every_robot_is_its_own_mirror_image(name):
    """Its masses, shapes, motors and limits are: MuJoCo's steps commute with the mirror."""
    whole = robot.load(config.Robot(name, actuated="all"))
    model = robot.spec("all", config.Physics(), name=name).compile()
    joints = mirror.pair_joints(model)
    rng, state, image = np.random.default_rng(0), mujoco.MjData(model), mujoco.MjData(model)
    state.qpos[:7] = [0.3, 0.2, whole.standing_height - 0.005, 1.0, 0.02, -0.03, 0.1]
    state.qpos[7:] = whole.nominal_pose + 0.05 * rng.normal(size=model.nu)
    state.qvel[:] = 0.3 * rng.normal(size=model.nv)
    turned = mirror.body(Body(*map(jnp.asarray, (state.qpos, state.qvel, state.qvel))), joints)
    image.qpos[:], image.qvel[:] = turned.qpos, turned.qvel
    for _ in range(20):
        target = whole.nominal_pose + 0.3 * rng.normal(size=model.nu)
        state.ctrl[:], image.ctrl[:] = target, joints.flip(jnp.asarray(target))
        mujoco.mj_step(model, state)
        mujoco.mj_step(model, image)
    assert state.ncon > 2
    expected = mirror.body(Body(*map(jnp.asarray, (state.qpos, state.qvel, state.qvel))), joints)
    np.testing.assert_allclose(image.qpos, expected.qpos, atol=1e-4)
    np.testing.assert_allclose(image.qvel, expected.qvel, atol=1e-2)


def taught():
    """Return the world, the learner and the robots of a small run that is taught symmetry."""
    c = config.override(
        C,
        {
            "run": {"num_envs": 4},
            "ppo": {"horizon": 4, "minibatches": 2, "mirror_weight": 1.0},
            "network": {"token": 8, "lstm": 8, "gru": 8, "actor": [8], "critic": [8]},
        },
    )
    world = small_world.world().replace(config=c)
    return world, jax.jit(iteration.initial_state)(world)


@pytest.fixture(scope="module")
def symmetric():
    return taught()


def test_the_twin_lives_what_a_mirrored_robot_would(symmetric):
    world, state = symmetric
    of = mirror.make_mirror(world.physics.model, world.config.network)
    nets = rollout.networks(world.config.network, world.physics.robot.num_joints)
    act = jax.jit(lambda nets, r: rollout.apply_policy(nets, state.train, r), static_argnums=0)
    keys = iter(jax.random.split(jax.random.key(5), 9))
    noise = lambda x: jax.random.uniform(next(keys), x.shape, x.dtype)
    robots = state.robots
    image = robots.replace(memory=robots.memory.twin)
    for fresh in (True, False):
        seen = robots.observation._replace(proprioception=noise(robots.observation.proprioception))
        feed = robots.feed.replace(
            frame=noise(robots.feed.frame), seen=jnp.ones(4, bool), fresh=jnp.array(fresh)
        )
        robots = robots.replace(observation=seen, feed=feed)
        turned = seen._replace(proprioception=of.obs(seen.proprioception))
        image = image.replace(observation=turned, feed=feed.replace(frame=of.frames(feed.frame)))
        memory, said = act(nets._replace(mirror=of), robots)
        alone, expected = act(nets, image)
        jax.tree.map(np.testing.assert_array_equal, memory.twin, alone)
        assert not np.allclose(said.mean, expected.mean)
        robots, image = robots.replace(memory=memory), image.replace(memory=alone)


def test_training_remembers_what_the_twin_has_seen(symmetric):
    world, state = symmetric
    after, log = iteration.chunk(world, state, iteration.make_mesh(), 2)
    assert (log["loss/asymmetry"] > 0.0).all()
    twin, own = after.robots.memory.twin, after.robots.memory
    assert not np.allclose(twin.carry.gru, own.carry.gru)
    assert float(jnp.abs(twin.features.tokens).max()) == 0.0  # dropped after a horizon
