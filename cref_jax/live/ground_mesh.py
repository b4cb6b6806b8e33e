"""The ground as one mesh with fields of alternating tone, which make motion visible."""

from typing import NamedTuple

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float, Int, UInt8
from mjviser.conversions import create_primitive_mesh

from cref_jax import geoms
from cref_jax.whole_body.ground import Ground

FIELD = 0.5  # m, side of a field
SIDE = 0.78  # brightness of upright faces
SHADE = 0.55  # brightness of ground that lies `DEEP` or lower
DEEP = -0.5  # m, lower than any step of a stair that a robot begins on
PLAIN = (0.5, 0.5, 0.5)  # MuJoCo's colour of a geom that was given none


class _Quads(NamedTuple):
    """Rectangles with a colour each."""

    corners: Float[np.ndarray, "Q 4 3"]  # m, anticlockwise seen from outside
    colours: Float[np.ndarray, "Q 3"]


def build_mesh(ground: Ground) -> trimesh.Trimesh:
    """Build one mesh of all solids of a ground."""
    spec = mujoco.MjSpec()
    ground.add_to(spec, 1.0)
    model = spec.compile()
    quads, parts = [], []
    for i in range(model.ngeom):
        upright = np.abs(model.geom_quat[i, 0]) > 1.0 - 1e-9
        if model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX and upright:
            quads.append(_cut_box(model.geom_pos[i], model.geom_size[i], _tones(model, i)))
        else:
            parts.append(_place_solid(model, i))
    if quads:
        parts.append(_join_quads(_Quads(*map(np.concatenate, zip(*quads, strict=True)))))
    return trimesh.util.concatenate(parts)


def _tones(model: mujoco.MjModel, geom: int) -> Float[np.ndarray, "2 3"]:
    """Return the two tones of a geom's fields: the floor's, or two near its own colour."""
    colour = model.geom_rgba[geom, :3].astype(float)
    if model.geom_matid[geom] >= 0 or np.allclose(colour, PLAIN):
        return np.array(geoms.TONES)
    return np.stack([colour, 0.9 * colour])


def _cut_box(
    middle: Float[np.ndarray, "3"], half: Float[np.ndarray, "3"], tones: Float[np.ndarray, "2 3"]
) -> _Quads:
    """Cut the top of an upright box along the borders of the fields, and add its four sides."""
    low, high = middle - half, middle + half
    x, y = (_cut_line(low[axis], high[axis]) for axis in (0, 1))
    x0, y0 = (a.ravel() for a in np.meshgrid(x[:-1], y[:-1], indexing="ij"))
    x1, y1 = (a.ravel() for a in np.meshgrid(x[1:], y[1:], indexing="ij"))
    z = np.full_like(x0, high[2])
    across = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    top = np.stack([np.stack([a, b, z], axis=-1) for a, b in across], axis=1)
    field = np.floor((x0 + x1) / (2 * FIELD)) + np.floor((y0 + y1) / (2 * FIELD))
    colours = tones[field.astype(int) % 2] * (SHADE if high[2] < DEEP else 1.0)
    round_about = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
    sides = [
        [[*a, low[2]], [*b, low[2]], [*b, high[2]], [*a, high[2]]]
        for a, b in zip(round_about, [*round_about[1:], round_about[0]], strict=True)
    ]
    side_colours = np.tile(SIDE * tones.mean(axis=0), (4, 1))
    return _Quads(np.concatenate([top, sides]), np.concatenate([colours, side_colours]))


def _cut_line(low: float, high: float) -> Float[np.ndarray, " n"]:
    """Cut the interval, m, at every multiple of `FIELD` inside it."""
    inner = FIELD * np.arange(np.ceil(low / FIELD + 1e-6), np.floor(high / FIELD - 1e-6) + 1)
    return np.concatenate([[low], inner, [high]])


def _join_quads(quads: _Quads) -> trimesh.Trimesh:
    """Join rectangles to a mesh; no two share a vertex, so that edges stay sharp."""
    count = len(quads.corners)
    first: Int[np.ndarray, "Q 1"] = 4 * np.arange(count)[:, None]
    faces = np.concatenate([first + np.array(corners) for corners in ((0, 1, 2), (0, 2, 3))])
    colours = np.repeat(_to_rgba(quads.colours), 4, axis=0)
    corners = quads.corners.reshape(-1, 3)
    return trimesh.Trimesh(corners, faces, vertex_colors=colours, process=False)


def _place_solid(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Build the mesh of a solid that lies askew or is round."""
    mesh, rotation = create_primitive_mesh(model, geom), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
    mesh = mesh.apply_transform(pose)
    colours = np.repeat(_to_rgba(_tones(model, geom)[:1]), len(mesh.vertices), axis=0)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=colours, process=False)
    solid.unmerge_vertices()  # so that edges stay sharp
    return solid


def _to_rgba(colours: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 4"]:
    """Convert colours of 0 to 1 to bytes, opaque."""
    alpha = np.ones((len(colours), 1))
    return np.round(255.0 * np.clip(np.hstack([colours, alpha]), 0.0, 1.0)).astype(np.uint8)
