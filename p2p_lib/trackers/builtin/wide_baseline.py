"""Wide-baseline matching: how a rigid motion segment moved where short steps fail, by the corners of two frames.

A fast turn, a fast camera or blur leaves nothing for Lucas-Kanade, whose steps are short, and little for templates.
Corners described on the surface are still the same: those of the segment in the frame where it was seen last are matched
with those of the newest frame, both ways, and the rigid motion that most pairs agree on in 3D is the segment's.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from p2p_lib.core import robust, se3
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.image import in_mask
from p2p_lib.trackers.builtin.features import mutual_match
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.landmarks import Corners, corners

#: Corners that are described in one frame: what a search may cost.
CORNERS = 400
#: A segment reaches so far beyond the hull of its points; it may move by this from frame to frame, px.
_BESIDE_PX, _MOVES_PX = 6, 100
#: Samples of the search for the rigid motion, and pairs that have to agree on it.
_SAMPLES, _AGREEING = 300, 8


@dataclass(eq=False)
class Sight:
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
    def corners(self) -> Corners:
        """The corners on the segment: inside the hull of its points."""
        region = np.zeros(self.image.gray.shape, np.uint8)
        cv2.fillConvexPoly(region, cv2.convexHull(np.rint(self.uv_px).astype(np.int32)), 1)
        own = cv2.dilate(region, np.ones((2 * _BESIDE_PX + 1,) * 2, np.uint8)) > 0
        own = own if self.search is None else own & self.search
        if self.found is None:
            return corners(self.image, own, CORNERS)
        return self.found.select(in_mask(self.found.uv_px, own))

    def region(self) -> np.ndarray:
        """(H, W) bool: where the segment can be one frame later."""
        region = np.zeros(self.image.gray.shape, bool)
        left, top = np.maximum(self.uv_px.min(0) - _MOVES_PX, 0).astype(int)
        right, bottom = np.maximum(self.uv_px.max(0) + _MOVES_PX + 1, 0).astype(int)
        region[top:bottom, left:right] = True
        return region


@dataclass(frozen=True, eq=False)
class Matched:
    """The pose T_cam_seg (4, 4) that pairs agree on; of those p_seg (M, 3), uv_px (M, 2), z_m (M,).

    found  the corners that were searched
    """

    T_cam_seg: np.ndarray
    p_seg: np.ndarray
    uv_px: np.ndarray
    z_m: np.ndarray
    found: Corners

    def __len__(self) -> int:
        return len(self.p_seg)


def matched(then: Sight, found: Corners, cfg: TrackingConfig, rng: np.random.Generator) -> Matched | None:
    """The segment's pose among the corners ``found`` in a later frame; None where too few of its own agree on one."""
    own = then.corners
    if min(len(own.uv_px), len(found.uv_px)) < _AGREEING:
        return None
    scales = (np.moveaxis(of.descriptors, 1, 0) for of in (own, found))
    pairs = [mutual_match(a, b, cfg.match_ratio) for a, b in zip(*scales, strict=True)]
    which, corner = np.unique(np.concatenate(pairs, 1), axis=1)
    p_then, p_cam = own.p_cam[which], found.p_cam[corner]
    limit_m = np.full(len(p_cam), cfg.segment_inlier_m)
    T = robust.ransac(p_then, p_cam, limit_m, 3, _SAMPLES, rng) if len(p_cam) >= _AGREEING else None
    if T is None:
        return None
    everything = np.ones(len(p_cam), bool)
    fit = robust.refit(T, p_then, p_cam, limit_m, np.ones(len(p_cam)), _AGREEING, everything)
    if fit is None:
        return None
    agree = fit.inliers
    p_seg = se3.transform(se3.inverse(then.T_cam_seg), p_then[agree])
    return Matched(fit.T_a_b @ then.T_cam_seg, p_seg, found.uv_px[corner[agree]], p_cam[agree, 2], found)
