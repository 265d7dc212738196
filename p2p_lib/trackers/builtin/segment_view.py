"""A motion segment in the frame where it was seen last: what showed of it, where it can be next, its matches."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from scipy.spatial import cKDTree

from p2p_lib.core import se3
from p2p_lib.core.image import in_mask
from p2p_lib.trackers.builtin.direct_alignment import Patch, Surface
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.landmarks import Corners, corners

#: Corners that are described on a segment.
CORNERS = 400
#: A segment reaches so far beyond the hull of its points; it may move by these from frame to frame.
_BESIDE_PX, _MOVES_PX, _MOVES_M = 6, 80, 0.08
#: Error of a matched corner's place, px.
_CORNER_PX = 1.5
#: Corners nearer to the border of a region are of its outline, px.
_BORDER_PX = 4
#: A corner is on it that is nearer to one of its points than so many times their own distance, within these bounds.
_SPACINGS, _NEAR_M = 2.0, (0.01, 0.03)
#: Colours (CIELAB a, b) that differ by less than one or two of these are the same.
_BIN = 6


def inner(region: np.ndarray) -> np.ndarray:
    """A region (H, W) without its border: an outline does not move with a round object that turns."""
    return cv2.erode(region.astype(np.uint8), np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)) > 0


@dataclass(eq=False)
class SegmentView:
    """A segment where it was last seen: the image, its visible points uv_px (N, 2), its pose T_cam_seg.

    search  (H, W) bool: where the objects were in that frame; None where nobody knows
    found   corners of the whole region that was searched in that frame; None where it was not
    """

    image: Image
    uv_px: np.ndarray
    T_cam_seg: np.ndarray
    search: np.ndarray | None = None
    found: Corners | None = field(default=None, repr=False)

    @cached_property
    def own(self) -> np.ndarray:
        """(H, W) bool: the segment, inside the hull of its points."""
        hull = np.zeros(self.image.gray.shape, np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(self.uv_px).astype(np.int32)), 1)
        own = cv2.dilate(hull, np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)) > 0
        return own if self.search is None else own & inner(self.search)

    @cached_property
    def corners(self) -> Corners:
        """The corners on the segment: those near points of it in space, for a hand may be before it."""
        found = self.found
        if found is None:
            found = corners(self.image, self.own, CORNERS)
        else:
            found = found.select(in_mask(found.uv_px, self.own))
        return found.select(self._on_it(found.p_cam))

    def _on_it(self, p_cam: np.ndarray) -> np.ndarray:
        """Which of these places (N, 3) are near its points: what is before it, or beside it, is not."""
        z = self.image.depth_at(self.uv_px)
        points = self.image.camera.unproject(self.uv_px[z > 0], z[z > 0])
        if len(points) < 2:
            return np.zeros(len(p_cam), bool)
        tree = cKDTree(points)
        apart_m = np.clip(_SPACINGS * np.median(tree.query(points, 2)[0][:, 1]), *_NEAR_M)
        return tree.query(p_cam)[0] < apart_m

    @cached_property
    def _box(self) -> np.ndarray:
        """(2, 2) corners of where it is and can be in the next frame, px of half the resolution."""
        reach = [_MOVES_PX, _BESIDE_PX]
        return np.array(
            [np.floor((self.uv_px.min(0) - sum(reach)) / 2), np.ceil((self.uv_px.max(0) + sum(reach)) / 2)], int
        )

    @cached_property
    def surface(self) -> Surface:
        """What showed of it, for direct alignment."""
        patch, corner = Patch.of(self.image, *self._box), np.maximum(self._box[0], 0)
        hull = np.zeros(patch.depth_m.shape, np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(self.uv_px / 2).astype(np.int32) - corner.astype(np.int32)), 1)
        own = cv2.dilate(hull, np.ones((_BESIDE_PX + 1,) * 2, np.uint8)) > 0
        if self.search is not None:
            end = corner + own.shape[::-1]
            search = self.search[::2, ::2][corner[1] : end[1], corner[0] : end[0]]
            own &= cv2.erode(search.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        shown = patch.surface(own)
        return shown.select(np.flatnonzero(self._on_it(shown.p_cam)))

    def patch(self, now: Image) -> Patch:
        """Where it can be in the next frame."""
        return Patch.of(now, *self._box)

    def carried(self, motion: np.ndarray, now: Image) -> Matched:
        """Its surface taken along by a motion (4, 4), as far as that shows: as pairs."""
        p_cam = se3.transform(motion, self.surface.p_cam)
        uv_px = now.camera.project(p_cam)
        shows = np.abs(now.depth_at(uv_px) - p_cam[:, 2]) < self.surface.depth_m
        p_seg = se3.transform(se3.inverse(self.T_cam_seg), self.surface.p_cam[shows])
        return Matched(
            motion @ self.T_cam_seg, p_seg, uv_px[shows], p_cam[shows, 2], None, self.surface.cov_px2[shows], True
        )

    def region(self, now: Image) -> np.ndarray:
        """(H, W) bool: where the segment can be one frame later, by its place, its depth and its colours."""
        h, w = now.gray.shape
        left, top = np.clip(self.uv_px.min(0) - _MOVES_PX, 0, [w - 1, h - 1]).astype(int)
        right, bottom = np.clip(self.uv_px.max(0) + _MOVES_PX + 1, 1, [w, h]).astype(int)
        part = np.s_[top:bottom, left:right]
        z = self.image.depth_at(self.uv_px)
        z = z[z > 0]
        region = np.zeros((h, w), bool)
        if len(z):
            depth_m = now.depth_m[part]
            region[part] = (depth_m > z.min() - _MOVES_M) & (depth_m < z.max() + _MOVES_M) & self._coloured(now)[part]
        return region

    def _coloured(self, now: Image) -> np.ndarray:
        """(H, W) bool: the pixels with about the colours of the segment."""
        own = cv2.resize(self.own.astype(np.uint8), self.image.chroma.shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
        known = np.zeros((256 // _BIN,) * 2, np.uint8)
        known[tuple((self.image.chroma[own] // _BIN).astype(int).T)] = 1
        known = cv2.dilate(known, np.ones((3, 3), np.uint8)).astype(np.uint8)
        a, b = (now.chroma // _BIN).astype(int).transpose(2, 0, 1)
        near = cv2.dilate(known[a, b], np.ones((3, 3), np.uint8))
        return cv2.resize(near, now.gray.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0


@dataclass(frozen=True, eq=False)
class Matched:
    """The pose T_cam_seg (4, 4) that pairs agree on; of those p_seg (M, 3), uv_px (M, 2), z_m (M,).

    found      the corners that were searched; None where none were
    cov_px2    (M, 2, 2) of uv_px
    overruling whether the pose stands against that of the points
    """

    T_cam_seg: np.ndarray
    p_seg: np.ndarray
    uv_px: np.ndarray
    z_m: np.ndarray
    found: Corners | None = None
    cov_px2: np.ndarray = field(default_factory=lambda: _CORNER_PX**2 * np.eye(2))
    overruling: bool = False

    def __len__(self) -> int:
        return len(self.p_seg)
