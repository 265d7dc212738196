"""What one frame shows of one object, with more than the paper asks: who made its mask, where it was sighted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.image import bounds
from p2p_lib.core.types import Frame as Frame  # the type of an inherited field
from p2p_lib.core.types import Tracks
from p2p_lib.extended.agreement import outline_share
from p2p_lib.extended.contour import contour_px
from p2p_lib.extended.frame_guard import DoubtedFrame
from p2p_lib.extended.image_search import Sighting
from p2p_lib.method.observation import Observation, Observer

#: A mask this near to the border of what is measured may be cut off by it.
_BORDER_PX = 2
#: A keypoint farther than this from the depth measured at its pixel does not show, m.
_HIDDEN_M = 0.015
#: Depth this far behind a point shows that the point is not there, m.
_EMPTY_M = 0.05


@dataclass(frozen=True, eq=False)
class OurObservation(Observation):
    """What one frame shows of one object.

    sighting  where an absent object was found by shape and colour; None where it was not
    given     whether the caller gave the mask; else the segmenter made it
    told      whether the caller's prompt made or corrected it
    other     the same for the object's other map; None where there is none
    """

    sighting: Sighting | None = None
    given: bool = True
    told: bool = False
    other: OurObservation | None = None

    @cached_property
    def contour_px(self) -> np.ndarray:
        """(N, 2) where its mask ends because the object does."""
        return np.zeros((0, 2)) if self.mask is None else contour_px(self.frame, self.mask)

    @property
    def still(self) -> bool:
        """Whether the camera has given the same image for a while."""
        return isinstance(self.frame, DoubtedFrame) and self.frame.still

    @cached_property
    def outline_share(self) -> float | None:
        """Share of the mask's outline along depth steps; None where unknown."""
        return None if self.mask is None else outline_share(self.frame, self.mask)


def with_tracks(observer: Observer, obs: OurObservation, tracks: Tracks) -> OurObservation:
    """The observation with these tracks of the object's points instead of its own."""
    return replace(obs, tracks=tracks, p_cam=observer.lifted(obs.frame, obs.mask, tracks))


def area_m2(observer: Observer, obs: Observation) -> float:
    """Area of the object that is measured, across the line of sight."""
    z = obs.frame.depth_m[observer.measured(obs)]
    return float((z.astype(float) ** 2).sum() / (observer.camera.fx * observer.camera.fy))


def cut_off(observer: Observer, obs: Observation) -> bool:
    """Whether the mask ends where the measured part of the image does.

    An object before a background without depth does so on all four sides, and is whole.
    """
    seen, measured = bounds(observer.measured(obs)), bounds(obs.frame.depth_m > 0)
    both = list(zip(seen, measured, strict=True))
    sides = [one.start <= whole.start + _BORDER_PX for one, whole in both]
    sides += [one.stop >= whole.stop - _BORDER_PX for one, whole in both]
    return any(sides) and not all(sides)


def expected_px(observer: Observer, obs: Observation, T_cam_obj: np.ndarray, p_obj: np.ndarray) -> np.ndarray:
    """(N, 2) where points p_obj (N, 3) show under a pose.

    NaN for those outside the mask, and for those that the measured depth contradicts: something hides them, the
    object itself included.
    """
    p_cam = se3.transform(T_cam_obj, p_obj)
    uv_px = observer.camera.project(p_cam)
    at = np.flatnonzero((p_cam[:, 2] > 0) & observer.camera.inside(uv_px))
    u, v = np.rint(uv_px[at]).astype(int).T
    inside = True if obs.mask is None else obs.mask[v, u]
    at = at[inside & (np.abs(obs.frame.depth_m[v, u] - p_cam[at, 2]) < _HIDDEN_M)]
    expected = np.full_like(uv_px, np.nan)
    expected[at] = uv_px[at]
    return expected


def empty(observer: Observer, frame: Frame, T_cam_obj: np.ndarray, p_obj: np.ndarray) -> bool:
    """Whether most points p_obj (N, 3) of an object are not where a pose has them: depth is measured behind them."""
    p_cam = se3.transform(T_cam_obj, p_obj)
    uv_px = observer.camera.project(p_cam)
    at = np.flatnonzero((p_cam[:, 2] > 0) & observer.camera.inside(uv_px))
    u, v = np.rint(uv_px[at]).astype(int).T
    return bool(2 * (frame.depth_m[v, u] > p_cam[at, 2] + _EMPTY_M).sum() > len(p_obj))
