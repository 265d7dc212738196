"""Where an object should show: what the pipeline asks around segmentation and 2D tracking (mostly not in the paper).

Questions, which change nothing of an object but the state of its random numbers: its step is
:mod:`p2p_lib.method.object_tracker`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.image import in_mask
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.types import Frame
from p2p_lib.method.object_model import Known, Requests
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.pose_finder import PoseFinder
from p2p_lib.method.refinement import surface_distance
from p2p_lib.recovery.search import Sighting

#: While an object has a pose, the tracker is asked every so many frames to look for points that are not seen.
_LOOK_EVERY = 3


def hidden(mask_px: int | None, config: Config) -> bool:
    """Whether a mask of so many pixels, None where no mask is known, says that nothing of an object is to be seen."""
    return mask_px is not None and mask_px < config.lifecycle.min_mask_px


@dataclass(frozen=True, eq=False)
class Outlook:
    """By what is ``known`` of one object, and where it is absent by what was put ``aside``."""

    known: Known
    observer: Observer
    finder: PoseFinder
    config: Config
    aside: Known | None = None

    @property
    def sought(self) -> bool:
        """Whether an object that has been seen is absent, or back by shape and colour alone."""
        return not self.known.model.empty and self.known.life.sought

    @property
    def away(self) -> bool:
        """Whether an object that has been seen has no pose now."""
        return not self.known.model.empty and not self.known.life.has_pose

    @property
    def out_of_view(self) -> bool:
        """Whether most keypoints of an absent object lay outside the image at its last pose."""
        T_cam_obj = self.known.life.T_cam_obj
        inside = np.ones(1, bool) if T_cam_obj is None else self._inside(T_cam_obj)
        return bool(len(inside)) and inside.mean() < 0.5

    def awaited(self, mask: np.ndarray | None) -> bool:
        """Whether the object was hidden or lost until now and its mask says that it is back."""
        return self.away and mask is not None and not hidden(np.count_nonzero(mask), self.config)

    def misplaced(self, obs: Observation, within: np.ndarray | None) -> Requests:
        """Tracks that an absent object has elsewhere, on a look-alike perhaps: to be looked for anew.

        within  (H, W) bool, where they may be; None: anywhere
        """
        if self.known.life.has_pose or within is None:
            return Requests()
        return Requests(reject=self.known.map.ids[obs.tracks.visible & ~in_mask(obs.tracks.uv_px, within)])

    def expected_px(self, obs: Observation) -> np.ndarray | None:
        """(N, 2) where keypoints show under the best hypothesis, NaN where not: what guided re-detection looks for.

        None where enough are seen, or there is no pose to go by. A few points that agree say where all the others
        should show, which the tracker checks by their appearance: so an object is back in the frame of its return.
        """
        known, unknown = self.known, obs.mask is None or self.known.model.empty
        if unknown or not self.config.method.redetection or hidden(obs.mask_px, self.config):
            return None
        enough = known.keypoints(obs).sum() >= self.config.keypoint_map.keyframe_min_points
        if known.life.has_pose and (enough or obs.frame.index % _LOOK_EVERY):
            return None
        best = max(self.finder.register(obs, known), key=lambda h: h.support, default=None)
        return None if best is None else self.points_px(obs, best.T_cam_obj)

    def points_px(self, obs: Observation, T_cam_obj: np.ndarray) -> np.ndarray:
        """(N, 2) where keypoints show under a pose; NaN where not."""
        keypoints = np.where(self.known.map.promoted[:, None], self.known.map.p_obj, np.nan)
        return self.observer.expected_px(obs, T_cam_obj, keypoints)

    def sighted(self, obs: Observation) -> Sighting | None:
        """Where a sought object shows by shape and colour."""
        if not (self.sought and self.finder.shape.knows(self.known)) or hidden(obs.mask_px, self.config):
            return None
        return self.finder.shape.sighted(obs, self.known)

    def hint(self, obs: Observation) -> tuple[Hint, Requests]:
        """Where this object should be, by its tracks and its model, before the frame is segmented.

        Also the tracks to reject: while the object is away, points that agree on no pose are somewhere else.
        """
        known, requests = self.known, Requests()
        if known.model.empty:
            return Hint(), requests
        best = max(self.finder.register(obs, known), key=lambda h: h.support, default=None)
        if self.sought:
            agrees = np.zeros(len(known.map), bool) if best is None else best.inliers
            certain = obs.seen & (obs.tracks.uncertainty <= self.config.registration.max_uncertainty)
            requests = Requests(reject=known.map.ids[certain & ~agrees])
            enough = best is not None and best.support >= self.config.lifecycle.return_inliers
            if obs.sighting is not None and not enough:
                uv_px = np.concatenate([obs.tracks.uv_px[agrees], obs.sighting.uv_px])
                return self._hint(obs.frame, uv_px, obs.sighting.T_cam_obj, True), requests
            best = best if enough else None
        if best is None and self.aside is not None:
            by_aside, _ = replace(self, known=self.aside, aside=None).hint(obs.aside)
            if len(by_aside.uv_px):
                return by_aside, requests
        if best is None:
            return Hint(gone=self._gone(obs.frame), place=self._place(obs.frame.time_s)), requests
        return self._hint(obs.frame, obs.tracks.uv_px[best.inliers], best.T_cam_obj, False), requests

    def _hint(self, frame: Frame, uv_px: np.ndarray, T_cam_obj: np.ndarray, sighted: bool) -> Hint:
        """The hint of a pose, with the distances from the surface under it."""
        distance_m, model = None, self.known.model
        if model.has_surface:
            distance_m = surface_distance(model.surface, frame.depth_m, self.observer.camera, T_cam_obj)
        return Hint(uv_px, distance_m, T_cam_obj, sighted)

    def _gone(self, frame: Frame) -> bool:
        """Whether nothing of an absent object would show in the image if it has lain still; False if nobody knows."""
        return any(not self._inside(T).any() for T in self.known.life.scene_prior(frame.T_world_cam).values())

    def _place(self, time_s: float) -> np.ndarray | None:
        """Where an absent object's motion leads: see :class:`p2p_lib.core.interfaces.Hint`."""
        if not (self.sought and self.known.carried(time_s)):
            return None
        motion = self.known.life.motion
        middle = se3.transform(motion.at(time_s), self.known.map.p_obj.mean(0, keepdims=True))[0]
        return np.append(middle, motion.reach_m(time_s))

    def _inside(self, T_cam_obj: np.ndarray) -> np.ndarray:
        """(N,) bool: the keypoints that a pose puts into the image, whatever may hide them."""
        camera = self.observer.camera
        return camera.inside(camera.project(se3.transform(T_cam_obj, self.known.map.p_obj)), -0.5)
