"""The mug as an experiment: truth, tracks and hypotheses fit together."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.method.refinement import surface_score
from p2p_lib.studies.mug_moment import decide, mug_moment

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
    score, before = surface_score(moment.surface, moment.cloud, np.stack([moment.T_cam_obj, moment.T_before]))
    assert score < 0.003 and score < 0.8 * before


def test_one_hypothesis_fails_and_the_surface_finds_the_right_one(moment):
    decided = decide(moment, CONFIG, 1)
    assert moment.error(decided.poses["RANSAC: most inliers"])[0] > 15
    assert moment.error(decided.poses["refine all, least score"])[0] < 3
    assert moment.error(decided.poses["configured selection"])[0] < 3 and "nearest to the surface" in decided.reason
    assert (decided.refined_scores_m <= decided.scores_m + 2e-4).all()
