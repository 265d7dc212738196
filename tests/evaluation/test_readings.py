"""Poses in another convention are told from bad ones: each reading is doubted, and no noise of right poses is."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.errors import Doubt
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.evaluation.readings import doubt_reading

N = 150
POINTS = np.random.default_rng(3).normal(0, [0.03, 0.05, 0.1], (200, 3))


def path(rng, turn_rad=0.03, shift_m=0.005):
    """(N, 4, 4) of an object that moves before a camera."""
    steps = se3.exp(rng.normal(0, [turn_rad] * 3 + [shift_m] * 3, (N, 6)))
    T = [se3.exp(np.r_[rng.normal(size=3), 0, 0, 0])]
    T[0][:3, 3] = 0.1, 0, 0.7
    for step in steps[1:]:
        T.append(T[-1] @ step)
    return np.array(T)


def run_of(T_cam_obj, T_cam_model):
    nothing, posed = np.zeros(N, int), np.isfinite(T_cam_obj).all((1, 2))
    obj = ObjectRun(
        **{"frame_index": np.arange(N), "time_s": np.arange(N) / 30, "status": np.where(posed, "tracked", "lost")},
        **{"T_cam_obj": T_cam_obj, "confidence": posed * 1.0, "covariance": np.full((N, 6, 6), np.nan)},
        **{"visible_points": nothing, "inliers": nothing, "keyframe": nothing > 0, "map_id": nothing},
        **{"joined_map": nothing - 1, "T_obj_joined": np.full((N, 4, 4), np.nan), "T_cam_model": T_cam_model},
        **{"labelled": nothing == 0, "visible_px": np.full(N, 5000), "reason": np.full(N, "")},
    )
    return Run(Path("theirs.txt"), {"tracker": "imported"}, {"mug": obj}, {"mug": POINTS}, {})


def scaled(T, times):
    return se3.from_rt(T[:, :3, :3], T[:, :3, 3] * times)


def scalar_first(T):
    """As a reader of x y z w takes what was written as w x y z."""
    x, y, z, w = se3.quaternion_xyzw(T).T
    return se3.from_rt(Rotation.from_quat(np.stack([w, x, y, z], 1)).as_matrix(), T[:, :3, 3])


WRITTEN = {
    "in millimetres": lambda T: scaled(T, 1000),
    "in metres instead": lambda T: scaled(T, 0.001),
    "the inverse": se3.inverse,
    "OpenGL": lambda T: np.diag([1.0, -1, -1, 1]) @ T,
    "w x y z": scalar_first,
}


@pytest.mark.parametrize("align", ["first", "all"])
@pytest.mark.parametrize("means", WRITTEN)
def test_the_convention_that_fits_is_named_and_the_score_stays(means, align):
    """With noise of 3 mm and 2 degrees, an object frame of their own, and a third of the frames lost."""
    rng = np.random.default_rng(0)
    truth = path(rng)
    right = truth @ se3.exp(rng.normal(0, [0.03] * 3 + [0.003] * 3, (N, 6))) @ se3.exp(rng.normal(0, 0.1, 6))
    given = np.where(np.arange(N)[:, None, None] % 3 == 1, np.nan, WRITTEN[means](right))
    run = run_of(given, truth)
    before = evaluate(run, align=align).as_dict()
    with pytest.warns(
        Doubt, match=rf"theirs\.txt: poses that fit far better read .*{means}.*: ADD-S AUC 9\d instead of"
    ):
        doubt_reading(run, ["mug"], align)
    assert evaluate(run, align=align).as_dict() == before and before["mean"]["adds_auc"] < 60


def test_matrices_have_no_order_of_quaternions():
    truth = path(np.random.default_rng(0))
    assert doubt_reading(run_of(scalar_first(truth), truth)) == ""


@pytest.mark.parametrize("seed", range(3))
def test_right_poses_are_never_doubted_however_noisy(seed):
    """Objects that move, and that hardly do, noise from none to a score of nothing."""
    rng = np.random.default_rng(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("error", Doubt)
        for turn_rad, shift_m in ((0.03, 0.005), (0.001, 0.0003), (0.0, 0.0)):
            truth = path(rng, turn_rad, shift_m)
            for noise_rad, noise_m in ((0, 0), (0.02, 0.003), (0.1, 0.03), (0.5, 0.1)):
                noise = se3.exp(rng.normal(0, [noise_rad] * 3 + [noise_m] * 3, (N, 6)))
                for given in (truth @ noise, noise @ truth, np.repeat(truth[:1], N, 0)):
                    for align in ("first", "all"):
                        doubt_reading(run_of(given, truth), ["mug"], align)


def test_noise_in_the_place_of_an_object_at_rest_is_no_other_unit():
    """Read a thousand times smaller it would be gone, and the score full."""
    rng = np.random.default_rng(0)
    truth = path(rng, 0, 0)
    given = scaled(truth, 1)
    given[:, :3, 3] += rng.normal(0, 0.06, (N, 3))
    for_all = evaluate(run_of(given, truth)).as_dict()["mean"]["adds_auc"]
    assert for_all < 60 < 99 < evaluate(run_of(scaled(given, 0.001), truth)).as_dict()["mean"]["adds_auc"]
    assert doubt_reading(run_of(given, truth), ["mug"]) == ""


def test_poses_that_are_bad_in_every_reading_are_bad():
    """Where hardly anything fits, another reading fits better by chance."""
    rng = np.random.default_rng(5)
    truth = path(rng)
    given = se3.inverse(truth @ se3.exp(rng.normal(0, [0.3] * 3 + [0.06] * 3, (N, 6))))
    as_given, inverse = (evaluate(run_of(T, truth), align="all").as_dict()["mean"] for T in (given, se3.inverse(given)))
    assert as_given["adds_auc"] + 15 < inverse["adds_auc"] < 80
    assert doubt_reading(run_of(given, truth), ["mug"], "all") == ""


def test_what_cannot_be_scored_is_not_doubted():
    truth = path(np.random.default_rng(0))
    run = run_of(np.full_like(truth, np.nan), truth)
    assert doubt_reading(run) == "" and doubt_reading(replace(run, points={})) == ""
