"""What an object goes through, on made-up poses and evidence: no frame, no tracker, no image."""

import dataclasses

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import LifecycleConfig
from p2p_lib.core.types import WITH_POSE, Status
from p2p_lib.extended.gates import DOUBTS, GATES, SIGHTED, Judgement, PoseEvidence, judge
from p2p_lib.extended.lifecycle import CLEAR, TELLING, Lifecycle
from p2p_lib.method.object_model import CONFIRM_FRAMES, CONFIRM_LONGER

CFG = LifecycleConfig()
ALL = (*GATES, *DOUBTS)
TRACKED, RECOVERED, DEGRADED = (Judgement(True, s) for s in (Status.TRACKED, Status.RECOVERED, Status.DEGRADED))
GOOD = PoseEvidence(support=30, surface_share=0.9)


def pose(k: float) -> np.ndarray:
    return se3.exp(np.array([0.02 * k, 0, 0.01 * k, 0.001 * k, 0, 0.6]))


def lived(*steps: PoseEvidence | Status) -> list[Lifecycle]:
    """Started at pose 0, then judged with all gates, frame by frame; a status stands for a frame without a pose."""
    lives = [Lifecycle(Status.TRACKED, pose(0), 0.0)]
    for k, step in enumerate(steps, 1):
        life = lives[-1]
        if isinstance(step, PoseEvidence):
            verdict = judge(life, step, ALL, CFG)
            life = life.with_verdict(pose(k), k, verdict) if verdict.accepted else life.without_pose(verdict.status)
        else:
            life = life.without_pose(step)
        lives.append(life)
    return lives


def test_it_is_a_value():
    life = Lifecycle()
    with pytest.raises(dataclasses.FrozenInstanceError):
        life.status = Status.TRACKED
    before = lived(GOOD)[-1]
    judge(before, PoseEvidence(0, None), ALL, CFG)
    before.without_pose(Status.LOST)
    assert before.has_pose and before.status is Status.TRACKED


def test_priors_are_the_last_pose_and_even_motion():
    lives = lived(GOOD, GOOD)
    priors = lives[-1].motion_priors()
    np.testing.assert_array_equal(priors["last pose"], pose(2))
    # The step from the pose before, made once more on the right.
    np.testing.assert_allclose(priors["constant velocity"], pose(2) @ np.linalg.inv(pose(1)) @ pose(2), atol=1e-12)
    assert list(lives[0].motion_priors()) == ["last pose"]


def test_a_gap_leaves_no_prior():
    assert lived(GOOD, Status.OCCLUDED)[-1].motion_priors() == {}
    back = lived(GOOD, Status.OCCLUDED, GOOD)[-1]
    assert list(back.motion_priors()) == ["last pose"], "what moved during a gap says nothing of the speed"


def test_only_sure_poses_say_how_it_moves():
    sure = Lifecycle(Status.TRACKED, pose(0), 0.0).moved(0.9).with_verdict(pose(1), 1.0, TRACKED).moved(0.9)
    turn = np.linalg.norm(se3.log(pose(1) @ se3.inverse(pose(0)))[:3])
    assert np.linalg.norm(sure.motion.velocity[:3]) == pytest.approx(0.1 * turn), "a tenth of it is taken over"
    doubtful = sure.with_verdict(pose(9), 2.0, TRACKED).moved(0.5)
    assert doubtful.motion is sure.motion
    assert sure.moved(0.9).motion.time_s == 1.0, "no time has passed"


def test_for_a_while_the_surface_stands_for_points_where_the_motion_leads():
    away = lived(GOOD)[-1].moved(0.9).without_pose(Status.OCCLUDED)
    assert away.motion.holds(away.seen_s + 1) and not away.motion.holds(away.seen_s + 2)
    fits = PoseEvidence(0, 0.61, carried=True)
    assert judge(away, fits, ALL, CFG).accepted and judge(away, fits, ALL, CFG).status is Status.DEGRADED
    assert not judge(away, dataclasses.replace(fits, surface_share=0.59), ALL, CFG).accepted
    assert not judge(away, dataclasses.replace(fits, surface_share=0.59, support=3), ALL, CFG).accepted
    assert not judge(away, dataclasses.replace(fits, carried=False), ALL, CFG).accepted


def test_it_is_in_sight_until_it_is_hidden():
    life = lived(GOOD, Status.LOST)[-1]
    assert life.in_sight and life.without_pose(Status.LOST).in_sight
    hidden = life.without_pose(Status.OCCLUDED, carried=True)
    assert not hidden.in_sight and not hidden.without_pose(Status.LOST).in_sight
    back = hidden.without_pose(Status.LOST, carried=True)
    assert back.in_sight and back.without_pose(Status.LOST).in_sight


def test_what_the_surface_alone_says_proves_nothing_where_the_image_says_otherwise():
    """Frames in which it is not proven confirm no return, and it counts as lost in them."""
    away = lived(GOOD, Status.LOST)[-1].moved(0.9)
    unproven = judge(away, PoseEvidence(0, 0.9, sighting=0.1, carried=True), ALL, CFG)
    assert unproven.accepted and not unproven.proven
    assert judge(away, PoseEvidence(0, 0.9, carried=True), ALL, CFG).proven, "too little shows to say"
    life = away.with_verdict(pose(3), 3.0, unproven)
    for k in range(4):
        life = life.with_verdict(pose(4 + k), 4.0 + k, unproven)
    assert life.confirming == CONFIRM_LONGER and life.lost_frames == away.lost_frames + 5
    proven = life.with_verdict(pose(9), 9.0, DEGRADED)
    assert proven.confirming == CONFIRM_LONGER - 1 and not proven.lost_frames


def test_a_return_whose_turn_is_clear_is_confirmed_as_soon_as_one_by_points():
    away = lived(GOOD, Status.LOST)[-1]
    assert away.with_verdict(pose(3), 3.0, DEGRADED, 0.9 * CLEAR).confirming == CONFIRM_LONGER
    assert away.with_verdict(pose(3), 3.0, DEGRADED, CLEAR).confirming == CONFIRM_FRAMES


def test_moves_are_told_from_the_frame_before():
    life = lived(GOOD)[-1]
    moved_m, turned_deg = life.moved_from_last(pose(1) @ se3.exp(np.array([0, 0.1, 0, 0, 0, 0])))
    assert moved_m == pytest.approx(0, abs=1e-9) and turned_deg == pytest.approx(np.degrees(0.1))
    assert life.moved_from_last(se3.from_rt(pose(1)[:3, :3], pose(1)[:3, 3] + [0, 0.03, 0]))[0] == pytest.approx(0.03)
    assert lived(Status.LOST)[-1].moved_from_last(pose(1)) is None


def test_few_points_are_degraded_while_tracked_and_no_return():
    few = PoseEvidence(CFG.return_inliers - 1, 0.9)
    assert lived(few)[-1].status is Status.DEGRADED
    verdict = judge(lived(Status.OCCLUDED)[-1], few, ALL, CFG)
    assert not verdict.accepted and verdict.status is Status.LOST and "the pose of a return" in verdict.reason
    assert judge(lived(Status.OCCLUDED)[-1], few, (), CFG).accepted, "the paper has no gates"
    assert judge(lived(Status.OCCLUDED)[-1], GOOD, ALL, CFG).accepted


@pytest.mark.parametrize(("share", "accepted"), [(0.61, True), (0.59, False), (None, False)])
def test_without_points_the_surface_has_to_fit(share, accepted):
    verdict = judge(lived(GOOD)[-1], PoseEvidence(0, share), ALL, CFG)
    assert verdict.accepted == accepted
    assert verdict.status is (Status.DEGRADED if accepted else Status.LOST) and verdict.reason


def test_a_return_is_recovered_until_it_is_confirmed():
    lives = lived(Status.OCCLUDED, *[GOOD] * (CONFIRM_FRAMES + 2))
    assert [life.status for life in lives[2:]] == [Status.RECOVERED] * CONFIRM_FRAMES + [Status.TRACKED] * 2
    assert [life.unconfirmed for life in lives[1:]] == [True] * (CONFIRM_FRAMES + 1) + [False] * 2


def test_a_return_that_is_not_confirmed_is_taken_back():
    lives = lived(GOOD, Status.OCCLUDED, GOOD, GOOD, PoseEvidence(3, 0.9))
    assert [life.status in WITH_POSE for life in lives] == [True, True, False, True, True, False]
    np.testing.assert_array_equal(lives[-1].T_cam_obj, pose(1))
    confirmed = lived(GOOD, Status.OCCLUDED, *[GOOD] * (CONFIRM_FRAMES + 1), Status.LOST)[-1]
    np.testing.assert_array_equal(confirmed.T_cam_obj, pose(CONFIRM_FRAMES + 3))


def test_what_was_left_is_kept_through_the_frames_of_an_absence():
    lives = lived(GOOD, GOOD, Status.LOST, Status.OCCLUDED, Status.LOST)
    for life in lives[3:]:
        np.testing.assert_array_equal(life.T_cam_obj, pose(2))


def test_a_return_is_doubted_until_its_turn_is_told_from_others():
    life = lived(Status.OCCLUDED)[-1]
    for k, (lead, doubted) in enumerate([(0.1, True), (None, True), (TELLING, False), (None, False)]):
        life = life.with_verdict(pose(k), k, RECOVERED, lead)
        assert life.doubted == doubted
    assert not lived(GOOD, GOOD)[-1].doubted


def test_after_a_pause_in_the_stream_an_object_may_be_anywhere():
    life = Lifecycle(Status.TRACKED, pose(0), 0.0).with_verdict(pose(1), 0.03, TRACKED)
    assert life.at(0.06).motion_priors() and life.at(0.2).motion_priors(), "a few frames are dropped"
    paused = life.at(1.0)
    assert (
        paused.motion_priors() == {} and paused.unconfirmed and paused.with_verdict(pose(2), 1.0, RECOVERED).confirming
    )
    slow = Lifecycle(Status.TRACKED, pose(0), 0.0).with_verdict(pose(1), 1.0, TRACKED)
    assert slow.at(2.0).motion_priors(), "a frame a second is no pause"


# -- the scene -------------------------------------------------------------------------------------


def test_a_return_without_points_goes_on_being_expected_where_it_lay():
    """Else what was found on something else is followed there."""
    found = lived(GOOD)[-1].placed(pose(3)).without_pose(Status.OCCLUDED).with_verdict(pose(9), 9, DEGRADED)
    expected = np.linalg.inv(pose(5)) @ pose(3) @ pose(1)
    np.testing.assert_allclose(found.scene_prior(pose(5))["scene"], expected, atol=1e-9)
    assert found.with_verdict(pose(9), 10, TRACKED).scene_prior(pose(5)) == {}, "many points agree"


def test_what_moves_in_the_scene_does_not_lie_still():
    life, still = lived(GOOD)[-1], np.linalg.inv(lived(GOOD)[-1].T_cam_obj)
    for lay in (False, False, False, True):
        life = life.placed(still)
        assert life.lay_still == lay
    moved = still.copy()
    moved[0, 3] += 0.09
    assert not life.placed(moved).lay_still


def test_what_lay_still_is_expected_where_it_lay():
    life = lived(GOOD)[-1].placed(pose(3))
    assert life.scene_prior(pose(5)) == {}, "while it is seen it needs no prior"
    away = life.without_pose(Status.OCCLUDED)
    expected = np.linalg.inv(pose(5)) @ pose(3) @ life.T_cam_obj
    np.testing.assert_allclose(away.scene_prior(pose(5))["scene"], expected, atol=1e-9)
    assert away.scene_prior(None) == {} and away.placed(None) is away


def test_a_pose_of_few_points_places_nothing_again():
    life = lived(GOOD)[-1].placed(np.eye(4))
    poor = life.with_verdict(pose(7), 7.0, DEGRADED).placed(np.eye(4))
    np.testing.assert_array_equal(poor.T_world_obj, life.T_world_obj)


def test_what_the_graph_corrects_lies_elsewhere_in_the_world_too():
    T_world_cam = pose(7)
    life = lived(GOOD)[-1].placed(T_world_cam).corrected(pose(3))
    np.testing.assert_array_equal(life.T_cam_obj, pose(3))
    np.testing.assert_allclose(life.T_world_obj, T_world_cam @ pose(3), atol=1e-12)
    assert lived(GOOD)[-1].corrected(pose(3)).T_world_obj is None


def test_a_return_has_a_place_once_it_is_confirmed():
    life = lived(GOOD)[-1].placed(np.eye(4)).without_pose(Status.LOST)
    back = life.with_verdict(pose(9), 9.0, RECOVERED)
    np.testing.assert_array_equal(back.placed(np.eye(4)).T_world_obj, life.T_world_obj)


def test_shape_and_colour_stand_for_points_at_a_return():
    few, away = PoseEvidence(support=0, surface_share=0.2, sighting=SIGHTED), lived(GOOD, Status.LOST)[-1]
    assert judge(away, few, ALL, CFG).accepted
    less = dataclasses.replace(few, sighting=0.9 * SIGHTED)
    assert not judge(away, less, ALL, CFG).accepted
    confirming = away.with_verdict(pose(3), 3.0, RECOVERED)
    assert judge(confirming, less, ALL, CFG).accepted, "what has been found may show a little less"
    assert not judge(confirming, dataclasses.replace(few, sighting=0.5 * SIGHTED), ALL, CFG).accepted


def test_a_return_without_points_is_sought_until_points_confirm_it():
    away = lived(GOOD, Status.LOST)[-1]
    assert away.sought and not lived(GOOD)[-1].sought
    life = away.with_verdict(pose(3), 3.0, DEGRADED)
    for k in range(CONFIRM_FRAMES + 1):
        assert life.sought and life.confirming
        life = life.with_verdict(pose(4 + k), 4.0 + k, DEGRADED)
    confirmed = life.with_verdict(pose(20), 20.0, RECOVERED)
    assert not confirmed.sought and confirmed.confirming <= CONFIRM_FRAMES


@pytest.mark.parametrize(
    ("contradiction", "doubted"),
    [
        ({}, False),
        ({"scene_ratio": 1.04, "outline": 0.6}, False),
        ({"scene_ratio": 1.1}, True),
        ({"scene_ratio": 0.9}, True),
        ({"outline": 0.4}, True),
        ({"still": True}, True),
    ],
)
def test_what_contradicts_itself_is_doubted_and_the_paper_doubts_nothing(contradiction, doubted):
    life, evidence = lived(GOOD)[-1], dataclasses.replace(GOOD, **contradiction)
    verdict = judge(life, evidence, ALL, CFG)
    assert verdict.accepted and verdict.doubted == doubted == bool(verdict.reason)
    assert verdict.status is (Status.DEGRADED if doubted else Status.TRACKED)
    assert not judge(life, evidence, (), CFG).doubted


def test_a_mask_that_stays_as_wide_is_taken_for_right_in_the_end():
    long, wide = dataclasses.replace(lived(GOOD)[-1], doubted_frames=60), dataclasses.replace(GOOD, outline=0.4)
    assert not judge(long, wide, ALL, CFG).doubted
    assert judge(long, dataclasses.replace(GOOD, scene_ratio=1.2), ALL, CFG).doubted, "what rests stays as far away"
