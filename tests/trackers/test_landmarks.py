"""Landmarks of a segment: which corners are taken, how many, and the search that finds the segment by them."""

import cv2
import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin.landmarks import Landmarks, corners
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from tests.trackers.made_up import CAMERA, DEPTH_M, SHAPE, grid, image, shifted, started, texture

UV = grid((80, 180), (70, 170), 20)


def test_found_again_elsewhere_by_its_landmarks():
    now, moved = image(), shifted(60, -20)
    p, segments = started(UV, now)
    segments.add_landmarks(p, now)
    (segment,) = segments.segments
    assert len(segment.landmarks.p_seg) > 20
    segment.hidden_for = 50
    segments.search(moved, None)
    assert segment.hidden_for == 1
    np.testing.assert_allclose(segment.fit.T_cam_seg[:3, 3], np.array([60, -20, 0]) * DEPTH_M / CAMERA.fx, atol=0.003)


def test_landmarks_are_added_for_new_sides_only():
    now = image()
    p, segments = started(UV, now)
    for _ in range(3):
        segments.add_landmarks(p, now)
    assert len(segments.segments[0].landmarks.views) == 1
    marks = Landmarks(views=np.array([[0, 0, -0.5]]))
    side = np.array([np.sin(np.radians(20)), 0, -np.cos(np.radians(20))])
    assert marks.taken_from(np.array([0, 0.01, -0.8]), 15) and not marks.taken_from(side, 15)


def test_what_is_fast_from_the_start_is_remembered_by_its_first_view_alone():
    tracker, now = BuiltinTracker(TrackingConfig()), image()
    tracker.start(Frame(0, 0.0, np.repeat(now.gray[..., None], 3, 2), now.depth_m), now.camera)
    tracker.add(UV)
    (segment,) = tracker._segments.segments
    count = len(segment.landmarks.p_seg)
    assert count > 20
    segment.matched, segment.landmarks.views = True, np.zeros((0, 3))
    tracker._segments.add_landmarks(tracker._points, now)
    assert len(segment.landmarks.p_seg) == count, "blurred, and there is a better view"


def test_only_corners_on_the_segment_are_taken():
    depth = np.full((240, 320), 0.8, np.float32)
    depth[60:180, 70:125] = DEPTH_M
    p, segments = started(UV[UV[:, 0] < 115], image(depth_m=depth))
    segments.add_landmarks(p, image(depth_m=depth))
    marks = segments.segments[0].landmarks
    assert len(marks.p_seg) > 5 and np.abs(marks.p_seg[:, 2] - DEPTH_M).max() < 0.05


@pytest.mark.parametrize("cap", [100, 2500])
def test_no_more_landmarks_than_the_cap(cap):
    now, cfg = image(), TrackingConfig(max_landmarks=cap)
    p, segments = started(UV, now, cfg)
    (segment,) = segments.segments
    for _ in range(3):
        segment.landmarks.views = np.zeros((0, 3))
        segments.add_landmarks(p, now)
    assert len(segment.landmarks.p_seg) == len(segment.landmarks.descriptors)
    assert (len(segment.landmarks.p_seg) <= 100) == (cap == 100)


def test_small_islands_of_what_was_seen_are_recognised():
    """Of each landmark's surroundings 18 px are left, three centimetres: the wider descriptors hold other things."""
    now, islands = image(), np.zeros(SHAPE, np.uint8)
    known = corners(now, None, 60)
    for u, v in np.rint(known.uv_px).astype(int).tolist():
        if not islands[max(v - 25, 0) : v + 26, max(u - 25, 0) : u + 26].any():
            cv2.circle(islands, (u, v), 9, 1, -1)
    there = corners(image(np.where(islands[..., None] > 0, texture(), texture(5))), islands > 0, 200)
    marks = Landmarks(known.p_cam, known.descriptors)
    p_seg, p_cam, corner = marks.match(there, TrackingConfig().match_ratio, np.random.default_rng(0))
    right = np.linalg.norm(p_seg - p_cam, axis=1) < 0.005
    assert len(np.unique(corner[right])) > 12 and right.mean() > 0.5
