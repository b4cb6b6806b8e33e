"""Structures beside the lane: where they are, and that the camera alone sees them."""

import jax
import jax.numpy as jnp
import numpy as np
from small_world import C, one

from cref_jax import config, terrain
from cref_jax.env import environment, structures
from cref_jax.env.state import even_spread

SIX = config.override(C, {"randomisation": {"structures": 6}})


def drawn(world, states, count=64):
    world = world.replace(config=SIX)
    draw = jax.jit(jax.vmap(lambda s: structures.sample_structures(world, s)))
    return np.asarray(draw(one(states, np.arange(count))))


def test_half_of_them_are_there_and_none_is_in_the_way(world, fresh_states):
    found = drawn(world, fresh_states)
    assert found.shape == (64, 6, 7)
    is_there = found[..., 2] > -50.0
    assert 0.4 < is_there.mean() < 0.6
    start, end, radius = found[..., :3], found[..., 3:6], found[..., 6]
    crosses = is_there & (np.sign(start[..., 1]) != np.sign(end[..., 1]))
    beside = is_there & ~crosses
    nearest = np.minimum(np.abs(start[..., 1]), np.abs(end[..., 1])) - radius
    assert nearest[beside].min() >= structures.FREE - 1e-6
    assert (nearest[beside] < 0.6).any() and (start[..., 1][beside] > 0).any()
    assert crosses.any()


def test_while_nothing_is_randomised_there_are_none(world, fresh_states):
    states = fresh_states.replace(spread=even_spread(jnp.zeros(512)))
    assert (drawn(world, states)[..., 2] < -50.0).all()


def test_those_that_cross_hang_above_the_robot(world, fresh_states):
    states, found = one(fresh_states, np.arange(64)), drawn(world, fresh_states)
    crosses = (found[..., 1] * found[..., 4] < 0) & (found[..., 2] > -50.0)
    for e, k in np.argwhere(crosses):
        ground = world.lanes.tile(states.level[e], states.kind[e], states.variant[e])
        height = float(terrain.height_at(ground, jnp.array([found[e, k, 0], 0.0])))
        assert 1.4 - 1e-4 <= found[e, k, 2] - height <= 2.0 + 1e-4


def test_an_episode_keeps_its_structures_and_the_next_has_others(world, robots):
    later = robots.replace(
        step=robots.step + 100, body=robots.body._replace(qpos=robots.body.qpos + 1.0)
    )
    world = world.replace(config=SIX)
    draw = jax.jit(jax.vmap(lambda s: structures.sample_structures(world, s)))
    np.testing.assert_array_equal(draw(robots), draw(later))
    other = robots.replace(start=robots.start + 1e-3)
    assert (np.asarray(draw(robots)) != np.asarray(draw(other))).any(axis=(1, 2)).all()


def test_the_camera_sees_them_nearer_than_the_ground_and_no_one_else_does(world, robots):
    render = lambda c: jax.jit(jax.vmap(environment.render_depth, in_axes=(None, 0)))(
        world.replace(config=c), robots
    )
    many = config.override(C, {"randomisation": {"structures": 40}})
    before, after = np.asarray(render(C)), np.asarray(render(many))
    assert (after <= before + 1e-6).all() and (after < before - 0.05).any(axis=(1, 2)).any()
    off = config.override(many, {"randomisation": {"enabled": False}})
    np.testing.assert_array_equal(render(off), before)


def test_no_structure_is_drawn_with_the_key_of_the_faults_of_depth(world, fresh_states):
    # split(key, 8)[1] is fold_in(key, 1)
    key = lambda salt: structures.episode_key(world, one(fresh_states), salt)
    data = lambda keys: {tuple(x) for x in np.asarray(jax.random.key_data(keys))}
    assert not data(jax.random.split(key(0), 8)) & data(key(1)[None])
    assert data(jax.random.split(key(0), 8)) & data(jax.random.fold_in(key(0), 1)[None])
