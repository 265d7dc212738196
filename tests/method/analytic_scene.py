"""Exact shapes for the surface tests: signed distances, and depth pictures of them by sphere tracing."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera

Sdf = Callable[[np.ndarray], np.ndarray]

CAMERA = Camera(300.0, 310.0, 119.5, 89.5, 240, 180)


def ball(centre, radius: float) -> Sdf:
    return lambda p: np.linalg.norm(p - np.asarray(centre), axis=-1) - radius


def box(centre, half) -> Sdf:
    def sdf(p):
        d = np.abs(p - np.asarray(centre)) - np.asarray(half)
        return np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(-1), 0)

    return sdf


def can(radius: float, half_height: float) -> Sdf:
    """A cylinder about z with its lids."""

    def sdf(p):
        d = np.stack([np.hypot(p[..., 0], p[..., 1]) - radius, np.abs(p[..., 2]) - half_height], -1)
        return np.linalg.norm(np.maximum(d, 0), axis=-1) + np.minimum(d.max(-1), 0)

    return sdf


def union(*parts: Sdf) -> Sdf:
    return lambda p: np.min([part(p) for part in parts], axis=0)


#: A shape without any symmetry, off the origin: its surface determines all six directions.
LUMP = union(
    box((0.01, 0.0, 0.02), (0.03, 0.02, 0.045)),
    ball((0.035, 0.02, 0.04), 0.025),
    box((-0.02, 0.025, 0), (0.012, 0.02, 0.03)),
)


def render(sdf: Sdf, T_cam_obj: np.ndarray, camera: Camera = CAMERA) -> tuple[np.ndarray, np.ndarray]:
    """Depth (H, W) in metres, 0 where nothing is hit, and the mask of what is."""
    depth, mask = _render(sdf, np.ascontiguousarray(T_cam_obj, float).tobytes(), camera)
    return depth.copy(), mask.copy()


@lru_cache(maxsize=256)
def _render(sdf: Sdf, pose: bytes, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    T_cam_obj = np.frombuffer(pose).reshape(4, 4)
    rays = camera.rays.reshape(-1, 3).astype(float)
    length = np.linalg.norm(rays, axis=1)
    T_obj_cam = se3.inverse(T_cam_obj)
    z = np.full(len(rays), 0.05)
    gap = np.full(len(rays), np.inf)
    for _ in range(80):
        live = (z < 3.0) & (gap > 1e-6)
        gap[live] = sdf(se3.transform(T_obj_cam, rays[live] * z[live, None]))
        z[live] += gap[live] / length[live]
    hit = (z < 3.0) & (gap < 1e-4)
    shape = (camera.height, camera.width)
    return np.where(hit, z, 0.0).astype(np.float32).reshape(shape), hit.reshape(shape)


def look_from(direction, distance: float = 0.4, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """T_cam_obj of a camera ``distance`` metres from the object's origin in ``direction``, looking at it."""
    z = -np.asarray(direction, float) / np.linalg.norm(direction)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    return se3.from_rt(R, np.array([0.0, 0.0, distance]))


def around(n: int, distance: float = 0.4, height: float = 0.5) -> list[np.ndarray]:
    """n poses on a circle about the object's z axis."""
    angle = 2 * np.pi * np.arange(n) / n
    return [look_from((np.cos(a), np.sin(a), height), distance) for a in angle]
