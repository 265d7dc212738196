"""The mug as an experiment: truth, tracks and hypotheses fit together."""

from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.figures import style
from p2p_lib.method.refinement import surface_distances
from p2p_lib.method.registration import register
from studies import registration as study
from studies.registration import mug_moment, ways_to_decide

CONFIG = preset("default")


@pytest.fixture(scope="module")
def moment():
    return mug_moment(CONFIG, seed=1)


def test_most_tracks_are_wrong_and_the_truth_lies_on_the_surface(moment):
    seen = np.isfinite(moment.off_m)
    assert seen.sum() > 40 and 0.1 < moment.right[seen].mean() < 0.5 and not moment.right[~seen].any()
    assert moment.turned_deg > 20 and moment.error(moment.T_cam_obj) == (0, 0)
    expected = se3.transform(moment.T_cam_obj, moment.p_obj[moment.right])
    assert np.linalg.norm(moment.camera.project(expected) - moment.uv_px[moment.right], axis=1).max() < 12
    poses = np.stack([moment.T_cam_obj, moment.T_before])
    score, before = surface_distances(moment.surface, moment.cloud, poses).mean(1)
    assert score < 0.003 and score < 0.8 * before


def test_one_hypothesis_fails_and_the_surface_finds_the_right_one(moment):
    off_deg = {way: moment.error(T)[0] for way, T in ways_to_decide(moment, CONFIG, 1).items()}
    assert off_deg["RANSAC: most inliers"] > 15
    assert off_deg["refine all, least score"] < 3 and off_deg["configured selection"] < 3


def test_the_papers_rule_has_the_papers_registration(moment):
    text = preset("paper").registration
    found = register(moment.p_obj, moment.p_cam, text, np.random.default_rng([1, 8]))
    expected = np.stack([h.T_cam_obj for h in found])
    scores = surface_distances(moment.surface, moment.cloud, expected).mean(1)
    np.testing.assert_array_equal(ways_to_decide(moment, CONFIG, 1)["least score"], expected[scores.argmin()])


def test_both_labels_of_the_scores_are_inside_the_figure():
    found = [SimpleNamespace(support=support, T_cam_obj=np.eye(4)) for support in (45, 35)]
    scores = {"as registered": np.array([0.00337, 0.00373]), "after SDF refinement": np.array([0.00326, 0.00215])}
    figure = study.support_and_score(SimpleNamespace(error=lambda T: (30.5, 0)), found, scores)
    with style.applied():
        figure.draw_without_rendering()
    for axis in figure.axes:
        box = axis.xaxis.label.get_window_extent()
        assert 0 <= box.x0 and box.x1 <= figure.bbox.x1 and 0 <= box.y0
