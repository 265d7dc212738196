"""Which points the built-in tracker calls visible: those hidden, facing away, or not recognised but predicted."""

import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame
from p2p_lib.trackers.builtin import tracker as builtin
from tests.trackers.made_up import CAMERA, DEPTH_M, grid, image, texture

UV = grid((60, 160), (60, 160), 20)


@pytest.fixture
def tracker():
    """The tracker after its first frame, all points on one segment and just followed."""
    one = builtin.BuiltinTracker(TrackingConfig())
    one.start(Frame(0, 0.0, texture(), np.full((240, 320), DEPTH_M, np.float32)), CAMERA)
    one.add(UV)
    one._points.cov[:] = 0.05 * np.eye(2)
    assert set(one._points.segment) == {0}
    return one


def test_a_point_that_is_not_recognised_is_where_its_segment_predicts_it(tracker):
    p = tracker._points
    p.verified[:3] = False
    p.uv[:3] += 4
    tracker._reconcile(None)
    assert p.visible.all() and not p.verified[:3].any()
    np.testing.assert_allclose(p.uv[:3], UV[:3], atol=0.05)
    p.map_cov[:3] = 0.02**2 * np.eye(3)  # about 12 px
    tracker._reconcile(None)
    assert p.visible[3:].all() and not p.visible[:3].any()


def test_a_point_far_from_its_prediction_is_another_one(tracker):
    p = tracker._points
    p.uv[0] += 9
    tracker._reconcile(None)
    assert p.verified[1:].all() and not p.verified[0]


def test_a_point_that_leaves_with_others_is_not_held_back(tracker):
    p = tracker._points
    p.uv[:3] += 9
    p.leaving[:3] = True
    tracker._reconcile(None)
    np.testing.assert_allclose(p.uv[:3], UV[:3] + 9)


def test_a_surface_that_faces_away_is_invisible(tracker):
    p = tracker._points
    p.tangent[0] = p.tangent[0, :, ::-1]
    tracker._reconcile(None)
    assert p.visible[1:].all() and not p.visible[0]


def test_points_behind_a_nearer_surface_are_invisible(tracker):
    depth = np.full((240, 320), DEPTH_M, np.float32)
    depth[:, :100] -= 0.1
    tracker._now = image(depth_m=depth)
    tracker._reconcile(None)
    np.testing.assert_array_equal(tracker._points.visible, UV[:, 0] >= 100)


def test_textureless_points_are_not_searched_for(tracker, monkeypatch):
    p, searched = tracker._points, []
    monkeypatch.setattr(builtin.recognition, "find", lambda p, at, *_: searched.append(at.tolist()))
    p.verified[:4] = False
    p.templates.fine.contrast[p.template[:2, 0]] = 3
    tracker._find_predicted(None)
    assert searched == [[2, 3]]
