"""From pixels to 3D: lift tracked points with the depth picture (paper: section "Sampling Strategy")."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame


def lift(frame: Frame, uv_px: np.ndarray, camera: Camera, range_m: tuple[float, float], edge_m: float) -> np.ndarray:
    """Points p_cam (N, 3) behind pixels uv_px (N, 2); NaN rows where there is no trustworthy depth.

    Depth is the mean of the valid readings in the 3x3 neighbourhood that lie within ``edge_m`` of the
    nearest pixel's, which averages sensor noise without mixing two surfaces. Depth outside
    ``range_m`` = (nearest, farthest) is invalid.
    """
    p_cam = np.full((len(uv_px), 3), np.nan)
    rows = np.flatnonzero(camera.inside(uv_px))
    if not len(rows):
        return p_cam
    px = np.rint(uv_px[rows]).astype(int)
    offset = np.array([(0, 0), (-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)])
    x = np.clip(px[:, :1] + offset[:, 0], 0, camera.width - 1)
    y = np.clip(px[:, 1:] + offset[:, 1], 0, camera.height - 1)
    z = frame.depth_m[y, x].astype(float)
    same_surface = (z >= range_m[0]) & (z <= range_m[1]) & (np.abs(z - z[:, :1]) <= edge_m)
    ok = same_surface[:, 0]
    depth = (z * same_surface).sum(1)[ok] / same_surface.sum(1)[ok]
    p_cam[rows[ok]] = camera.unproject(uv_px[rows[ok]], depth)
    return p_cam
