"""Calibration and separation of confidences, against counts by hand and populations with known answers."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.evaluation.confidence import Judged, pooled, reliability, right_poses
from p2p_lib.evaluation.protocol import ObjectScore


def test_bins_hold_what_they_should():
    judged = Judged(np.array([0.05, 0.08, 0.31, 0.99, 1.0, 1.0]), np.array([0, 1, 1, 1, 1, 0], bool))
    bins = reliability(judged)
    np.testing.assert_allclose(bins.confidence, [0.065, 0.31, (0.99 + 2) / 3])
    np.testing.assert_allclose(bins.right, [0.5, 1, 2 / 3])
    assert bins.poses.tolist() == [2, 1, 3]
    by_hand = (2 * abs(0.5 - 0.065) + 1 * 0.69 + 3 * abs(2 / 3 - 2.99 / 3)) / 6
    assert judged.calibration_error == pytest.approx(by_hand)


def test_auroc_is_the_share_of_pairs_in_the_right_order():
    rng = np.random.default_rng(0)
    confidence, right = rng.integers(0, 8, 60) / 8, rng.random(60) < 0.4  # with many ties
    a, b = confidence[right][:, None], confidence[~right]
    assert Judged(confidence, right).auroc == pytest.approx(np.mean((a > b) + 0.5 * (a == b)))
    assert np.isnan(Judged(confidence, np.ones(60, bool)).auroc)


def test_a_confidence_that_means_what_it_says_is_calibrated_and_a_boast_is_not():
    rng = np.random.default_rng(1)
    chance = rng.random(20_000)
    honest = Judged(chance, rng.random(20_000) < chance)
    assert honest.calibration_error < 0.02 and honest.auroc == pytest.approx(5 / 6, abs=0.01)  # of a uniform chance
    boast = Judged(np.ones(20_000), honest.right)
    assert boast.calibration_error == pytest.approx(0.5, abs=0.01) and boast.auroc == 0.5


def test_pooling_keeps_every_pose():
    one, other = Judged(np.array([0.2]), np.array([True])), Judged(np.array([0.4, 0.5]), np.array([False, True]))
    total = pooled([one, other])
    assert total.confidence.tolist() == [0.2, 0.4, 0.5] and total.right.tolist() == [True, False, True]
    assert len(pooled([])) == 0 and np.isnan(pooled([]).calibration_error)


def test_right_is_within_two_centimetres_and_five_degrees():
    class Obj:
        T_cam_model = np.tile(se3.exp(np.array([0.3, 0.2, -0.4, 0.1, 0, 0.6])), (5, 1, 1))

    errors = [[0, 0, 0, 0, 0, 0], [0, 0, 0, 0.019, 0, 0], [0, 0, 0, 0.021, 0, 0], [0, np.radians(4.9), 0, 0, 0, 0]]
    errors = np.array([*errors, [np.radians(5.1), 0, 0, 0, 0, 0]])
    T_obj_model = se3.exp(np.array([0.1, 0, 0.7, 0, 0.05, 0]))
    obj = Obj()
    obj.T_cam_obj = Obj.T_cam_model @ se3.exp(errors) @ se3.inverse(T_obj_model)
    obj.T_cam_obj = np.concatenate([obj.T_cam_obj, np.full((1, 4, 4), np.nan)])
    obj.T_cam_model = np.concatenate([Obj.T_cam_model, Obj.T_cam_model[:1]])
    none = np.zeros(0)
    score = ObjectScore(none, none, none, T_obj_model, 1)
    assert right_poses(obj, score).tolist() == [True, True, False, True, False, False]
