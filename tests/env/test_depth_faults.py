"""Faults of the depth camera: each by itself, and holes filled in as the runtime fills them."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_world import C, one

from cref_jax import config
from cref_jax.env import depth_faults, environment
from cref_jax.env.state import even_spread
from cref_jax.runtime import camera
from cref_jax.whole_body import disturbances

SHAPE = C.camera.shape
D_MAX = C.camera.d_max


def misread(world, state, share=1.0, **faults):
    """Return the images, before and after, of robots whose camera has these faults."""
    c = config.override(C, {"randomisation": {"enabled": True, **faults}})
    state = state.replace(spread=even_spread(jnp.full(state.kind.shape, share)))
    depth = jax.jit(jax.vmap(environment.render_depth, in_axes=(None, 0)))(world, state)
    wrong = jax.vmap(depth_faults.misread, in_axes=(None, 0, 0))
    return np.asarray(depth), np.asarray(jax.jit(wrong)(world.replace(config=c), state, depth))


def test_holes_are_filled_as_the_runtime_does():
    rng = np.random.default_rng(0)
    values = rng.uniform(0.3, 3.0, SHAPE).astype(np.float32)
    known = rng.random(SHAPE) < 0.5
    known[:5], known[:, -3:], known[20:30, 10:40] = False, False, False
    ours = jax.jit(depth_faults.fill_holes)(values, known)
    np.testing.assert_allclose(ours, camera.fill_holes(values, known), atol=2e-6)


def test_level_ground_is_filled_in_exactly(world, robots):
    row = np.linspace(0.4, 2.0, SHAPE[0], dtype=np.float32)[:, None]  # 1 / depth of a plane
    depth, wrong = 1.0 / np.broadcast_to(row, SHAPE), {"depth_holes": 0.4, "narrow_view": 1.0}
    c = config.override(C, {"randomisation": {"enabled": True, **wrong}})
    state = one(robots).replace(spread=even_spread(jnp.ones(())))
    read = depth_faults.misread(world.replace(config=c), state, jnp.asarray(depth))
    np.testing.assert_allclose(read, depth, rtol=1e-5)


def test_nothing_is_wrong_with_a_share_of_nothing(world, robots):
    every = {"depth_noise": 0.1, "depth_scale": 0.5, "depth_dead": 0.5, "depth_holes": 0.5}
    depth, read = misread(world, robots, 0.0, **every, narrow_view=1.0)
    np.testing.assert_array_equal(read, depth)


def test_a_wrong_scale_is_one_factor_per_episode_and_what_is_far_stays_far(world, robots):
    depth, read = misread(world, robots, depth_scale=0.1)
    near = (depth < 0.9 * D_MAX) & (depth > 0.0)
    factors = [
        np.unique(np.round((b / a)[n], 5)) for a, b, n in zip(depth, read, near, strict=True)
    ]
    assert all(len(of) == 1 and 0.9 <= of[0] <= 1.1 for of in factors)
    assert len({of[0] for of in factors}) == len(factors)
    assert (read[depth >= D_MAX] == D_MAX).all()


def test_noise_grows_with_the_square_of_depth(world, fresh_states):
    depth, read = misread(world, one(fresh_states, np.arange(64)), depth_noise=0.01)
    band = lambda low, high: (depth > low) & (depth < high)
    deviation = lambda which: (read - depth)[which].std()
    # the deviation is uniform up to 1 cm at 1 m: 0.01 / sqrt(3) in all
    assert deviation(band(0.95, 1.05)) == pytest.approx(0.01 / np.sqrt(3.0), rel=0.25)
    ratio = deviation(band(1.95, 2.05)) / deviation(band(0.95, 1.05))
    assert ratio == pytest.approx(4.0, rel=0.3)


def test_noise_is_of_the_frame_and_dead_columns_are_of_the_episode(world, robots):
    later = robots.replace(step=robots.step + 1)
    (_, first), (_, second) = (misread(world, s, depth_noise=0.01) for s in (robots, later))
    assert (first != second).any(axis=(1, 2)).all()
    (_, first), (_, second) = (misread(world, s, depth_dead=0.5) for s in (robots, later))
    np.testing.assert_array_equal(first, second)


def test_holes_cover_no_more_than_their_share():
    keys = jax.random.split(jax.random.key(0), 200)
    holes = jax.vmap(lambda k: depth_faults.sample_holes(k, SHAPE, jnp.float32(0.2)))(keys)
    covered = np.asarray(holes).mean(axis=(1, 2))
    assert covered.max() < 0.21 and 0.08 < covered.mean() < 0.2  # less where two overlap
    assert not depth_faults.sample_holes(keys[0], SHAPE, jnp.float32(0.0)).any()


def test_a_narrow_view_misses_what_the_whole_robots_does():
    ours = depth_faults._outside_narrow_view(C.camera)
    whole = disturbances.find_outside(SHAPE, C.camera.view, config.NARROW_VIEW)
    np.testing.assert_array_equal(np.broadcast_to(ours, SHAPE), whole)
    assert ours[0].sum() == 12  # |u| > tan 37.5 / tan 43.5 = 0.809: six on each side of 64


def test_images_have_faults_where_the_randomisation_has(world, robots):
    c = config.override(C, {"randomisation": {"enabled": True, "depth_noise": 0.02}})
    state = one(robots).replace(spread=even_spread(jnp.ones(())))
    image = lambda c: np.asarray(environment.depth_image(world.replace(config=c), state))
    clean = dataclasses.replace(c.randomisation, enabled=False)
    assert (image(c) != image(dataclasses.replace(c, randomisation=clean))).mean() > 0.3
