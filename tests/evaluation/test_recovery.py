"""Recovery events: what is one, and when it is over."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.evaluation.recovery import RecoveryEvent, recovered_within

POINTS = np.random.default_rng(0).normal(0, 0.05, (400, 3))


def standing(visible, found, wrong=(), first_frame=0):
    """An object that stands still, visible in some frames, posed in some, 30 cm off in others."""
    n = len(visible)
    truth = np.tile(se3.from_rt(np.eye(3), [0.0, 0, 0.6]), (n, 1, 1))
    poses = truth.copy()
    poses[list(wrong), 0, 3] += 0.3
    poses[~np.asarray(found)] = np.nan
    zeros = np.zeros(n, int)
    return ObjectRun(
        frame_index=np.arange(n) + first_frame, time_s=np.arange(n) / 30, status=np.full(n, "tracked"),
        T_cam_obj=poses, confidence=np.ones(n), covariance=np.full((n, 6, 6), np.nan), visible_points=zeros,
        inliers=zeros, keyframe=zeros > 0, map_id=zeros, joined_map=zeros - 1,
        T_obj_joined=np.full((n, 4, 4), np.nan), T_cam_model=truth, labelled=np.ones(n, bool),
        visible_px=np.where(visible, 900, 50), reason=np.full(n, ""),
    )  # fmt: skip


def events_of(*how, **where):
    obj = standing(*how, **where)
    return list(evaluate(Run(None, {}, {"mug": obj}, {"mug": POINTS}, {})).objects["mug"].returns)


def delays(events):
    return [event.frames_to_recovery for event in events]


def spans(n, *away):
    visible = np.ones(n, bool)
    for start, stop in away:
        visible[start:stop] = False
    return visible


def test_a_return_that_is_found_at_once_late_and_never():
    visible = spans(200, (20, 40), (80, 95), (150, 160))
    found = visible.copy()
    found[95:102] = False
    found[160:] = False
    events = events_of(visible, found)
    assert events == [
        RecoveryEvent(20, 40, 0),
        RecoveryEvent(80, 95, 7),
        RecoveryEvent(150, 160, None),
    ]
    assert recovered_within(delays(events)) == {5: 1, 15: 2, 30: 2}


@pytest.mark.parametrize(("hidden", "events"), [(9, 0), (10, 1)])
def test_ten_hidden_frames_make_an_event(hidden, events):
    visible = spans(60, (20, 20 + hidden))
    assert len(events_of(visible, visible)) == events


def test_a_wrong_pose_is_no_recovery():
    visible = spans(80, (20, 40))
    assert events_of(visible, visible, wrong=range(40, 46))[0].frames_to_recovery == 6


def test_what_was_never_right_before_is_not_recovered():
    """Two absences, and an object whose map begins after the first: that one is no recovery, the second is."""
    visible = spans(120, (20, 40), (80, 95))
    found = visible & (np.arange(120) >= 40)
    assert delays(events_of(visible, found)) == [None, 0]


def test_first_sight_and_last_sight_are_no_returns():
    visible = spans(60, (0, 20), (45, 60))
    assert events_of(visible, visible) == []


def test_frames_hidden_after_the_return_are_not_asked():
    # Returns at 40, is covered again from 42 to 46 (too short for an event) and is found only at 48.
    visible = spans(80, (20, 40), (42, 47))
    found = visible.copy()
    found[40:48] = False
    events = events_of(visible, found, first_frame=100)
    assert events == [RecoveryEvent(120, 140, 8)]
    assert recovered_within(delays(events), (5, 8)) == {5: 0, 8: 1}


@pytest.mark.parametrize(("masks", "told"), [("dataset", True), ("drawn/", True), ("clicks", False), ("first", False)])
def test_a_score_says_where_masks_came_from_and_how_soon_objects_were_back(masks, told):
    visible = spans(200, (20, 40), (80, 95), (150, 160))
    found = visible.copy()
    found[95:102] = False
    found[160:] = False
    obj = standing(visible, found)
    scored = evaluate(Run(None, {"masks": masks, "segmenter": "builtin"}, {"mug": obj}, {"mug": POINTS}, {}))
    table = scored.as_table()
    assert "returns after an absence: 3; frames until it was found again (ADD-S of 2 cm at most): 0, 7, never" in table
    assert f"masks {masks}, segmenter builtin" in table and ("masks that were given tell" in table) == told
    assert scored.as_dict()["objects"]["mug"]["frames_to_recovery"] == [0, 7, None]
    assert scored.as_dict()["masks"] == masks
