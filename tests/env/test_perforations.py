"""Holes in the ground that the camera alone sees."""

import jax
import jax.numpy as jnp
import numpy as np
from small_world import C, one

from cref_jax import config, depth
from cref_jax.env import environment, perforations
from cref_jax.env.state import even_spread

D_MAX = C.camera.d_max
HOLES = config.override(C, {"randomisation": {"perforations": 0.04}})


def render(world, c, states):
    """Return the images, m, of robots in the world with these settings."""
    draw = jax.jit(jax.vmap(environment.render_depth, in_axes=(None, 0)))
    return np.asarray(draw(world.replace(config=c), states))


def test_a_pixel_lies_where_its_ray_meets_the_ground():
    down = jnp.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).T
    metres, above = jnp.full(C.camera.shape, 2.0), jnp.array([3.0, 1.0, 2.5])
    points = np.stack(depth.locate_pixels(metres, above, down, C.camera), axis=-1)
    np.testing.assert_allclose(points[..., 2], 0.5, atol=1e-6)
    np.testing.assert_allclose(points.mean((0, 1)), [3.0, 1.0, 0.5], atol=1e-5)
    reach = 2.0 * np.tan(np.radians(0.5 * np.array(C.camera.view))) * (1 - 1 / np.array([48, 64]))
    # the first row is ahead, and the first column to the left
    np.testing.assert_allclose(points[0, 0, :2] - [3.0, 1.0], reach, rtol=1e-5)


def test_half_of_the_robots_see_holes_whose_depth_is_that_of_a_level_below(world, fresh_states):
    states = one(fresh_states, np.arange(64))
    before, after = render(world, C, states), render(world, HOLES, states)
    assert (after >= before - 1e-5).all()
    is_hole = after > before + 1e-3
    has_holes = is_hole.any((1, 2))
    assert 0.3 < has_holes.mean() < 0.7
    share = is_hole[has_holes].mean((1, 2))
    assert 0.05 < np.median(share) < 0.6 and share.max() < 0.9
    e = np.flatnonzero(has_holes)[0]
    at = is_hole[e] & (after[e] < D_MAX)
    state = one(states, e)
    place = depth.pose(
        world.physics.links(state.body),
        world.physics.robot.camera,
        C.camera,
        state.camera_pitch,
        state.camera_shift,
    )
    top, low = (
        np.asarray(depth.locate_pixels(jnp.asarray(x[e]), *place, C.camera)[2])[at]
        for x in (before, after)
    )
    np.testing.assert_allclose(top - low, (top - low).mean(), atol=1e-4)
    assert perforations.BELOW[0] <= (top - low).mean() <= perforations.BELOW[1]


def test_a_riser_is_open_up_to_the_pixel_below_the_tread():
    x = jnp.array([2.7, 2.5, 2.31, 2.3, 2.3, 2.25, 2.1])[:, None]  # m, from the first row on
    z = jnp.array([0.30, 0.30, 0.28, 0.22, 0.16, 0.15, 0.15])[:, None]
    found = perforations._is_on_riser(x, jnp.zeros_like(x), z)[:, 0]
    np.testing.assert_array_equal(found, [0, 0, 0, 1, 1, 0, 0])
    x, y, z = jnp.array([[2.0], [2.0]]), jnp.array([[0.25], [0.0]]), jnp.array([[0.25], [0.0]])
    assert not perforations._is_on_riser(x, y, z).any()  # as far aside as up: 45 degrees


def test_steps_without_risers_show_a_level_below(world, fresh_states, monkeypatch):
    monkeypatch.setattr(perforations, "SHARE", 1.0)
    monkeypatch.setattr(perforations, "OPEN_STAIRS", 1.0)
    monkeypatch.setattr(perforations, "WEBS", (1e3, 1e3))  # holes in risers alone
    up = world.lanes.kinds.index("stairs_up")
    on_top_level = (fresh_states.kind == up) & (fresh_states.level == 2)
    states = one(fresh_states, np.flatnonzero(on_top_level)[:16])
    is_open = render(world, HOLES, states) > render(world, C, states) + 1e-3
    flat = one(
        fresh_states, np.flatnonzero(fresh_states.kind == world.lanes.kinds.index("flat"))[:16]
    )
    is_open_there = render(world, HOLES, flat) > render(world, C, flat) + 1e-3
    assert is_open.mean((1, 2)).min() > 0.1
    assert np.median(is_open_there.mean((1, 2))) == 0


def test_links_have_no_holes(world, robots):
    without = jax.jit(
        jax.vmap(lambda w, s: environment.render_depth(w, s, with_links=False), in_axes=(None, 0))
    )
    robots = robots.replace(camera_pitch=jnp.full_like(robots.camera_pitch, 0.5))  # down at feet
    before = render(world, C, robots)
    is_link = before < np.asarray(without(world, robots)) - 0.05
    assert is_link.any()
    seen = render(world, HOLES, robots)
    np.testing.assert_allclose(seen[is_link], before[is_link], atol=1e-4)


def test_lanes_of_other_kinds_are_whole_and_undisturbed_robots_see_holes(world, fresh_states):
    states = one(fresh_states, np.arange(128)).replace(spread=even_spread(jnp.zeros(128)))
    only = config.override(HOLES, {"terrain": {"slit_kinds": ("stairs_up",)}})
    changed = (render(world, only, states) > render(world, C, states) + 1e-3).any((1, 2))
    kinds = {world.lanes.kinds[k] for k in np.asarray(states.kind)[changed]}
    assert kinds == {"stairs_up"}


def test_an_episode_keeps_its_holes_and_none_are_seen_where_nothing_is_randomised(world, robots):
    later = robots.replace(step=robots.step + 100)
    np.testing.assert_array_equal(render(world, HOLES, robots), render(world, HOLES, later))
    off = config.override(HOLES, {"randomisation": {"enabled": False}})
    np.testing.assert_array_equal(render(world, off, robots), render(world, C, robots))
