"""Tangent planes: the measured surface around pixels, from the depth image, and its projection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.types import Rows

#: Half the window in which the surface around a pixel is taken for a plane, in steps.
_HALF_WINDOW = 3
#: Readings farther from the pixel's own depth, then from the plane, belong to another surface (m per step).
_REACH_M, _OFF_PLANE_M = 0.015, 0.006
#: Fewer readings do not make a plane.
_MIN_READINGS = 8


@dataclass(frozen=True, eq=False)
class TangentPlanes(Rows):
    """The measured surface at N pixels.

    p_cam    (N, 3) NaN where there is no trustworthy depth
    per_px   (N, 3, 2) displacement on the plane per pixel
    sigma_m  (N,) standard deviation along the optical axis
    """

    p_cam: np.ndarray
    per_px: np.ndarray
    sigma_m: np.ndarray


def planes_at(depth_m: np.ndarray, camera: Camera, uv_px: np.ndarray, step_px: int = 1) -> TangentPlanes:
    """The planes behind pixels (N, 2): least squares through the readings around each that lie on its surface.

    step_px  between the 7 x 7 readings
    """
    uv = np.asarray(uv_px, float)
    px = np.rint(uv).astype(int)
    dy, dx = (step_px * a.ravel() for a in np.mgrid[-_HALF_WINDOW : _HALF_WINDOW + 1, -_HALF_WINDOW : _HALF_WINDOW + 1])
    h, w = depth_m.shape
    x, y = px[:, :1] + dx, px[:, 1:] + dy
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    z = np.where(inside, depth_m[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)], 0).astype(float)
    # Depth of the pixel itself, else of the nearest one that has any.
    nearest = np.argsort(dx**2 + dy**2, kind="stable")[:21]
    z0 = z[np.arange(len(uv)), nearest[(z[:, nearest] > 0).argmax(1)]]
    # Moments about the pixel itself: the plane's first parameter is the depth there.
    basis = np.stack([np.ones_like(x, float), x - uv[:, :1], y - uv[:, 1:]], -1)
    off, limit = z - z0[:, None], _REACH_M * step_px
    for _ in range(2):
        use = (z > 0) & (np.abs(off) < limit)
        weighted = basis * use[..., None]
        normal = weighted.transpose(0, 2, 1) @ basis + np.diag([1e-3, 3.0, 3.0])
        plane = np.linalg.solve(normal, (weighted * (z - z0[:, None])[..., None]).sum(1)[..., None])[..., 0]
        off, limit = z - z0[:, None] - (basis * plane[:, None]).sum(-1), _OFF_PLANE_M
    count = use.sum(1)
    known = (z0 > 0) & (count >= _MIN_READINGS)
    at_m = np.where(known, z0 + plane[:, 0], np.nan)
    spread = np.sqrt((use * off**2).sum(1) / np.maximum(count, 1))
    rays = np.column_stack([(uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, np.ones(len(uv))])
    across = np.array([[1 / camera.fx, 0], [0, 1 / camera.fy], [0, 0]])
    per_px = across * at_m[:, None, None] + rays[:, :, None] * plane[:, None, 1:]
    # Neighbouring readings share their noise; where the plane does not fit, the depth is uncertain by the misfit.
    return TangentPlanes(rays * at_m[:, None], per_px, np.hypot(0.7 * depth_noise_m(at_m), spread))


def projection(camera: Camera, p_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of points (N, 3) and their Jacobian (N, 2, 3)."""
    z = np.maximum(p_cam[:, 2], 0.05)
    uv = p_cam[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    J = np.zeros((len(z), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = camera.fx / z, camera.fy / z
    J[:, 0, 2], J[:, 1, 2] = -(uv[:, 0] - camera.cx) / z, -(uv[:, 1] - camera.cy) / z
    return uv, J


def tangent_steps(planes: TangentPlanes, camera: Camera, step_m: float) -> np.ndarray:
    """(N, 2, 2) pixels per step of a square grid on each tangent plane, step_m apart."""
    u, v = planes.per_px[..., 0], planes.per_px[..., 1]
    a = u / np.linalg.norm(u, axis=1, keepdims=True)
    b = v - (a * v).sum(1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return step_m * (projection(camera, planes.p_cam)[1] @ np.stack([a, b], -1))


def lifted_cov(
    camera: Camera, uv_px: np.ndarray, z_m: np.ndarray, cov_px2: np.ndarray, sigma_m: np.ndarray
) -> np.ndarray:
    """(N, 3, 3) covariance, camera's axes, of points lifted from uv_px, known up to cov_px2, at z_m, up to sigma_m."""
    G = np.zeros((len(uv_px), 3, 3))
    G[:, 0, 0], G[:, 1, 1], G[:, 2, 2] = z_m / camera.fx, z_m / camera.fy, 1
    G[:, 0, 2], G[:, 1, 2] = (uv_px[:, 0] - camera.cx) / camera.fx, (uv_px[:, 1] - camera.cy) / camera.fy
    cov = np.zeros((len(uv_px), 3, 3))
    cov[:, :2, :2], cov[:, 2, 2] = cov_px2, sigma_m**2
    return G @ cov @ G.transpose(0, 2, 1)
