"""How well a pose is known: its covariance, and how likely it is right, within 2 cm and 5 degrees of the truth.

The confidence is a logistic regression on what is known without the truth: how well the pose is determined, how many
keypoints agree on it, and which share of those seen that is. Points that a wrong pose placed agree with it for ever
after, so each counts as much as the confidence of the pose that placed it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.method import registration
from p2p_lib.method.object_model import Known, ObjectModel
from p2p_lib.method.observability import contrast_along
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.pose_finder import Candidate, took_part

#: The noise of points is set for a poor sensor; what is left of the covariance, measured on ``synthetic/crossing``.
_COVARIANCE_SCALE = 0.55
#: Points on a round body drift along it by this share of its accumulated rotation. Where nothing on it is seen to turn,
#: its turn is known to this, rad: the error of plain bodies in turning scenes.
_DRIFT_SHARE, _UNTOLD_RAD = 0.03, 1.0
#: Weights of the log odds: constant, logarithm of the largest standard deviation of rotation in degrees, logarithm of
#: the agreeing keypoints + 1, their share of those seen. Fitted on ``fading_label``, ``weak_texture`` and ``crossing``,
#: degraded until half of the poses were wrong; ``benchmarks/bench_confidence.py`` judges them on other seeds.
_CONSTANT, _LOG_SIGMA, _LOG_INLIERS, _AGREEMENT = -2.0, -0.75, 1.1, 0.9


def pose_covariance(
    of_frame: np.ndarray, of_map: np.ndarray, free_rotations: np.ndarray, accumulated_rad: float, told: bool = True
) -> np.ndarray:
    """(6, 6) covariance of a pose in the object frame, right tangent of T_cam_obj, rotation first.

    of_frame         (6, 6) of the pose relative to the map
    of_map           (6, 6) of the newest keyframe, by the graph
    free_rotations   (K, 6) tangents of one radian each that the shape leaves free
    accumulated_rad  how far the object has turned, view by view, since its first keyframe
    told             whether its texture tells the turns that the shape leaves free
    """
    free_rad = np.hypot(_DRIFT_SHARE * accumulated_rad, 0.0 if told else _UNTOLD_RAD)
    drift = free_rad**2 * free_rotations.T @ free_rotations
    return _COVARIANCE_SCALE * (of_frame + of_map + drift)


def confidence(covariance: np.ndarray, inliers: float, agreement: float) -> float:
    """How likely a pose is right, 0 to 1.

    covariance  (6, 6) of the pose, rotation (rad) first
    inliers     keypoints that agree with the pose, each counted by the confidence of the pose that placed it
    agreement   their share of the keypoints seen, 0 to 1
    """
    sigma_deg = np.degrees(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
    logit = _CONSTANT + _LOG_SIGMA * np.log(max(sigma_deg, 1e-3)) + _LOG_INLIERS * np.log1p(inliers)
    return float(1 / (1 + np.exp(-logit - _AGREEMENT * agreement)))


@dataclass(frozen=True, eq=False)
class Belief:
    """What a candidate rests on; asked before a keyframe changes the rows of the map.

    of_frame        (6, 6) covariance of the pose relative to the map, right tangent of T_cam_obj
    free_rotations  (K, 6) tangents of one radian each that the shape leaves free
    slides          whether it leaves more free than that
    told            whether the texture at the points that agree tells these turns
    support         keypoints that agree, each counted by the confidence of the pose that placed it
    agreement       their share of the points that took part
    """

    of_frame: np.ndarray
    free_rotations: np.ndarray
    slides: bool
    told: bool
    support: float
    agreement: float

    @classmethod
    def of(cls, obs: Observation, best: Candidate, known: Known, observer: Observer, config: Config) -> Belief:
        """Of a candidate in the map ``known``."""
        ours, agrees = config.method.gates == "all", best.hypothesis.inliers
        keypoints = took_part(obs, known, config) if ours else known.keypoints(obs)
        support = known.map.confidence[agrees].sum()
        agreement = (agrees & keypoints).sum() / max(keypoints.sum(), 1)
        told = not ours or _told(obs, best, observer.camera, config)
        free, held = best.refined.free_rotations, best.refined.eigenvalues
        slides = held is not None and (held < config.refinement.min_eigenvalue).sum() > len(free)
        return cls(_of_frame(obs, best, known, observer), free, slides, told, support, agreement)

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

    def given_turn(self, covariance: np.ndarray) -> float:
        """The confidence in all but turns, where the shape leaves nothing else free: these bend no surface."""
        axes = np.pad(self.free_rotations[: 0 if self.slides else None, :3], ((0, 0), (0, 3)))
        shared = covariance @ axes.T
        held = covariance - shared @ np.linalg.pinv(axes @ shared) @ shared.T
        return confidence(held, self.support, self.agreement)


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
