"""Eq. 1-3: what stands where, and in which frame."""

import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cref_jax import config, geometry, terrain
from cref_jax.env import observations

JOINTS = 12
CELL = 0.02  # m
SCAN = functools.partial(config.Scan, base_height=0.62)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def turned(axis: list[float], degrees: float) -> jnp.ndarray:
    return geometry.quat_from_axis_angle(jnp.array(axis), jnp.float32(math.radians(degrees)))


def state(rotation=LEVEL, velocity=(0.0, 0.0, 0.0), spin=(0.0, 0.0, 0.0)):
    """Return qpos and qvel with joints 0.00, 0.01, ... rad and 0, 1, ... rad/s."""
    qpos = jnp.concatenate([jnp.array([0.8, 0.0, 0.72]), jnp.asarray(rotation, jnp.float32)])
    qvel = jnp.concatenate([jnp.array(velocity), jnp.array(spin)])
    numbers = jnp.arange(JOINTS, dtype=jnp.float32)
    return jnp.concatenate([qpos, 0.01 * numbers]), jnp.concatenate([qvel, numbers])


def test_the_parts_follow_each_other_as_in_eq_2():
    clean = observations.motion(*state(turned([1.0, 0.0, 0.0], 90.0), spin=(1.0, 2.0, 3.0)), JOINTS)
    command = jnp.array([0.5, -0.1, 0.2])
    action = jnp.arange(JOINTS) + 100.0
    found = observations.proprioception(clean, command, jnp.full(JOINTS, 0.5), action)
    assert found.shape == (3 + 3 + 3 + 3 * JOINTS,)
    parts = {name: found[part] for name, part in observations.slices(JOINTS).items()}
    expected = {
        "angular_velocity": [1.0, 2.0, 3.0],
        "gravity": [0.0, -1.0, 0.0],  # lying on its right side, the left side up
        "command": [0.5, -0.1, 0.2],
        "joint_position": 0.01 * np.arange(JOINTS) - 0.5,
        "joint_velocity": np.arange(JOINTS),
        "action": 100.0 + np.arange(JOINTS),
    }
    assert list(parts) == list(expected)
    for name, values in expected.items():
        np.testing.assert_allclose(parts[name], values, atol=1e-6, err_msg=name)


def test_the_slices_cover_everything_once():
    covered = np.concatenate([np.arange(100)[s] for s in observations.slices(JOINTS).values()])
    np.testing.assert_array_equal(covered, np.arange(45))


def test_gravity_tells_the_tilt_and_not_the_heading():
    # nose down by 30 degrees: x_b = (cos 30, 0, -sin 30), so g points along it by sin 30
    pitched = turned([0.0, 1.0, 0.0], 30.0)
    expected = [0.5, 0.0, -math.cos(math.radians(30.0))]
    for heading in (0.0, 70.0, -120.0):
        rotation = geometry.quat_multiply(turned([0.0, 0.0, 1.0], heading), pitched)
        np.testing.assert_allclose(
            observations.motion(*state(rotation), JOINTS).gravity, expected, atol=1e-6
        )


def test_the_velocity_is_turned_into_the_body_frame_and_the_spin_is_there_already():
    # heading along world y: what goes along world x goes to the right, -y of the body
    found = observations.motion(
        *state(turned([0.0, 0.0, 1.0], 90.0), (1.0, 0.0, 0.5), (1, 2, 3)), JOINTS
    )
    np.testing.assert_allclose(found.velocity, [0.0, -1.0, 0.5], atol=1e-6)
    np.testing.assert_array_equal(found.angular_velocity, [1.0, 2.0, 3.0])


@pytest.fixture(scope="module")
def ground():
    """Level ground, from x = 1 m on a step of 15 cm, from x = 2 m on a pit of 1 m."""
    x = (np.arange(150) + 0.5) * CELL
    profile = np.where(x < 1.0, 0.0, np.where(x < 2.0, 0.15, -1.0))
    return terrain.from_heights(np.repeat(profile[:, None], 100, 1), CELL, (0.0, -1.0))


def test_the_height_scan_of_a_step(ground):
    # base 0.72 m above the start; 0.72 - 0.62 = 0.1 over the ground, 0.1 - 0.15 = -0.05 over the
    # step; x runs slowly, y fast: (0.3, +-0.1), (0.8, +-0.1), (1.3, +-0.1)
    c = SCAN(x=(-0.5, 0.5, 3), y=(-0.1, 0.1, 2))
    found = observations.height_scan(ground, state()[0], c)
    np.testing.assert_allclose(found, [0.1, 0.1, 0.1, 0.1, -0.05, -0.05], atol=1e-6)


def test_the_height_scan_turns_with_the_heading_and_not_with_the_tilt(ground):
    # heading along world y: the samples at y = -0.4 of the body lie at x = 0.8 + 0.4 of the world
    c = SCAN(x=(-0.5, 0.5, 2), y=(-0.4, 0.4, 2))
    heading = turned([0.0, 0.0, 1.0], 90.0)
    for tilt in (0.0, 25.0):
        rotation = geometry.quat_multiply(heading, turned([0.0, 1.0, 0.0], tilt))
        found = observations.height_scan(ground, state(rotation)[0], c)
        np.testing.assert_allclose(found, [-0.05, 0.1, -0.05, 0.1], atol=1e-6)


def test_the_height_scan_is_clipped(ground):
    # over the pit: 0.72 + 1 - 0.62 = 1.1, cut to 1
    c = SCAN(x=(1.5, 1.5, 1), y=(0.0, 0.0, 1))
    np.testing.assert_array_equal(observations.height_scan(ground, state()[0], c), [1.0])


def test_the_critic_sees_the_clean_observation_the_velocity_the_hidden_and_last_the_heights():
    parts = (jnp.arange(45.0), jnp.arange(3) + 50.0, jnp.arange(2) + 55.0, jnp.arange(6) + 60.0)
    found = observations.privileged_state(*parts)
    np.testing.assert_array_equal(found, [*range(45), 50, 51, 52, 55, 56, *range(60, 66)])


def test_the_fine_row_places_a_riser_within_its_spacing():
    # a step up of 20 cm at x = 1.0; the base at x = 0.3, 0.62 m up: 0.7 m ahead, of samples from
    # -0.2 m on every 5 cm; the one at 0.7 m is up already
    heights = np.where((np.arange(200) + 0.5) * 0.02 > 0.99, 0.2, 0.0)[:, None]
    ground = terrain.from_heights(heights, 0.02, (0.0, 0.0))
    qpos = jnp.zeros(19).at[:4].set(jnp.array([0.3, 0.0, 0.62, 1.0]))
    found = observations.fine_row(ground, qpos, SCAN())
    np.testing.assert_allclose(found, [*[0.0] * 18, *[-0.2] * 7], atol=1e-6)


def test_a_teacher_sees_which_cells_around_it_are_on_a_step():
    # the same step and base, 0.7 m ahead of it: of 21 rows from -0.5 m on every 10 cm, those from
    # 0.7 m on, the last 9, in all 11 columns. It stands on 0.05 m: -0.05 m, and 0.15 m there
    heights = np.where((np.arange(200) + 0.5) * 0.02 > 0.99, 0.2, 0.0)[:, None]
    ground = terrain.from_heights(heights, 0.02, (0.0, 0.0))
    qpos = jnp.zeros(19).at[:4].set(jnp.array([0.3, 0.0, 0.62, 1.0]))
    found = observations.teacher_heights(ground, qpos, jnp.float32(0.05), SCAN()).reshape(21, 11)
    np.testing.assert_allclose(found[:12], -0.05, atol=1e-6)
    np.testing.assert_allclose(found[12:], 0.15, atol=1e-6)
    # it does not tell how high the base is
    crouching = observations.teacher_heights(ground, qpos.at[2].set(0.4), jnp.float32(0.05), SCAN())
    np.testing.assert_array_equal(crouching.reshape(21, 11), found)
    # at x = 0.83 and turned to the left the step is on the right, from 0.17 m on: columns from
    # -0.5 m on every 10 cm, so the first 4
    left = turned([0.0, 0.0, 1.0], 90.0)
    qpos = qpos.at[0].set(0.83).at[3:7].set(left)
    found = observations.teacher_heights(ground, qpos, jnp.float32(0.0), SCAN()).reshape(21, 11)
    np.testing.assert_allclose(found[:, :4], 0.2, atol=1e-6)
    np.testing.assert_allclose(found[:, 4:], 0.0, atol=1e-6)


def test_noise_stays_within_its_bounds_and_reaches_them():
    c = config.Randomisation()
    clean = observations.motion(*state(velocity=(1.0, 2.0, 3.0)), JOINTS)
    noisy = jax.vmap(lambda key: observations.with_noise(clean, c, 1.0, key))(
        jax.random.split(jax.random.key(0), 2000)
    )
    bounds = {
        "angular_velocity": c.noise_angular_velocity,
        "gravity": c.noise_gravity,
        "joint_position": c.noise_joint_position,
        "joint_velocity": c.noise_joint_velocity,
    }
    for name, bound in bounds.items():
        noise = np.asarray(getattr(noisy, name) - getattr(clean, name))
        assert np.abs(noise).max() <= bound * (1 + 1e-4) + 1e-6, name
        # each of the numbers has its own noise, over the whole width, and without a bias
        assert (noise.max(axis=0) > 0.98 * bound).all(), name
        assert (noise.min(axis=0) < -0.98 * bound).all(), name
        assert np.abs(noise.mean(axis=0)).max() < 0.1 * bound, name
    np.testing.assert_array_equal(noisy.velocity, np.tile(clean.velocity, (2000, 1)))
