"""Notebooks 00, 06, 09 and 10: reconstructed meshes, rendered with their own colours as the synthetic bodies are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.figures import overlay
from p2p_lib.figures.overlay import OrientedBox
from p2p_lib.synthetic.render import Light, render
from p2p_lib.synthetic.shapes import Mesh

if TYPE_CHECKING:
    import trimesh

#: A reconstructed surface carries the light it was seen in: no second one.
_AS_SEEN = Light(ambient=1.0)
#: Towards the lamp of a clay model in camera coordinates: over the left shoulder.
_LAMP, _CLAY = np.array([-0.7, -0.6, -0.5]), 225


def draw_mesh(mesh: trimesh.Trimesh | Mesh, camera: Camera, T_cam_obj: np.ndarray, clay: bool = False) -> np.ndarray:
    """A mesh on white, (H, W, 3) uint8: a reconstructed one with its vertex colours, or a synthetic body.

    ``clay`` leaves the colours out: what remains is the shape.
    """
    body = mesh if isinstance(mesh, Mesh) else as_body(mesh)
    if clay:
        body = replace(body, texture=np.full((2, 2, 3), _CLAY, np.uint8))
    lamp = Light(towards=tuple(T_cam_obj[:3, :3].T @ _LAMP), ambient=0.3) if clay else _AS_SEEN
    drawn = render([(body, se3.IDENTITY)], camera, se3.inverse(T_cam_obj), lamp)
    image = np.where((drawn.label > 0)[..., None], drawn.rgb, 255)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def as_body(mesh: trimesh.Trimesh) -> Mesh:
    """A reconstructed surface for the renderer: a texel per face, the mean of its corners; shaded by their normals."""
    faces = np.asarray(mesh.faces)
    side = int(np.ceil(np.sqrt(len(faces))))
    texture = np.zeros((side, side, 3), np.uint8)
    visual: Any = mesh.visual  # of vertices
    colours = np.asarray(visual.vertex_colors)[:, :3]
    row, column = np.divmod(np.arange(len(faces)), side)
    texture[row, column] = colours[faces].mean(1)
    uv = np.stack([(column + 0.5) / side, 1 - (row + 0.5) / side], -1)
    normals = np.asarray(mesh.vertex_normals)[faces]
    vertices = np.asarray(mesh.vertices, float)
    return Mesh(vertices, faces, np.repeat(uv[:, None], 3, 1), texture, normals)


def portrait(
    mesh: trimesh.Trimesh | Mesh,
    width_px: int,
    height_px: int,
    turn_deg: float = 25.0,
    filling: np.ndarray | None = None,
) -> np.ndarray:
    """A surface from slightly above; ``turn_deg`` about the vertical, 0 as it was first seen.

    filling  (V, 3) what fills the image, by default the surface itself
    """
    filling = np.asarray(mesh.vertices if filling is None else filling)
    centre = OrientedBox.around(filling).T_obj_box[:3, 3]
    radius_m = float(np.linalg.norm(filling - centre, axis=1).max())
    focal_px = 1.4 * min(height_px, width_px)
    camera = Camera(focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2, width_px, height_px)
    tilt, turn = se3.exp(np.radians(np.array([[25.0, 0, 0, 0, 0, 0], [0, turn_deg, 0, 0, 0, 0]])))
    away, centred = se3.from_rt(np.eye(3), np.array([0, 0, 3.2 * radius_m])), se3.from_rt(np.eye(3), -centre)
    return draw_mesh(mesh, camera, away @ tilt @ turn @ centred)


def portraits(meshes: Mapping[str, trimesh.Trimesh], turns_deg: Sequence[float] = (-70, 0, 70, 180)) -> np.ndarray:
    """Every surface from several sides, a row each."""
    sides = [
        overlay.draw_caption(portrait(mesh, 300, 260, turn), f"{name}, {turn:+g} deg")
        for name, mesh in meshes.items()
        for turn in turns_deg
    ]
    return overlay.montage(sides, columns=len(turns_deg))
