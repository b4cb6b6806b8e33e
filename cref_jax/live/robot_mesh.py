"""The robot's links as meshes of few triangles, which a machine without a GPU can draw as well."""

import mujoco
import numpy as np
import trimesh

ROUND = 16  # sides of a capsule
SHOWN_GROUP = 2  # geoms that are to be seen; contact spheres are in another


def build_links(model: mujoco.MjModel) -> dict[int, trimesh.Trimesh]:
    """Build the mesh of each body that is to be seen, in its own frame, by the body's number."""
    shown = [i for i in range(model.ngeom) if model.geom_group[i] == SHOWN_GROUP]
    parts: dict[int, list[trimesh.Trimesh]] = {}
    for geom in shown:
        parts.setdefault(int(model.geom_bodyid[geom]), []).append(_build_part(model, geom))
    return {body: trimesh.util.concatenate(meshes) for body, meshes in parts.items()}


def _build_part(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Build the mesh of a geom in its body's frame; faces share vertices where it is round."""
    size, create = model.geom_size[geom], trimesh.creation
    match model.geom_type[geom]:
        case mujoco.mjtGeom.mjGEOM_CAPSULE:
            mesh = create.capsule(2.0 * size[1], size[0], count=np.array([ROUND, ROUND]))
        case mujoco.mjtGeom.mjGEOM_ELLIPSOID:
            mesh = create.icosphere(subdivisions=2)
            mesh.apply_scale(size)
        case mujoco.mjtGeom.mjGEOM_BOX:
            mesh = create.box(2.0 * size)
            mesh.unmerge_vertices()
        case other:
            raise ValueError(f"a robot's visible geom must be a capsule, ellipsoid or box: {other}")
    pose, rotation = np.eye(4), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    mesh.apply_transform(pose)
    colour = np.round(255.0 * model.geom_rgba[geom]).astype(np.uint8)
    colours = np.tile(colour, (len(mesh.vertices), 1))
    return trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
