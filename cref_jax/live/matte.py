"""Matte surfaces: glTF takes a mesh of vertex colours for metal, which is black without a room."""

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial


def make_matte(mesh: trimesh.Trimesh, is_smooth: bool = False) -> trimesh.Trimesh:
    """Return the mesh with its vertex colours as a texture of one pixel per colour.

    Faces that share vertices look smooth if `is_smooth`, else each face looks flat.
    """
    assert isinstance(mesh.visual, ColorVisuals)
    palette, which = np.unique(mesh.visual.vertex_colors, axis=0, return_inverse=True)
    uv = np.stack([(which.ravel() + 0.5) / len(palette), np.full(which.size, 0.5)], axis=1)
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(palette[None, :, :3]),
        metallicFactor=0.0,
        roughnessFactor=0.9,
    )
    visual = TextureVisuals(uv=uv, material=material)
    normals = mesh.vertex_normals if is_smooth else None
    return trimesh.Trimesh(
        mesh.vertices, mesh.faces, vertex_normals=normals, visual=visual, process=False
    )
