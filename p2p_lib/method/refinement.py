"""SDF refinement: Levenberg-Marquardt of a pose on the fused surface (paper: SDF Refinement).

Minimises, over D in SE(3), the Huber loss of the surface's signed distance at the measured points,
``sum rho_H(Phi(T^-1 D^-1 p)^2)``, with ``T <- D T``. The increment is parameterised on the right,
``D = T exp(xi) T^-1``, which makes ``D T = T exp(xi)``: the same pose, in our tangent.

Ours beyond the paper: the surface does not move the pose along directions that the shape leaves free,
keypoint residuals can hold these, and the result says how well each direction is known.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np

from p2p_lib.core import observability, se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import compiled
from p2p_lib.core.config import RefinementConfig
from p2p_lib.core.types import evenly

if TYPE_CHECKING:
    from p2p_lib.method.tsdf import TsdfVolume

#: Fewer points on the observed surface than this determine nothing.
MIN_POINTS = 10
#: Levenberg-Marquardt: the initial damping, and the factor by which it falls when a step succeeds; its square is the
#: rise when one fails. The release's, as are the two bounds of a step.
_DAMPING, _DAMPING_FACTOR = 1e-4, 5.0
_MAX_STEP_M, _MAX_STEP_RAD = 0.02, 0.2
#: A smaller change of the cost, in squared standard deviations, ends the iterations.
_TOLERANCE = 0.2
#: Residuals beyond so many median absolute deviations are left out (the release's).
_MAD_TRIM = 2.5
#: Depth errors of neighbours are correlated: together, the points are worth so many independent ones.
_INDEPENDENT_POINTS = 100
#: No map is exact to less than this share of its voxels, however little the points scatter.
_SIGMA_FLOOR_VOXELS = 0.25
_MAD_TO_SIGMA = 1.4826


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints seen in the frame: p_obj (M, 3), p_cam (M, 3) as measured, sigma_m (M,) noise of each coordinate."""

    p_obj: np.ndarray
    p_cam: np.ndarray
    sigma_m: np.ndarray


@dataclass(frozen=True, eq=False)
class Refinement:
    """A refined pose and what is known about it.

    T_cam_obj    (4, 4); the input's where nothing could be refined
    covariance   (6, 6) right tangent of T_cam_obj, [rotation rad, translation m], or None where not refined
    rms_m        root mean square distance of the used points to the surface; NaN where none
    inliers      share of the given points that lie on observed surface and were not trimmed
    iterations   Levenberg-Marquardt steps tried
    eigenvalues  (6,) ascending: how well the shape determines each of :attr:`directions`, as the mean squared change
                 of the points' distance per squared displacement; a plane has three at 0, a can one
    directions   (6, 6) rows: unit tangents about the cloud's centre, rotation scaled by the cloud's radius
    free_rotations  (K, 6) right tangents of T_cam_obj, a radian each: turns that do not change the fit
    reason       why the pose was not refined, or how many directions the shape leaves free; else empty
    """

    T_cam_obj: np.ndarray
    covariance: np.ndarray | None = None
    rms_m: float = float("nan")
    inliers: float = 0.0
    iterations: int = 0
    eigenvalues: np.ndarray | None = None
    directions: np.ndarray | None = None
    free_rotations: np.ndarray = field(default_factory=lambda: np.zeros((0, 6)))
    reason: str = ""

    @property
    def refined(self) -> bool:
        """Whether the surface took part at all."""
        return self.covariance is not None


@dataclass(frozen=True, eq=False)
class _Linear:
    """The surface residuals at one pose, linearised about the cloud's centre.

    distance_m is every point's unsigned distance, infinite off the observed surface. ``rows`` are the points used, J
    (n, 6) the derivatives of their distances. H and g are means over them; rotations are scaled by the cloud's radius,
    so that every variable is in metres.

    eigenvalues (6,) and directions (6, 6), columns, are those of :func:`p2p_lib.core.observability.eigen`.
    """

    T: np.ndarray
    distance_m: np.ndarray
    H: np.ndarray
    g: np.ndarray
    eigenvalues: np.ndarray
    directions: np.ndarray
    cut_m: float
    rows: np.ndarray
    J: np.ndarray
    rms_m: float
    sigma_m: float


def refine(
    T_cam_obj: np.ndarray,
    p_cam: np.ndarray,
    volume: TsdfVolume,
    config: RefinementConfig,
    *,
    keypoints: Keypoints | None = None,
) -> Refinement:
    """Refine T_cam_obj so that the measured points p_cam (N, 3) lie on the volume's surface.

    Points that are not finite or fall where nothing was observed take no part. Never raises for bad
    numbers: with fewer than ten usable points the input pose comes back with the reason.
    """
    T_cam_obj = np.asarray(T_cam_obj, float)
    if not np.isfinite(T_cam_obj).all():
        return Refinement(T_cam_obj, reason="the pose to refine is not finite")
    p_cam = _usable(p_cam, config.max_points)
    keypoints = _usable_keypoints(keypoints, config)
    if len(p_cam) < MIN_POINTS:
        return Refinement(T_cam_obj, reason=f"{len(p_cam)} depth points, {MIN_POINTS} are needed")
    problem = _Problem.about(T_cam_obj, p_cam, volume, config, keypoints)
    if problem is None:
        return Refinement(T_cam_obj, reason=f"fewer than {MIN_POINTS} depth points lie on observed surface")
    return problem.solve(T_cam_obj)


@dataclass(frozen=True, eq=False)
class _Problem:
    p_cam: np.ndarray
    volume: TsdfVolume
    config: RefinementConfig
    keypoints: Keypoints | None
    centre: np.ndarray  # of the cloud, object frame
    radius: float  # of the cloud: turns a rotation into the displacement it causes
    pairs: np.ndarray  # (2, P) rows of p_cam: neighbours far enough apart for their noise to be independent

    @classmethod
    def about(cls, T_cam_obj, p_cam, volume, config, keypoints) -> _Problem | None:
        p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
        _, valid = volume.query(p_obj)
        if valid.sum() < MIN_POINTS:
            return None
        centre = p_obj[valid].mean(0)
        radius = float(np.sqrt(((p_obj[valid] - centre) ** 2).sum(-1).mean()))
        pairs = observability.neighbours(p_cam, observability.PAIR_VOXELS * volume.voxel_m)
        return cls(p_cam, volume, config, keypoints, centre, max(radius, 1e-4), pairs)

    def solve(self, T: np.ndarray) -> Refinement:
        damping, converged, tries = _DAMPING, False, 0
        # Wide at first: far from the solution, the few points that hold a direction look like outliers.
        begun = self.surface(T, self.volume.tau_m / 2)
        if begun is None:
            return Refinement(T, reason="the depth points lie beyond the truncation distance")
        at = begun
        while tries < self.config.iterations and not converged:
            tries += 1
            step = self.clipped(self.step(*self.joint(at), damping))
            nearby = at if np.linalg.norm(step) < self.volume.voxel_m else None
            new = self.surface(self.moved(at.T, step), self.volume.tau_m / 2 ** (tries + 1), nearby)
            gain = self.cost(at, at) - self.cost(new, at) if new is not None else -np.inf
            converged = abs(gain) < _TOLERANCE
            if new is not None and gain > 0:
                at, damping = new, damping / _DAMPING_FACTOR
            else:
                damping = max(damping, 1e-4) * _DAMPING_FACTOR**2
        eigenvalues, directions = self.eigen(at.rows, at.J)
        return self.result(replace(at, eigenvalues=eigenvalues, directions=directions), tries)

    # -- the two kinds of residual -----------------------------------------------------------------

    def surface(self, T: np.ndarray, widest_m: float = 0.0, nearby: _Linear | None = None) -> _Linear | None:
        """Robust normal equations of Phi(T^-1 p) in metres; None where fewer than ten points can be used.

        Trims outliers by the MAD, but nothing within ``widest_m`` nor within Huber's threshold. The eigenvectors are
        those of ``nearby``, another pose, where it is given: they hardly change.
        """
        p_obj = se3.transform(se3.inverse(T), self.p_cam)
        value, gradient, valid = self.volume.query_with_gradient(p_obj)
        huber_m, least_m = self.config.huber_m, max(self.config.huber_m, widest_m)
        # The smallest standard deviation of a distance, and the distance at which truncation begins.
        floor_m, reach_m = _SIGMA_FLOOR_VOXELS * self.volume.voxel_m, 0.98 * self.volume.tau_m
        points = p_obj, self.centre, self.radius, value, gradient, valid
        used, J, H, g, cut, rms, sigma = _linearised(*points, floor_m, reach_m, huber_m, least_m)
        if len(used) < MIN_POINTS:
            return None
        distance = np.where(valid, np.abs(value), np.inf)
        held = (nearby.eigenvalues, nearby.directions) if nearby else self.eigen(used, J)
        return _Linear(T, distance, H, g, *held, cut, used, J, rms, sigma)

    def eigen(self, used: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Eigenvalues (6,) ascending and eigenvectors (6, 6), columns, of what the shape determines."""
        row = np.full(len(self.p_cam), -1)
        row[used] = np.arange(len(used))
        first, second = pairs = row.take(self.pairs)
        return observability.eigen(J, pairs[:, (first >= 0) & (second >= 0)])

    def keypoint_system(self, k: Keypoints, T: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Normal equations of T^-1 p_cam - p_obj in standard deviations, in the variables of :meth:`surface`."""
        return _keypoint_system(se3.inverse(T), k.p_obj, k.p_cam, k.sigma_m, self.centre, self.radius)

    # -- solving -------------------------------------------------------------------------------

    def joint(self, at: _Linear) -> tuple[np.ndarray, np.ndarray]:
        """Information and gradient: the surface's in the directions it determines, the keypoints' in all."""
        held = at.directions[:, at.eigenvalues >= self.floor]
        P, information = held @ held.T, self.effective_information(at)
        H, g = information * P @ at.H @ P, information * P @ at.g
        if self.keypoints is not None:
            H_k, g_k = self.keypoint_system(self.keypoints, at.T)
            H, g = H + H_k, g + g_k
        return H, g

    def effective_information(self, at: _Linear) -> float:
        """Independent observations per squared metre: depth errors of neighbours are correlated."""
        return min(len(at.rows), _INDEPENDENT_POINTS) / at.sigma_m**2

    @property
    def floor(self) -> float:
        """The smallest eigenvalue of a direction that the shape determines; 0, as in the paper, moves all."""
        return self.config.min_eigenvalue if self.config.residuals == "surface_and_keypoints" else 0.0

    def step(self, H: np.ndarray, g: np.ndarray, damping: float) -> np.ndarray:
        """Damped Gauss-Newton step in the subspace that holds any information."""
        value, vector = np.linalg.eigh(H)
        known = value > 1e-9 * max(value[-1], 1e-300)
        inverse = np.where(known, 1 / np.where(known, value + damping * value[-1], 1.0), 0.0)
        return -vector @ (inverse * (vector.T @ g))

    def clipped(self, step: np.ndarray) -> np.ndarray:
        turn, shift = np.linalg.norm(step[:3]) / self.radius, np.linalg.norm(step[3:])
        largest = max(turn / _MAX_STEP_RAD, shift / _MAX_STEP_M, 1.0)
        return step / largest

    def moved(self, T: np.ndarray, step: np.ndarray) -> np.ndarray:
        """T turned and shifted about the cloud's centre."""
        R = cv2.Rodrigues(step[:3] / self.radius)[0]
        return T @ se3.from_rt(R, self.centre + step[3:] - R @ self.centre)

    def cost(self, new: _Linear, at: _Linear) -> float:
        """The objective at ``new`` in squared standard deviations, with the trimming and scale of ``at``.

        Trimmed points and those off the observed surface cost what the trimming distance does.
        """
        loss = _huber_loss(new.distance_m, self.config.huber_m, at.cut_m)
        total = self.effective_information(at) / len(at.rows) * loss
        if self.keypoints is not None:
            k = self.keypoints
            off_m = se3.transform(se3.inverse(new.T), k.p_cam) - k.p_obj
            total += _huber_loss(np.sqrt((off_m * off_m).sum(-1)) / k.sigma_m, _HUBER, np.inf)
        return total

    def result(self, at: _Linear, tries: int) -> Refinement:
        """The pose reached, its covariance moved from the cloud's centre to the object's origin."""
        H, _ = self.joint(at)
        # What nothing determines is known to within the largest step.
        free = np.repeat([_MAX_STEP_RAD * self.radius, _MAX_STEP_M], 3) ** -2.0
        metres = np.repeat([1 / self.radius, 1.0], 3)
        to_origin = se3.adjoint(se3.from_rt(np.eye(3), self.centre)) * metres
        covariance = to_origin @ np.linalg.inv(H + np.diag(free)) @ to_origin.T
        loose = at.directions[:, at.eigenvalues < self.floor]
        return Refinement(
            se3.orthonormalised(at.T),
            (covariance + covariance.T) / 2,
            at.rms_m,
            len(at.rows) / len(self.p_cam),
            tries,
            at.eigenvalues,
            at.directions.T,
            observability.rotations_in(loose).T @ to_origin.T * self.radius,
            f"the shape leaves {loose.shape[1]} of 6 degrees of freedom unconstrained" if loose.size else "",
        )


#: Huber threshold of keypoint residuals in standard deviations.
_HUBER = 1.345


@compiled("f8[::1], f8, f8")
def _huber_loss(e: np.ndarray, threshold: float, most: float) -> float:
    """Twice the Huber loss, summed over residuals e (N,), 0 or more, each cut at ``most``."""
    total = 0.0
    for x in np.minimum(e, most):
        total += x * x if x < threshold else 2 * threshold * x - threshold * threshold
    return total


@compiled()
def _upper_median(x: np.ndarray) -> float:
    return np.median(np.append(x, np.inf)[: len(x) | 1])  # np.partition takes three times as long to compile


@compiled("f8[:,::1], f8[::1], f8, f8[::1], f8[::1,:], b1[::1], f8, f8, f8, f8")
def _linearised(p_obj, centre, radius, value, gradient, valid, floor_m, reach_m, huber_m, least_m):
    """Of points (N, 3) with these distances: rows (n,) used, their J (n, 6), H, g, the cut, the rms and the noise.

    Points beyond ``reach_m`` are truncated and left out; so are outliers by the MAD, unless within ``least_m``.
    """
    near = np.flatnonzero(valid & (np.abs(value) < reach_m))
    H, g = np.zeros((6, 6)), np.zeros(6)
    if len(near) < MIN_POINTS:
        return near, np.zeros((0, 6)), H, g, 0.0, 0.0, 0.0
    median = _upper_median(value[near])
    sigma = max(_MAD_TO_SIGMA * _upper_median(np.abs(value[near] - median)), floor_m)
    cut = max(abs(median) + _MAD_TRIM * sigma, least_m)
    used = near[np.abs(value[near]) <= cut]
    J, squares = surface_jacobian((p_obj[used] - centre) / radius, gradient[used]), 0.0
    for n in range(len(used)):
        r = value[used[n]]
        w = min(1.0, huber_m / max(abs(r), 1e-12))
        squares += r * r
        for a in range(6):
            g[a] += w * J[n, a] * r
            for b in range(6):
                H[a, b] += w * J[n, a] * J[n, b]
    count = max(len(used), 1)
    return used, J, H / count, g / count, cut, np.sqrt(squares / count), sigma


@compiled()
def surface_jacobian(q: np.ndarray, gradient: np.ndarray) -> np.ndarray:
    """(N, 6) derivative of Phi at points q (N, 3) by a right tangent xi of the pose: q -> exp(-xi) q.

    ``gradient`` (N, 3) is that of Phi at q. Rotation first, about q's origin.
    """
    J = np.empty((len(q), 6))
    for n in range(len(q)):
        (x, y, z), (a, b, c) = q[n], gradient[n]
        J[n, 0], J[n, 1], J[n, 2] = b * z - c * y, c * x - a * z, a * y - b * x
        J[n, 3], J[n, 4], J[n, 5] = -a, -b, -c
    return J


@compiled("f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], f8")
def _keypoint_system(
    T_obj_cam: np.ndarray, p_obj: np.ndarray, p_cam: np.ndarray, sigma_m: np.ndarray, centre: np.ndarray, radius: float
) -> tuple[np.ndarray, np.ndarray]:
    """H (6, 6), g (6,) of T^-1 p_cam - p_obj in standard deviations; turns about ``centre``, scaled by ``radius``."""
    H, g, J, q = np.zeros((6, 6)), np.zeros(6), np.zeros((3, 6)), np.zeros(3)
    J[0, 3] = J[1, 4] = J[2, 5] = -1.0
    for n in range(len(p_obj)):
        squared = 0.0
        for i in range(3):
            q[i] = T_obj_cam[i, 3]
            for k in range(3):
                q[i] += T_obj_cam[i, k] * p_cam[n, k]
            squared += (q[i] - p_obj[n, i]) ** 2
        e = np.sqrt(squared) / sigma_m[n]
        w = min(1.0, _HUBER / max(e, 1e-12)) / sigma_m[n] ** 2
        x, y, z = (q - centre) / radius
        J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = -z, y, z, -x, -y, x
        for i in range(3):
            for a in range(6):
                g[a] += w * J[i, a] * (q[i] - p_obj[n, i])
                for b in range(6):
                    H[a, b] += w * J[i, a] * J[i, b]
    return H, g


def surface_distances(volume: TsdfVolume, p_cam: np.ndarray, T_cam_obj: np.ndarray) -> np.ndarray:
    """(H, N) absolute TSDF value in metres of the points p_cam (N, 3) under poses (H, 4, 4).

    Its mean over the points is the paper's measure for choosing a hypothesis. A point that falls where nothing was
    observed counts the truncation distance, so that no pose wins by turning away from the surface.
    Points that are not finite are left out.
    """
    T_cam_obj = np.asarray(T_cam_obj, float).reshape(-1, 4, 4)
    value, valid = volume.query(se3.transform(se3.inverse(T_cam_obj), _usable(p_cam, len(p_cam))))
    return np.where(valid, np.abs(value), volume.tau_m)


def _usable(p_cam: np.ndarray, max_points: int) -> np.ndarray:
    p_cam = np.asarray(p_cam, float).reshape(-1, 3)
    return evenly(p_cam[np.isfinite(p_cam).all(-1)], max_points)


def _usable_keypoints(keypoints: Keypoints | None, config: RefinementConfig) -> Keypoints | None:
    if keypoints is None or config.residuals != "surface_and_keypoints":
        return None
    finite = np.isfinite(keypoints.p_obj).all(-1) & np.isfinite(keypoints.p_cam).all(-1)
    ok = finite & (keypoints.sigma_m > 0) & np.isfinite(keypoints.sigma_m)
    return Keypoints(keypoints.p_obj[ok], keypoints.p_cam[ok], keypoints.sigma_m[ok]) if ok.sum() >= 3 else None


#: Every second row and column of an image is compared with the surface.
_STRIDE = 2


def surface_distance(volume: TsdfVolume, depth_m: np.ndarray, camera: Camera, T_cam_obj: np.ndarray) -> np.ndarray:
    """(H, W) float32 signed distance of each measured pixel to the surface under a pose, in metres.

    Positive in front of it, infinite off the volume; NaN where it is not known. In the volume's part of the image every
    second row and column is computed, and repeated.
    """
    distance = np.where(depth_m > 0, np.float32(np.inf), np.float32(np.nan))
    corners = volume.corners_m()
    uv = camera.project(se3.transform(T_cam_obj, corners))
    if not np.isfinite(uv).all():
        return np.full(depth_m.shape, np.nan, np.float32)
    size = np.array(depth_m.shape[::-1])
    (left, top), (right, bottom) = np.clip([uv.min(0), uv.max(0) + 1], 0, size).astype(int)
    every = np.s_[top:bottom:_STRIDE, left:right:_STRIDE]
    z = depth_m[every]
    p_obj = se3.transform(se3.inverse(T_cam_obj), (camera.rays[every] * z[..., None]).reshape(-1, 3))
    value, known = volume.query(p_obj)
    off = ((p_obj < corners.min(0)) | (p_obj > corners.max(0))).any(1)
    value = np.where(known, value, np.where(off, np.inf, np.nan))
    found = np.where(z.ravel() > 0, value, np.nan).reshape(z.shape)
    coarse = np.repeat(np.repeat(found, _STRIDE, 0), _STRIDE, 1)
    distance[top:bottom, left:right] = coarse[: bottom - top, : right - left]
    return distance
