"""What moves a confidence, and which way."""

import numpy as np
import pytest

from p2p_lib.core.config import ConfidenceConfig
from p2p_lib.method.confidence import confidence

CONFIG = ConfidenceConfig()


def covariance(largest_deg: float, metres: float = 0.001) -> np.ndarray:
    """A turn known to ``largest_deg`` about a slanting axis, to a tenth of it about the others."""
    axes = np.linalg.qr(np.array([[1.0, 2, 3], [0, 1, 1], [2, 0, 1]]))[0]
    C = np.diag(np.full(6, metres**2))
    C[:3, :3] = axes @ np.diag(np.radians([largest_deg, largest_deg / 10, largest_deg / 10]) ** 2) @ axes.T
    return C


def test_sure_of_many_that_agree_and_not_of_few_that_do_not():
    assert confidence(covariance(0.4), 35, 0.9, CONFIG) > 0.95
    assert confidence(covariance(8.0), 6, 0.3, CONFIG) < 0.3
    assert confidence(covariance(1.0), 0, 0.0, CONFIG) < 0.15


@pytest.mark.parametrize("inliers", [0, 5, 40])
def test_each_thing_counts_in_its_direction(inliers):
    sure = [confidence(covariance(deg), inliers, 0.5, CONFIG) for deg in (0.3, 1, 5, 30)]
    assert sure == sorted(sure, reverse=True) and len(set(sure)) == 4
    assert confidence(covariance(2), inliers + 5, 0.5, CONFIG) > confidence(covariance(2), inliers, 0.5, CONFIG)
    assert confidence(covariance(2), inliers, 0.9, CONFIG) > confidence(covariance(2), inliers, 0.5, CONFIG)


def test_the_log_odds_are_those_of_the_configuration():
    config = ConfidenceConfig(offset=-1.0, per_log_sigma=-2.0, per_log_inliers=0.5, per_agreement=3.0)
    p = confidence(covariance(2.0), 7, 0.6, config)
    assert np.log(p / (1 - p)) == pytest.approx(-1 - 2 * np.log(2) + 0.5 * np.log(8) + 1.8)


@pytest.mark.parametrize("deg", [1e-9, 1e3])
def test_never_outside_its_range(deg):
    assert 0 <= confidence(covariance(deg), 10**6, 1.0, CONFIG) <= 1
    assert 0 <= confidence(covariance(deg), 0, 0.0, CONFIG) <= 1
