import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from cref_jax import config, robot
from cref_jax.robot import kinematics
from cref_jax.robot.registry import ROBOTS

STATES = 50


def random_state(model: mujoco.MjModel, rng: np.random.Generator):
    qpos = rng.uniform(-1.0, 1.0, model.nq)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    return qpos, rng.uniform(-2.0, 2.0, model.nv)


def mujocos_links(model: mujoco.MjModel, state: mujoco.MjData, bodies: int) -> kinematics.Links:
    velocity = np.zeros((bodies, 6))  # angular, then linear
    for body in range(bodies):
        xbody = mujoco.mjtObj.mjOBJ_XBODY
        mujoco.mj_objectVelocity(model, state, xbody, body, velocity[body], 0)
    return kinematics.Links(
        state.xpos[:bodies], state.xquat[:bodies], velocity[:, 3:], velocity[:, :3]
    )


@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("actuated", ["legs", "all"])
def test_links_are_where_mujoco_has_them_and_move_as_it_says(actuated, name):
    model = robot.spec(actuated, config.Physics(), name=name).compile()
    state, tree, rng = mujoco.MjData(model), kinematics.tree(model), np.random.default_rng(0)
    forward = jax.jit(lambda qpos, qvel: kinematics.links(tree, qpos, qvel))
    for _ in range(STATES):
        qpos, qvel = random_state(model, rng)
        state.qpos, state.qvel = qpos, qvel
        mujoco.mj_forward(model, state)
        ours = forward(jnp.array(qpos, jnp.float32), jnp.array(qvel, jnp.float32))
        theirs = mujocos_links(model, state, len(ours.position))
        np.testing.assert_allclose(ours.position, theirs.position, atol=1e-5)
        same_sign = np.sign(np.sum(ours.rotation * theirs.rotation, -1, keepdims=True))
        np.testing.assert_allclose(same_sign * ours.rotation, theirs.rotation, atol=1e-5)
        np.testing.assert_allclose(ours.velocity, theirs.velocity, atol=1e-5)
        np.testing.assert_allclose(ours.angular_velocity, theirs.angular_velocity, atol=1e-5)


def test_points_are_the_centres_of_the_contact_spheres():
    model = robot.spec("legs", config.Physics()).compile()
    spheres = robot.load(config.Robot()).spheres
    state = mujoco.MjData(model)
    state.qpos, state.qvel = random_state(model, np.random.default_rng(1))
    mujoco.mj_kinematics(model, state)
    qpos, qvel = jnp.array(state.qpos, jnp.float32), jnp.array(state.qvel, jnp.float32)
    links = kinematics.links(kinematics.tree(model), qpos, qvel)
    found = kinematics.points(links, spheres.body, spheres.position)
    expected = [state.geom(name).xpos for name in spheres.names]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_row_0_is_the_world_at_rest():
    model = robot.spec("legs", config.Physics()).compile()
    qpos, qvel = random_state(model, np.random.default_rng(2))
    links = kinematics.links(
        kinematics.tree(model), jnp.array(qpos, jnp.float32), jnp.array(qvel, jnp.float32)
    )
    np.testing.assert_array_equal(links.rotation[0], [1.0, 0.0, 0.0, 0.0])
    for at_rest in (links.position, links.velocity, links.angular_velocity):
        np.testing.assert_array_equal(at_rest[0], 0.0)


def test_a_hinge_off_its_links_origin_is_refused():
    spec = robot.spec("legs", config.Physics())
    spec.joint("left_knee_joint").pos = [0.0, 0.0, 0.1]
    with pytest.raises(ValueError, match="about its origin"):
        kinematics.tree(spec.compile())
