import numpy as np
import pytest

from cref_jax import config, geoms, robot
from cref_jax.live import ground_mesh, robot_mesh
from cref_jax.live.matte import make_matte
from cref_jax.whole_body import scene_files
from cref_jax.whole_body.ground import MARGIN, Lane

STEP = Lane(np.repeat([[0.0], [0.2]], 50, axis=0) + np.zeros((100, 50)), np.zeros(2), 0.02, 9.0)


def test_the_top_of_a_lane_is_as_high_as_its_columns():
    """Two boxes: half of 2 m at 0 and half at 20 cm, with a border of 4 m."""
    mesh = ground_mesh.build_mesh(STEP)
    tops = mesh.face_normals[:, 2] > 0.999
    height, area = mesh.triangles_center[tops, 2], mesh.area_faces[tops]
    side = 1.0 + MARGIN
    for z in (0.0, 0.2):
        across = 1.0 + 2.0 * MARGIN
        assert area[np.isclose(height, z)].sum() == pytest.approx(side * across)
    assert area.sum() == pytest.approx(2 * side * across)


def test_neighbouring_fields_have_the_two_tones_of_the_floor():
    mesh = ground_mesh.build_mesh(STEP)
    tops = mesh.face_normals[:, 2] > 0.999
    tones = np.unique(mesh.visual.face_colors[tops, :3], axis=0)
    expected = np.round(255.0 * np.array(sorted(geoms.TONES)))
    np.testing.assert_array_equal(tones, expected)


def test_a_scene_is_drawn_as_high_as_it_is():
    mesh = ground_mesh.build_mesh(scene_files.load_named("posts"))
    solids = scene_files.load_named("posts").solids
    assert len(mesh.faces) > 12 * len(solids)
    assert mesh.bounds[0, 2] == pytest.approx(-1.1)  # m, the underside of the floor


def test_every_link_has_a_mesh_of_its_own_size():
    """The pelvis is a capsule: its mesh reaches as far as its ends and its radius."""
    c = config.Config()
    model = robot.spec("all", c.physics, 0, visual=True, name=c.robot.name).compile()
    links = robot_mesh.build_links(model)
    seen = {int(model.geom_bodyid[i]) for i in range(model.ngeom) if model.geom_group[i] == 2}
    assert set(links) == seen
    assert sum(len(mesh.faces) for mesh in links.values()) < 30_000
    geom = next(i for i in range(model.ngeom) if model.geom_group[i] == 2)
    reach = np.linalg.norm(links[int(model.geom_bodyid[geom])].vertices, axis=1).max()
    radius, half = model.geom_size[geom, :2]
    assert reach == pytest.approx(np.linalg.norm(model.geom_pos[geom]) + radius + half, rel=0.05)


def test_a_matte_mesh_keeps_its_colours():
    mesh = ground_mesh.build_mesh(STEP)
    matte = make_matte(mesh)
    assert matte.visual.material.metallicFactor == 0.0
    palette = np.asarray(matte.visual.material.baseColorTexture)[0]
    column = np.floor(matte.visual.uv[:, 0] * len(palette)).astype(int)
    np.testing.assert_array_equal(palette[column], mesh.visual.vertex_colors[:, :3])
