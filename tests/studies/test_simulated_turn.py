"""The simulated turn: its noise is what it says, and the graph does with it what the notebook shows."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import FactorGraphConfig
from p2p_lib.studies.simulated_turn import (
    consistency,
    optimise,
    optimise_online,
    outlier_trials,
    register,
    simulate_turn,
)

CONFIG = FactorGraphConfig(max_keyframes=0)


@pytest.fixture(scope="module", params=[3, 4, 5])
def turn(request):
    return simulate_turn(np.random.default_rng(request.param), config=CONFIG)


def test_observations_have_the_noise_that_they_claim(turn):
    exact = se3.transform(turn.T_cam_obj, turn.p_obj)[turn.seen]
    seen = turn.p_cam[turn.seen]
    range_m, bearing = np.linalg.norm(exact, axis=1), exact / np.linalg.norm(exact, axis=1)[:, None]
    assert np.std(np.linalg.norm(seen, axis=1) - range_m) == pytest.approx(CONFIG.range_sigma_m, rel=0.1)
    across = np.linalg.norm(np.cross(seen / np.linalg.norm(seen, axis=1)[:, None], bearing), axis=1)
    assert np.sqrt((across**2).mean() / 2) == pytest.approx(CONFIG.bearing_sigma_rad, rel=0.1)
    assert np.isnan(turn.p_cam[~turn.seen]).all() and turn.seen.sum(1).min() > 10


def test_the_graph_takes_out_drift_and_observations_are_what_does_it(turn):
    front_end = register(turn)
    alone, graph = front_end.errors(turn)[0], optimise(turn, front_end, CONFIG).errors(turn)[0]
    assert graph.mean() < 0.8 * alone.mean()
    blind = optimise(turn, front_end, replace(CONFIG, observations=False))
    np.testing.assert_allclose(blind.errors(turn)[0], alone, atol=0.05)


def test_hidden_keyframes_need_relative_poses():
    gap = simulate_turn(np.random.default_rng(1), keyframes=14, config=CONFIG, hidden=(6, 8))
    assert gap.seen[6:8].sum(1).tolist() == [2, 2]
    left_out = optimise_online(gap, register(gap), replace(CONFIG, between=False))[-1].T_cam_obj
    assert np.isnan(left_out[6:8]).all() and np.isfinite(left_out[[5, 8, 13]]).all()
    assert np.isfinite(optimise_online(gap, register(gap), CONFIG)[-1].T_cam_obj).all()


def test_covariance_is_honest():
    nees = consistency(60, CONFIG, 9, keyframes=8, points=50)
    assert nees.shape == (60, 2) and (nees.mean(0) > 1.5).all() and (nees.mean(0) < 6).all()


def test_outliers_cost_squares_more_than_huber():
    rows = outlier_trials([0, 1], CONFIG, 0.08)
    assert [row["turn"] for row in rows] == [0, 1]
    for row in rows:
        assert row["graph with squares, outliers [°]"] > 2 * row["graph with Huber, outliers [°]"]
        assert row["graph, clean [°]"] < row["registration alone, clean [°]"]
