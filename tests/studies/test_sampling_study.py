"""What points are worth: coverage by hand, a pose held by known points, the terms of every choice, lives of a map.

And what is drawn is what was computed.
"""

import numpy as np
import pytest
from pandas import DataFrame

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.robust import fit_rigid
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.method.sampling import choose, terms
from studies import sampling
from studies.sampling import (
    MapHistory,
    Situation,
    compare_choices,
    conditioning,
    coverage,
    follow_map,
    greedy_terms,
    open_views,
)

CONFIG = preset()


@pytest.fixture(scope="module")
def crossing():
    return open_sequence("synthetic/crossing")


def test_coverage_by_hand():
    mask = np.zeros((20, 40), bool)
    mask[5:15, 10:30] = True  # 200 pixels
    inside = sum(1 for v in range(5, 15) for u in range(10, 30) if np.hypot(u - 12, v - 6) <= 3)
    assert coverage(mask, np.array([[12.0, 6.0]]), 3) == inside / 200
    assert coverage(mask, np.array([[12.0, 6.0]]), 100) == 1
    assert coverage(mask, np.zeros((0, 2)), 100) == 0


def test_conditioning_is_the_error_that_registration_makes():
    """The standard deviation stated for a choice of points is that of registrations with noise drawn anew."""
    rng = np.random.default_rng(0)
    p_cam = rng.uniform(-0.05, 0.05, (12, 3)) * [1, 1, 0.2] + [0, 0, 0.7]
    surface = rng.uniform(-0.08, 0.08, (200, 3)) * [1, 1, 0.2] + [0, 0, 0.7]
    turn_deg, error_m = conditioning(p_cam, surface, CONFIG)
    sigma_m = depth_noise_m(p_cam[:, 2], CONFIG.depth)[:, None]
    moved, turned = [], []
    for _ in range(1500):
        T = fit_rigid(p_cam, p_cam + sigma_m * rng.normal(size=p_cam.shape), 1 / sigma_m[:, 0] ** 2)
        moved.append(((se3.transform(T, surface) - surface) ** 2).sum(1).mean())
        turned.append(se3.log(T)[:3])
    assert error_m == pytest.approx(np.sqrt(np.mean(moved)), rel=0.05)
    worst = np.degrees(np.sqrt(np.linalg.eigvalsh(np.cov(np.array(turned).T)).max()))
    assert turn_deg == pytest.approx(worst, rel=0.08)


def test_points_in_a_line_hold_no_turn_about_it():
    line = np.stack([np.linspace(-0.05, 0.05, 20), np.zeros(20), np.full(20, 0.7)], 1)
    spread = line + np.array([[0, 0.04, 0], [0, -0.04, 0]] * 10)
    assert conditioning(line, spread, CONFIG)[0] > 50 > 2 > conditioning(spread, spread, CONFIG)[0]


def test_terms_of_the_choices_sum_to_what_was_maximised():
    rng = np.random.default_rng(0)
    candidates = Candidates(rng.uniform(0, 60, (80, 2)), rng.uniform(0, 1, 80))
    cfg = CONFIG.sampling
    chosen = choose(candidates, np.zeros((0, 2)), 80, cfg)
    parts = greedy_terms(candidates, chosen, cfg)
    assert 20 < len(chosen) < 80 and (parts.total > 0).all() and parts.crowding.min() < 0
    assert (np.diff(parts.total) <= 1e-12).all(), "distances only shrink, so each choice is worth no more than the last"
    np.testing.assert_allclose(parts.trackability, cfg.score_weight * candidates.score[chosen])


def test_choices_are_scored_on_the_same_ground(crossing):
    at = Situation(crossing, "box", 0)
    scores = compare_choices([at], frames_on=0).set_index("choice")
    assert [len(uv_px) for uv_px in scores["uv_px"]] == [CONFIG.sampling.points] * 6
    assert scores["covered [%]"]["farthest"] > scores["covered [%]"]["score alone"]
    assert scores["pose error [mm]"]["farthest"] < scores["pose error [mm]"]["score alone"]
    again = compare_choices([at], frames_on=0)
    np.testing.assert_array_equal(again["uv_px"][0], scores["uv_px"]["J"])
    followed = compare_choices([at], {"J": ("corners", {})}, frames_on=3)
    assert 80 < followed["still tracked [%]"][0] <= 100


def test_views_are_of_objects_in_sight(crossing):
    views = open_views(crossing, 3, 20)
    assert [v.name for v in views] == ["box"] * 3 + ["can"] * 3
    assert all(v.mask.sum() >= 2000 and v.frame.index < 280 for v in views)


def test_the_life_of_a_map_follows_the_rules_of_promotion(crossing):
    history, cfg = follow_map(crossing, "box", 30), CONFIG.keypoint_map
    points = history.points
    late = points.born > 0
    assert history.keyframe[0] and set(points.born) == set(np.flatnonzero(history.keyframe))
    assert (points.promoted[~late] == 0).all()
    waited = (points.promoted - points.born)[late & (points.promoted < 30)]
    assert len(waited) > 5 and waited.min() >= cfg.streak
    np.testing.assert_array_equal(np.isfinite(history.p_promoted[:, 0]), points.promoted < 30)
    assert points.born_error_m.notna().mean() > 0.9 and points.born_error_m.median() < 0.004


def test_maps_show_the_terms_and_the_next_choice(crossing):
    situation = Situation(crossing, "box", 0)
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
    objective = terms(candidates.score, np.full(len(dots), np.inf), config).total
    np.testing.assert_allclose(np.sort(dots), np.sort(objective))


def test_the_plot_of_choices_has_a_panel_a_measure():
    columns = ["choice", "covered [%]", "pose error [mm]", "still tracked [%]"]
    table = DataFrame([("J", 60, 2, 80), ("uniform", 50, 4, 80)], columns=columns)
    dots = [axis.collections[0].get_offsets()[:, 0].tolist() for axis in sampling.choice_plot(table).axes]
    assert dots == [[60, 50], [2, 4], [80, 80]]


@pytest.fixture
def history():
    """Two founders, three pending from frame 4: promoted at 7 and 8, and retired at 9."""
    born, promoted, gone = np.array([0, 0, 4, 4, 4]), np.array([0, 0, 7, 8, 10]), np.array([10, 6, 10, 10, 9])
    p = np.zeros((5, 3))
    later = np.where((promoted < 10)[:, None], p, np.nan)
    keyframe, poses = np.isin(np.arange(10), [0, 4]), np.tile(np.eye(4), (10, 1, 1))
    points = DataFrame({"born": born, "promoted": promoted, "gone": gone})
    return MapHistory("box", points, p, later, keyframe, poses)


def test_lives_are_bars_of_the_right_length(history, crossing):
    bars = sampling.life_lines(history, crossing).axes[0].patches
    spans = sorted((bar.get_x(), bar.get_x() + bar.get_width()) for bar in bars if bar.get_width())
    assert spans == [(0, 6), (0, 10), (4, 7), (4, 8), (4, 9), (7, 10), (8, 10)]


def test_the_moments_of_promotion(history):
    assert history.late.index.tolist() == [2, 3]
    moments = sampling.promotion_moments(history)
    assert moments[0] == 4 and moments[-1] == 7 and len(moments) == 4
