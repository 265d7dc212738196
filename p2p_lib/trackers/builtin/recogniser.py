"""Objects that are known from a memory, found anywhere in an image by how their landmarks look on the surface.

By the same corners and descriptors the tracker finds a lost segment: what is remembered is as if it had been lost.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.robust import consensus, refit, residual_m
from p2p_lib.core.types import SHARED, Frame, Rows
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.landmarks import Corners, alike, corners, described
from p2p_lib.trackers.builtin.segment_view import inner

#: Corners that are described in a whole image, and in the mask of one object.
_IN_IMAGE, _IN_MASK = 800, 300
#: Landmarks that are compared with them in one frame, and the most pairs that a pose is sought by.
_COMPARED, _PAIRS = 600, 400
#: A match is nearer than this times the next best place, among all and where a pose expects it.
_RATIO, _EXPECTED_RATIO = 0.85, 0.95
#: Descriptors are of unit length, and kept as bytes of this scale.
_SCALE = 255.0
#: Pairs agree within this, m; fewer of them do not improve a pose.
_AGREE_M, _REFIT = 0.008, 12


@dataclass(frozen=True, eq=False)
class Recognised(Rows):
    """Landmarks, rows (M,), that look like corners at uv_px (M, 2), p_cam (M, 3); those that agree on T_cam_obj (4, 4).

    T_cam_obj is None for pairs of which nobody knows whether they agree.
    """

    rows: np.ndarray
    uv_px: np.ndarray
    p_cam: np.ndarray
    T_cam_obj: np.ndarray | None = field(default=None, metadata=SHARED)


class Recogniser:
    """Describes landmarks, and finds them again, in images of one camera."""

    def __init__(self, camera: Camera):
        self.camera = camera
        self._rng = np.random.default_rng(0)  # part of the method: the same stream gives the same
        self._newest: tuple[Frame, Corners] | None = None  # a frame's corners serve all objects

    def describe(self, frame: Frame, mask: np.ndarray, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Landmarks of an object: corners in its ``mask`` (H, W) and points at ``uv_px`` (M, 2), where there is depth.

        Returns p_cam (N, 3) and descriptors (N, scales, SIZE) uint8.
        """
        now = Image.of(frame, self.camera)
        own, (_, points) = corners(now, inner(mask), _IN_MASK), described(now, uv_px.astype(np.float32))
        descriptors = np.concatenate([own.descriptors, points.descriptors])
        as_bytes = np.rint(np.clip(descriptors, 0, 1) * _SCALE).astype(np.uint8)
        return np.concatenate([own.p_cam, points.p_cam]), as_bytes

    def pairs(self, frame: Frame, descriptors: np.ndarray) -> Recognised:
        """Some of the landmarks (N,) that look like corners anywhere in an image."""
        some, found = self._rng.permutation(len(descriptors))[:_COMPARED], self._corners(frame)
        rows, corner = self._pairs(found, descriptors, some, _RATIO)
        kept = np.sort(self._rng.permutation(len(rows))[:_PAIRS])
        rows, corner = rows[kept], corner[kept]
        return Recognised(rows, found.uv_px[corner].astype(float), found.p_cam[corner])

    def within(self, frame: Frame, mask: np.ndarray, descriptors: np.ndarray) -> Recognised:
        """The landmarks (N,) that look like corners in a ``mask`` (H, W)."""
        found = corners(Image.of(frame, self.camera), inner(mask), _IN_MASK)
        rows, corner = self._pairs(found, descriptors, np.arange(len(descriptors)), _EXPECTED_RATIO)
        return Recognised(rows, found.uv_px[corner].astype(float), found.p_cam[corner])

    @staticmethod
    def agreeing(pairs: Recognised, p_obj: np.ndarray) -> Recognised:
        """Of pairs with landmarks (N, 3) those that most agree with on one pose, each landmark and corner once."""
        _, corner = np.unique(pairs.uv_px, axis=0, return_inverse=True)
        T_cam_obj, agrees = consensus(p_obj[pairs.rows], pairs.p_cam, _AGREE_M, corner.ravel())
        return _once(pairs, agrees, T_cam_obj)

    def at(
        self, frame: Frame, mask: np.ndarray, T_cam_obj: np.ndarray, p_obj: np.ndarray, descriptors: np.ndarray
    ) -> Recognised:
        """The landmarks (N, 3) that are seen in a ``mask`` (H, W) where a pose has them; perhaps none.

        Each looks like its corner, and may be a few pixels beside it: their pose is refit to them all.
        """
        pairs = self.within(frame, mask, descriptors)
        expected, every = p_obj[pairs.rows], np.ones(len(pairs))
        if fit := refit(T_cam_obj, expected, pairs.p_cam, _AGREE_M * every, every, _REFIT, every > 0):
            return _once(pairs, fit.inliers, fit.T_a_b)
        near = residual_m(T_cam_obj, expected, pairs.p_cam) < _AGREE_M
        return _once(pairs, near, T_cam_obj)

    def _corners(self, frame: Frame) -> Corners:
        if self._newest is None or self._newest[0] is not frame:
            self._newest = frame, corners(Image.of(frame, self.camera), None, _IN_IMAGE)
        return self._newest[1]

    @staticmethod
    def _pairs(
        found: Corners, descriptors: np.ndarray, some: np.ndarray, ratio: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rows among ``some`` landmarks, and the corners that look like them."""
        if not len(found) or not len(some):
            return np.zeros(0, int), np.zeros(0, int)
        which, corner = np.unique(alike(descriptors[some].astype(np.float32) / _SCALE, found, ratio), axis=1)
        return some[which], corner


def _once(pairs: Recognised, chosen: np.ndarray, T_cam_obj: np.ndarray) -> Recognised:
    """The chosen (M,) of some pairs, each corner and each landmark once."""
    at = np.flatnonzero(chosen)
    at = at[np.unique(pairs.uv_px[at], axis=0, return_index=True)[1]]
    at = at[np.unique(pairs.rows[at], return_index=True)[1]]
    return Recognised(pairs.rows[at], pairs.uv_px[at], pairs.p_cam[at], T_cam_obj)
