"""How well a pose is known: its covariance, and how likely it is right, within 2 cm and 5 degrees of the truth.

The confidence is a logistic regression on what is known without the truth: how well the pose is determined, how many
keypoints agree on it, and which share of those seen that is. Points that a wrong pose placed agree with it for ever
after, so each counts as much as the confidence of the pose that placed it.
"""

from __future__ import annotations

import numpy as np

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
    sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    logit = _CONSTANT + _LOG_SIGMA * np.log(max(sigma_deg, 1e-3)) + _LOG_INLIERS * np.log1p(inliers)
    return float(1 / (1 + np.exp(-logit - _AGREEMENT * agreement)))
