"""Meshes from the fused volume: marching cubes, vertex colours, components, PLY and GLB; the box around one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.files import replacing

if TYPE_CHECKING:
    import trimesh

#: What is thinner than this share of its length is flat, or a line.
_FLAT = 1e-6


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


def oriented_box(shape: trimesh.Trimesh | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The smallest box around a surface or points (N, 3), N > 0: T_box_obj (4, 4) and its three sides.

    Box axes stand in no order. trimesh searches among the faces of the convex hull, which a flat surface and points
    on a line lack: its plane is that of the principal axes.
    """
    import trimesh

    p = np.asarray(shape if isinstance(shape, np.ndarray) else shape.vertices, float)
    middle = p.mean(0)
    axes = np.linalg.eigh((p - middle).T @ (p - middle))[1][:, ::-1]
    axes *= np.sign(np.linalg.det(axes))
    along = (p - middle) @ axes
    thin = np.ptp(along, axis=0) <= _FLAT * np.ptp(along[:, 0])
    if not thin[2]:
        return trimesh.bounds.oriented_bounds(shape)
    T_box_obj = np.eye(4)
    T_box_obj[:3] = np.column_stack([axes.T, -axes.T @ middle])
    if not thin[1]:  # principal axes of a square are any: the smallest rectangle in its plane
        turn = trimesh.bounds.oriented_bounds(along[:, :2])[0]
        T_box_obj = trimesh.transformations.planar_matrix_to_3D(turn) @ T_box_obj
    q = p @ T_box_obj[:3, :3].T + T_box_obj[:3, 3]
    T_box_obj[:3, 3] -= (q.min(0) + q.max(0)) / 2
    return T_box_obj, np.ptp(q, axis=0)


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
