"""The meshes and poses of the comparison with another ray-cast."""

import jax.numpy as jnp
import numpy as np

from cref_jax import config, terrain
from cref_jax.benchmarks import warp_raycast

STEP = np.repeat([[0.0], [0.0], [0.2], [0.2]], 3, axis=1)  # m, up by 20 cm half way


def area(mesh, normal):
    """Return the area of the triangles that face along `normal`."""
    a, b, c = (mesh.points[mesh.triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    size = np.linalg.norm(cross, axis=1)
    facing = np.abs(cross @ np.asarray(normal)) > 0.999 * size
    return 0.5 * size[facing].sum()


def test_boxes_have_vertical_risers_and_level_treads():
    mesh = warp_raycast.box_mesh(STEP, np.zeros(2), 0.1)
    # two boxes of 20 x 30 cm: top and bottom of each, 4 x 0.06 m^2
    np.testing.assert_allclose(area(mesh, (0, 0, 1)), 0.24, atol=1e-6)
    # fronts and backs, 30 cm wide, from 0.1 m under the ground: 2 x 0.3 x (0.1 + 0.3)
    np.testing.assert_allclose(area(mesh, (1, 0, 0)), 0.24, atol=1e-6)
    assert len(mesh.triangles) == 2 * 12


def test_a_grid_has_two_triangles_between_four_columns():
    mesh = warp_raycast.grid_mesh(STEP, np.zeros(2), 0.1)
    assert len(mesh.points) == 12 and len(mesh.triangles) == 3 * 2 * 2
    # level parts: between the first two rows of columns and the last two, 0.1 x 0.2 m^2 each
    np.testing.assert_allclose(area(mesh, (0, 0, 1)), 0.04, atol=1e-6)


def test_our_renderers_are_compared_on_the_same_image(monkeypatch):
    monkeypatch.setattr(warp_raycast, "CAMERAS", 4)
    monkeypatch.setattr(warp_raycast, "REPEATS", 1)
    monkeypatch.setattr(warp_raycast.importlib.util, "find_spec", lambda name: None)
    heights = np.repeat(np.floor(np.arange(200) / 15)[:, None] * 0.15, 60, axis=1)
    ground = terrain.from_heights(jnp.asarray(heights), 0.02, (0.0, -0.6))
    march, sweep, cast = warp_raycast.compare_renderers(
        ground, config.Camera(pitch=50.0), is_profile=True
    )
    assert march.agreement == 1.0 and sweep.agreement > 0.999 and cast.agreement > 0.99
    assert march.frames_per_second > 0 and sweep.threads == "all"
