"""The pose of one rigid motion segment from its points, and the prediction of its points from its pose.

A point has a position on its segment and the map that takes offsets in its first template to offsets on the
surface there. The pose of the segment then predicts where the point is seen, how its surroundings are
warped, and whether its surface faces the camera. T_cam_seg means nothing outside the tracker: a segment's
frame is the camera's when the segment was started.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
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


def _motion_jacobian(arm: np.ndarray) -> np.ndarray:
    """(N, 3, 6) change of points by a small motion [rotation, translation]; arm (N, 3) from its centre."""
    return np.concatenate([-se3.hat(arm), np.broadcast_to(np.eye(3), (len(arm), 3, 3))], -1)


@dataclass(frozen=True, eq=False)
class PoseFit:
    """A segment's pose.

    T_cam_seg   (4, 4)
    covariance  (6, 6) of its rotation and translation, in the camera's axes, about ``centre`` (3,), on the segment
    agrees      (N,) bool: the points that it was fitted to and that agree with it
    """

    T_cam_seg: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray
    agrees: np.ndarray


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
    R, moved = T_cam_seg[:3, :3], np.zeros(6)
    at = start = R @ centre + T_cam_seg[:3, 3]
    arm = (p_seg - centre) @ R.T
    _, P = projection(camera, arm + at)
    map_cov_cam = R @ map_cov @ R.T
    W = np.linalg.inv(cov_px2 + P @ map_cov_cam @ P.transpose(0, 2, 1) + _SHARED_PX**2 * np.eye(2))
    z_weight = np.where(z_m > 0, 1 / (depth_noise_m(z_m) ** 2 + map_cov_cam[:, 2, 2]), 0)
    H = _PRIOR
    steps = _ITERATIONS
    for step in range(steps + 1):
        p_cam = arm + at
        uv, P = projection(camera, p_cam)
        r, r_z = uv_px - uv, np.where(z_m > 0, z_m - p_cam[:, 2], 0)
        chi2, chi2_z = ((r[:, None] @ W)[:, 0] * r).sum(1), r_z**2 * z_weight
        if step >= steps:
            break
        # While most points are far off, as at the start, a large residual is no sign of an outlier.
        soft, soft_z = max(_SOFT, 2 * np.median(chi2)), max(_SOFT, 2 * np.median(chi2_z))
        w, w_z = 1 / (1 + chi2 / soft) ** 2, z_weight / (1 + chi2_z / soft_z) ** 2
        J_cam = _motion_jacobian(arm)
        J, J_z = P @ J_cam, J_cam[:, 2]
        JW = ((w[:, None, None] * W) @ J).reshape(-1, 6)
        H = _PRIOR + JW.T @ J.reshape(-1, 6) + (J_z * w_z[:, None]).T @ J_z
        g = JW.T @ r.ravel() + J_z.T @ (w_z * r_z) - _PRIOR @ moved
        delta = np.linalg.solve(H, g)
        R, at = cv2.Rodrigues(delta[:3])[0] @ R, at + delta[3:]
        arm, moved = (p_seg - centre) @ R.T, np.concatenate([moved[:3] + delta[:3], at - start])
        if soft == _SOFT and np.abs(delta[:3]).max() < 1e-3 and np.abs(delta[3:]).max() < 2e-4:
            steps = step + 1
    agrees = (chi2 < _AGREES_CHI2) & (chi2_z < _AGREES_DEPTH_CHI2)
    return PoseFit(se3.from_rt(R, at - R @ centre), np.linalg.inv(H), centre, agrees)


@dataclass(frozen=True, eq=False)
class Prediction:
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
) -> Prediction:
    """Of points (N, 3) on segments at T (N, 4, 4), covariance (N, 6, 6), centre (N, 3) as in PoseFit."""
    R = T[:, :3, :3]
    p_cam = (R @ p_seg[..., None])[..., 0] + T[:, :3, 3]
    uv, P = projection(camera, p_cam)
    across = R @ tangent
    J, PR = P @ _motion_jacobian((R @ (p_seg - centre)[..., None])[..., 0]), P @ R
    cov = PR @ map_cov @ PR.transpose(0, 2, 1) + J @ covariance @ J.transpose(0, 2, 1)
    normal = np.cross(across[..., 0], across[..., 1])
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(p_cam, axis=1)
    cosine = (normal * p_cam).sum(1) / np.maximum(length, 1e-12)
    return Prediction(uv, P @ across, cov, p_cam[:, 2], cosine)


def pose_distance_m(T_a: np.ndarray, T_b: np.ndarray, centre: np.ndarray) -> float:
    """Distance between two poses of a segment: of its centre (3,), and of points 5 cm from it by the rotation."""
    moved = (T_a[:3, :3] - T_b[:3, :3]) @ centre + T_a[:3, 3] - T_b[:3, 3]
    return float(np.linalg.norm(moved) + 0.05 * np.linalg.norm(T_a[:3, :3] - T_b[:3, :3]))
