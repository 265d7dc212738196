"""The simulated turn: its noise is what it says, and the graph does with it what the notebook shows."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.depth import depth_noise_m
from studies.factor_graph import (
    consistency,
    optimise,
    optimise_online,
    outlier_trials,
    register_turn,
    simulate_turn,
)

CONFIG = preset("default").with_values({"factor_graph.max_keyframes": 0})
WITHOUT_REG = CONFIG.with_values({"factor_graph.between": False})


@pytest.fixture(scope="module")
def turn():
    return simulate_turn(np.random.default_rng(3), CONFIG)


def test_observations_have_the_noise_of_the_pipeline(turn):
    exact = se3.transform(turn.T_cam_obj, turn.p_obj)[turn.seen]
    seen = turn.p_cam[turn.seen]
    range_m, bearing = np.linalg.norm(exact, axis=1), exact / np.linalg.norm(exact, axis=1)[:, None]
    off_sigmas = (np.linalg.norm(seen, axis=1) - range_m) / depth_noise_m(exact[:, 2], CONFIG.depth)
    assert np.std(off_sigmas) == pytest.approx(1, rel=0.1)
    across = np.linalg.norm(np.cross(seen / np.linalg.norm(seen, axis=1)[:, None], bearing), axis=1)
    assert np.sqrt((across**2).mean() / 2) == pytest.approx(CONFIG.factor_graph.bearing_sigma_rad, rel=0.1)
    assert np.isnan(turn.p_cam[~turn.seen]).all() and turn.seen.sum(1).min() > 10


def test_the_graph_takes_out_drift():
    alone_deg, graph_deg = [], []
    for seed in (1, 2, 3, 4):
        one = simulate_turn(np.random.default_rng(seed), CONFIG)
        registered = register_turn(one, CONFIG)
        alone_deg.append(registered.errors(one)[0].mean())
        graph_deg.append(optimise(one, registered, CONFIG).errors(one)[0].mean())
    assert np.mean(graph_deg) < 0.75 * np.mean(alone_deg)


def test_without_observations_nothing_contradicts_registration(turn):
    registered = register_turn(turn, CONFIG)
    blind = optimise(turn, registered, CONFIG.with_values({"factor_graph.observations": False}))
    np.testing.assert_allclose(blind.errors(turn)[0], registered.errors(turn)[0], atol=0.05)


def test_hidden_keyframes_need_relative_poses():
    gap = simulate_turn(np.random.default_rng(1), CONFIG, keyframes=14, hidden=(6, 8))
    assert gap.seen[6:8].sum(1).tolist() == [2, 2]
    registered = register_turn(gap, CONFIG)
    left_out = optimise_online(gap, registered, WITHOUT_REG)[-1].T_cam_obj
    assert np.isnan(left_out[6:8]).all() and np.isfinite(left_out[[5, 8, 13]]).all()
    kept = optimise_online(gap, registered, CONFIG)[-1]
    assert np.isfinite(kept.T_cam_obj).all() and kept.errors(gap)[0].max() < 12


def test_a_bounded_graph_merges_keyframes(turn):
    registered = register_turn(turn, CONFIG)
    solved = [optimise_online(turn, registered, preset(name))[-1] for name in ("default", "paper")]
    kept = [int(np.isfinite(one.T_cam_obj).all((1, 2)).sum()) for one in solved]
    assert kept == [31, 42], "30 and the newest, which is merged after it is solved for; the paper keeps all"
    assert solved[0].errors(turn)[0][-1] < 1.5 * solved[1].errors(turn)[0][-1]


def test_covariance_is_honest_where_observations_count_once():
    (nees,) = consistency(60, WITHOUT_REG, (WITHOUT_REG,), 9, keyframes=8, points=50)
    assert len(nees) > 45 and (nees.mean(0) > 1.5).all() and (nees.mean(0) < 6).all()


def test_outliers_cost_squares_more_than_huber():
    rows = outlier_trials([0, 1], CONFIG, 0.08)
    assert rows["turn"].tolist() == [0, 1]
    assert (rows["graph with squares, outliers [°]"] > 2 * rows["graph with Huber, outliers [°]"]).all()
    assert (rows["graph, clean [°]"] < rows["registration alone, clean [°]"]).all()
