"""What the built-in tracker does with its points from frame to frame, on a textured plane: each part by itself."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin.motion_segments import MotionSegment
from p2p_lib.trackers.builtin.rigid_motion import PoseFit
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from tests.trackers.made_up import CAMERA, DEPTH_M, SHAPE, grid, texture

UV = grid((60, 160), (60, 160), 20)
FEW = grid((200, 240), (60, 100), 20)  # too few for a segment
BLANK = np.full((*SHAPE, 3), 128, np.uint8)


def frame(rgb: np.ndarray | None = None, depth_m: np.ndarray | float = DEPTH_M) -> Frame:
    depth = np.broadcast_to(np.float32(depth_m), SHAPE).copy()
    return Frame(0, 0.0, texture() if rgb is None else rgb, depth)


def started(uv: np.ndarray = UV, first: Frame | None = None, **settings) -> tuple[BuiltinTracker, np.ndarray]:
    """The tracker after its first frame, and the ids of its points."""
    tracker = BuiltinTracker(TrackingConfig(**settings))
    tracker.start(first or frame(), CAMERA)
    ids = tracker.add(uv)
    tracker._points.cov[:] = 0.05 * np.eye(2)
    return tracker, ids


# --- a frame ------------------------------------------------------------------------------------


def test_segments_follow_their_points():
    tracker, _ = started()
    tracker.track(frame(np.roll(texture(), 5, 1)))
    (segment,) = tracker._segments.segments
    assert segment.posed
    np.testing.assert_allclose(segment.fit.T_cam_seg[:3, 3], [5 * DEPTH_M / CAMERA.fx, 0, 0], atol=5e-4)


def test_a_segment_is_expected_to_go_on_as_it_did():
    step = se3.exp(np.array([0.02, -0.03, 0.05, 0.004, 0.002, -0.003]))
    segment = MotionSegment(PoseFit(step, np.eye(6), np.zeros(3)), before=np.eye(4))
    np.testing.assert_allclose(segment.extrapolated, step @ step, atol=1e-9)
    segment.hidden_for = 1
    np.testing.assert_array_equal(segment.extrapolated, step)


def test_points_without_depth_join_a_segment_once_there_is_some():
    blind = frame(depth_m=0.0)
    tracker, _ = started(first=blind, update_every=2)
    assert (tracker._points.segment == -1).all()
    tracker.track(frame())
    assert (tracker._points.segment == -1).all(), "not every frame"
    tracker.track(frame())
    assert (tracker._points.segment == 0).all()


def test_templates_of_a_changed_appearance_are_added_every_few_frames():
    tracker, _ = started(update_every=2)
    noise = np.random.default_rng(0).normal(0, 32, (*SHAPE, 1))
    changed = frame(np.clip(texture() + noise, 0, 255).astype(np.uint8))
    tracker.track(changed)
    assert ((tracker._points.template >= 0).sum(1) == 1).all()
    tracker.track(changed)
    assert ((tracker._points.template >= 0).sum(1) == 2).mean() > 0.5


# --- points and their segment ---------------------------------------------------------------------


def test_a_vague_point_is_put_where_its_segment_predicts_it_and_a_sharp_one_stays():
    tracker, _ = started()
    p = tracker._points
    p.uv[:2] += [1.0, 0]
    p.cov[0], p.cov[1] = 4 * np.eye(2), 0.01 * np.eye(2)
    tracker._reconcile(None)
    off = p.uv[:2, 0] - UV[:2, 0]
    assert off[0] < 0.15 and off[1] > 0.9
    assert p.cov[0, 0, 0] < 0.5


def test_points_outside_the_region_are_invisible():
    tracker, _ = started()
    region = np.broadcast_to(np.arange(SHAPE[1]) < 100, SHAPE)
    tracker._reconcile(region)
    np.testing.assert_array_equal(tracker._points.visible, UV[:, 0] < 100)


def test_positions_are_learned_from_points_that_are_recognised():
    tracker, _ = started()
    p = tracker._points
    p.map_cov[:] = 0.005**2 * np.eye(3)
    p.p_seg[:, 2] += 0.004
    p.coasting[:3] = 1
    wrong = p.p_seg.copy()
    tracker._reconcile(None)
    np.testing.assert_array_equal(p.p_seg[:3], wrong[:3])
    assert (p.p_seg[3:, 2] < wrong[3:, 2] - 0.001).all()


# --- lost and rejected ----------------------------------------------------------------------------


@pytest.mark.parametrize(("frames", "back"), [(3, True), (8, False)])
def test_lost_points_of_no_segment_are_looked_for_where_they_were_for_a_while(frames, back):
    tracker, _ = started(FEW)
    assert (tracker._points.segment == -1).all()
    for _ in range(frames):
        assert not tracker.track(frame(BLANK)).visible.any()
    assert tracker.track(frame()).visible.all() == back


def test_rejected_points_are_not_looked_for_where_they_were():
    tracker, ids = started(FEW)
    tracker.reject(ids[:2])
    assert tracker._points.visible.tolist() == [False, False, True, True], "at once"
    tracks = tracker.track(frame())
    assert tracks.visible.tolist() == [False, False, True, True]


def test_a_segment_is_lost_with_most_of_its_points_and_another_stays():
    far = UV + np.array([140, 0], np.float32)
    tracker, ids = started(np.vstack([UV, far]))
    one, other = tracker._segments.segments
    mine = ids[: len(UV)]
    tracker.reject(mine[: len(mine) // 3])
    assert one.posed
    tracker.reject(mine[len(mine) // 3 :])
    assert not one.posed and one.rejected_for == TrackingConfig().reject_frames and other.posed
    np.testing.assert_allclose(CAMERA.project(one.rejected), UV[len(mine) // 3 :], atol=0.1)
