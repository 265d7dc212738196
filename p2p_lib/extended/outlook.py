"""Where an object should show: what :mod:`~p2p_lib.extended.reacquisition` asks before its step.

Read-only queries; they advance the random generator.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.image import in_mask
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.types import Frame
from p2p_lib.extended.image_search import Sighting
from p2p_lib.extended.model import OurKnown
from p2p_lib.extended.observation import OurObservation, expected_px
from p2p_lib.extended.policy import OurPolicy
from p2p_lib.method.object_model import Requests
from p2p_lib.method.object_tracker import hint_at

#: While an object has a pose, the tracker is asked every so many frames to look for points that are not seen.
_LOOK_EVERY = 3


@dataclass(frozen=True, eq=False)
class Outlook:
    """By what is ``known`` of one object, or by its ``other`` map where that finds nothing."""

    known: OurKnown
    policy: OurPolicy
    other: OurKnown | None = None

    @property
    def sought(self) -> bool:
        """Whether an object that has been seen is absent, or back by shape and colour alone."""
        return not self.known.model.empty and self.known.life.sought

    def misplaced(self, obs: OurObservation, within: np.ndarray | None) -> Requests:
        """Requests to reject an absent object's tracks that are elsewhere, perhaps on a look-alike.

        within  (H, W) bool, where they may be; None: anywhere
        """
        if self.known.life.has_pose or within is None:
            return Requests()
        return Requests(reject=self.known.map.ids[obs.tracks.visible & ~in_mask(obs.tracks.uv_px, within)])

    def expected_px(self, obs: OurObservation) -> np.ndarray | None:
        """(N, 2) where keypoints should show under the best hypothesis, NaN where not: for guided re-detection.

        None where enough are seen, or no hypothesis. A few points that agree predict all the others, which the
        tracker checks by their appearance: so an object is back in the very frame of its return.
        """
        known, unknown = self.known, obs.mask is None or self.known.model.empty
        if unknown or self.policy.hidden(obs):
            return None
        enough = known.keypoints(obs).sum() >= self.policy.config.keypoint_map.keyframe_min_points
        if known.life.has_pose and (enough or obs.frame.index % _LOOK_EVERY):
            return None
        best = max(self.policy.propose(obs, known), key=lambda h: h.support, default=None)
        return None if best is None else self.points_px(obs, best.T_cam_obj)

    def points_px(self, obs: OurObservation, T_cam_obj: np.ndarray) -> np.ndarray:
        """(N, 2) where keypoints should show under a pose; NaN where not."""
        keypoints = np.where(self.known.map.promoted[:, None], self.known.map.p_obj, np.nan)
        return expected_px(self.policy.observer, obs, T_cam_obj, keypoints)

    def sighted(self, obs: OurObservation) -> Sighting | None:
        """Where a sought object shows by shape and colour."""
        if not (self.sought and self.policy.shape.knows(self.known)) or self.policy.hidden(obs):
            return None
        return self.policy.shape.sighted(obs, self.known, self.policy.carried(self.known, obs.frame.time_s))

    def hint(self, obs: OurObservation) -> tuple[Hint, Requests]:
        """Where the object should be by its tracks and its model, for the segmenter; and the tracks to reject.

        While the object is away, points that do not agree on a pose are on something else.
        """
        known, requests = self.known, Requests()
        if known.model.empty:
            return Hint(), requests
        best = max(self.policy.propose(obs, known), key=lambda h: h.support, default=None)
        if self.sought:
            agrees = np.zeros(len(known.map), bool) if best is None else best.inliers
            _, certain = self.policy.correspondences(obs, known)
            requests = Requests(reject=known.map.ids[certain & ~agrees])
            enough = best is not None and best.support >= self.policy.config.lifecycle.return_inliers
            if obs.sighting is not None and not enough:
                uv_px = np.concatenate([obs.tracks.uv_px[agrees], obs.sighting.uv_px])
                return self._hint(obs.frame, uv_px, obs.sighting.T_cam_obj, True), requests
            best = best if enough else None
        if best is None and self.other is not None:
            assert obs.other is not None, "it is observed, too"
            by_other, _ = replace(self, known=self.other, other=None).hint(obs.other)
            if len(by_other.uv_px):
                return by_other, requests
        if best is None:
            return Hint(gone=self._gone(obs.frame), place=self._place(obs.frame.time_s)), requests
        return self._hint(obs.frame, obs.tracks.uv_px[best.inliers], best.T_cam_obj, False), requests

    def _hint(self, frame: Frame, uv_px: np.ndarray, T_cam_obj: np.ndarray, sighted: bool) -> Hint:
        return replace(hint_at(frame, self.known, self.policy.observer, uv_px, T_cam_obj), sighted=sighted)

    def _gone(self, frame: Frame) -> bool:
        """Whether an absent object, if it has lain still, is outside the image; False if unknown."""
        return any(not self._inside(T).any() for T in self.known.life.scene_prior(frame.T_world_cam).values())

    def _place(self, time_s: float) -> np.ndarray | None:
        """Where an absent object's motion leads: see :class:`p2p_lib.core.interfaces.Hint`."""
        motion = self.known.life.motion
        if motion is None or not (self.sought and self.policy.carried(self.known, time_s)):
            return None
        centre = se3.transform(motion.at(time_s), self.known.map.p_obj.mean(0, keepdims=True))[0]
        return np.append(centre, motion.reach_m(time_s))

    def _inside(self, T_cam_obj: np.ndarray) -> np.ndarray:
        """(N,) bool: whether a pose projects the keypoints into the image, hidden or not."""
        return self.policy.observer.in_image(T_cam_obj, self.known.map.p_obj)
