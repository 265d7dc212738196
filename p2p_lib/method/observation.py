"""What one frame shows of one object: its keypoints lifted to 3D and its dense cloud (paper: P_cur)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import DepthConfig
from p2p_lib.core.depth import depth_noise_m, in_range, lift, of_one_surface
from p2p_lib.core.image import bounds, in_mask
from p2p_lib.core.types import Frame, Tracks

#: Depth this near the mask's border mixes the object with what is behind it.
_BORDER_PX = 2
#: A larger depth step in the 3x3 neighbourhood of a cloud pixel is an edge, m.
_CLOUD_EDGE_M = 0.02


@dataclass(frozen=True, eq=False)
class Observation:
    """What one frame shows of one object; rows are those of its keypoint map.

    mask      (H, W) bool; None where no mask is known
    tracks    of the map's points
    p_cam     (N, 3) their measured positions, m; NaN where not visible, outside the mask, or without depth
    cloud     (M, 3) depth points in the mask, camera frame, m
    """

    frame: Frame
    mask: np.ndarray | None
    tracks: Tracks
    p_cam: np.ndarray
    cloud: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(N,) bool: points with a 3D observation."""
        return np.isfinite(self.p_cam[:, 0])

    @cached_property
    def mask_px(self) -> int | None:
        """Pixels of the mask; None where no mask is known."""
        return None if self.mask is None else int(np.count_nonzero(self.mask))


class Observer:
    """Makes observations with one camera.

    cloud_points  the most points of a dense cloud; 0: no cloud
    """

    def __init__(self, camera: Camera, config: DepthConfig, cloud_points: int):
        self.camera, self.config, self.cloud_points = camera, config, cloud_points

    def observe(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> Observation:
        """The observation of the object that these ``tracks`` belong to."""
        nothing = np.zeros((0, 3))
        cloud = nothing
        if mask is not None:
            cloud = sample_cloud(frame.depth_m, mask, self.camera, self.cloud_points, self.config.narrow)
        return Observation(frame, mask, tracks, self.lifted(frame, mask, tracks), cloud)

    def lifted(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> np.ndarray:
        """(N, 3) tracks lifted to the camera frame; NaN where not visible, outside the mask, or without depth."""
        p_cam, rows = np.full((len(tracks), 3), np.nan), np.flatnonzero(tracks.visible)
        if mask is not None:
            rows = rows[in_mask(tracks.uv_px[rows], mask)]
        p_cam[rows] = self.lift(frame, tracks.uv_px[rows])
        return p_cam

    def lift(self, frame: Frame, uv_px: np.ndarray) -> np.ndarray:
        """(N, 3) camera-frame points seen at pixels (N, 2); NaN where there is no trustworthy depth."""
        return lift(frame, uv_px, self.camera, self.config)

    def noise_m(self, p_cam: np.ndarray) -> np.ndarray:
        """(N,) standard deviation, m, of measured points (N, 3), by their depth."""
        return depth_noise_m(p_cam[:, 2], self.config)

    def measured(self, observation: Observation) -> np.ndarray:
        """(H, W) bool: pixels of the mask with a depth within range."""
        return observation.mask & in_range(observation.frame.depth_m, self.config)

    def in_image(self, T_cam_obj: np.ndarray, p_obj: np.ndarray) -> np.ndarray:
        """(N,) bool: whether a pose projects points p_obj (N, 3) into the image, hidden or not."""
        return self.camera.inside(self.camera.project(se3.transform(T_cam_obj, p_obj)), -0.5)


def sample_cloud(
    depth_m: np.ndarray, mask: np.ndarray, camera: Camera, max_points: int, narrow: bool = True
) -> np.ndarray:
    """(N, 3) measured points of a masked depth image in the camera frame, N <= max_points.

    Only pixels that pass :func:`~p2p_lib.core.depth.of_one_surface`, spread evenly over the mask; deterministic.
    """
    cut = bounds(mask, 1)
    top, left = cut[0].start, cut[1].start
    if max_points < 1 or not mask[cut].any():
        return np.zeros((0, 3))
    depth = np.ascontiguousarray(depth_m[cut], np.float32)
    depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
    usable = of_one_surface(depth, mask[cut], _BORDER_PX, _CLOUD_EDGE_M, narrow)
    # A lattice of pixels, then an even thinning of what is left over.
    stride = max(1, int(np.sqrt(np.count_nonzero(usable) / max_points)))
    v, u = stride * np.stack(np.nonzero(usable[::stride, ::stride]))
    on = np.linspace(0, len(u) - 1, min(len(u), max_points)).astype(int)
    return camera.unproject(np.stack([u[on] + left, v[on] + top], -1), depth[v[on], u[on]].astype(float))
