"""The runner: who is asked what and when, which frames count, and what a perfect and a late tracker score."""

import json

import numpy as np
import pytest

from p2p_lib.apps import cli
from p2p_lib.core.backends import TRACKERS, make_tracker
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Tracks
from p2p_lib.datasets.models import MESHES, find_models
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.tracker_score import TrackTask, run_tracker
from p2p_lib.evaluation.true_tracks import TrueScene, draw_queries


class Recorder:
    """A tracker that keeps every query where it was, and a diary."""

    name = "recorder"

    def __init__(self, late=0):
        self.latency_frames, self.diary = late, []
        self._uv, self._frames = np.zeros((0, 2)), 0

    def start(self, frame, camera=None):
        self.diary.append(("start", frame.index))

    def add(self, uv_px):
        self.diary.append(("add", len(uv_px)))
        ids = len(self._uv) + np.arange(len(uv_px))
        self._uv = np.concatenate([self._uv, uv_px])
        return ids

    def track(self, frame, search=None, urgent=False):
        self.diary.append(("track", frame.index, None if search is None else int(search.sum())))
        n = len(self._uv)
        return Tracks(np.arange(n), self._uv + frame.index, np.ones(n, bool), np.zeros(n))


@pytest.fixture(scope="module")
def queries(made):
    scene = TrueScene(made.sequence, find_models(made.sequence, MESHES))
    return draw_queries(scene, np.random.default_rng(0), 16)


def test_all_queries_in_one_pass_each_at_its_frame(made, queries):
    tracker = Recorder()
    run = run_tracker(tracker, made.sequence, queries)
    adds = [k for k, entry in enumerate(tracker.diary) if entry[0] == "add"]
    assert [tracker.diary[k] for k in adds] == [("add", 4)] * 4
    assert [tracker.diary[k - 1][:2] for k in adds] == [("start", 0), ("track", 10), ("track", 20), ("track", 30)]
    assert [entry[2] for entry in tracker.diary if entry[0] == "track"] == [None] * 39
    for k, first in enumerate(queries.frame):
        assert not run.visible[: first + 1, k].any() and run.visible[first + 1 :, k].all()
        np.testing.assert_array_equal(run.uv_px[first + 1, k], queries.uv_px[k] + first + 1)
        assert np.isnan(run.uv_px[: first + 1, k]).all()
    assert np.isfinite(run.cpu_ms).all()


def test_search_is_the_union_of_the_masks(made, queries):
    tracker = Recorder()
    run_tracker(tracker, made.sequence, queries, search=True)
    told = {entry[1]: entry[2] for entry in tracker.diary if entry[0] == "track"}
    for t in (1, 20, 39):
        assert told[t] == np.logical_or.reduce(list(made.sequence.masks(t).values())).sum()


def test_a_late_answer_belongs_to_an_earlier_frame(made, queries):
    tracker = Recorder(late=3)
    run = run_tracker(tracker, made.sequence, queries)
    # Queries of frame 10 are added once the tracker has answered that frame.
    adds = [k for k, entry in enumerate(tracker.diary) if entry[0] == "add"]
    assert [tracker.diary[k - 1][1] for k in adds] == [3, 13, 23, 33]
    for k, first in enumerate(queries.frame):
        np.testing.assert_array_equal(run.uv_px[first + 1, k], queries.uv_px[k] + first + 4)
        assert not run.visible[: first + 1, k].any() and run.visible[first + 1 :, k].all()
    # The last picture is shown three times more.
    assert [entry[1] for entry in tracker.diary[-4:]] == [39] * 4


def test_plain_lk_scores_as_lucas_kanade_does():
    """It follows well and finds nothing again."""
    crossing = open_sequence("synthetic/crossing")
    score = TrackTask.of(crossing, 1, count=48).score(make_tracker("lk", TrackingConfig()))
    plain = score.as_dict()
    assert 0.2 < plain["aj"] < plain["delta_avg"] < 0.6 and plain["jaccard"]["16_px"] > plain["jaccard"]["1_px"]
    assert plain["redetection"]["returns"] > 10 and plain["redetection"]["found"] == 0
    assert 0 < plain["cpu_ms"]["mean"] <= plain["cpu_ms"]["p95"] < 200
    assert "48 queries, seed 1" in score.as_table()


# --- p2p eval-tracks ----------------------------------------------------------------------------


def test_the_command_prints_one_json_object(made, capsys):
    words = f"eval-tracks {made.sequence.path} --tracker lk --queries 8 --seed 2 --json"
    assert cli.main(words.split()) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["tracker"] == "lk" and plain["queries"] == 8 and plain["seed"] == 2
    assert plain["search"] == "whole image" and plain["truth"] == "box: mesh, can: mesh"
    assert plain["frames"] > 20 and cli.main([*words.split(), "--stop", "20"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"] == 20
    assert set(plain["jaccard"]) == {"1_px", "2_px", "4_px", "8_px", "16_px"}
    # Nothing is hidden so early: what is a share of nothing is no number.
    assert cli.main([*words.split()[:-1], "--stop", "3"]) == 0 and "no point returns after" in capsys.readouterr().out
    assert cli.main([*words.split(), "--stop", "3"]) == 0
    again = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)["redetection"]
    assert again["returns"] == 0 and again["found"] is None


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ("SEQUENCE --tracker lkk", "tracker: got 'lkk', expected one of builtin, builtin2d, lk"),
        ("SEQUENCE --models tin=x.obj", "model: got the name 'tin', expected one of the objects: box, can"),
        ("SEQUENCE --models can=nowhere.obj", "nowhere.obj: no such model"),
        ("nowhere", "nowhere: no such folder"),
        ("SEQUENCE --set tracking.windo=3", "Did you mean tracking.window_px"),
    ],
)
def test_what_does_not_fit_is_said_in_one_line(made, capsys, words, complaint):
    assert cli.main(["eval-tracks", *words.replace("SEQUENCE", str(made.sequence.path)).split()]) == 2
    err = capsys.readouterr().err
    assert err.startswith("p2p eval-tracks: ") and complaint in err and err.count("\n") == 1


def test_every_tracker_says_its_name():
    for name in ("lk", "builtin"):
        assert name in TRACKERS and make_tracker(name, TrackingConfig()).name == name
