"""Two runs of one video, compared without truth."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.evaluation.apart import apart
from tests.evaluation.test_readings import N, path, run_of

T = path(np.random.default_rng(0))


def run(T_cam_obj, **info):
    return replace(run_of(T_cam_obj, T), info={"sequence": "film", **info})


def test_poses_are_compared_whatever_the_object_frames_are():
    own_frame = T @ se3.exp(np.array([0.3, -1, 2, 0.05, 0.02, -0.1]))
    assert "0.0° and 0.0 mm apart" in apart(run(T), run(own_frame))["mug"]
    turned = T.copy()
    turned[1:] = turned[1:] @ se3.exp(np.array([0, 0, np.radians(5), 0.003, 0, 0]))
    turned[N // 2 :] = np.nan
    said = apart(run(T), run(turned))["mug"]
    assert f"5.0° and 3.0 mm apart (medians of {N // 2} frames" in said
    assert f"only one has a pose: {N - N // 2} and 0 frames" in said


def test_runs_that_have_nothing_in_common_are_no_pair():
    here, there = T.copy(), T.copy()
    here[::2], there[1::2] = np.nan, np.nan
    assert "no frame in which both have a pose" in apart(run(here), run(there))["mug"]
    with pytest.raises(BadInput, match=r"got mug in another.*mug in film"):
        apart(run(T), run(T, sequence="another"))
    with pytest.raises(BadInput, match=r"got cup in film.*mug in film"):
        apart(run(T), replace(run(T), objects={"cup": run(T).objects["mug"]}))
