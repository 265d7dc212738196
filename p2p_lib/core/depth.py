"""Measured depth: its noise, its edges, and points lifted with it (paper: section "Sampling Strategy")."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import Frame

#: The 3x3 neighbourhood, its middle first: (9, 2) pixels.
_OFFSETS = np.array([(0, 0), (-1, -1), (0, -1), (1, -1), (-1, 0), (1, 0), (-1, 1), (0, 1), (1, 1)])
#: 1, x, y, xx, yy, xy of each, (9, 6).
_MOMENTS = np.stack([np.ones(9), *_OFFSETS.T, *_OFFSETS.T**2, _OFFSETS.prod(1)], -1)
# Holds the slope back where few or collinear readings would let noise choose it; nine readings outweigh it twelvefold.
_RIDGE = 0.5
#: What depth cameras have about: the built-in tracker and segmenter assume it of any.
USUAL = DepthConfig()


def depth_noise_m(z_m: np.ndarray, config: DepthConfig = USUAL) -> np.ndarray:
    """Standard deviation of depth measured at z_m: that of a depth sensor, growing with the range squared."""
    return config.noise_m + config.noise_per_m2 * z_m**2


def in_range(depth_m: np.ndarray, config: DepthConfig) -> np.ndarray:
    """(H, W) bool: measured, and neither too near nor too far."""
    return (depth_m >= config.min_m) & (depth_m <= config.max_m)


def off_edges(depth_m: np.ndarray, edge_m: float) -> np.ndarray:
    """(H, W) bool: the whole 3x3 neighbourhood is measured and holds no step larger than ``edge_m``."""
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth_m, around), cv2.dilate(depth_m, around)
    return (low > 0) & (high - low <= edge_m)


def depths_at(uv_px: np.ndarray, frame: Frame, radius: int = 2) -> np.ndarray:
    """(N,) median depth around each pixel (N, 2); NaN where nothing is measured."""
    d = np.arange(-radius, radius + 1)
    around = np.stack(np.meshgrid(d, d), -1).reshape(-1, 2)
    u, v = nearest_px(np.rint(uv_px)[:, None] + around, frame.shape)
    return np.ma.median(np.ma.masked_equal(frame.depth_m[v, u], 0), axis=1).astype(float).filled(np.nan)


def lift(frame: Frame, uv_px: np.ndarray, camera: Camera, config: DepthConfig) -> np.ndarray:
    """Points p_cam (N, 3) behind pixels uv_px (N, 2); NaN rows where there is no trustworthy depth.

    Depth is that of a plane, least squares through the readings in the 3x3 neighbourhood that lie within
    ``config.edge_m`` of the nearest pixel's: it averages sensor noise without mixing two surfaces, and gives a
    slanted surface its depth at the pixel's fraction too. Depth outside ``config.min_m`` to ``config.max_m`` is
    invalid.
    """
    p_cam = np.full((len(uv_px), 3), np.nan)
    rows = np.flatnonzero(camera.inside(uv_px))
    px = np.rint(uv_px[rows]).astype(int)
    last = [camera.width - 1, camera.height - 1]
    at = px[:, None] + _OFFSETS
    x, y = np.moveaxis(np.clip(at, 0, last), -1, 0)
    z = frame.depth_m[y, x].astype(float)
    same_surface = in_range(z, config) & (np.abs(z - z[:, :1]) <= config.edge_m)
    same_surface &= ((at >= 0) & (at <= last)).all(-1)
    ok = same_surface[:, 0]
    rows, uv = rows[ok], uv_px[rows[ok]]
    p_cam[rows] = camera.unproject(uv, _plane_depth(uv - px[ok], z[ok], same_surface[ok]))
    return p_cam


def _plane_depth(d_px: np.ndarray, z: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Depth (N,) at d_px (N, 2) from the middle, of planes through the readings z (N, 9) that are ``used``."""
    n, x, y, xx, yy, xy = (used @ _MOMENTS).T
    mean, xz, yz = ((z - z[:, :1]) * used @ _MOMENTS[:, :3]).T
    mean, x, y = mean / n, x / n, y / n
    xx, yy, xy = xx - n * x * x + _RIDGE, yy - n * y * y + _RIDGE, xy - n * x * y
    xz, yz = xz - n * x * mean, yz - n * y * mean
    slope = np.stack([yy * xz - xy * yz, xx * yz - xy * xz]) / (xx * yy - xy * xy)
    return z[:, 0] + mean + slope[0] * (d_px[:, 0] - x) + slope[1] * (d_px[:, 1] - y)
