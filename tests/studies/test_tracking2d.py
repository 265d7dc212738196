"""2D tracks on the video and over time: a perfect and a broken tracker, what is counted, what did not run."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.tracker_score import TrackTask
from p2p_lib.figures import overlay, style
from studies import tracking2d as tracks
from studies.tracking2d import QueryOutcome


@pytest.fixture(scope="module")
def task():
    return TrackTask.of(open_sequence("synthetic/crossing"), count=24)


@pytest.fixture(scope="module")
def scores(task):
    contestants = {"perfect": ("oracle", {"oracle.noise_px": 0.0}), "learned": ("tapir", {})}
    return tracks.compare_trackers(task, contestants, {"learned": "no weights"})


def test_a_perfect_tracker_is_right_or_rightly_silent(scores):
    came = tracks.score_outcomes(scores["perfect"])
    assert set(np.unique(came)) == {QueryOutcome.NOT_ASKED, QueryOutcome.HIDDEN, QueryOutcome.RIGHT}
    assert ((came == QueryOutcome.RIGHT) <= scores["perfect"].truth.visible).all()


def test_a_tracker_that_did_not_run_has_dashes_and_a_reason(scores):
    perfect, learned = tracks.tracker_table(scores).to_dict("records")
    assert perfect["AJ"] == perfect["OA"] == 1 and perfect["found again [%]"] == 100 and perfect["why not"] == ""
    assert np.isnan(learned["AJ"]) and learned["why not"] == "no weights"


def test_a_backend_that_is_missing_gives_its_reason(task, monkeypatch):
    monkeypatch.delenv("P2P_DATA", raising=False)
    reason = tracks.compare_trackers(task, {"tapir": ("tapir", {})})["tapir"]
    assert isinstance(reason, str) and "Run: " in reason


def test_the_story_shows_before_while_and_after_each_absence(task, scores):
    scene = tracks.TrackScene(task.sequence, scores["perfect"])
    absences = scene.absences()
    assert {name for name, _, _ in absences} == {"box", "can"}
    moments = scene.moments(6)
    assert len(set(moments)) == 6 and moments == sorted(moments)
    for _, start, stop in absences:
        assert any(start <= t < stop for t in moments) and any(stop <= t <= stop + 12 for t in moments)
    assert scene.story(count=6, columns=3, width_px=200).shape[1] == 608


def test_right_and_wrong_points_look_different(task, scores):
    score, blue = scores["perfect"], np.array(style.rgb(style.OBJECTS[0]))
    strayed = replace(score, run=replace(score.run, uv_px=score.run.uv_px + 30.0))
    scenes = [tracks.TrackScene(task.sequence, s) for s in (score, strayed)]
    right, wrong = (scene.draw(60, width_px=640, trail=0) for scene in scenes)
    rgb, camera = task.sequence.frame(60).rgb, task.sequence.camera
    before, seen_by = overlay.zoomed(rgb, camera, scenes[0].region_px, 640)
    seen = score.truth.visible[60] & (score.queries.frame < 60) & (score.queries.points.object == 0)
    assert seen.any()
    u, v = np.rint(overlay.zoomed_px(score.truth.uv_px[60, seen], camera, seen_by)).astype(int).T
    assert (np.abs(right[v, u].astype(int) - blue).max(1) < 30).all()
    assert not (right == before).all() and not (wrong == right).all()
    assert np.abs(wrong[v, u].astype(int) - blue).max(1).mean() > 60


def test_time_plots_take_what_ran_and_leave_out_what_did_not(task, scores):
    figure = tracks.found_over_time(scores, task.sequence.times_s)
    (line,) = figure.axes[0].get_lines()
    share = line.get_ydata()
    assert line.get_label() == "perfect" and (share[np.isfinite(share)] == 100).all()
    bands = tracks.outcome_bands({"perfect": scores["perfect"]}, task.sequence.times_s)
    assert bands.axes[0].get_images()[0].get_array().shape == (24, 300)


def test_every_outcome_by_hand():
    uv_true = np.zeros((1, 6, 2))
    uv = np.array([[[7.9, 0], [8.1, 0], [0, 0], [0, 0], [np.nan, np.nan], [0, 0]]])
    truly = np.array([[True, True, True, False, False, True]])
    said = np.array([[True, True, False, True, False, True]])
    asked = np.array([[True, True, True, True, True, False]])
    names = [QueryOutcome(k).name for k in tracks.outcomes(uv_true, truly, uv, said, asked)[0]]
    assert names == ["RIGHT", "WRONG", "MISSED", "WRONG", "HIDDEN", "NOT_ASKED"]


def test_reliability_of_an_honest_and_of_a_blind_tracker():
    rng = np.random.default_rng(0)
    sigma = rng.uniform(1, 6, 20_000)
    error = np.abs(sigma * rng.normal(size=sigma.shape))
    honest, blind = tracks.reliability(error, sigma), tracks.reliability(error, rng.uniform(size=sigma.shape))
    assert len(honest.uncertainty) == 10
    np.testing.assert_allclose(honest.median_px, 0.6745 * honest.uncertainty, rtol=0.1)
    np.testing.assert_allclose(honest.p90_px, 1.645 * honest.uncertainty, rtol=0.15)
    assert honest.rank_correlation > 0.4 > 0.03 > abs(blind.rank_correlation)
    assert np.ptp(blind.median_px) < 0.3
