"""Pictures of reconstructed meshes: rendered with their own colours, as the synthetic bodies are."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.data.synthetic.render import Light, render
from p2p_lib.data.synthetic.shapes import Mesh

if TYPE_CHECKING:
    import trimesh

#: From the camera's upper left, and much of it from everywhere: colours stay recognisable.
_LIGHT = Light(towards=(-0.4, -0.5, 0.8), ambient=0.55)


def draw_mesh(mesh: trimesh.Trimesh | Mesh, camera: Camera, T_cam_obj: np.ndarray) -> np.ndarray:
    """A mesh on white, (H, W, 3) uint8: a reconstructed one with its vertex colours, or a synthetic body."""
    body = mesh if isinstance(mesh, Mesh) else _textured(mesh)
    picture = render([(body, se3.IDENTITY)], camera, se3.inverse(T_cam_obj), _LIGHT)
    image = np.where((picture.label > 0)[..., None], picture.rgb, 255)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _textured(mesh: trimesh.Trimesh) -> Mesh:
    """One texel per face, in the mean colour of its corners; shaded by vertex normals."""
    faces = np.asarray(mesh.faces)
    side = int(np.ceil(np.sqrt(len(faces))))
    texture = np.zeros((side, side, 3), np.uint8)
    colours = np.asarray(mesh.visual.vertex_colors)[:, :3]
    row, column = np.divmod(np.arange(len(faces)), side)
    texture[row, column] = colours[faces].mean(1)
    uv = np.stack([(column + 0.5) / side, 1 - (row + 0.5) / side], -1)
    normals = np.asarray(mesh.vertex_normals)[faces]
    vertices = np.asarray(mesh.vertices, float)
    return Mesh(vertices, faces, np.repeat(uv[:, None], 3, 1), texture, normals, closed=False)
