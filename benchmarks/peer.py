"""The yardstick: a plain LK + SIFT + RANSAC tracker of a hundred lines of code, what an afternoon with OpenCV gives.

Lucas-Kanade follows the keypoints of all objects, SIFT finds lost ones again in the given masks and brings new ones,
RANSAC registers what has depth to a map that only grows. There is no surface, no graph, no second hypothesis, no doubt.
It uses values and the stopwatch of the library and none of its stages, so that it stays as it is when those change.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame

FLOW = {"winSize": (15, 15), "maxLevel": 3}
HOME_PX, APART_PX = 0.7, 6.0
SIFT_EVERY, FEW, MIN_PX = 5, 40, 300
SAMPLES, INLIER_M, MIN_INLIERS, NEW_VIEW_DEG = 200, 0.006, 6, 10.0


@dataclass
class Known:
    """One object: map points (N, 3) with SIFT descriptors (N, 128), where they are (N, 2) and whether; its views."""

    p_obj: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, 128), np.float32))
    uv_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), np.float32))
    visible: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))
    views: list[np.ndarray] = field(default_factory=list)


class Peer:
    """Follows ``objects`` by the masks that ``step`` is given; a keyframe adds up to ``points`` to an object's map."""

    def __init__(self, camera: Camera, objects: Iterable[str], points: int = 60):
        self.camera, self.points, self.objects = camera, points, {name: Known() for name in objects}
        self.stopwatch, self.count, self.gray = Stopwatch(), 0, None
        self.sift, self.matcher = cv2.SIFT.create(600, contrastThreshold=0.02), cv2.BFMatcher()
        self.rng = np.random.default_rng(0)

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray]) -> dict[str, np.ndarray | None]:
        """T_cam_obj (4, 4) of each object, in the camera's axes at its first frame; None where it has none."""
        with self.stopwatch.frame():
            gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
            with self.stopwatch("flow"):
                self._flow(gray)
            self.count += 1
            return {k: self._pose(obj, gray, frame.depth_m, masks[k]) for k, obj in self.objects.items() if k in masks}

    def _flow(self, gray: np.ndarray) -> None:
        """All visible points of all objects into this image, there and back."""
        before, self.gray = self.gray, gray
        if not any(obj.visible.any() for obj in self.objects.values()):
            return
        here = np.concatenate([obj.uv_px[obj.visible] for obj in self.objects.values()])
        there, found, _ = cv2.calcOpticalFlowPyrLK(before, gray, here, None, **FLOW)
        home, _, _ = cv2.calcOpticalFlowPyrLK(gray, before, there, None, **FLOW)
        kept = (found[:, 0] > 0) & (np.linalg.norm(home - here, axis=1) < HOME_PX) & self.camera.inside(there)
        for obj in self.objects.values():
            n = obj.visible.sum()
            obj.uv_px[obj.visible], there = there[:n], there[n:]
            obj.visible[obj.visible], kept = kept[:n], kept[n:]

    def _pose(self, obj: Known, gray: np.ndarray, depth_m: np.ndarray, mask: np.ndarray) -> np.ndarray | None:
        within = (cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & (depth_m > 0)
        obj.visible[obj.visible] = _at(within, obj.uv_px[obj.visible])
        if within.sum() < MIN_PX:
            return None
        seen = None
        if obj.visible.sum() < min(FEW, self.points) or self.count % SIFT_EVERY == 0:
            with self.stopwatch("detection"):
                seen = self._detect(obj, gray, within)
        if not obj.views:
            return self._extend(obj, se3.IDENTITY, depth_m, seen)
        with self.stopwatch("registration"):
            at = np.flatnonzero(obj.visible)
            p_cam = self.camera.unproject(obj.uv_px[at], _at(depth_m, obj.uv_px[at]))
            T, inliers = ransac(obj.p_obj[at], p_cam, self.rng)
        if inliers.sum() < MIN_INLIERS:
            return None
        obj.visible[at[~inliers]] = False
        turned = se3.angle_rad(se3.inverse(np.array(obj.views)) @ T).min()
        if seen is not None and (np.degrees(turned) > NEW_VIEW_DEG or inliers.sum() < FEW / 2):
            self._extend(obj, T, depth_m, seen)
        return T

    def _detect(self, obj: Known, gray: np.ndarray, within: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """SIFT inside the mask: where (n, 2), strongest first, and descriptors; lost map points among them are back."""
        x, y, w, h = cv2.boundingRect(within.astype(np.uint8))
        part = np.s_[y : y + h, x : x + w]
        found, descriptors = self.sift.detectAndCompute(gray[part], within[part].astype(np.uint8))
        if not found:
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
        uv_px = np.array([k.pt for k in found], np.float32) + np.float32([x, y])
        pairs = self.matcher.knnMatch(descriptors, obj.descriptors, k=2) if len(obj.p_obj) > 1 else ()
        for best, second in pairs:
            if best.distance < 0.75 * second.distance and not obj.visible[best.trainIdx]:
                obj.uv_px[best.trainIdx], obj.visible[best.trainIdx] = uv_px[best.queryIdx], True
        order = np.argsort([-k.response for k in found])
        return uv_px[order], descriptors[order]

    def _extend(self, obj: Known, T: np.ndarray, depth_m: np.ndarray, seen: tuple[np.ndarray, ...]) -> np.ndarray:
        """A keyframe: what SIFT saw apart from known points joins the map."""
        known, new = list(obj.uv_px[obj.visible]), []
        for k in np.flatnonzero(_at(depth_m, seen[0]) > 0):
            uv = seen[0][k]
            if len(new) < self.points and (not known or np.linalg.norm(known - uv, axis=1).min() > APART_PX):
                known.append(uv)
                new.append(k)
        p_cam = self.camera.unproject(seen[0][new], _at(depth_m, seen[0][new]))
        obj.p_obj = np.concatenate([obj.p_obj, se3.transform(se3.inverse(T), p_cam)])
        obj.descriptors = np.concatenate([obj.descriptors, seen[1][new]])
        obj.uv_px = np.concatenate([obj.uv_px, seen[0][new]])
        obj.visible = np.concatenate([obj.visible, np.ones(len(new), bool)])
        obj.views.append(T)
        return T


def _at(image: np.ndarray, uv_px: np.ndarray) -> np.ndarray:
    """Values of an image at the nearest pixels (n, 2)."""
    u, v = np.clip(np.round(uv_px).astype(int), 0, np.array(image.shape[::-1]) - 1).T
    return image[v, u]


def ransac(p_obj: np.ndarray, p_cam: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """T_cam_obj that most pairs (n, 3) agree on, refitted to them, and who they are (n,) bool."""
    if len(p_obj) < MIN_INLIERS:
        return se3.IDENTITY, np.zeros(len(p_obj), bool)
    some = rng.random((SAMPLES, len(p_obj))).argpartition(3, axis=1)[:, :3]
    T = kabsch(p_obj[some], p_cam[some])
    agree = np.linalg.norm(se3.transform(T, p_obj) - p_cam, axis=-1) < INLIER_M
    most = agree.sum(1).argmax()
    T, inliers = T[most], agree[most]
    for _ in range(2 if inliers.sum() >= MIN_INLIERS else 0):
        T = kabsch(p_obj[inliers], p_cam[inliers])
        inliers = np.linalg.norm(se3.transform(T, p_obj) - p_cam, axis=1) < INLIER_M
    return T, inliers


def kabsch(p_obj: np.ndarray, p_cam: np.ndarray) -> np.ndarray:
    """T_cam_obj (..., 4, 4) of least squares over pairs (..., n, 3)."""
    at_obj, at_cam = p_obj.mean(-2, keepdims=True), p_cam.mean(-2, keepdims=True)
    U, _, Vt = np.linalg.svd(np.swapaxes(p_cam - at_cam, -1, -2) @ (p_obj - at_obj))
    U[..., 2] *= np.sign(np.linalg.det(U @ Vt))[..., None]  # a rotation, no reflection
    R = U @ Vt
    return se3.from_rt(R, (at_cam - at_obj @ np.swapaxes(R, -1, -2))[..., 0, :])
