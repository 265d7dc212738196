"""Metrics against the golden numbers of the peers' own functions, against direct sums, and at their edges."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from p2p_lib.core import se3
from p2p_lib.evaluation import metrics


def some_poses(rng, n, angle_rad, shift_m):
    return se3.exp(np.c_[rng.normal(0, angle_rad, (n, 3)), rng.normal(0, shift_m, (n, 3))])


def test_golden_pose_metrics(shared_data):
    with np.load(shared_data / "golden" / "pose_metrics.npz", allow_pickle=False) as golden:
        add = metrics.add_m(golden["T_pred"], golden["T_gt"], golden["points"])
        adds = metrics.adds_m(golden["T_pred"], golden["T_gt"], golden["points"])
        np.testing.assert_allclose(add, golden["add_m"], rtol=0, atol=1e-9)
        np.testing.assert_allclose(adds, golden["adds_m"], rtol=0, atol=1e-9)
        for name, errors in (("add", add), ("adds", adds)):
            assert metrics.auc_exact(errors) == pytest.approx(float(golden[f"auc_{name}_exact"]), abs=1e-6)
            assert metrics.auc_voc(errors) == pytest.approx(float(golden[f"auc_{name}_voc"]), abs=1e-6)


def test_add_and_adds_are_the_sums_of_their_definitions():
    rng = np.random.default_rng(3)
    points = rng.normal(0, 0.05, (137, 3))
    T_gt = some_poses(rng, 9, 1.0, 0.5)
    T_pred = T_gt @ some_poses(rng, 9, 0.3, 0.02)
    predicted, true = se3.transform(T_pred, points), se3.transform(T_gt, points)
    add = [np.linalg.norm(p - t, axis=1).mean() for p, t in zip(predicted, true)]
    # One-directional: each true point looks for its nearest predicted one, not the other way round.
    adds = [cdist(t, p).min(1).mean() for p, t in zip(predicted, true)]
    np.testing.assert_allclose(metrics.add_m(T_pred, T_gt, points), add, rtol=1e-12)
    np.testing.assert_allclose(metrics.adds_m(T_pred, T_gt, points), adds, rtol=1e-9)


def test_chunks_do_not_change_the_errors(monkeypatch):
    rng = np.random.default_rng(4)
    points, T_gt = rng.normal(0, 0.05, (50, 3)), some_poses(rng, 23, 1.0, 0.5)
    T_pred = T_gt @ some_poses(rng, 23, 0.2, 0.02)
    T_pred[5] = np.nan
    whole = metrics.add_m(T_pred, T_gt, points), metrics.adds_m(T_pred, T_gt, points)
    monkeypatch.setattr(metrics, "_CHUNK", 150)
    parts = metrics.add_m(T_pred, T_gt, points), metrics.adds_m(T_pred, T_gt, points)
    np.testing.assert_allclose(parts, whole, rtol=1e-12)
    assert np.isinf(whole[0][5]) and np.isfinite(np.delete(whole[0], 5)).all()


def test_adds_of_a_turned_can_is_small_where_add_is_large():
    angle = np.linspace(0, 2 * np.pi, 240, endpoint=False)
    ring = np.c_[np.cos(angle), np.sin(angle), np.zeros_like(angle)] * 0.04
    heights = np.linspace(-0.06, 0.06, 20)
    can = (ring[None] + heights[:, None, None] * np.array([0, 0, 1])).reshape(-1, 3)
    turned = se3.exp(np.array([[0, 0, np.pi / 3, 0, 0, 0]]))
    assert metrics.add_m(turned, np.eye(4)[None], can)[0] == pytest.approx(0.04, rel=1e-9)  # chord of 60 degrees
    assert metrics.adds_m(turned, np.eye(4)[None], can)[0] < 1e-9


def test_no_frames_give_no_errors():
    none, points = np.empty((0, 4, 4)), np.zeros((5, 3))
    assert metrics.add_m(none, none, points).shape == metrics.adds_m(none, none, points).shape == (0,)
    assert np.isnan(metrics.auc_exact(np.empty(0))) and np.isnan(metrics.auc_voc(np.empty(0)))


@pytest.mark.parametrize("auc", [metrics.auc_exact, metrics.auc_voc])
def test_auc_ends(auc):
    assert auc(np.zeros(7)) == 100
    assert auc(np.full(7, 0.1)) == 0  # the guard: all errors at the limit, or failures
    assert auc(np.full(7, np.inf)) == 0
    assert auc(np.array([0, np.inf, np.nan, 0])) == 50


@given(st.lists(st.one_of(st.floats(0, 0.3), st.just(float("inf"))), min_size=1, max_size=60))
def test_voc_lies_between_the_exact_integral_and_one_frame_above_it(errors):
    # Right-Riemann over a step function: never below, and above by no more than one step.
    excess = metrics.auc_voc(np.array(errors)) - metrics.auc_exact(np.array(errors))
    assert -1e-9 <= excess <= 100 / len(errors) + 1e-9


@given(st.lists(st.floats(0, 0.2), min_size=1, max_size=60))
def test_exact_auc_is_the_integral_of_the_accuracy_curve(errors):
    limits = (np.arange(20_000) + 0.5) / 20_000 * 0.1
    accuracy = (np.array(errors)[:, None] <= limits).mean(0)
    assert metrics.auc_exact(np.array(errors)) == pytest.approx(accuracy.mean() * 100, abs=0.01)
