"""A bundle adjustment of poses and of points measured in 3D over a whole video.

Minimises, over poses T_k in SE(3) and points p_j of the object, ``sum rho(e^T W e)`` with ``e = T_k p_j - z_kj``: z is
where point j was measured in the camera of frame k, W the information of that measurement, larger across its ray than
along it. Gauss-Newton with the points eliminated (Triggs et al., "Bundle Adjustment: A Modern Synthesis", 2000); rho
is Geman and McClure's, so that a track that slid away has no weight. Of more than :data:`MOST_POINTS` points those that
most poses see decide the poses, so that memory is bounded (:func:`best_seen`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core import se3

#: A residual of so many standard deviations has weight 1/4; at first one so many times larger, less by this each step.
_HALF, _WIDE, _NARROWER = 3.0, 8.0, 0.6
#: Most steps; a mean step below this, in metres and radians, ends them.
_ITERATIONS, _TOLERANCE = 15, 2e-6
#: Poses that are located at a time.
_AT_ONCE = 2000
#: Points that are adjusted together with the poses at most: with 200 poses two arrays of 170 MB.
MOST_POINTS = 6000


@dataclass(frozen=True, eq=False)
class PointObservations:
    """M sightings: rows (M,) of pose and of point, measured p_cam (M, 3), and information (M, 3, 3)."""

    pose: np.ndarray
    point: np.ndarray
    p_cam: np.ndarray
    information: np.ndarray

    def select(self, rows: np.ndarray) -> PointObservations:
        """The sightings at these rows, or under a mask (M,) bool."""
        return PointObservations(self.pose[rows], self.point[rows], self.p_cam[rows], self.information[rows])


def information(p_cam: np.ndarray, lateral_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """(M, 3, 3) of points p_cam (M, 3) with standard deviations (M,) across their ray and along it, m."""
    ray = p_cam / np.linalg.norm(p_cam, axis=1, keepdims=True)
    along = ray[:, :, None] * ray[:, None]
    return (np.eye(3) - along) / lateral_m[:, None, None] ** 2 + along / depth_m[:, None, None] ** 2


def placed(T_cam_obj: np.ndarray, seen: PointObservations, count: int) -> np.ndarray:
    """(count, 3) points in the object frame, the median of each one's sightings at these poses; NaN without any."""
    p_obj = se3.transform(se3.inverse(T_cam_obj[seen.pose]), seen.p_cam[:, None])[:, 0]
    order = np.argsort(seen.point, kind="stable")
    starts = np.searchsorted(seen.point[order], np.arange(count + 1))
    points = np.full((count, 3), np.nan)
    for j in np.flatnonzero(np.diff(starts)):  # over points of an object, not over sightings
        points[j] = np.median(p_obj[order[starts[j] : starts[j + 1]]], axis=0)
    return points


def adjust(T_cam_obj: np.ndarray, p_obj: np.ndarray, seen: PointObservations) -> tuple[np.ndarray, np.ndarray]:
    """Poses (K, 4, 4) and points (N, 3) adjusted from these; each must have a sighting at least.

    Of more than :data:`MOST_POINTS` points the others are put where the adjusted poses have them (:func:`placed`).
    """
    p, used = np.array(p_obj, float), best_seen(seen, len(T_cam_obj), len(p_obj))
    few = seen.select(used[seen.point])
    T, p[used] = _adjusted(T_cam_obj, p[used], replace(few, point=(np.cumsum(used) - 1)[few.point]))
    if not used.all():
        p[~used] = placed(T, seen, len(p))[~used]
    return T, p


def best_seen(seen: PointObservations, poses: int, points: int) -> np.ndarray:
    """(points,) bool: at most :data:`MOST_POINTS`, those that most of the ``poses`` see; of each pose its best first.

    Without the latter all points might be of one half of a video, and nothing would hold the poses of the other.
    """
    if points <= MOST_POINTS:
        return np.ones(points, bool)
    count = np.bincount(seen.point, minlength=points)
    order = np.lexsort((seen.point, -count[seen.point], seen.pose))
    place = np.full(points, len(order))  # the best that a point has among those of a pose
    pose = seen.pose[order]
    np.minimum.at(place, seen.point[order], np.arange(len(order)) - np.searchsorted(pose, pose))
    used = np.zeros(points, bool)
    used[np.lexsort((-count, place >= MOST_POINTS // poses))[:MOST_POINTS]] = True
    return used


def _adjusted(T_cam_obj: np.ndarray, p_obj: np.ndarray, seen: PointObservations) -> tuple[np.ndarray, np.ndarray]:
    T, p = np.array(T_cam_obj, float), np.array(p_obj, float)
    K, N = len(T), len(p)
    same = np.tile(np.eye(6), (K, 1)) / np.sqrt(K)  # gauge: one change of the object frame for all poses
    for step_number in range(_ITERATIONS):
        V, e, A = _linear(T, p, seen, max(_WIDE * _NARROWER**step_number, 1.0))
        AV = np.einsum("mia,mij->maj", A, V)
        g = np.einsum("mij,mj->mi", V, e)
        H = _summed(seen.pose, AV @ A, K)
        b = _summed(seen.pose, np.einsum("mia,mi->ma", A, g), K)
        C = _summed(seen.point, V, N) + 1e-3 * np.eye(3)
        c = _summed(seen.point, g, N)
        blocks = np.zeros((K, 6, N, 3))
        np.add.at(blocks.swapaxes(1, 2), (seen.pose, seen.point), AV)
        E = blocks.reshape(6 * K, 3 * N)
        C_inverse = np.linalg.inv(C)
        F = np.einsum("anj,njk->ank", E.reshape(6 * K, N, 3), C_inverse).reshape(6 * K, 3 * N)
        S = -F @ E.T
        for k in range(K):  # the blocks on the diagonal
            S[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] += H[k]
        S += np.trace(S) / len(S) * same @ same.T
        S[np.diag_indices_from(S)] *= 1 + 1e-6
        step = -np.linalg.solve(S, b.ravel() - F @ c.ravel())
        shift = -np.einsum("njk,nk->nj", C_inverse, c + (E.T @ step).reshape(N, 3))
        T = T @ se3.exp(np.clip(step.reshape(K, 6), -0.1, 0.1))
        p = p + shift
        if step_number > 6 and np.abs(step).mean() < _TOLERANCE:
            break
    return se3.orthonormalised(T), p


def locate(T_cam_obj: np.ndarray, p_obj: np.ndarray, seen: PointObservations) -> np.ndarray:
    """Each pose (K, 4, 4) adjusted by itself to fixed points (N, 3); one with few sightings hardly moves."""
    T = np.array(T_cam_obj, float)
    for first in range(0, len(T), _AT_ONCE):
        some = seen.select((seen.pose >= first) & (seen.pose < first + _AT_ONCE))
        at = slice(first, first + _AT_ONCE)
        T[at] = _located(T[at], p_obj, replace(some, pose=some.pose - first))
    return T


def _located(T: np.ndarray, p_obj: np.ndarray, seen: PointObservations) -> np.ndarray:
    K = len(T)
    weak = np.diag(np.repeat([0.5, 0.1], 3) ** -2.0)
    for step_number in range(_ITERATIONS):
        V, e, A = _linear(T, p_obj, seen, max(_WIDE * _NARROWER ** (2 * step_number), 1.0))
        H = _summed(seen.pose, np.einsum("mia,mij,mjb->mab", A, V, A), K) + weak
        b = _summed(seen.pose, np.einsum("mia,mij,mj->ma", A, V, e), K)
        step = -np.linalg.solve(H, b[..., None])[..., 0]
        T = T @ se3.exp(np.clip(step, -0.1, 0.1))
        if step_number > 4 and np.abs(step).mean() < _TOLERANCE:
            break
    return se3.orthonormalised(T)


def _linear(T: np.ndarray, p: np.ndarray, seen: PointObservations, wide: float):
    """In the object's axes: weighted information (M, 3, 3), residual (M, 3), its derivative (M, 3, 6)."""
    R, points = T[seen.pose, :3, :3], p[seen.point]
    e = points - np.einsum("mji,mj->mi", R, seen.p_cam - T[seen.pose, :3, 3])
    V = np.einsum("mji,mjk,mkl->mil", R, seen.information, R)
    squared = np.einsum("mi,mij,mj->m", e, V, e)
    weight = 1 / (1 + squared / (wide * _HALF) ** 2) ** 2
    A = np.concatenate([-se3.hat(points), np.broadcast_to(np.eye(3), (len(e), 3, 3))], axis=2)
    return weight[:, None, None] * V, e, A


def _summed(row: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """Sums of values (M, ...) by row (M,), (count, ...)."""
    total = np.zeros((count, *values.shape[1:]))
    np.add.at(total, row, values)
    return total
