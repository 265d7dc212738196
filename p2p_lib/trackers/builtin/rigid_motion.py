"""The pose of one rigid motion segment from its points, and the prediction of its points from its pose.

A point has a position on its segment and the map that takes offsets in its first template to offsets on the
surface there. The pose of the segment then predicts where the point is seen, how its surroundings are
warped, and whether its surface faces the camera. T_cam_seg means nothing outside the tracker: a segment's
frame is the camera's when the segment was started.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import compiled
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.trackers.builtin.tangent_planes import projection

#: Standard deviation of a segment's change of motion between frames: rad, m.
_PRIOR = np.diag(1 / np.repeat([0.15, 0.02], 3) ** 2)
#: Scale of the robust cost in variances, and its steps at most.
_SOFT, _ITERATIONS = 5.0, 8
#: Errors of positions that points share with their templates, px.
_SHARED_PX = 0.3
#: Squared residuals in variances up to which a point agrees with the pose: of its pixel, of its depth.
_AGREES_CHI2, _AGREES_DEPTH_CHI2 = 16, 25


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A segment's pose.

    T_cam_seg   (4, 4)
    covariance  (6, 6) of its rotation and translation, in the camera's axes, about ``centre`` (3,), on the segment
    agrees      (N,) bool: which of the points that it was fitted to agree with it
    """

    T_cam_seg: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray
    agrees: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))


def fit_pose(
    T_cam_seg: np.ndarray,
    p_seg: np.ndarray,
    map_cov: np.ndarray,
    uv_px: np.ndarray,
    cov_px2: np.ndarray,
    z_m: np.ndarray,
    camera: Camera,
) -> PoseFit:
    """The pose from points p_seg (N, 3), covariance map_cov (N, 3, 3), seen at uv_px (N, 2) and depth z_m (N,).

    Iteratively reweighted Gauss-Newton (Geman-McClure) on pixels and depth together, started at T_cam_seg; depth 0 is
    not measured. Errors along an edge, where cov_px2 (N, 2, 2) is long, hardly count.
    """
    centre = p_seg.mean(0)
    start = np.ascontiguousarray(T_cam_seg[:3, :3]), T_cam_seg[:3, :3] @ centre + T_cam_seg[:3, 3]
    # Concatenated from broadcast ones they are not contiguous, for which it would be compiled anew.
    map_cov, uv_px, cov_px2 = (np.ascontiguousarray(each) for each in (map_cov, uv_px, cov_px2))
    seen = uv_px, cov_px2, z_m, depth_noise_m(z_m)
    intrinsics = camera.fx, camera.fy, camera.cx, camera.cy
    R, at, H, chi2, chi2_z = _fit_pose(*start, np.ascontiguousarray(p_seg - centre), map_cov, *seen, *intrinsics)
    agrees = (chi2 < _AGREES_CHI2) & (chi2_z < _AGREES_DEPTH_CHI2)
    return PoseFit(se3.from_rt(R, at - R @ centre), np.linalg.inv(H), centre, agrees)


@compiled("f8[:,::1], f8[::1], f8[:,::1], f8[:,:,::1], f8[:,::1], f8[:,:,::1], f8[::1], f8[::1], f8, f8, f8, f8")
def _fit_pose(R, at, arm_seg, map_cov, uv_px, cov_px2, z_m, sigma_m, fx, fy, cx, cy):
    """Rotation, centre, H (6, 6), and the squared residuals of pixels and depths (N,) in variances."""
    count, start, turned = len(arm_seg), at.copy(), np.zeros(3)
    W, z_weight, soft, soft_z = np.zeros((count, 2, 2)), np.zeros(count), 0.0, 0.0
    chi2, chi2_z, r, J = np.zeros(count), np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3, 6))
    H, last = _PRIOR.copy(), False
    for step in range(_ITERATIONS + 1):
        for n in range(count):
            a = R @ arm_seg[n]
            x, y, z = a[0] + at[0], a[1] + at[1], max(a[2] + at[2], 0.05)
            P = np.zeros((3, 3))  # of the pixel and the depth by the point
            P[0, 0], P[0, 2], P[1, 1], P[1, 2], P[2, 2] = fx / z, -fx * x / z**2, fy / z, -fy * y / z**2, 1.0
            if step == 0:
                cov = R @ map_cov[n] @ R.T
                of_pixel = (P @ cov @ P.T)[:2, :2] + cov_px2[n] + _SHARED_PX**2 * np.eye(2)
                inverse = np.linalg.inv(of_pixel)
                for i in range(2):
                    for j in range(2):
                        W[n, i, j] = inverse[i, j]
                z_weight[n] = 1 / (sigma_m[n] ** 2 + cov[2, 2]) if z_m[n] > 0 else 0.0
            r[n, 0], r[n, 1] = uv_px[n, 0] - fx * x / z - cx, uv_px[n, 1] - fy * y / z - cy
            r[n, 2] = z_m[n] - a[2] - at[2] if z_m[n] > 0 else 0.0
            chi2[n] = W[n, 0, 0] * r[n, 0] ** 2 + 2 * W[n, 0, 1] * r[n, 0] * r[n, 1] + W[n, 1, 1] * r[n, 1] ** 2
            chi2_z[n] = z_weight[n] * r[n, 2] ** 2
            for i in range(3):
                J[n, i, 0], J[n, i, 1] = P[i, 2] * a[1] - P[i, 1] * a[2], P[i, 0] * a[2] - P[i, 2] * a[0]
                J[n, i, 2] = P[i, 1] * a[0] - P[i, 0] * a[1]
                J[n, i, 3], J[n, i, 4], J[n, i, 5] = P[i, 0], P[i, 1], P[i, 2]
        if last or step == _ITERATIONS:
            break
        # While most points are far off, as at the start, a large residual is no sign of an outlier.
        soft, soft_z = max(_SOFT, 2 * np.median(chi2)), max(_SOFT, 2 * np.median(chi2_z))
        H, g = _PRIOR.copy(), -_PRIOR @ np.concatenate((turned, at - start))
        weight = np.zeros((3, 3))
        for n in range(count):
            for i in range(2):
                for j in range(2):
                    weight[i, j] = W[n, i, j] / (1 + chi2[n] / soft) ** 2
            weight[2, 2] = z_weight[n] / (1 + chi2_z[n] / soft_z) ** 2
            JW = J[n].T @ weight
            H += JW @ J[n]
            g += JW @ r[n]
        delta = np.linalg.solve(H, g)
        R, at, turned = _rotation(delta[:3]) @ R, at + delta[3:], turned + delta[:3]
        last = soft == _SOFT and np.abs(delta[:3]).max() < 1e-3 and np.abs(delta[3:]).max() < 2e-4
    return R, at, H, chi2, chi2_z


@compiled()
def _rotation(w: np.ndarray) -> np.ndarray:
    """(3, 3) turn about w (3,) by its length, rad."""
    angle = np.sqrt((w * w).sum())
    W = np.zeros((3, 3))
    W[0, 1], W[0, 2], W[1, 2] = -w[2], w[1], -w[0]
    W[1, 0], W[2, 0], W[2, 1] = w[2], -w[1], w[0]
    if angle < 1e-9:
        return np.eye(3) + W
    return np.eye(3) + np.sin(angle) / angle * W + 2 * (np.sin(angle / 2) / angle) ** 2 * (W @ W)


@dataclass(frozen=True, eq=False)
class PointPrediction:
    """Where points of posed segments are predicted.

    uv_px  (N, 2), warp (N, 2, 2), cov_px2 (N, 2, 2); z_m (N,); cosine (N,) of surface normal and view
    """

    uv_px: np.ndarray
    warp: np.ndarray
    cov_px2: np.ndarray
    z_m: np.ndarray
    cosine: np.ndarray

    @property
    def sigma_px(self) -> np.ndarray:
        """(N,) standard deviation of uv_px."""
        return np.sqrt(np.trace(self.cov_px2, axis1=1, axis2=2))


def predict(
    T: np.ndarray,
    covariance: np.ndarray,
    centre: np.ndarray,
    p_seg: np.ndarray,
    map_cov: np.ndarray,
    tangent: np.ndarray,
    camera: Camera,
) -> PointPrediction:
    """Of points (N, 3) on segments at T (N, 4, 4), covariance (N, 6, 6), centre (N, 3) as in PoseFit."""
    R = T[:, :3, :3]
    p_cam = (R @ p_seg[..., None])[..., 0] + T[:, :3, 3]
    uv, P = projection(camera, p_cam)
    across = R @ tangent
    arm = (R @ (p_seg - centre)[..., None])[..., 0]
    by_motion = np.concatenate([-se3.hat(arm), np.broadcast_to(np.eye(3), R.shape)], -1)  # [rotation, translation]
    J, PR = P @ by_motion, P @ R
    cov = PR @ map_cov @ PR.transpose(0, 2, 1) + J @ covariance @ J.transpose(0, 2, 1)
    normal = np.cross(across[..., 0], across[..., 1])
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(p_cam, axis=1)
    cosine = (normal * p_cam).sum(1) / np.maximum(length, 1e-12)
    return PointPrediction(uv, P @ across, cov, p_cam[:, 2], cosine)


def pose_distance_m(T_a: np.ndarray, T_b: np.ndarray, centre: np.ndarray) -> float:
    """Distance between two poses of a segment: of its centre (3,), and of points 5 cm from it by the rotation."""
    moved = (T_a[:3, :3] - T_b[:3, :3]) @ centre + T_a[:3, 3] - T_b[:3, 3]
    return float(np.linalg.norm(moved) + 0.05 * np.linalg.norm(T_a[:3, :3] - T_b[:3, :3]))
