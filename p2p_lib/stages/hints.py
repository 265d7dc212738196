"""What tracking knows of an object before a frame is segmented."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.stages.refinement import Surface

#: Every how many pixels a picture's depth is held against the surface.
_STRIDE = 2


@dataclass(frozen=True, eq=False)
class Hint:
    """Where an object should be, in plain values; empty where nothing is known.

    uv_px       (K, 2) its tracked points whose measured places agree with one rigid motion
    distance_m  (H, W) float32: signed distance of each measured pixel to the object's reconstructed surface
                at the pose those points give, positive in front of it; NaN where unknown. None without a surface
    """

    uv_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    distance_m: np.ndarray | None = None


def surface_distance(
    surface: Surface, corners_obj: np.ndarray, depth_m: np.ndarray, camera: Camera, T_cam_obj: np.ndarray
) -> np.ndarray:
    """(H, W) float32 of :class:`Hint`, from every second pixel where the surface can be seen.

    corners_obj (8, 3) bound the surface in the object frame.
    """
    distance = np.full(depth_m.shape, np.nan, np.float32)
    uv = camera.project(se3.transform(T_cam_obj, corners_obj))
    if not np.isfinite(uv).all():
        return distance
    size = np.array(depth_m.shape[::-1])
    (left, top), (right, bottom) = np.clip([uv.min(0), uv.max(0) + 1], 0, size).astype(int)
    v, u = np.mgrid[top:bottom:_STRIDE, left:right:_STRIDE]
    z = depth_m[v, u]
    p_obj = se3.transform(se3.inverse(T_cam_obj), camera.unproject(np.stack([u, v], -1), z).reshape(-1, 3))
    value, known = surface.query(p_obj)
    found = np.where(known & (z.ravel() > 0), value, np.nan).reshape(z.shape)
    coarse = np.repeat(np.repeat(found, _STRIDE, 0), _STRIDE, 1)
    distance[top:bottom, left:right] = coarse[: bottom - top, : right - left]
    return distance
