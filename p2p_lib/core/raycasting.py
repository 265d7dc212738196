"""Rays against triangle meshes, by Open3D's ray caster (Embree, float32)."""

from __future__ import annotations

from typing import Any

import numpy as np

from p2p_lib.core.native import load_open3d


def ray_scene(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """An Open3D ``RaycastingScene`` of one mesh (V, 3), (F, 3) in its own frame."""
    # One thread: frames and tests already run side by side.
    scene = load_open3d().t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(np.asarray(vertices, np.float32), np.asarray(faces, np.uint32))
    return scene


def cast(scene: Any, eye: np.ndarray, rays: np.ndarray) -> dict[str, np.ndarray]:
    """Open3D's answer for rays (N, 3) of any length from one eye (3,): ``t_hit``, ``primitive_ids`` and so on."""
    lines = np.empty((len(rays), 6), np.float32)
    lines[:, :3], lines[:, 3:] = eye, rays
    return {key: value.numpy() for key, value in scene.cast_rays(load_open3d().core.Tensor(lines)).items()}
