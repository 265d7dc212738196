"""What moves a confidence, and which way."""

import numpy as np
import pytest

from p2p_lib.extended.confidence import confidence, pose_covariance


def covariance(largest_deg: float, metres: float = 0.001) -> np.ndarray:
    """A turn known to ``largest_deg`` about a slanting axis, to a tenth of it about the others."""
    axes = np.linalg.qr(np.array([[1.0, 2, 3], [0, 1, 1], [2, 0, 1]]))[0]
    C = np.diag(np.full(6, metres**2))
    C[:3, :3] = axes @ np.diag(np.radians([largest_deg, largest_deg / 10, largest_deg / 10]) ** 2) @ axes.T
    return C


def test_sure_of_many_that_agree_and_not_of_few_that_do_not():
    assert confidence(covariance(0.4), 35, 0.9) > 0.95
    assert confidence(covariance(8.0), 6, 0.3) < 0.3
    assert confidence(covariance(1.0), 0, 0.0) < 0.15


@pytest.mark.parametrize("inliers", [0, 5, 40])
def test_each_thing_counts_in_its_direction(inliers):
    sure = [confidence(covariance(deg), inliers, 0.5) for deg in (0.3, 1, 5, 30)]
    assert sure == sorted(sure, reverse=True) and len(set(sure)) == 4
    assert confidence(covariance(2), inliers + 5, 0.5) > confidence(covariance(2), inliers, 0.5)
    assert confidence(covariance(2), inliers, 0.9) > confidence(covariance(2), inliers, 0.5)


def test_the_log_odds_are_linear_in_the_logarithms():
    """A tenfold number of agreeing points + 1 adds the same, whatever there were; so does a tenfold certainty."""

    def odds(*of):
        p = confidence(*of)
        return np.log(p / (1 - p))

    more = [odds(covariance(2.0), 10.0**k - 1, 0.6) for k in (0, 1, 2)]
    assert more[1] - more[0] == pytest.approx(more[2] - more[1])
    surer = [odds(covariance(10.0**-k), 3, 0.6) for k in (0, 1, 2)]
    assert surer[1] - surer[0] == pytest.approx(surer[2] - surer[1])


@pytest.mark.parametrize("deg", [1e-9, 1e3])
def test_never_outside_its_range(deg):
    assert 0 <= confidence(covariance(deg), 10**6, 1.0) <= 1
    assert 0 <= confidence(covariance(deg), 0, 0.0) <= 1


def test_drift_is_a_share_of_the_accumulated_rotation_along_what_is_free():
    spin, nothing = np.array([[0, 0, 1.0, 0.05, 0, 0]]), np.zeros((6, 6))
    one, two = (np.sqrt(np.diag(pose_covariance(nothing, nothing, spin, turn))) for turn in (np.pi, 2 * np.pi))
    assert one[2] > 0 and not one[:2].any() and one[3] == pytest.approx(0.05 * one[2])
    np.testing.assert_allclose(two, 2 * one)
    assert not pose_covariance(nothing, nothing, np.zeros((0, 6)), 3.0).any()


def test_a_turn_that_neither_shape_nor_texture_tells_is_hardly_known():
    spin, nothing = np.array([[0, 0, 1.0, 0.05, 0, 0]]), np.zeros((6, 6))
    known = 1e-4 * np.eye(6)
    told, untold = (pose_covariance(known, nothing, spin, 0.0, told) for told in (True, False))
    assert np.degrees(np.sqrt(untold[2, 2])) > 30 and confidence(untold, 20, 1.0) < 0.5 < confidence(told, 20, 1.0)
    np.testing.assert_allclose(untold[:2, :2], told[:2, :2])


def test_frame_and_map_add_up():
    frame, of_map = np.diag([1.0, 2, 3, 4, 5, 6]), np.diag([6.0, 5, 4, 3, 2, 1])
    together = pose_covariance(frame, of_map, np.zeros((0, 6)), 0.0)
    np.testing.assert_allclose(together / together[0, 0], np.eye(6))
