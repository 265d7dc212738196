"""Meshes from the fused volume: marching cubes, vertex colours, components, PLY and GLB."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replacing

if TYPE_CHECKING:
    import trimesh


def extract(
    value: np.ndarray, colours: np.ndarray, origin_m: np.ndarray, voxel_m: float, min_component: float
) -> trimesh.Trimesh:
    """The zero-crossing surface of a volume (paper: marching cubes on V(v) = 0), in metres.

    value     (nx, ny, nz) of the voxels, NaN where unobserved; voxel (0, 0, 0) is at origin_m (3,)
    colours   (nx, ny, nz, 4) sums of weighted red, green, blue, and of the weights

    Only cells whose eight voxels were observed are meshed. Connected components with less than ``min_component`` of the
    largest one's area are removed: depth noise. Faces wind so that normals point outwards. An empty volume gives an
    empty mesh.
    """
    import trimesh

    vertices, faces = _marching_cubes(value.copy())
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if len(faces):
        component = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(faces))
        area = np.bincount(component, mesh.area_faces)
        mesh.update_faces((area >= min_component * area.max())[component])
        mesh.remove_unreferenced_vertices()
        visual: Any = mesh.visual
        visual.vertex_colors = _colours(colours, mesh.vertices)
        mesh.vertices = origin_m + voxel_m * mesh.vertices
    return mesh


def save(mesh: trimesh.Trimesh, path: str | Path) -> Path:
    """Write a mesh as ``.ply`` or ``.glb`` (by the name's ending), making its folder.

    Raises :class:`BadInput` for any other ending or a mesh without faces.
    """
    path = Path(path)
    if path.suffix.lower() not in (".ply", ".glb"):
        raise BadInput("mesh file", path.name, "a name that ends in .ply or .glb")
    if len(mesh.faces) == 0:
        raise BadInput("mesh", "no faces", "a mesh of an observed surface", "Integrate at least one keyframe first.")
    with replacing(path) as file:
        mesh.export(file, file_type=path.suffix[1:].lower())
    return path


def _marching_cubes(value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in array indices (N, 3) and faces (M, 3), over fully observed cells."""
    from skimage.measure import marching_cubes

    cells = ~np.isnan(value)
    value[~cells] = 1.0
    for axis in range(3):  # scikit-image looks at the mask of a cell's last corner only
        cells = cells & np.roll(cells, 1, axis)
    try:
        vertices, faces, _, _ = marching_cubes(
            value, 0.0, mask=cells, gradient_direction="descent", allow_degenerate=False
        )
    except (RuntimeError, ValueError):  # nothing is observed, or the surface crosses no cell that is
        return np.zeros((0, 3)), np.zeros((0, 3), int)
    return vertices.astype(float), faces.astype(int)


def _colours(sums: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(N, 3) uint8 at array indices (N, 3): between the two voxels of each vertex's edge, by weight."""
    low, high = np.floor(vertices).astype(int), np.ceil(vertices).astype(int)
    share = (vertices - low).max(1)[:, None]
    mixed = sums[tuple(low.T)] * (1 - share) + sums[tuple(high.T)] * share
    rgb = mixed[:, :3] / np.maximum(mixed[:, 3:], 1e-6)
    return np.clip(np.round(rgb), 0, 255).astype(np.uint8)
