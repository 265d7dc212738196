"""Landmarks: corners that were seen on a segment, by which it is found again anywhere in the image."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.spatial.distance import cdist

from p2p_lib.core import se3
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import Rows
from p2p_lib.trackers.builtin import features
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.tangent_planes import planes_at, tangent_steps

#: Steps of the grids on the surface on which corners are described: descriptors cover 2.4 and 4.8 cm.
_STEPS_M = (0.0015, 0.003)
#: Landmarks searched for in one frame: the cost of a search grows with their matches squared.
_SEARCHED = 400


@dataclass(frozen=True, eq=False)
class Corners(Rows):
    """Corners of an image where there is depth: uv_px (M, 2), p_cam (M, 3), descriptors (M, scales, SIZE)."""

    uv_px: np.ndarray
    p_cam: np.ndarray
    descriptors: np.ndarray


def corners(now: Image, region: np.ndarray | None, limit: int) -> Corners:
    """The strongest corners, at most ``limit``, inside ``region`` (H, W) if given."""
    return described(now, features.detect(now.gray, region, limit))[1]


def described(now: Image, uv_px: np.ndarray) -> tuple[np.ndarray, Corners]:
    """Which of the pixels (N, 2) have depth around them, rows (M,), and these as corners."""
    planes = planes_at(now.depth_m, now.camera, uv_px, 2)
    known = np.flatnonzero(np.isfinite(planes.p_cam[:, 0]))
    uv_px, planes = uv_px[known], planes.select(known)
    steps = [tangent_steps(planes, now.camera, step_m) for step_m in _STEPS_M]
    return known, Corners(uv_px, planes.p_cam, features.describe(now.gray, uv_px, steps))


def alike(descriptors: np.ndarray, found: Corners, ratio: float) -> np.ndarray:
    """(2, M) which of descriptors (N, scales, SIZE) look like which corners, by one scale or the other."""
    scales = zip(np.moveaxis(descriptors, 1, 0), np.moveaxis(found.descriptors, 1, 0), strict=True)
    return np.concatenate([features.match(own, of, found.uv_px, ratio) for own, of in scales], 1)


@dataclass(eq=False)
class Landmarks:
    """Landmarks of one segment.

    p_seg        (L, 3) positions on it
    descriptors  (L, scales, SIZE)
    views        (V, 3) camera centres from which they were taken, relative to the segment's centre, in its frame
    """

    p_seg: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, len(_STEPS_M), features.SIZE), np.float32))
    views: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def taken_from(self, view: np.ndarray, within_deg: float) -> bool:
        """Whether landmarks were taken from about the direction of ``view`` (3,), one as in ``views``."""
        cosine = self.views @ view / (np.linalg.norm(self.views, axis=1) * np.linalg.norm(view))
        return bool((cosine > np.cos(np.radians(within_deg))).any())

    def add(
        self,
        now: Image,
        T_seg_cam: np.ndarray,
        view: np.ndarray,
        uv_px: np.ndarray,
        p_seg: np.ndarray,
        cfg: TrackingConfig,
        rng: np.random.Generator,
    ) -> None:
        """Add the corners near points of the segment, seen at uv_px (N, 2), p_seg (N, 3); at most ``max_landmarks``."""
        found = corners(now, _region_around(uv_px, now, cfg.segment_reach_m), cfg.corners)
        at = se3.transform(T_seg_cam, found.p_cam)
        near = cdist(at, p_seg).min(1) < cfg.segment_reach_m
        at = np.concatenate([self.p_seg, at[near]])
        keep = np.sort(rng.permutation(len(at))[: cfg.max_landmarks])
        self.p_seg, self.descriptors = at[keep], np.concatenate([self.descriptors, found.descriptors[near]])[keep]
        self.views = np.vstack([self.views, view])

    def match(
        self, found: Corners, ratio: float, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs of some of the landmarks with corners: p_seg (M, 3), p_cam (M, 3), and which corner (M,)."""
        some = rng.permutation(len(self.p_seg))[:_SEARCHED]
        which, corner = alike(self.descriptors[some], found, ratio)
        return self.p_seg[some[which]], found.p_cam[corner], corner


def _region_around(uv_px: np.ndarray, now: Image, reach_m: float) -> np.ndarray:
    """(H, W) bool: pixels about as near to uv_px (N, 2) as reach_m at their depth."""
    z = now.depth_at(uv_px)
    reach_px = int(now.camera.fx * reach_m / max(np.median(z[z > 0]), reach_m)) if (z > 0).any() else 0
    region = np.zeros(now.gray.shape, np.uint8)
    u, v = nearest_px(uv_px, now.gray.shape)
    region[v, u] = 1
    return cv2.dilate(region, np.ones((2 * reach_px + 1, 2 * reach_px + 1), np.uint8)) > 0
