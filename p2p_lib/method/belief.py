"""What a pose is worth: its covariance and its confidence, by what the frame and the map say of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.method import registration
from p2p_lib.method.confidence import confidence, pose_covariance
from p2p_lib.method.object_model import Known, ObjectModel
from p2p_lib.method.observability import contrast_along
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.pose_finder import Candidate


@dataclass(frozen=True, eq=False)
class Belief:
    """What a candidate rests on; asked before a keyframe changes the rows of the map.

    of_frame        (6, 6) covariance of the pose relative to the map, right tangent of T_cam_obj
    free_rotations  (K, 6) tangents of one radian each that the shape leaves free
    told            whether the texture at the points that agree tells these turns
    support         keypoints that agree, each counted by the confidence of the pose that placed it
    agreement       their share of the keypoints seen
    """

    of_frame: np.ndarray
    free_rotations: np.ndarray
    told: bool
    support: float
    agreement: float

    @classmethod
    def of(cls, obs: Observation, best: Candidate, known: Known, observer: Observer, config: Config) -> Belief:
        """Of a candidate in the map ``known``."""
        keypoints, agrees = known.keypoints(obs), best.hypothesis.inliers
        support = known.map.confidence[agrees].sum()
        agreement = (agrees & keypoints).sum() / max(keypoints.sum(), 1)
        told = config.method.gates != "all" or _told(obs, best, observer.camera, config)
        return cls(_of_frame(obs, best, known, observer), best.refined.free_rotations, told, support, agreement)

    def at(
        self, T_cam_obj: np.ndarray, model: ObjectModel, most: float, told: bool | None = None
    ) -> tuple[np.ndarray, float]:
        """Covariance (6, 6) and confidence of a pose, what the map as it is now may be wrong by included.

        most  the confidence at most
        told  in the place of its own
        """
        accumulated_rad = model.views.accumulated_rad(T_cam_obj)
        told = self.told if told is None else told
        covariance = pose_covariance(self.of_frame, model.covariance, self.free_rotations, accumulated_rad, told)
        return covariance, min(confidence(covariance, self.support, self.agreement), most)


def _of_frame(obs: Observation, best: Candidate, known: Known, observer: Observer) -> np.ndarray:
    """By the refinement, else by the keypoints alone."""
    if best.refined.covariance is not None:
        return best.refined.covariance
    return registration.covariance(best.hypothesis, known.map.p_obj, obs.p_cam, observer.noise_m(obs.p_cam))


def _told(obs: Observation, best: Candidate, camera: Camera, config: Config) -> bool:
    """Whether the texture at the points that agree tells every turn that the shape leaves free."""
    p_cam, least = obs.p_cam[best.hypothesis.inliers], config.tracking.textureless_contrast
    along = (contrast_along(obs.frame, camera, best.T_cam_obj, p_cam, turn) for turn in best.refined.free_rotations)
    return all((contrast >= least).sum() >= config.lifecycle.return_inliers for contrast in along)
