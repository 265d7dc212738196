"""2D tracks on the video and over time: a perfect and a broken tracker, what is counted, what did not run."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.point_tracks import QueryOutcome
from p2p_lib.evaluation.tracker_score import TrackTask
from p2p_lib.figures import overlay, style
from studies import tracking2d as tracks


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
