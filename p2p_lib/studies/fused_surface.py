"""How good a fused surface is, against a body whose exact distance is known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import TsdfConfig
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.studies.turntable import Body, Shot, fuse

if TYPE_CHECKING:
    import trimesh


def exact_distance(volume: TsdfVolume, body: Body, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(fused, exact) signed distance in metres at points (..., 3), both NaN where nothing was observed.

    The exact one is cut off at the truncation distance, as the fused one is.
    """
    value, valid = volume.query(points)
    exact = np.clip(body.distance_m(points), -volume.tau_m, volume.tau_m)
    return np.where(valid, value, np.nan), np.where(valid, exact, np.nan)


def seen_points(body: Body, T_cam_obj: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(n, 3) points of a convex body's surface that face at least one of the cameras (m, 4, 4) by 75° or less."""
    p, normals = body.mesh.sample(count, rng)
    eyes = se3.inverse(T_cam_obj)[:, None, :3, 3] - p
    cosine = np.einsum("mni,ni->mn", eyes, normals) / np.linalg.norm(eyes, axis=-1)
    return p[(cosine > np.cos(np.radians(75))).any(0)]


def mesh_errors(mesh: trimesh.Trimesh, body: Body, seen: np.ndarray, rng: np.random.Generator) -> tuple[float, float]:
    """Mean distance in metres from the mesh to the exact surface, and from the seen points (n, 3) to the mesh."""
    import trimesh
    from scipy.spatial import cKDTree

    on_mesh, _ = trimesh.sample.sample_surface(mesh, 20000, seed=int(rng.integers(2**31)))
    to_mesh, _ = cKDTree(on_mesh).query(seen)
    return float(np.abs(body.distance_m(on_mesh)).mean()), float(to_mesh.mean())


def errors_by_keyframes(
    shots: Sequence[Shot], counts: Sequence[int], body: Body, config: TsdfConfig, seed: int = 0
) -> np.ndarray:
    """(len(counts), 2) mesh errors in metres, both ways, after so many of the shots, spread evenly.

    Completeness is always asked of everything that all shots together have seen.
    """
    rng = np.random.default_rng([seed, 5])
    seen = seen_points(body, np.stack([s.T_cam_obj for s in shots]), 6000, rng)
    picked = [np.linspace(0, len(shots), count, endpoint=False).astype(int) for count in counts]
    return np.array([mesh_errors(fuse([shots[k] for k in p], config).mesh(), body, seen, rng) for p in picked])


def drifted(T_cam_obj: np.ndarray, degrees: float, millimetres: float, rng: np.random.Generator) -> np.ndarray:
    """Poses (n, 4, 4) that drift away evenly, by so much at the last."""
    axis, along = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    share = np.linspace(0, 1, len(T_cam_obj))[:, None]
    return T_cam_obj @ se3.exp(share * np.r_[np.radians(degrees) * axis, millimetres / 1e3 * along])
