"""The oracle: true tracks, spoiled by exactly as much as asked for; causal; and it drives the pipeline."""

import json

import numpy as np
import pytest

from p2p_lib.apps import cli
from p2p_lib.core import se3
from p2p_lib.core.config import OracleConfig, preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import WITH_POSE
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.oracle import OracleTracker
from p2p_lib.evaluation.true_tracks import TrueScene, draw_queries
from p2p_lib.extended.default import Point2Pose

EXACT = OracleConfig(noise_px=0)


@pytest.fixture(scope="module")
def crossing():
    return open_sequence("synthetic/crossing")


@pytest.fixture(scope="module")
def scene(crossing):
    return TrueScene.of(crossing)


@pytest.fixture(scope="module")
def queries(scene):
    return draw_queries(scene, np.random.default_rng(5), 400, at=1)


def told(scene, queries, config, seed=0, frames=range(1, 9), extra=0):
    """Positions (T, N, 2) and visibility (T, N) of the queries; ``extra`` more are added after the third frame."""
    tracker = OracleTracker(scene, config, seed)
    tracker.start(scene.sequence.frame(0))
    ids = tracker.add(queries.uv_px)
    uv, visible = [], []
    for k, t in enumerate(frames):
        tracks = tracker.track(scene.sequence.frame(t)).select(ids)
        uv.append(tracks.uv_px)
        visible.append(tracks.visible)
        if k == 2 and extra:
            tracker.add(np.full((extra, 2), 300.0))
    return np.array(uv), np.array(visible)


def test_without_spoiling_it_is_the_truth(scene, queries):
    uv, visible = told(scene, queries, EXACT)
    for k, t in enumerate(range(1, 9)):
        sight = scene.see(scene.sequence.frame(t), queries.points)
        np.testing.assert_array_equal(visible[k], sight.visible)
        np.testing.assert_allclose(uv[k][visible[k]], sight.uv_px[visible[k]])
        assert np.isnan(uv[k][~visible[k]]).all()


def test_spoiled_as_much_as_asked_for(scene, queries):
    uv, visible = told(scene, queries, EXACT)
    noisy, seen = told(scene, queries, OracleConfig(noise_px=1.5))
    np.testing.assert_array_equal(seen, visible)
    assert np.std((noisy - uv)[visible]) == pytest.approx(1.5, rel=0.05)
    _, some = told(scene, queries, OracleConfig(noise_px=0, dropout=0.3))
    assert not (some & ~visible).any() and some[visible].mean() == pytest.approx(0.7, abs=0.04)
    stray, seen = told(scene, queries, OracleConfig(noise_px=0, outliers=0.2, outlier_px=40))
    both = visible & seen
    off_px = np.linalg.norm(stray - uv, axis=-1)[both]
    assert set(np.round(off_px, 6)) == {0.0, 40.0}
    assert np.mean(off_px > 1) == pytest.approx(0.2, abs=0.04)
    assert not (seen & ~visible).any()  # an outlier may leave the picture, none comes from nowhere


def test_errors_that_last(scene, queries):
    """A slide goes from one value to the next; who strays or is silent does so for the whole of a span."""
    uv, visible = told(scene, queries, EXACT, frames=range(1, 25))
    slid, _ = told(scene, queries, OracleConfig(noise_px=0, slide_px=2.0, lasting_frames=8), frames=range(1, 25))
    off = np.where(visible[..., None], slid - uv, np.nan)
    assert np.nanstd(off) == pytest.approx(2.0, rel=0.1)
    assert np.nanstd(np.diff(off, axis=0)) < 1.0, "from frame to frame it changes little"
    config = OracleConfig(noise_px=0, dropout=0.2, outliers=0.2, outlier_px=40, lasting_frames=8)
    _, seen = told(scene, queries, config, frames=range(8, 16))
    always = told(scene, queries, EXACT, frames=range(8, 16))[1].all(0)
    assert (seen[:, always] == seen[0, always]).all(0).mean() > 0.95
    assert 0.7 < seen[:, always].mean() < 0.9


def test_seed_and_causality(scene, queries):
    spoiled = OracleConfig(noise_px=1, dropout=0.2, outliers=0.1)
    uv, visible = told(scene, queries, spoiled)
    for other in (told(scene, queries, spoiled, extra=7), told(scene, queries, spoiled)):
        np.testing.assert_array_equal(uv, other[0])
        np.testing.assert_array_equal(visible, other[1])
    assert (told(scene, queries, spoiled, seed=1)[1] != visible).any()
    cut = told(scene, queries, spoiled, frames=range(1, 5))
    np.testing.assert_array_equal(uv[:4], cut[0])


def test_a_query_beside_the_objects_is_never_seen(scene, crossing):
    tracker = OracleTracker(scene, EXACT)
    with pytest.raises(BadInput, match="start"):
        tracker.add(np.zeros((1, 2)))
    tracker.start(crossing.frame(0))
    tracker.add(np.array([[2.0, 2.0], [-5, 1000]]))
    assert not tracker.track(crossing.frame(1)).visible.any()
    tracker.drop(np.array([0]))
    assert tracker.track(crossing.frame(2)).ids.tolist() == [1]


@pytest.mark.parametrize("outliers", [0.0, 0.3])
def test_the_pipeline_takes_the_tracker_itself(crossing, scene, outliers):
    """Points alone: what comes after tracking must cope with three tracks in ten wrong."""
    config = preset().with_values({"method.surface": False, "method.graph": False})
    method = Point2Pose(crossing.camera, config, OracleTracker(scene, OracleConfig(noise_px=0.3, outliers=outliers)))
    for name in crossing.objects:
        method.add_object(name)
    first = method.step(crossing.frame(0), crossing.masks(0))
    for t in range(2, 24, 2):
        estimates = method.step(crossing.frame(t), crossing.masks(t))
    for name, estimate in estimates.items():
        assert estimate.status in WITH_POSE
        T0, T = crossing.truth[name].T_cam_model[[0, 22]]
        moved = estimate.T_cam_obj @ se3.inverse(first[name].T_cam_obj) @ T0
        assert np.degrees(se3.angle_rad(se3.inverse(moved) @ T)) < 3
        assert np.linalg.norm(moved[:3, 3] - T[:3, 3]) < 0.01


def test_from_the_command_line(capsys):
    words = "eval-tracks synthetic/crossing --tracker oracle --queries 32 --json --set oracle.noise_px=0"
    assert cli.main(words.split()) == 0
    plain = json.loads(capsys.readouterr().out)
    assert plain["tracker"] == "oracle" and plain["aj"] == plain["delta_avg"] == plain["oa"] == 1
    assert plain["redetection"]["returns"] > 5 and plain["redetection"]["found"] == 1
    assert cli.main("run synthetic/crossing --out x --tracker oracle --set oracle.dropout=2".split()) == 2
    assert "config oracle.dropout: got 2" in capsys.readouterr().err
