"""Rigid bodies among tracked points: where they are, and where that puts each of their points.

A point has a place on its body and the map that takes offsets in its first appearance to offsets on the
body's surface there. The pose of the body then says where the point is to be seen, how its surroundings
are warped, and whether its surface faces the camera. T_cam_body and body frames mean nothing outside
the tracker: a body's frame is the camera's when the body was first met.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.robust import fit_rigid
from p2p_lib.trackers.builtin.tangent_planes import projection

_EYE2, _EYE3 = np.eye(2), np.eye(3)
#: How far a body is thought to turn and move between frames beyond what it did before: rad, m.
_PRIOR = np.diag(1 / np.repeat([0.15, 0.02], 3) ** 2)
# A squared residual of a robust fit counts half at this many variances.
_SOFT = 5.0
# Triples of matches that a search for a motion starts from.
_TRIPLES = 100


def _turning(arm: np.ndarray) -> np.ndarray:
    """(N, 3, 6) change of points by a small motion [rotation, translation], arm (N, 3) from its centre."""
    J = np.zeros((len(arm), 3, 6))
    J[:, 0, 1], J[:, 0, 2], J[:, 1, 2] = arm[:, 2], -arm[:, 1], arm[:, 0]
    J[:, 1, 0], J[:, 2, 0], J[:, 2, 1] = -arm[:, 2], arm[:, 1], -arm[:, 0]
    J[:, 0, 3] = J[:, 1, 4] = J[:, 2, 5] = 1
    return J


@dataclass(frozen=True, eq=False)
class Fit:
    """A body's pose and who agrees with it.

    T_cam_body  (4, 4)
    covariance  (6, 6) of its turn and shift, in the camera's axes, about ``centre`` (3,), a point of the body
    agrees      (N,) bool
    """

    T_cam_body: np.ndarray
    covariance: np.ndarray
    centre: np.ndarray
    agrees: np.ndarray


def fit_pose(
    T_cam_body: np.ndarray,
    p_body: np.ndarray,
    map_cov: np.ndarray,
    uv_px: np.ndarray,
    cov_px2: np.ndarray,
    z_m: np.ndarray,
    camera: Camera,
    iterations: int = 8,
) -> Fit:
    """The pose by points p_body (N, 3) with covariance map_cov (N, 3, 3), seen at uv_px (N, 2) and depth z_m (N,).

    Robust Gauss-Newton on pixels and depth together, from about T_cam_body; depth 0 is not measured. What
    lies along an edge, where cov_px2 (N, 2, 2) is long, hardly counts.
    """
    centre = p_body.mean(0)
    R, at, turned = T_cam_body[:3, :3], T_cam_body[:3, :3] @ centre + T_cam_body[:3, 3], np.zeros(6)
    start, arm = at, (p_body - centre) @ R.T
    _, P = projection(camera, arm + at)
    spread = R @ map_cov @ R.T
    W = np.linalg.inv(cov_px2 + P @ spread @ P.transpose(0, 2, 1) + 0.3**2 * _EYE2)
    z_weight = np.where(z_m > 0, 1 / (depth_noise_m(z_m) ** 2 + spread[:, 2, 2]), 0)
    H = _PRIOR
    for step in range(iterations + 1):
        p_cam = arm + at
        uv, P = projection(camera, p_cam)
        r, r_z = uv_px - uv, np.where(z_m > 0, z_m - p_cam[:, 2], 0)
        chi2, chi2_z = ((r[:, None] @ W)[:, 0] * r).sum(1), r_z**2 * z_weight
        if step == iterations:
            break
        # While most are far off, far off is normal.
        soft, soft_z = max(_SOFT, 2 * np.median(chi2)), max(_SOFT, 2 * np.median(chi2_z))
        w, w_z = 1 / (1 + chi2 / soft) ** 2, z_weight / (1 + chi2_z / soft_z) ** 2
        turning = _turning(arm)
        J, J_z = P @ turning, turning[:, 2]
        JW = ((w[:, None, None] * W) @ J).reshape(-1, 6)
        H = _PRIOR + JW.T @ J.reshape(-1, 6) + (J_z * w_z[:, None]).T @ J_z
        g = JW.T @ r.ravel() + J_z.T @ (w_z * r_z) - _PRIOR @ turned
        delta = np.linalg.solve(H, g)
        R, at = _rotation(delta[:3]) @ R, at + delta[3:]
        arm, turned = (p_body - centre) @ R.T, np.concatenate([turned[:3] + delta[:3], at - start])
        if soft == _SOFT and np.abs(delta[:3]).max() < 1e-3 and np.abs(delta[3:]).max() < 2e-4:
            iterations = step + 1
    return Fit(se3.from_rt(R, at - R @ centre), np.linalg.inv(H), centre, (chi2 < 16) & (chi2_z < 25))


def _rotation(w: np.ndarray) -> np.ndarray:
    """(3, 3) of one rotation vector: as :func:`se3.exp`, without what batches cost."""
    angle = np.sqrt(w @ w)
    x, y, z = w / max(angle, 1e-12)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return _EYE3 + np.sin(angle) * K + (1 - np.cos(angle)) * (K @ K)


def consensus(
    p_body: np.ndarray, p_cam: np.ndarray, corner: np.ndarray, inlier_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion that most matches p_body, p_cam (M, 3) agree on: T_cam_body and who does (M,).

    corner  (M,) what each match is made of: several of one corner count once

    Two matches go together if they are equally far apart on the body and in the picture. Triples are made
    of the pairs that most others go together with, so that a few right matches among many wrong ones suffice.
    """
    nobody = np.eye(4), np.zeros(len(p_body), bool)
    if len(p_body) < 3:
        return nobody
    apart_body, apart_cam = (np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (p_body, p_cam))
    together = (np.abs(apart_body - apart_cam) < inlier_m) & (np.minimum(apart_body, apart_cam) > 2 * inlier_m)
    C = together.astype(np.float32)
    votes = C @ C * C
    i, j = np.unravel_index(np.argsort(-np.triu(votes), axis=None, kind="stable")[:_TRIPLES], votes.shape)
    k = np.where(together[i] & together[j], votes[i] + votes[j], -1).argmax(1)
    some = votes[i, j] > 0
    at = np.stack([i, j, k], 1)[some]
    if not len(at):
        return nobody
    T = fit_rigid(p_body[at], p_cam[at])
    weight = 1 / np.bincount(corner, minlength=corner.max() + 1)[corner]
    for _ in range(2):
        off = np.linalg.norm(p_body @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3] - p_cam, axis=-1)
        inliers = off < inlier_m
        best = inliers[(inliers @ weight).argmax()]
        if best.sum() < 3:
            return nobody
        T = fit_rigid(p_body[best], p_cam[best])[None]
    return T[0], best


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where points of posed bodies are to be seen.

    uv_px  (N, 2), warp (N, 2, 2), cov_px2 (N, 2, 2); z_m (N,); cosine (N,) of the surface's normal and the view
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
    p_body: np.ndarray,
    map_cov: np.ndarray,
    tangent: np.ndarray,
    camera: Camera,
) -> Prediction:
    """Of points (N, 3) on bodies at T (N, 4, 4), covariance (N, 6, 6), centre (N, 3) as in Fit; tangent (N, 3, 2)."""
    R = T[:, :3, :3]
    p_cam = (R @ p_body[..., None])[..., 0] + T[:, :3, 3]
    uv, P = projection(camera, p_cam)
    across = R @ tangent
    JT, PR = P @ _turning((R @ (p_body - centre)[..., None])[..., 0]), P @ R
    cov = PR @ map_cov @ PR.transpose(0, 2, 1) + JT @ covariance @ JT.transpose(0, 2, 1)
    normal = np.cross(across[..., 0], across[..., 1])
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(p_cam, axis=1)
    cosine = (normal * p_cam).sum(1) / np.maximum(length, 1e-12)
    return Prediction(uv, P @ across, cov, p_cam[:, 2], cosine)


def linked(p: np.ndarray, reach_m: float) -> np.ndarray:
    """(N,) label of each point's chain of points not farther than reach_m apart: the smallest row in it."""
    near = np.linalg.norm(p[:, None] - p[None], axis=-1) <= reach_m
    label = np.arange(len(p))
    while True:
        smaller = np.where(near, label[None], len(p)).min(1) if len(p) else label
        if (smaller == label).all():
            return label
        label = smaller


def apart_m(T_a: np.ndarray, T_b: np.ndarray, centre: np.ndarray) -> float:
    """How far two poses take a body's centre (3,) apart, and by turning what is 5 cm from it."""
    moved = (T_a[:3, :3] - T_b[:3, :3]) @ centre + T_a[:3, 3] - T_b[:3, 3]
    return float(np.linalg.norm(moved) + 0.05 * np.linalg.norm(T_a[:3, :3] - T_b[:3, :3]))
