"""Where something flat ends: what holds its pose along its surface, where neither shape nor points do (ours).

What is flat and plain slides over itself: its surface fits as well a little farther on. But it ends somewhere. The
contour of a mask, laid on the plane of its depth, is a line on the object; a pose lays it on the contour of a later
mask. Of a round body the contour is wherever the line of sight grazes it, which says nothing of its turn: it is asked
only where the surface leaves free where the object is.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import RefinementConfig
from p2p_lib.core.image import in_image, nearest_px, outline_px
from p2p_lib.core.types import Frame, evenly
from p2p_lib.method.refinement import Keypoints, Refinement, refine
from p2p_lib.method.tsdf import TsdfVolume

#: Points that an object's contour is known by at most, and the fewest that say anything.
_POINTS, _FEWEST = 120, 24
#: Depth is compared so many pixels to either side of a contour. What is so much nearer outside, m, hides the object.
_BESIDE_PX, _NEARER_M = 4, 0.02
#: Something is flat whose points scatter about a plane by less, m. A plane carries a contour where the line of sight is
#: this near to its normal, as a cosine: else where it ends is not known well.
_FLAT_M, _FACING = 0.005, 0.5
#: How far from each other points of two contours may be to be one, px: in each round of matching. Less than this share
#: of a contour does not say which part it is.
REACH_PX, _MOST = (16.0, 8.0, 4.0, 4.0, 4.0), 0.7
#: A point is on the other contour within this, px: a known one on one seen, one seen on a known one, which has fewer.
_ON_PX, _BACK_PX = 2.5, 5.0
#: Neighbours are off together: all points of a contour are worth so many.
_INDEPENDENT = 20


def contour_px(frame: Frame, mask: np.ndarray) -> np.ndarray:
    """(N, 2) pixels along the largest part of a mask (H, W) where it ends because the object does.

    Not at the image's border, nor where something nearer begins.
    """
    uv_px, inner, outer = outline_px(mask, _BESIDE_PX)
    (u, v), (u_out, v_out) = (nearest_px(at, mask.shape) for at in (inner, outer))
    own_m, beyond_m = frame.depth_m[v, u], frame.depth_m[v_out, u_out]
    ends = mask[v, u] & (own_m > 0) & in_image(outer, mask.shape)
    ends &= (beyond_m == 0) | (beyond_m > own_m - _NEARER_M)
    return uv_px[ends].astype(float)


def on_plane(uv_px: np.ndarray, cloud: np.ndarray, camera: Camera) -> np.ndarray | None:
    """(K, 3) some of a contour's pixels (N, 2) on the plane of the points (M, 3) that were measured.

    None where these are no plane, or one that is seen along itself.
    """
    if min(len(uv_px), len(cloud)) < _FEWEST:
        return None
    centre = cloud.mean(0)
    normal = np.linalg.svd(cloud - centre, full_matrices=False)[2][2]
    if np.median(np.abs((cloud - centre) @ normal)) > _FLAT_M:
        return None
    if abs(normal @ centre) < _FACING * np.linalg.norm(centre):
        return None
    uv_px = evenly(uv_px, _POINTS)
    rays = camera.unproject(uv_px, np.ones(len(uv_px)))
    return rays * (centre @ normal / (rays @ normal))[:, None]


class ContourFit:
    """The contour p_obj (K, 3) that an object is known by beside the one that is seen, pixels (N, 2)."""

    def __init__(self, p_obj: np.ndarray, seen_px: np.ndarray, frame: Frame, camera: Camera):
        self._p_obj, self._seen_px, self._frame, self._camera = p_obj, seen_px, frame, camera

    def pairs(self, T_cam_obj: np.ndarray, reach_px: float) -> Keypoints | None:
        """Points of the contour with where they are seen, across the line of sight alone; None where most are not."""
        rows, p_cam, _, nearest, off_px = self._nearest(T_cam_obj)
        near = off_px < reach_px
        if near.sum() < max(_MOST * len(self._p_obj), _FEWEST):
            return None
        z = p_cam[near, 2]
        sigma_m = z / self._camera.fx * np.sqrt(max(near.sum() / _INDEPENDENT, 1.0))
        return Keypoints(self._p_obj[rows[near]], self._camera.unproject(self._seen_px[nearest[near]], z), sigma_m)

    def refined(
        self, found: Refinement, cloud: np.ndarray, surface: TsdfVolume, config: RefinementConfig
    ) -> Refinement:
        """A pose laid on the contour that is seen and, by points (N, 3), on the surface; ``found`` if little shows."""
        for reach_px in REACH_PX:
            if (pairs := self.pairs(found.T_cam_obj, reach_px)) is None:
                break
            found = refine(found.T_cam_obj, cloud, surface, config, keypoints=pairs)
        return found

    def share(self, T_cam_obj: np.ndarray) -> float:
        """How much of either contour is on the other one under a pose: of a part one does not know which it is."""
        rows, _, uv_px, _, off_px = self._nearest(T_cam_obj)
        if len(rows) < _FEWEST:
            return 0.0
        back_px = np.linalg.norm(self._seen_px[:, None] - uv_px, axis=-1).min(1)
        return float(min((off_px < _ON_PX).sum() / len(self._p_obj), (back_px < _BACK_PX).mean()))

    def _nearest(self, T_cam_obj: np.ndarray) -> tuple[np.ndarray, ...]:
        """Rows (M,) of points that nothing hides under a pose, p_cam, uv_px, the nearest that are seen, and how far."""
        p_cam = se3.transform(T_cam_obj, self._p_obj)
        uv_px = self._camera.project(p_cam)
        rows = np.flatnonzero((p_cam[:, 2] > 0) & in_image(uv_px, self._frame.depth_m.shape))
        u, v = nearest_px(uv_px[rows], self._frame.depth_m.shape)
        measured_m = self._frame.depth_m[v, u]
        rows = rows[(measured_m == 0) | (measured_m > p_cam[rows, 2] - _NEARER_M)]
        if not len(rows) or not len(self._seen_px):
            none = np.zeros(0, int)
            return none, p_cam[none], uv_px[none], none, np.zeros(0)
        away_px = np.linalg.norm(uv_px[rows, None] - self._seen_px, axis=-1)
        return rows, p_cam[rows], uv_px[rows], away_px.argmin(1), away_px.min(1)
