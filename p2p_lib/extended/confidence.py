"""How well a pose is known: its covariance, and how likely it is right, within 2 cm and 5 degrees of the truth.

The confidence is a logistic regression on what is known without the truth: how well the pose is determined, how many
keypoints agree with it, and their share of those seen. Points that a wrong pose placed agree with it for ever
after, so each is weighted by the confidence of the pose that placed it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.image import nearest_px
from p2p_lib.core.types import Frame
from p2p_lib.extended.views import AccumulatedViews
from p2p_lib.method.object_model import Known, ObjectModel
from p2p_lib.method.observation import Observation
from p2p_lib.method.policy import Candidate, Policy
from p2p_lib.method.refinement import Refinement

#: Half the side of a point's surroundings, px.
_AROUND_PX = 5
#: Scale of covariances, measured on ``synthetic/crossing``: the noise of points is set for a poor sensor.
_COVARIANCE_SCALE = 0.55
#: Points on a round body drift along it by this share of its accumulated rotation. Where no
#: texture shows its turn, that is known to this, rad: the error of plain bodies in turning scenes.
_DRIFT_SHARE, _UNCONSTRAINED_RAD = 0.03, 1.0
#: Weights of the log odds: constant, logarithm of the largest standard deviation of rotation in degrees, logarithm of
#: the agreeing keypoints + 1, their share of those seen. Fitted on ``fading_label``, ``weak_texture`` and ``crossing``,
#: degraded until half of the poses were wrong; ``benchmarks/bench_confidence.py`` judges them on other seeds.
_CONSTANT, _LOG_SIGMA, _LOG_INLIERS, _AGREEMENT = -2.0, -0.75, 1.1, 0.9


def pose_covariance(
    of_frame: np.ndarray,
    of_map: np.ndarray,
    free_rotations: np.ndarray,
    accumulated_rad: float,
    constrained: bool = True,
) -> np.ndarray:
    """(6, 6) covariance of a pose in the object frame, right tangent of T_cam_obj, rotation first.

    of_frame         (6, 6) of the pose relative to the map
    of_map           (6, 6) of the newest keyframe, by the graph
    free_rotations   (K, 6) tangents of one radian each that the shape leaves free
    accumulated_rad  how far the object has turned, view by view, since its first keyframe
    constrained      whether its texture constrains the turns that the shape leaves free
    """
    free_rad = np.hypot(_DRIFT_SHARE * accumulated_rad, 0.0 if constrained else _UNCONSTRAINED_RAD)
    drift = free_rad**2 * free_rotations.T @ free_rotations
    return _COVARIANCE_SCALE * (of_frame + of_map + drift)


def confidence(covariance: np.ndarray, inliers: float, agreement: float) -> float:
    """The probability, 0 to 1, that a pose is right.

    covariance  (6, 6) of the pose, rotation (rad) first
    inliers     keypoints that agree with the pose, each weighted by the confidence of the pose that placed it
    agreement   their share of the keypoints seen, 0 to 1
    """
    sigma_deg = np.degrees(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
    logit = _CONSTANT + _LOG_SIGMA * np.log(max(sigma_deg, 1e-3)) + _LOG_INLIERS * np.log1p(inliers)
    return float(1 / (1 + np.exp(-logit - _AGREEMENT * agreement)))


@dataclass(frozen=True, eq=False)
class Belief:
    """The evidence of a candidate, taken before a keyframe changes the rows of the map.

    of_frame        (6, 6) covariance of the pose relative to the map, right tangent of T_cam_obj
    free_rotations  (K, 6) tangents of one radian each that the shape leaves free
    slides          whether the shape leaves more free than these
    constrained     whether the texture at the points that agree constrains these turns
    support         keypoints that agree, each weighted by the confidence of the pose that placed it
    agreement       their share of the points that took part
    """

    of_frame: np.ndarray
    free_rotations: np.ndarray
    slides: bool
    constrained: bool
    support: float
    agreement: float

    @classmethod
    def of(cls, obs: Observation, best: Candidate, known: Known, policy: Policy, texture: bool = True) -> Belief:
        """Of a candidate in the map ``known``; without ``texture`` free turns count as constrained, unchecked."""
        (keypoints, _), agrees = policy.correspondences(obs, known), best.hypothesis.inliers
        support = known.map.confidence[agrees].sum()
        agreement = (agrees & keypoints).sum() / max(keypoints.sum(), 1)
        config = policy.config
        bounds = config.tracking.textureless_contrast, config.lifecycle.return_inliers
        constrained = not texture or _constrained(obs, best, policy.observer.camera, *bounds)
        assert best.refined is not None, "a pose that is believed was refined"
        free, slides = best.refined.free_rotations, may_slide(best.refined, config.refinement.min_eigenvalue)
        return cls(policy.covariance(obs, known, best), free, slides, constrained, support, agreement)

    def at(
        self, T_cam_obj: np.ndarray, model: ObjectModel, most: float, constrained: bool | None = None
    ) -> tuple[np.ndarray, float]:
        """Covariance (6, 6) and confidence of a pose, including the error of the map as it is now.

        most         upper bound of the confidence
        constrained  used instead of the belief's own, if given
        """
        assert isinstance(model.views, AccumulatedViews)
        accumulated_rad = model.views.accumulated_rad(T_cam_obj)
        constrained = self.constrained if constrained is None else constrained
        covariance = pose_covariance(self.of_frame, model.covariance, self.free_rotations, accumulated_rad, constrained)
        return covariance, min(confidence(covariance, self.support, self.agreement), most)

    def confidence_given_turn(self, covariance: np.ndarray) -> float:
        """The confidence given the free turns, unless the shape leaves more free: they bend no surface."""
        axes = np.pad(self.free_rotations[: 0 if self.slides else None, :3], ((0, 0), (0, 3)))
        shared = covariance @ axes.T
        held = covariance - shared @ np.linalg.pinv(axes @ shared) @ shared.T
        return confidence(held, self.support, self.agreement)


def _constrained(obs: Observation, best: Candidate, camera: Camera, least: float, points: int) -> bool:
    """Whether the texture at the points that agree constrains every turn that the shape leaves free."""
    assert best.refined is not None
    p_cam = obs.p_cam[best.hypothesis.inliers]
    along = (contrast_along(obs.frame, camera, best.T_cam_obj, p_cam, turn) for turn in best.refined.free_rotations)
    return all((contrast >= least).sum() >= points for contrast in along)


def contrast_along(
    frame: Frame, camera: Camera, T_cam_obj: np.ndarray, p_cam: np.ndarray, turn: np.ndarray
) -> np.ndarray:
    """(N,) how much a turn of the object, (6,) right tangent of a pose, would change the image around points (N, 3).

    In grey levels: the standard deviation, around each point, of the change by a motion of two pixels. An edge along
    the motion, as the rim of a tin, adds nothing, and neither does even shading.
    """
    if not len(p_cam):
        return np.zeros(0)
    p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
    moved = p_cam + 1e-3 * (np.cross(turn[:3], p_obj) + turn[3:]) @ T_cam_obj[:3, :3].T
    uv_px = camera.project(p_cam)
    flow_px = camera.project(moved) - uv_px
    flow_px /= np.maximum(np.linalg.norm(flow_px, axis=-1, keepdims=True), 1e-9)
    u, v = nearest_px(uv_px, frame.shape)
    cut = tuple(slice(max(at.min() - _AROUND_PX - 1, 0), at.max() + _AROUND_PX + 2) for at in (v, u))
    grey = cv2.cvtColor(np.ascontiguousarray(frame.rgb[cut]), cv2.COLOR_RGB2GRAY)
    y, x = np.mgrid[-_AROUND_PX : _AROUND_PX + 1, -_AROUND_PX : _AROUND_PX + 1].reshape(2, -1)
    v = np.clip(v[:, None] - cut[0].start + y, 0, grey.shape[0] - 1)
    u = np.clip(u[:, None] - cut[1].start + x, 0, grey.shape[1] - 1)
    over_two_px = [cv2.Sobel(grey, cv2.CV_32F, *axis, ksize=3, scale=0.25)[v, u] for axis in ((1, 0), (0, 1))]
    return sum(change * flow_px[:, [k]] for k, change in enumerate(over_two_px)).std(-1)


def may_slide(refined: Refinement, min_eigenvalue: float, ways: int = 1) -> bool:
    """Whether a refined pose may move along the surface in so many ways without leaving it, besides turns."""
    held = refined.eigenvalues
    return held is not None and bool((held < min_eigenvalue).sum() >= len(refined.free_rotations) + ways)
