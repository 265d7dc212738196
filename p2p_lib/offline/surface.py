"""Each frame's pose refined on the surface fused from all, and lost ones found from their neighbours."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import median_abs_deviation

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.core.depth import depth_noise_m, in_range, off_edges
from p2p_lib.datasets.runs import NO_COVARIANCE, NO_POSE
from p2p_lib.method.refinement import Keypoints, refine
from p2p_lib.method.tsdf import TsdfVolume
from p2p_lib.offline.adjustment import PointObservations
from p2p_lib.offline.evidence import STEP_M, VideoEvidence
from p2p_lib.offline.finished import Finished
from p2p_lib.offline.surface_check import FittedPose, SurfaceCheck, off_surface

#: A point within this distance of its place by a pose is a keypoint of the pose, m.
_NEAR_M = 0.02
#: Finer volumes grow by other blocks, and take up to so many times the voxels that the coarser one says.
_ROOM = 1.3
#: A fit is as good as usual up to so many standard deviations above the median cost, and this.
_SIGMAS, _SLACK = 3.0, 0.02


def fused(made: Finished, name: str, T: np.ndarray, rows: np.ndarray, config: Config, voxel_m: float) -> TsdfVolume:
    """The surface that the frames ``rows`` show at poses T (n, 4, 4)."""
    volume = TsdfVolume(replace(config.tsdf, voxel_m=voxel_m))
    for k in rows:
        frame = made.frame(int(made.frames[k]))
        if (mask := made.masks(frame.index).get(name)) is not None:
            use = mask & off_edges(frame.depth_m, STEP_M) & in_range(frame.depth_m, config.depth)
            volume.integrate(frame.depth_m, frame.rgb, use, made.sequence.camera, se3.orthonormalised(T[k]))
    return volume


def finer_m(volume: TsdfVolume) -> float:
    """Half a volume's voxels, m, or such that all of its surface fits: half as long they are eight times as many."""
    return volume.voxel_m * max(0.5, float(np.cbrt(_ROOM * np.prod(volume.shape) / volume.config.max_voxels)))


class SurfacePoses:
    """Poses T (n, 4, 4) of an object, NaN where there is none, their covariance (n, 6, 6) and cost (n,) on a volume.

    points, seen  points of the object (N, 3) and their sightings, in the order of frames
    limit         the largest cost of a pose that fits as well as the others do
    """

    def __init__(
        self,
        T: np.ndarray,
        points: np.ndarray,
        seen: PointObservations,
        evidence: VideoEvidence,
        volume: TsdfVolume,
        camera: Camera,
        config: Config,
    ):
        self.T, self.covariance, self.cost = T.copy(), np.tile(NO_COVARIANCE, (len(T), 1, 1)), np.full(len(T), np.inf)
        self.limit = np.inf
        self._points, self._seen, self._evidence, self._volume = points, seen, evidence, volume
        self._camera, self._config = camera, config

    def refine(self, start: np.ndarray, confident: np.ndarray, bar: Any) -> None:
        """Refine each pose from itself and from ``start`` (n, 4, 4); ``confident`` rows set the limit of costs."""
        for k in range(len(self.T)):
            if np.isfinite(self.T[k, 0, 0]):
                self.T[k], self.covariance[k], self.cost[k] = self._best_of(k, [self.T[k], start[k]])
            bar.update()
        cost = self.cost[confident]
        self.limit = np.median(cost) + _SIGMAS * median_abs_deviation(cost, scale="normal") + _SLACK

    def ask_neighbours(self, check: SurfaceCheck | None) -> None:
        """Try frames that do not fit from their neighbours, from the end backwards, then from the start forwards."""
        T, cost, shown = self.T, self.cost, self._evidence.shown
        for step in (-1, 1):
            for k in range(len(T))[::step]:
                if cost[k] <= self.limit or not 0 <= k - step < len(T) or cost[k - step] > self.limit:
                    continue
                two = 0 <= k - 2 * step < len(T) and cost[k - 2 * step] <= self.limit
                before = T[k - 2 * step] if two else T[k - step]
                on = T[k - step] @ se3.inverse(before) @ T[k - step]  # goes on as it moved, else stays
                found: FittedPose | None
                if shown[k]:
                    found = self._best_of(k, [T[k - step], on])
                else:
                    found = check.found(k, [on, T[k - step]], k - step, T[k - step]) if check else None
                if found is not None and found.cost < cost[k]:
                    T[k], self.covariance[k], cost[k] = found

    def cost_at(self, k: int, T: np.ndarray) -> float:
        """The cost, 0 to 2, of a pose of the k-th frame: distance of its cloud and of its keypoints from the map."""
        met = self._points_in(k)
        off = off_surface(self._volume, T, self._evidence.clouds[k])
        apart = np.linalg.norm(se3.transform(se3.inverse(T), met.p_cam) - met.p_obj, axis=1) / (5 * met.sigma_m)
        parts = [float(part.mean()) for part in (off, np.minimum(apart, 1)) if len(part)]
        return 2 * sum(parts) / len(parts) if parts else 2.0

    def _best_of(self, k: int, candidates: list[np.ndarray]) -> FittedPose:
        """The pose of the k-th frame that fits surface and points best."""
        met, cloud = self._points_in(k), self._evidence.clouds[k].astype(float)
        best = FittedPose(NO_POSE, NO_COVARIANCE, np.inf)
        for T in candidates:
            near = np.linalg.norm(se3.transform(se3.inverse(T), met.p_cam) - met.p_obj, axis=1) < _NEAR_M
            keypoints = Keypoints(met.p_obj[near], met.p_cam[near], met.sigma_m[near]) if near.any() else None
            found = refine(T, cloud, self._volume, self._config.refinement, keypoints=keypoints)
            if (cost := self.cost_at(k, found.T_cam_obj)) < best.cost:
                covariance = NO_COVARIANCE if found.covariance is None else found.covariance
                best = FittedPose(found.T_cam_obj, covariance, cost)
        return best

    def _points_in(self, k: int) -> Keypoints:
        """The object's points that are seen in the k-th frame."""
        rows = slice(*np.searchsorted(self._seen.pose, [k, k + 1]))
        p_cam = self._seen.p_cam[rows]
        sigma_m = np.hypot(depth_noise_m(p_cam[:, 2], self._config.depth), p_cam[:, 2] / self._camera.fx)
        return Keypoints(self._points[self._seen.point[rows]], p_cam, sigma_m)
