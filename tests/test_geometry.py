import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from cref_jax import geometry

NORMALS = np.array(
    [
        [0, 0, 1],
        [0, 0, -1],
        [1, 0, 0],
        [0, -1, 0],
        [0.36, 0.48, -0.8],
        [-0.6, 0, 0.8],
        [0, 1e-4, -1],
    ]
)
NORMALS = (NORMALS / np.linalg.norm(NORMALS, axis=1, keepdims=True)).astype(np.float32)


def quaternions(seed: int, count: int = 20):
    q = jax.random.normal(jax.random.key(seed), (count, 4))
    return q / jnp.linalg.norm(q, axis=-1, keepdims=True)


def vectors(seed: int, count: int = 20):
    return jax.random.normal(jax.random.key(seed), (count, 3))


def test_product_matrix_and_axis_angle_are_mujocos():
    a, b, v = quaternions(0), quaternions(1), vectors(2)
    axis, angle = v / jnp.linalg.norm(v, axis=-1, keepdims=True), jnp.linspace(-4.0, 4.0, 20)
    product, matrix, turn = np.zeros(4), np.zeros(9), np.zeros(4)
    for i in range(20):
        mujoco.mju_mulQuat(product, np.float64(a[i]), np.float64(b[i]))
        np.testing.assert_allclose(geometry.quat_multiply(a, b)[i], product, atol=1e-6)
        mujoco.mju_quat2Mat(matrix, np.float64(a[i]))
        np.testing.assert_allclose(geometry.quat_to_matrix(a)[i].ravel(), matrix, atol=1e-6)
        mujoco.mju_axisAngle2Quat(turn, np.float64(axis[i]), float(angle[i]))
        np.testing.assert_allclose(geometry.quat_from_axis_angle(axis, angle)[i], turn, atol=1e-6)


def test_rotating_agrees_with_the_matrix_and_the_inverse_undoes_it():
    q, v = quaternions(3), vectors(4)
    by_matrix = jnp.einsum("nij,nj->ni", geometry.quat_to_matrix(q), v)
    np.testing.assert_allclose(geometry.rotate(q, v), by_matrix, atol=1e-5)
    np.testing.assert_allclose(geometry.rotate_inverse(q, geometry.rotate(q, v)), v, atol=1e-5)


def test_a_product_turns_by_its_right_factor_first():
    a, b, v = quaternions(5), quaternions(6), vectors(7)
    one_by_one = geometry.rotate(a, geometry.rotate(b, v))
    np.testing.assert_allclose(
        geometry.rotate(geometry.quat_multiply(a, b), v), one_by_one, atol=1e-5
    )


def test_yaw_is_the_heading_of_the_x_axis():
    q = quaternions(8)
    ahead = geometry.rotate(q, jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(geometry.yaw(q), jnp.arctan2(ahead[:, 1], ahead[:, 0]), atol=1e-5)


def test_a_quarter_turn_of_yaw_takes_x_to_y_and_keeps_z():
    quarter = jnp.array(0.5 * jnp.pi)
    turned = geometry.rotate_yaw(quarter, jnp.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(turned, [-2.0, 1.0, 3.0], atol=1e-6)
    turned = geometry.rotate_yaw(quarter, jnp.array([[1.0, 0.0], [0.0, 1.0]]))
    np.testing.assert_allclose(turned, [[0.0, 1.0], [-1.0, 0.0]], atol=1e-6)


def test_quat_from_z_takes_z_to_the_normal_even_straight_down():
    q = geometry.quat_from_z(jnp.array(NORMALS))
    np.testing.assert_allclose(jnp.linalg.norm(q, axis=-1), 1.0, atol=1e-6)
    np.testing.assert_allclose(geometry.rotate(q, jnp.array([0.0, 0.0, 1.0])), NORMALS, atol=1e-6)


def test_quat_from_z_has_a_finite_gradient_everywhere():
    gradient = jax.vmap(jax.jacobian(geometry.quat_from_z))(jnp.array(NORMALS))
    assert np.isfinite(gradient).all()
