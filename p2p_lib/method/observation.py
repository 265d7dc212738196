"""What one frame shows of one object: its keypoints lifted to 3D and its dense cloud (paper: P_cur)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import depth_noise_m, in_range, lift, off_edges
from p2p_lib.core.image import bounds, in_mask
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.method.agreement import outline_share
from p2p_lib.recovery.search import Sighting

#: Depth this near the mask's border mixes the object with what is behind it.
_BORDER_PX = 2
#: A larger step in the 3x3 neighbourhood of a pixel of the cloud is an edge, m.
_CLOUD_EDGE_M = 0.02
#: A keypoint farther from the depth measured at its pixel is hidden, m.
_HIDDEN_M = 0.015


@dataclass(frozen=True, eq=False)
class Observation:
    """One frame's share of one object; rows are those of its keypoint map.

    mask      (H, W) bool; None where no mask is known
    tracks    of the map's points
    p_cam     (N, 3) their lifted positions; NaN where not visible, outside the mask, or without depth
    cloud     (M, 3) depth points in the mask, camera frame
    sighting  where an absent object was found by shape and colour; None where it was not
    given     whether the caller vouches for the mask; else the segmenter made it
    still     whether the image is the same as for a while
    aside     the same of a second map of the object, which is put aside; None where there is none
    """

    frame: Frame
    mask: np.ndarray | None
    tracks: Tracks
    p_cam: np.ndarray
    cloud: np.ndarray
    sighting: Sighting | None = None
    given: bool = True
    still: bool = False
    aside: Observation | None = None

    @property
    def seen(self) -> np.ndarray:
        """(N,) bool: points with a 3D observation."""
        return np.isfinite(self.p_cam[:, 0])

    @cached_property
    def mask_px(self) -> int | None:
        """Pixels of the mask; None where no mask is known."""
        return None if self.mask is None else int(np.count_nonzero(self.mask))

    @cached_property
    def outline_share(self) -> float | None:
        """What of the mask's outline lies where depth has steps; None where nobody knows."""
        return None if self.mask is None else outline_share(self.frame, self.mask)


class Observer:
    """Makes observations with one camera.

    cloud_points  of the dense cloud at most; 0 makes none
    """

    def __init__(self, camera: Camera, config: DepthConfig, cloud_points: int):
        self.camera, self.config, self.cloud_points = camera, config, cloud_points

    def observe(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> Observation:
        """The observation of an object whose points have these ``tracks``."""
        nothing = np.zeros((0, 3))
        cloud = nothing if mask is None else sample_cloud(frame.depth_m, mask, self.camera, self.cloud_points)
        return Observation(frame, mask, tracks, self._lifted(frame, mask, tracks), cloud)

    def with_tracks(self, obs: Observation, tracks: Tracks) -> Observation:
        """The observation with these tracks of the object's points instead of its own."""
        return replace(obs, tracks=tracks, p_cam=self._lifted(obs.frame, obs.mask, tracks))

    def _lifted(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> np.ndarray:
        p_cam, rows = np.full((len(tracks), 3), np.nan), np.flatnonzero(tracks.visible)
        if mask is not None:
            rows = rows[in_mask(tracks.uv_px[rows], mask)]
        p_cam[rows] = self.lift(frame, tracks.uv_px[rows])
        return p_cam

    def lift(self, frame: Frame, uv_px: np.ndarray) -> np.ndarray:
        """(N, 3) points behind pixels (N, 2); NaN where there is no trustworthy depth."""
        return lift(frame, uv_px, self.camera, self.config)

    def noise_m(self, p_cam: np.ndarray) -> np.ndarray:
        """(N,) standard deviation of measured points (N, 3)."""
        return depth_noise_m(p_cam[:, 2], self.config)

    def measured(self, observation: Observation) -> np.ndarray:
        """(H, W) bool: pixels of the mask with a depth within range."""
        return observation.mask & in_range(observation.frame.depth_m, self.config)

    def area_m2(self, observation: Observation) -> float:
        """What is measured of the object, as an area across the line of sight."""
        z = observation.frame.depth_m[self.measured(observation)]
        return float((z.astype(float) ** 2).sum() / (self.camera.fx * self.camera.fy))

    def cut_off(self, observation: Observation) -> bool:
        """Whether the mask ends where depth does: at the border of the image, or of what of it is registered.

        An object before nothing that is measured does so on all four sides, and is whole.
        """
        seen, measured = bounds(self.measured(observation)), bounds(observation.frame.depth_m > 0)
        both = list(zip(seen, measured, strict=True))
        sides = [one.start <= whole.start + _BORDER_PX for one, whole in both]
        sides += [one.stop >= whole.stop - _BORDER_PX for one, whole in both]
        return any(sides) and not all(sides)

    def expected_px(self, obs: Observation, T_cam_obj: np.ndarray, p_obj: np.ndarray) -> np.ndarray:
        """(N, 2) where points p_obj (N, 3) show under a pose.

        NaN for those outside the mask, and for those that the measured depth contradicts: something hides them, the
        object itself included.
        """
        p_cam = se3.transform(T_cam_obj, p_obj)
        uv_px = self.camera.project(p_cam)
        at = np.flatnonzero((p_cam[:, 2] > 0) & self.camera.inside(uv_px))
        u, v = np.rint(uv_px[at]).astype(int).T
        inside = True if obs.mask is None else obs.mask[v, u]
        at = at[inside & (np.abs(obs.frame.depth_m[v, u] - p_cam[at, 2]) < _HIDDEN_M)]
        expected = np.full_like(uv_px, np.nan)
        expected[at] = uv_px[at]
        return expected


def sample_cloud(depth_m: np.ndarray, mask: np.ndarray, camera: Camera, max_points: int) -> np.ndarray:
    """(N, 3) measured points of a masked depth image in the camera frame, N <= max_points.

    Leaves out a border inside the mask, and pixels whose 3x3 neighbourhood holds an invalid depth or a step: both mix
    two surfaces. Deterministic, spread over the whole mask. Empty where nothing is left.
    """
    cut = bounds(mask, 1)
    top, left = cut[0].start, cut[1].start
    if max_points < 1 or not mask[cut].any():
        return np.zeros((0, 3))
    inside, depth = np.ascontiguousarray(mask[cut]).astype(np.uint8), np.ascontiguousarray(depth_m[cut], np.float32)
    kernel = np.ones((2 * _BORDER_PX + 1,) * 2, np.uint8)
    inside = cv2.erode(inside, kernel, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    usable = (inside > 0) & off_edges(depth, _CLOUD_EDGE_M)
    # A lattice of pixels, then an even thinning of what is left over.
    stride = max(1, int(np.sqrt(np.count_nonzero(usable) / max_points)))
    v, u = stride * np.stack(np.nonzero(usable[::stride, ::stride]))
    on = np.linspace(0, len(u) - 1, min(len(u), max_points)).astype(int)
    return camera.unproject(np.stack([u[on] + left, v[on] + top], -1), depth[v[on], u[on]].astype(float))
