"""Maps of the objective, the worth of choices, and lives of points: what is drawn is what was computed."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.method.sampling import choose, objective
from p2p_lib.studies import sampling_plots as sampling
from p2p_lib.studies.map_history import MapHistory
from p2p_lib.studies.sampling_study import ChoiceScore, Situation


@pytest.fixture(scope="module")
def situation():
    return Situation.of(open_sequence("synthetic/crossing"), "box", 0)


def test_maps_show_the_terms_and_the_next_choice(situation):
    candidates, config = situation.candidates(), situation.config.sampling
    figure = sampling.term_maps(situation, candidates, after=(0, 4))
    axes = figure.axes  # two rows of four, then the colour bars
    chosen = choose(candidates, np.zeros((0, 2)), 5, config)
    spread = axes[5].get_images()[-1].get_array()
    assert spread.max() == pytest.approx(1 - config.score_weight) and spread.min() < 0.05
    assert np.ma.is_masked(spread), "nothing is drawn beside the object"
    crosses = [tuple(line.get_xydata()[0]) for line in axes[7].get_lines()]
    np.testing.assert_allclose(crosses[-1], candidates.uv_px[chosen[4]])
    dots = axes[3].collections[0].get_array()
    np.testing.assert_allclose(np.sort(dots), np.sort(objective(candidates.score, np.full(len(dots), np.inf), config)))


def test_the_table_is_of_means_over_situations():
    one = ChoiceScore("J", np.zeros((3, 2)), 0.5, 1.0, 0.002, 0.8)
    rows = [one, replace(one, coverage=0.7, kept=float("nan")), replace(one, label="uniform", error_m=0.004)]
    first, second = sampling.choice_table(rows).to_dict("records")
    assert first["choice"] == "J" and first["covered [%]"] == 60 and first["still tracked [%]"] == 80
    assert (first["pose error [mm]"], second["pose error [mm]"]) == (2, 4)
    assert len(sampling.choice_plot(sampling.choice_table(rows)).axes) == 3


@pytest.fixture
def history():
    """Two founders, three pending from frame 4: promoted at 7 and 8, and retired at 9."""
    born, promoted, gone = np.array([0, 0, 4, 4, 4]), np.array([0, 0, 7, 8, 10]), np.array([10, 6, 10, 10, 9])
    p = np.zeros((5, 3))
    later = np.where((promoted < 10)[:, None], p, np.nan)
    keyframe, poses = np.isin(np.arange(10), [0, 4]), np.tile(np.eye(4), (10, 1, 1))
    return MapHistory("box", np.arange(5), born, promoted, gone, p, later, p, keyframe, poses)


def test_lives_are_bars_of_the_right_length(history, situation):
    bars = sampling.life_lines(history, situation.video).axes[0].patches
    spans = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars if bar.get_width())
    assert spans == [(0, 6), (0, 10), (4, 7), (4, 8), (4, 9), (7, 10), (8, 10)]


def test_the_moments_of_promotion(history):
    assert history.founding.tolist() == [True, True, False, False, False]
    moments = sampling.promotion_moments(history)
    assert moments[0] == 4 and moments[-1] == 7 and len(moments) == 4
