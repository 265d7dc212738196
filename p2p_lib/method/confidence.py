"""How likely a pose is right: within 2 cm and 5 degrees of the truth.

A logistic regression on what is known without the truth: how well the pose is determined, how many keypoints agree on
it, and which share of those seen that is. Points that a wrong pose placed agree with it for ever after, so each
counts as much as the confidence of the pose that placed it.
"""

from __future__ import annotations

import numpy as np

#: Weights of the log odds: constant, logarithm of the largest standard deviation of rotation in degrees, logarithm of
#: the agreeing keypoints + 1, their share of those seen. Fitted on ``fading_label``, ``weak_texture`` and ``crossing``,
#: degraded until half of the poses were wrong; ``benchmarks/bench_confidence.py`` judges them on other seeds.
_CONSTANT, _LOG_SIGMA, _LOG_INLIERS, _AGREEMENT = -2.0, -0.75, 1.1, 0.9


def confidence(covariance: np.ndarray, inliers: float, agreement: float) -> float:
    """Between 0 and 1.

    covariance  (6, 6) of the pose, rotation (rad) first
    inliers     keypoints that agree with the pose, each counted by the confidence of the pose that placed it
    agreement   their share of the keypoints seen, 0 to 1
    """
    sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    logit = _CONSTANT + _LOG_SIGMA * np.log(max(sigma_deg, 1e-3)) + _LOG_INLIERS * np.log1p(inliers)
    return float(1 / (1 + np.exp(-logit - _AGREEMENT * agreement)))
