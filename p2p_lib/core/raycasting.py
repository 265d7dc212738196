"""Rays against triangle meshes, by Embree (float32)."""

from __future__ import annotations

from typing import Any

import numpy as np


def ray_scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """An Embree scene of one mesh (V, 3), (F, 3) in its own frame."""
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene, np.asarray(vertices, np.float32), np.asarray(faces, np.int32))
    return scene


def cast(scene: Any, eye: np.ndarray, rays: np.ndarray) -> dict[str, np.ndarray]:
    """Where rays (N, 3) of any length, from one eye (3,) or an eye each (N, 3), meet a scene first.

    ``t_hit`` (N,) is in lengths of the ray, infinite where it meets nothing; ``primitive_ids`` (N,) says which face, -1
    where none; ``primitive_normals`` (N, 3) is its unit normal by the order of its corners, 0 where none.
    """
    rays = np.asarray(rays, np.float32)
    eyes = np.array(np.broadcast_to(np.asarray(eye, np.float32), rays.shape))
    found = scene.run(eyes, rays, query="INTERSECT", output=True)
    met = found["primID"] >= 0
    normals = np.where(met[:, None], found["Ng"], np.float32(0))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float32).tiny)
    t_hit = np.where(met, found["tfar"], np.float32(np.inf))
    return {"t_hit": t_hit, "primitive_ids": found["primID"], "primitive_normals": normals}


def blocked(scene: Any, points: np.ndarray, way: np.ndarray) -> np.ndarray:
    """(N,) bool: whether a scene is met from points (N, 3) on in a direction (3,), a thousandth of it left out."""
    rays = np.tile(np.asarray(way, np.float32), (len(points), 1))
    return scene.run(np.asarray(points, np.float32) + np.float32(1e-3) * rays, rays) >= 0


class SurfaceDistance:
    """Distances from one mesh (V, 3), (F, 3): exact to the triangles that hold the nearest of many surface points."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, samples: int = 20_000, candidates: int = 6):
        import trimesh
        from scipy.spatial import cKDTree

        mesh = trimesh.Trimesh(vertices, faces, process=False)
        points, self._face = trimesh.sample.sample_surface(mesh, samples, seed=0)
        self._triangles, self._tree, self._candidates = mesh.triangles, cKDTree(points), candidates

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """How far points (N, 3) are from the surface (N,), inside or out."""
        from trimesh.triangles import closest_point

        _, sample = self._tree.query(points, self._candidates)
        near = np.repeat(points, self._candidates, 0)
        on = closest_point(self._triangles[self._face[sample.ravel()]], near)
        return np.linalg.norm(on - near, axis=1).reshape(sample.shape).min(1)
