"""Rigid motion segments on made-up points: start, fit, split, loss, rejection, and positions that improve."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import joined
from p2p_lib.trackers.builtin import motion_segments
from p2p_lib.trackers.builtin.landmarks import Corners
from p2p_lib.trackers.builtin.segment_view import Matched
from p2p_lib.trackers.builtin.tracked_points import Points
from tests.trackers.made_up import CAMERA, DEPTH_M, SHAPE, grid, image, shifted, started

PX_M = DEPTH_M / CAMERA.fx  # one pixel on the plane
LEFT, RIGHT = grid((40, 80), (80, 140), 12), grid((200, 250), (80, 140), 12)


def test_components_of_enough_points_start_a_segment_each():
    few = grid((120, 140), (200, 220), 10)  # 4 points, 8 cm from all others
    p, segments = started(np.vstack([LEFT, RIGHT, few]), image())
    of = np.split(p.segment, [len(LEFT), len(LEFT) + len(RIGHT)])
    assert [set(one) for one in of] == [{0}, {1}, {-1}]
    assert len(segments.segments) == 2
    np.testing.assert_allclose(CAMERA.project(p.p_seg[: len(LEFT)]), LEFT, atol=0.01)


def test_new_points_join_the_segment_next_to_them_in_steps():
    now = image()
    p, segments = started(LEFT, now)
    row = grid((90, 200), (110, 111), 18)  # 3 cm apart, the first of them near the segment
    p = joined([p, Points.new(row, 5)])
    segments.assign(p, len(LEFT) + np.arange(len(row)), now)
    assert set(p.segment) == {0} and len(segments.segments) == 1


def test_the_pose_follows_the_points_and_refuses_those_that_disagree():
    p, segments = started(LEFT, image())
    p.uv += [5, 0]
    p.uv[:4] += [0, 30]
    segments.fit(p, shifted(5))
    np.testing.assert_allclose(segments.segments[0].fit.T_cam_seg[:3, 3], [5 * PX_M, 0, 0], atol=1e-3)
    assert not p.verified[:4].any() and p.verified[4:].all()


@pytest.mark.parametrize("hidden_for", [0, 1])
@pytest.mark.parametrize(("found", "posed"), [(3, False), (5, False), (6, True)])
def test_a_segment_needs_a_fair_share_of_the_points_that_were_searched_for(found, posed, hidden_for):
    """Three points that agree are enough to hold a segment, but three of twenty-four are chance on a look-alike.

    What was found there goes with the pose: else chance would add up from frame to frame.
    """
    p, segments = started(RIGHT, image())
    (segment,) = segments.segments
    segment.hidden_for = hidden_for
    p.verified[found:] = False
    segments.fit_found(p, image(), np.arange(24), motion_segments.MIN_FOUND)
    assert segment.posed == posed and p.verified.sum() == (found if posed else 0)


@pytest.mark.parametrize(("found", "posed"), [(6, False), (9, False), (10, True)])
def test_where_a_caller_expects_a_segment_it_needs_more_of_its_points(found, posed):
    p, segments = started(RIGHT, image())
    segments.segments[0].hidden_for = 1
    p.verified[found:] = False
    segments.fit_found(p, image(), np.arange(24), motion_segments.MIN_SUGGESTED)
    assert segments.segments[0].posed == posed


def test_a_segment_that_is_not_where_it_was_expected_is_searched_for_where_it_was():
    p, segments = started(RIGHT, image())
    (segment,) = segments.segments
    segment.hidden_for, p.verified[:] = 7, False
    was = segment.fit
    before = segments.suggest(p, np.arange(len(RIGHT)), RIGHT - [90.0, 0], image())
    assert segment.fit is not was and segment.hidden_for == 1
    segments.restore(before)
    assert segments.segments[0].fit is was and segments.segments[0].hidden_for == 7


def test_points_that_leave_together_stay_verified_and_then_are_a_segment():
    p, segments = started(np.vstack([LEFT, LEFT + np.array([48, 0])]), image())
    assert len(segments.segments) == 1
    part = slice(0, 10)
    p.uv[part] += [0, 7]  # 1.2 cm: not far yet
    segments.fit(p, image())
    assert len(segments.segments) == 1 and p.leaving[part].all() and p.verified[part].all()
    p.uv[part] += [0, 9]
    segments.fit(p, image())
    assert len(segments.segments) == 2 and set(p.segment[part]) == {1} and not p.leaving.any()


@pytest.mark.parametrize(("count", "leave"), [(7, False), (8, True)])
def test_a_few_points_do_not_leave_together(count, leave):
    p, segments = started(LEFT, image())
    p.uv[:count] += [0, 7]
    segments.fit(p, image())
    assert (p.verified[:count] == leave).all() and (p.leaving[:count] == leave).all()


def test_points_that_leave_one_by_one_are_no_segment():
    p, segments = started(LEFT, image())
    p.uv[:8] += np.random.default_rng(0).permutation(8)[:, None] * [0, 11] + [0, 20]
    segments.fit(p, image())
    assert not p.verified[:8].any() and len(segments.segments) == 1


def half_lost(
    monkeypatch, shift_px: float, pairs: int, followed: int = 8
) -> tuple[Points, motion_segments.MotionSegments]:
    """So many of 25 points are followed, where they were; so many corners of the frame before match, moved."""
    p, segments = started(RIGHT, image(), replace(TrackingConfig(), overruled_below=0))
    segments.remember(p, image(), None)
    p.verified[followed:] = False
    T_cam_seg = segments.segments[0].fit.T_cam_seg.copy()
    T_cam_seg[0, 3] += shift_px * PX_M
    own, found = slice(8, 8 + pairs), segments.segments[0].last_view.corners
    match = Matched(T_cam_seg, p.p_seg[own], RIGHT[own] + [shift_px, 0], np.full(pairs, DEPTH_M), found)
    monkeypatch.setattr(motion_segments, "matched", lambda *_: match)
    return p, segments


@pytest.mark.parametrize(
    ("state", "pairs", "matched"),
    [({}, 12, True), ({}, 8, False), ({"hidden_for": 5}, 12, False), ({"rejected_for": 2}, 12, False)],
    ids=["lost", "no more agree", "lost for long", "rejected"],
)
def test_a_segment_is_matched_that_was_just_lost(monkeypatch, state, pairs, matched):
    p, segments = half_lost(monkeypatch, 30, pairs)
    for name, frames in state.items():
        setattr(segments.segments[0], name, frames)
    segments.fit(p, image())
    assert (segments.segments[0].matched is not None) == matched


@pytest.mark.parametrize(("shift_px", "followed", "matched"), [(2, 8, False), (2, 5, True), (30, 8, True)])
def test_of_a_short_step_matches_say_nothing_where_points_are_followed(monkeypatch, shift_px, followed, matched):
    """A reflection stands still while its object turns: its corners agree with hardly any motion."""
    p, segments = half_lost(monkeypatch, shift_px, 12, followed)
    segments.fit(p, image())
    assert (segments.segments[0].matched is not None) == matched


def test_where_points_and_matches_about_agree_the_pose_is_that_of_the_points(monkeypatch):
    p, segments = half_lost(monkeypatch, 30, 12)
    p.uv[:8] += [34, 0]
    segments.fit(p, image())
    (segment,) = segments.segments
    assert segment.matched is not None and p.verified[:8].all()
    assert segment.fit.T_cam_seg[0, 3] == pytest.approx(34 * PX_M, abs=0.3 * PX_M)
    segments.fit_found(p, image(), np.arange(8, 25), motion_segments.MIN_FOUND)
    assert segment.fit.T_cam_seg[0, 3] == pytest.approx(34 * PX_M, abs=0.3 * PX_M)


def test_what_is_left_behind_by_a_match_does_not_leave_as_a_segment(monkeypatch):
    """The points that seem to be followed stand still on something else."""
    p, segments = half_lost(monkeypatch, 30, 12)
    segments.fit(p, image())
    (segment,) = segments.segments
    assert segment.fit.T_cam_seg[0, 3] == pytest.approx(30 * PX_M, abs=1e-3) and not p.verified.any()


def test_points_that_come_back_are_not_leaving_any_more():
    p, segments = started(np.vstack([LEFT, LEFT + np.array([48, 0])]), image())
    p.uv[:10] += [0, 7]
    segments.fit(p, image())
    assert p.leaving[:10].all()
    p.uv[:10] -= [0, 7]
    segments.fit(p, image())
    assert not p.leaving.any() and p.verified.all()


@pytest.mark.parametrize(("wrong", "posed"), [(12, True), (13, False)])
def test_a_segment_is_rejected_with_most_of_its_points(wrong, posed):
    p, segments = started(RIGHT, image())
    segments.invalidate(p, np.arange(len(RIGHT)) < wrong)
    assert segments.segments[0].posed == posed


def test_a_rejected_segment_is_not_searched_for_where_it_was(monkeypatch):
    p, segments = started(LEFT, image())
    segments.invalidate(p, np.ones(len(p), bool))
    p.verified[:] = False
    (segment,) = segments.segments
    assert not segment.posed and segment.rejected_for > 0
    segment.landmarks.p_seg = np.zeros((5, 3))
    both = np.vstack([LEFT, RIGHT]).astype(float)
    found = Corners(
        both, CAMERA.unproject(both, np.full(len(both), DEPTH_M)), np.zeros((len(both), 2, 128), np.float32)
    )
    offered = []
    monkeypatch.setattr(motion_segments, "corners", lambda *_: found)
    monkeypatch.setattr(segment.landmarks, "match", lambda here, *_: offered.append(here) or (np.zeros((0, 3)),) * 3)
    monkeypatch.setattr(segments, "_propose", lambda *_: None)
    segments.search(image(), None)
    np.testing.assert_array_equal(offered[0].uv_px, RIGHT)
    for _ in range(TrackingConfig().reject_frames):
        segments.fit(p, image())
    segments.search(image(), None)
    assert len(offered[1].uv_px) == len(both)


def test_segments_that_are_followed_are_not_searched_for(monkeypatch):
    _, segments = started(LEFT, image())
    segments.segments[0].landmarks.p_seg = np.zeros((5, 3))
    monkeypatch.setattr(motion_segments, "corners", lambda *_: (_ for _ in ()).throw(AssertionError("searched")))
    segments.search(image(), None)


def test_a_pose_is_proposed_by_enough_corners_only():
    p, segments = started(LEFT, image())
    (segment,) = segments.segments
    segment.hidden_for = 9
    p_cam = p.p_seg + np.array([0.05, 0, 0])
    segments._propose(segment, p.p_seg[:4], p_cam[:4], np.arange(4))
    assert segment.hidden_for == 9
    # Eight pairs, but of four corners.
    segments._propose(segment, p.p_seg[:8], p_cam[:8], np.arange(8) // 2)
    assert segment.hidden_for == 9
    segments._propose(segment, p.p_seg[:8], p_cam[:8], np.arange(8))
    assert segment.hidden_for == 1
    np.testing.assert_allclose(segment.fit.T_cam_seg[:3, 3], [0.05, 0, 0], atol=1e-6)


def test_positions_improve_with_observations_that_count_a_quarter_each():
    now = image()
    p, segments = started(LEFT, now)
    p.p_seg += [0, 0, 0.004]
    p.map_cov[:] = 0.005**2 * np.eye(3)
    for _ in range(8):
        segments.update_positions(p, np.arange(len(p)), now)
    assert np.abs(p.p_seg[:, 2] - DEPTH_M).max() < 0.001
    one = (1.5 * (0.001 + 0.0025 * DEPTH_M**2)) ** 2  # variance of one observation's depth, by hand
    np.testing.assert_allclose(p.map_cov[:, 2, 2], 1 / (1 / 0.005**2 + 8 / (4 * one)), rtol=0.05)


def test_depth_of_another_surface_teaches_nothing():
    p, segments = started(LEFT, image())
    p.map_cov[:] = 0.005**2 * np.eye(3)
    before = p.p_seg.copy()
    segments.update_positions(p, np.arange(len(p)), image(depth_m=DEPTH_M - 0.05))
    np.testing.assert_array_equal(p.p_seg, before)


def overruled(monkeypatch, colours: bool, shift_px: float) -> tuple[Points, motion_segments.MotionSegments]:
    """Points that are followed where they were, of a surface that is said to have moved; it is grey without colours."""
    p, segments = started(RIGHT, image())
    look = image() if colours else image(np.full((*SHAPE, 3), 90, np.uint8))
    segments.remember(p, look, None)
    motion = np.eye(4)
    motion[0, 3] = shift_px * PX_M
    monkeypatch.setattr(motion_segments, "overruling", lambda *_: motion)
    segments.fit(p, image())
    return p, segments


def moved_px(segments: motion_segments.MotionSegments) -> float:
    (segment,) = segments.segments
    return segment.fit.T_cam_seg[0, 3] / PX_M


def test_points_that_are_overruled_neither_hold_it_back_nor_are_given_up(monkeypatch):
    """The surface may be wrong for a frame: they are looked for as before."""
    p, segments = overruled(monkeypatch, colours=True, shift_px=10)
    assert abs(moved_px(segments) - 10) < 0.5 and p.verified.all()
    segments.fit_found(p, image(), np.arange(len(p)), motion_segments.MIN_FOUND)
    assert abs(moved_px(segments) - 10) < 0.5 and p.verified.all()


def test_where_colours_tell_little_points_have_their_say(monkeypatch):
    _, segments = overruled(monkeypatch, colours=False, shift_px=2.5)
    assert abs(moved_px(segments)) < 1


@pytest.mark.parametrize(("field", "value"), [("rejected_for", 5), ("hidden_for", 9)])
def test_what_was_refused_or_lost_for_long_is_not_aligned(field, value, monkeypatch):
    p, segments = started(RIGHT, image())
    segments.remember(p, image(), None)
    setattr(segments.segments[0], field, value)
    monkeypatch.setattr(motion_segments, "overruling", lambda *_: pytest.fail("aligned"))
    segments.fit(p, image())
