"""How likely a pose is right: within 2 cm and 5 degrees of the truth.

A logistic regression on what is known without the truth: how well the pose is determined, how many keypoints agree on
it, and which share of those seen that is. Points that a wrong pose placed agree with it for ever after, so each
counts as much as the pose was trusted that placed it. Its weights were fitted where poses go wrong (see
:class:`ConfidenceConfig`).
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.config import ConfidenceConfig


def confidence(covariance: np.ndarray, inliers: float, agreement: float, config: ConfidenceConfig) -> float:
    """Between 0 and 1.

    covariance  (6, 6) of the pose, rotation (rad) first
    inliers     keypoints that agree with the pose, each counted by the confidence of the pose that placed it
    agreement   their share of the keypoints seen, 0 to 1
    """
    sigma_deg = np.degrees(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))
    logit = (
        config.offset
        + config.per_log_sigma * np.log(max(sigma_deg, 1e-3))
        + config.per_log_inliers * np.log1p(inliers)
        + config.per_agreement * agreement
    )
    return float(1 / (1 + np.exp(-logit)))
