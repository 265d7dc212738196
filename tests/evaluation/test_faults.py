"""Lies, their longest stretch, frames until a pose is good, vertices off the surface: on made-up poses."""

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.datasets.runs import NO_POSE, ObjectRun
from p2p_lib.evaluation.faults import fault_score, longest_run, mesh_off_share

POINTS = np.random.default_rng(0).normal(0, 0.03, (50, 3))


def run_with(off_m: dict[int, float], confidence: float = 0.9, lost: tuple[int, ...] = (), frames: int = 20):
    """Poses that are right but in the frames that say by how much they are off."""
    truth, zeros = np.tile(se3.from_rt(np.eye(3), [0, 0, 0.6]), (frames, 1, 1)), np.zeros(frames, int)
    T_cam_obj = truth.copy()
    for k, m in off_m.items():
        T_cam_obj[k, 0, 3] += m
    T_cam_obj[list(lost)] = NO_POSE
    return ObjectRun(
        frame_index=np.arange(frames), time_s=np.arange(frames) / 30, status=np.full(frames, "tracked"),
        T_cam_obj=T_cam_obj, confidence=np.full(frames, confidence), covariance=np.full((frames, 6, 6), np.nan),
        visible_points=zeros, inliers=zeros, keyframe=zeros > 0, map_id=zeros, T_cam_model=truth,
        joined_map=zeros - 1, T_obj_joined=np.full((frames, 4, 4), np.nan),
        labelled=np.ones(frames, bool), visible_px=zeros + 900, reason=np.full(frames, ""),
    )  # fmt: skip


def score(obj, during=(5, 10)):
    return fault_score(obj, np.eye(4), POINTS, during)


def test_a_lie_is_sure_and_far_off():
    found = score(run_with({6: 0.06, 7: 0.06, 10: 0.07, 12: 0.04}))
    assert found == {"frames": 15, "lies_in": 2, "lies_after": 1, "longest": 2, "until_good": 1}
    assert score(run_with({6: 0.06}, confidence=0.5))["lies_in"] == 0, "who doubts does not lie"
    assert score(run_with({2: 0.5}))["lies_in"] == 0, "before the fault"
    assert score(run_with({6: 0.06, 7: 0.06, 8: 0.06}, lost=(7,)))["longest"] == 1


def test_good_again_counts_frames_in_view():
    assert score(run_with({}))["until_good"] == 0
    assert score(run_with(dict.fromkeys(range(5, 14), 0.03)))["until_good"] == 4
    assert score(run_with({}, lost=tuple(range(5, 13))))["until_good"] == 3
    assert score(run_with(dict.fromkeys(range(5, 20), 0.03)))["until_good"] == np.inf
    assert np.isnan(score(run_with({}), during=(0, 20))["until_good"]), "nothing comes after it"


def test_never_a_pose_is_no_lie():
    found = fault_score(run_with({}, lost=tuple(range(20))), np.full((4, 4), np.nan), POINTS, (5, 10))
    assert (found["lies_in"], found["lies_after"], found["until_good"]) == (0, 0, np.inf)


@pytest.mark.parametrize(("flags", "longest"), [([], 0), ([0, 0], 0), ([1, 1, 0, 1, 1, 1], 3), ([1], 1)])
def test_longest_run(flags, longest):
    assert longest_run(np.array(flags, bool)) == longest


def test_vertices_off_the_true_surface():
    ball = trimesh.creation.icosphere(3, 0.05)
    T_obj_model = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.2]))
    surface = trimesh.sample.sample_surface(ball, 20_000, seed=0)[0]
    seen = ball.copy()
    seen.apply_transform(T_obj_model)
    assert mesh_off_share(seen, T_obj_model, surface) == 0
    seen.vertices[: len(seen.vertices) // 4] += [0, 0.3, 0]
    assert mesh_off_share(seen, T_obj_model, surface) == pytest.approx(0.25, abs=0.01)
