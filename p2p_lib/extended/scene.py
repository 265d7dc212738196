"""The static background as a sparse map of corners, which tells how the camera has moved (not in the paper; ours).

An object that lies still while the camera looks elsewhere is where the scene says when the camera returns: a
hypothesis for :mod:`p2p_lib.extended.policy`, which points and surface have to confirm.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import robust, se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import compiled
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import Frame

#: Most corners of an image, and the margin left around objects, px.
_CORNERS, _ROOM_PX = 600, 10
#: Farthest depth used for the camera's pose, m: that only has to lead to an object.
_MAX_M = 5.0
#: A descriptor is matched when it is nearer than this share of the second nearest.
_RATIO = 0.8
#: A camera pose needs so many corners that agree within the noise of depth or this distance, m.
_MIN_AGREEING, _INLIER_M = 15, 0.02
#: A view is kept when the camera has moved (m) or turned (rad) by this from all others; so many at most.
_MOVED_M, _TURNED_RAD, _VIEWS = 0.15, np.radians(12), 100
#: A frame is matched to so many views near the newest pose or, after a failure, to as many others in turn.
_NEAR = 5
#: Views nearer to the newest pose than this, in units of _MOVED_M or _TURNED_RAD, overlap it.
_OVERLAPS = 4.0
_SAMPLES = 300


@dataclass(frozen=True, eq=False)
class _View:
    """Corners of one frame: p (M, 3) in the camera's or the world's frame, ORB descriptors (M, 32) uint8."""

    p: np.ndarray
    descriptors: np.ndarray
    T_world_cam: np.ndarray


class CameraTracker:
    """Tracks the camera in the world, the frame of the first camera, while it sees places that it has seen before."""

    def __init__(self, camera: Camera, config: DepthConfig, rng: np.random.Generator):
        self._camera, self._config, self._rng = camera, config, rng
        # As many matches as with the default pyramid, in half the time.
        self._orb = cv2.ORB.create(_CORNERS, scaleFactor=1.4, nlevels=4)
        self._views: list[_View] = []
        self._T_world_cam = np.eye(4)
        self._turn = 0  # of the views that are tried while the camera is lost

    def locate(self, frame: Frame, occupied: np.ndarray | None) -> np.ndarray | None:
        """T_world_cam (4, 4) of a frame, None where it is not known; views of new places are taken into the map.

        occupied  (H, W) bool: objects, which may move by themselves
        """
        seen = self._corners(frame, occupied)
        if not self._views:
            if len(seen.p) >= _MIN_AGREEING:
                self._views.append(seen)
            return seen.T_world_cam if self._views else None
        T_world_cam = self._registered(seen)
        if T_world_cam is None:
            self._turn += 1
            return None
        self._turn, self._T_world_cam = 0, T_world_cam
        if self._away(T_world_cam).min() > 1 and len(self._views) < _VIEWS:
            self._views.append(_View(se3.transform(T_world_cam, seen.p), seen.descriptors, T_world_cam))
        return T_world_cam

    def _corners(self, frame: Frame, occupied: np.ndarray | None) -> _View:
        gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        free = None
        if occupied is not None:
            grown = cv2.dilate(occupied.astype(np.uint8), np.ones((2 * _ROOM_PX + 1,) * 2, np.uint8))
            free = 255 * (1 - grown)
        found, descriptors = self._orb.detectAndCompute(gray, free)
        uv_px = np.asarray(cv2.KeyPoint.convert(found)) if found else np.zeros((0, 2), np.float32)
        u, v = nearest_px(uv_px, gray.shape)
        z = frame.depth_m[v, u].astype(float)
        measured = (z > self._config.min_m) & (z < _MAX_M)
        p_cam = self._camera.unproject(uv_px[measured], z[measured])
        descriptors = np.zeros((0, 32), np.uint8) if descriptors is None else descriptors[measured]
        return _View(p_cam, descriptors, self._T_world_cam)

    def _away(self, T_world_cam: np.ndarray) -> np.ndarray:
        """(V,) how far the views are from a pose; above 1 it is another place."""
        poses = np.stack([view.T_world_cam for view in self._views])
        moved_m = np.linalg.norm(poses[:, :3, 3] - T_world_cam[:3, 3], axis=1)
        return np.maximum(moved_m / _MOVED_M, se3.angle_rad(se3.inverse(T_world_cam) @ poses) / _TURNED_RAD)

    def _registered(self, seen: _View) -> np.ndarray | None:
        """The camera's pose by the two nearest and the three oldest overlapping views; when lost, by others in turn."""
        away = self._away(self._T_world_cam)
        nearest = np.argsort(away, kind="stable")
        oldest = np.flatnonzero(away < _OVERLAPS)
        turn = self._turn % (1 + int(np.ceil(max(len(away) - 2, 0) / _NEAR)))
        chosen = nearest[2 + (turn - 1) * _NEAR : 2 + turn * _NEAR]
        if not turn:
            chosen = np.unique(np.concatenate([nearest[:2], oldest[:3]]))
        pairs = [self._matched(self._views[k], seen) for k in chosen]
        p_world, p_cam = (np.concatenate(column) for column in zip(*pairs, strict=True))
        if len(p_world) < _MIN_AGREEING:
            return None
        limit_m = np.maximum(_INLIER_M, 3 * depth_noise_m(p_cam[:, 2], self._config))
        T = robust.ransac(p_world, p_cam, limit_m, 3, _SAMPLES, self._rng)
        if T is None:
            return None
        among = np.ones(len(p_cam), bool)
        fit = robust.refit(T, p_world, p_cam, limit_m, 1 / limit_m**2, _MIN_AGREEING, among)
        return None if fit is None else se3.inverse(fit.T_a_b)

    @staticmethod
    def _matched(view: _View, seen: _View) -> tuple[np.ndarray, np.ndarray]:
        """Corners p (M, 3) of a view with those they match, p_cam (M, 3)."""
        if len(seen.descriptors) < 2:
            return np.zeros((0, 3)), np.zeros((0, 3))
        nearest, distance, second = two_nearest(view.descriptors.view(np.uint64), seen.descriptors.view(np.uint64))
        good = distance < _RATIO * second
        return view.p[good], seen.p[nearest[good]]


@compiled("u8[:,::1], u8[:,::1]")
def two_nearest(descriptors, others):
    """Nearest (M,) of others (N, W) to binary descriptors (M, W) uint64; bits (M,) by which it and the next differ.

    A third of the time of OpenCV's search, whose ordered lists cost more than the distances.
    """
    nearest = np.zeros(len(descriptors), np.int64)
    distance, second = np.full((2, len(descriptors)), 64 * descriptors.shape[1] + 1)
    for m in range(len(descriptors)):
        for n in range(len(others)):
            bits = 0
            for w in range(descriptors.shape[1]):
                # A sum of neighbouring bits, pairs, nibbles and bytes, which compilers know as one instruction.
                x = descriptors[m, w] ^ others[n, w]
                x = x - ((x >> np.uint64(1)) & np.uint64(0x5555555555555555))
                x = (x & np.uint64(0x3333333333333333)) + ((x >> np.uint64(2)) & np.uint64(0x3333333333333333))
                x = (x + (x >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
                bits += np.int64((x * np.uint64(0x0101010101010101)) >> np.uint64(56))  # type: ignore[assignment]  # compiled
            if bits < distance[m]:
                nearest[m], distance[m], second[m] = n, bits, distance[m]
            elif bits < second[m]:
                second[m] = bits
    return nearest, distance, second
