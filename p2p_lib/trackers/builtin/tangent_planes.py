"""The measured surface around pixels, as planes: what a depth picture says of points and of how they lie."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depth_noise_m

#: Half the window in which the surface around a pixel is taken for a plane, in steps.
_PLANE = 3
#: Readings that are farther from the nearest one, then from the plane, are of another surface; per step.
_REACH_M, _OFF_M = 0.015, 0.006
#: Fewer readings are no plane.
_READINGS = 8


def usual_camera(width: int, height: int) -> Camera:
    """A camera with the field of view that most depth cameras have about, for pictures of an unknown one."""
    return Camera(0.95 * width, 0.95 * width, (width - 1) / 2, (height - 1) / 2, width, height)


@dataclass(frozen=True, eq=False)
class Surface:
    """Measured surface at N pixels, as planes.

    p_cam    (N, 3) NaN where there is no trustworthy depth
    per_px   (N, 3, 2) displacement on the plane per pixel
    sigma_m  (N,) standard deviation along the optical axis
    """

    p_cam: np.ndarray
    per_px: np.ndarray
    sigma_m: np.ndarray

    def select(self, rows: np.ndarray) -> Surface:
        """The pixels at these rows or under this mask."""
        return Surface(self.p_cam[rows], self.per_px[rows], self.sigma_m[rows])


def surface_at(depth_m: np.ndarray, camera: Camera, uv_px: np.ndarray, step_px: int = 1) -> Surface:
    """The surface behind pixels (N, 2): planes through the readings around each that hang together with it.

    step_px  between the 7 x 7 readings
    """
    uv = np.asarray(uv_px, float)
    px = np.rint(uv).astype(int)
    dy, dx = (step_px * a.ravel() for a in np.mgrid[-_PLANE : _PLANE + 1, -_PLANE : _PLANE + 1])
    h, w = depth_m.shape
    x, y = px[:, :1] + dx, px[:, 1:] + dy
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    z = np.where(inside, depth_m[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)], 0).astype(float)
    # Of the pixel itself, else of the nearest that has one.
    nearest = np.argsort(dx**2 + dy**2, kind="stable")[:21]
    z0 = z[np.arange(len(uv)), nearest[(z[:, nearest] > 0).argmax(1)]]
    # The plane at the pixel itself: moments about it.
    basis = np.stack([np.ones_like(x, float), x - uv[:, :1], y - uv[:, 1:]], -1)
    off, limit, plane = z - z0[:, None], _REACH_M * step_px, np.zeros((len(uv), 3))
    for _ in range(2):
        use = (z > 0) & (np.abs(off) < limit)
        weighted = basis * use[..., None]
        normal = weighted.transpose(0, 2, 1) @ basis + np.diag([1e-3, 3.0, 3.0])
        plane = np.linalg.solve(normal, (weighted * (z - z0[:, None])[..., None]).sum(1)[..., None])[..., 0]
        off, limit = z - z0[:, None] - (basis * plane[:, None]).sum(-1), _OFF_M
    count = use.sum(1)
    known = (z0 > 0) & (count >= _READINGS)
    at_m = np.where(known, z0 + plane[:, 0], np.nan)
    spread = np.sqrt((use * off**2).sum(1) / np.maximum(count, 1))
    rays = np.column_stack([(uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, np.ones(len(uv))])
    across = np.zeros((len(uv), 3, 2))
    across[:, 0, 0], across[:, 1, 1] = 1 / camera.fx, 1 / camera.fy
    per_px = across * at_m[:, None, None] + rays[:, :, None] * plane[:, None, 1:]
    # Readings nearby share their noise; where the plane does not fit, it is not known where the point is.
    return Surface(rays * at_m[:, None], per_px, np.hypot(0.7 * depth_noise_m(at_m), spread))


def projection(camera: Camera, p_cam: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) of points (N, 3) and their Jacobian (N, 2, 3)."""
    z = np.maximum(p_cam[:, 2], 0.05)
    uv = p_cam[:, :2] / z[:, None] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    J = np.zeros((len(z), 2, 3))
    J[:, 0, 0], J[:, 1, 1] = camera.fx / z, camera.fy / z
    J[:, 0, 2], J[:, 1, 2] = -(uv[:, 0] - camera.cx) / z, -(uv[:, 1] - camera.cy) / z
    return uv, J


def tangent_steps(surface: Surface, camera: Camera, step_m: float) -> np.ndarray:
    """(N, 2, 2) pixels per step of a square grid on each surface's tangent plane, step_m apart."""
    u = surface.per_px[..., 0]
    a = u / np.linalg.norm(u, axis=1, keepdims=True)
    v = surface.per_px[..., 1]
    b = v - (a * v).sum(1, keepdims=True) * a
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    return step_m * (projection(camera, surface.p_cam)[1] @ np.stack([a, b], -1))


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
