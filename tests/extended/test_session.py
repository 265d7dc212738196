"""What a program asks of a tracker beside poses: a new start, one thread at a time, the world, where things will be."""

import threading
from dataclasses import replace
from inspect import signature

import numpy as np
import pytest

from p2p_lib import open_sequence
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.core.memory import save_memory
from p2p_lib.core.types import NOT_FOUND, Status, status_text, status_word
from p2p_lib.extended.default import Point2Pose
from p2p_lib.method import pipeline
from p2p_lib.segmenters.anchored import builtin
from tests.fixtures.made_memory import made_memory
from tests.method.test_pipeline import CAMERA, HIDDEN, assert_same, film, quick, track

FEW = 8
MEMORY = made_memory("mug")


def followed(method: Point2Pose, frames) -> list:
    for name in ("left", "right"):
        method.add_object(name)
    return [method.step(frame, masks) for frame, masks in frames]


def test_a_map_that_is_kept_as_it_is_needs_a_memory():
    with Point2Pose(CAMERA, quick()) as method, pytest.raises(BadInput, match="frozen without a memory"):
        method.add_object("left", frozen=True)


def test_a_memory_and_its_path_the_wrong_way_round_are_told(tmp_path):
    with pytest.raises(BadInput, match="save_memory: got str, expected a path and a memory"):
        save_memory(MEMORY, str(tmp_path / "mug.npz"))


def test_a_look_alike_that_shows_first_gets_no_map():
    """README's example: where the carton went behind a board comes a tin in its colours, then the carton beside it."""
    sequence = open_sequence("synthetic/crossing")
    with Point2Pose(sequence.camera) as method:
        method.add_object("box", clicks=[[170, 245], [190, 220], [150, 270]])
        found = [method.step(sequence.frame(i))["box"] for i in range(215)]
    assert all(estimate.T_cam_obj is None for estimate in found[170:202]), "the board hides it"
    assert all(estimate.T_cam_obj is not None and estimate.map_id == 0 for estimate in found[206:])


def test_after_a_reset_a_tracker_is_as_new():
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("other", mask=film()[3][1]["right"])
        method.step(film()[3][0])
        method.reset()
        assert not method.objects and not method.segmenter.names and method.frame is None
        assert_same(followed(method, film()[:FEW]), track(film()[:FEW]))


def test_a_closed_tracker_says_so_and_can_be_reset():
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left")
    with pytest.raises(BadInput, match=r"a call after close\(\).* reset\(\)"):
        method.step(film()[0][0])
    method.reset()
    assert method.step(film()[0][0]) == {}
    method.close()


@pytest.mark.parametrize("camera", ["cam", None, np.eye(3)], ids=["text", "none", "matrix"])
@pytest.mark.parametrize("tracker", [Point2Pose, pipeline.Point2Pose])
def test_what_is_no_camera_is_refused_at_once(camera, tracker):
    with pytest.raises(BadInput, match=r"tracker camera: got .*, expected a p2p_lib\.Camera\. Make one: Camera\(fx"):
        tracker(camera)


def test_a_reset_forgets_the_objects_of_a_segmenter_that_was_given():
    own = builtin(CAMERA, quick().segmentation)
    with Point2Pose(CAMERA, quick(), segmenter=own) as method:
        method.add_object("left", mask=film()[0][1]["left"])
        method.step(film()[0][0])
        assert own.names == ("left",)
        method.reset()
        assert method.segmenter is own and not own.names


def test_what_an_object_is_told_by_is_named_and_nothing_else_is_taken():
    told = ["mask", "clicks", "negative", "box"]
    assert list(signature(Point2Pose.add_object).parameters) == ["self", "name", *told, "frame", "memory", "frozen"]
    assert list(signature(Point2Pose.correct).parameters) == ["self", "name", *told, "frame"]
    with Point2Pose(CAMERA, quick()) as method:
        with pytest.raises(TypeError, match=r"add_object\(\) got an unexpected keyword argument 'klicks'"):
            method.add_object("left", klicks=3)
        method.add_object("left", film()[0][1]["left"])  # by its place, too
        with pytest.raises(TypeError, match=r"correct\(\) got an unexpected keyword argument 'click'"):
            method.correct("left", click=3)
        with pytest.raises(BadInput, match="add_object with a memory: got clicks or a mask, too"):
            method.add_object("right", clicks=[[1, 1]], memory=made_memory())
        assert method.step(film()[0][0])["left"].T_cam_obj is not None and list(method.objects) == ["left"]


def test_a_second_thread_is_told_so_and_nothing_has_changed():
    inside, go_on, answers = threading.Event(), threading.Event(), []

    with Point2Pose(CAMERA, quick()) as method:
        track_frame = method.front.track

        def slow(asked):
            inside.set()
            assert go_on.wait(20)
            return track_frame(asked)

        method.add_object("left")
        method.front.track = slow
        (frame, masks), (second, _) = film()[:2]
        first = threading.Thread(target=lambda: answers.append(method.step(frame, {"left": masks["left"]})))
        first.start()
        assert inside.wait(20)
        calls = {
            "step": lambda: method.step(second),
            "add": lambda: method.add_object("right"),
            "click": lambda: method.add_object("right", clicks=[[200, 150]]),
            "correct": lambda: method.correct("left", clicks=[[200, 150]]),
            "remove": lambda: method.remove_object("left"),
            "reset": method.reset,
            "remembered": lambda: method.add_object("mug", memory=MEMORY),
            "close": method.close,
        }
        for call in calls.values():
            with pytest.raises(BadInput, match=r"a call from a second thread .* one thread at a time.* lock"):
                call()
        assert method.predict("left", 1.0) is None  # it may be asked at any time, and nothing is known yet
        go_on.set()
        first.join()
        assert list(method.objects) == ["left"] and answers[0]["left"].status is Status.TRACKED and not method.closed
        method.front.track = track_frame
        method.step(second)  # a third thread, or this one, when nobody is inside
    method.close()


def test_poses_are_in_the_world_where_the_camera_is_given():
    """A robot's camera that goes by things: each T_world_obj is what the object's own motion makes of it."""
    T_world_cam = [se3.exp(np.array([0, 0.02 * k, 0, 0.01 * k, 0, 0.3])) for k in range(FEW)]
    placed = [(replace(frame, T_world_cam=T_world_cam[k]), masks) for k, (frame, masks) in enumerate(film()[:FEW])]
    for estimates, T in zip(track(placed), T_world_cam):
        for estimate in estimates.values():
            np.testing.assert_allclose(estimate.T_world_obj, T @ estimate.T_cam_obj)
    assert all(e.T_world_obj is None for of in track(film()[:2]) for e in of.values())


def test_the_scene_that_the_tracker_finds_is_no_world_of_the_users():
    config = quick().with_values({"method.mechanisms": "all"})
    assert all(e.T_world_obj is None for of in track(film(board=True), config=config) for e in of.values())


def test_prediction_and_velocity_go_by_the_world_where_it_is_given():
    """Camera and object go the same way: nothing moves before the camera, everything moves in the world."""
    step, stands = np.array([0, 0, 0, 0.003, 0, 0.0]), film()[0]
    frames = [(replace(stands[0], index=k, time_s=k / 30, T_world_cam=se3.exp(k * step)), stands[1]) for k in range(25)]
    with Point2Pose(CAMERA, quick().with_values({"method.mechanisms": "all but still"})) as method:
        estimates = followed(method, frames)
        said = method.predict("left", 24 / 30 + 0.1)
    world_m_s = estimates[-1]["left"].T_world_obj[:3, :3] @ said.velocity[3:]
    np.testing.assert_allclose(world_m_s, [0.09, 0, 0], atol=0.005)
    moved = said.T_world_obj[:3, 3] - estimates[-1]["left"].T_world_obj[:3, 3]
    np.testing.assert_allclose(moved, [0.009, 0, 0], atol=0.001)
    np.testing.assert_allclose(se3.exp(24 * step) @ said.T_cam_obj, said.T_world_obj, atol=1e-9)


def test_a_prediction_refuses_what_it_cannot_answer():
    with Point2Pose(CAMERA, quick()) as method:
        with pytest.raises(BadInput, match="predict: got 'mug', expected one of no objects"):
            method.predict("mug", 1.0)
        method.add_object("left")
        assert method.predict("left", 1.0) is None
        for no_time in (None, "1", True):
            with pytest.raises(BadInput, match=r"predict time_s: got .*, expected a time in seconds"):
                method.predict("left", no_time)
        for frame, masks in film()[:3]:
            method.step(frame, {"left": masks["left"]})
        for time_s in (0.0, np.nan, np.inf, None, "1"):
            with pytest.raises(BadInput, match="predict time_s"):
                method.predict("left", time_s)
        method.remove_object("left")
        method.add_object("left")
        assert method.predict("left", 1.0) is None


def test_what_the_segmenter_does_not_find_is_said_to_be_not_found_and_since_when():
    """With a mask that is empty it is hidden for sure; without any nobody knows."""
    for given in (True, False):
        with Point2Pose(CAMERA, quick()) as method:
            method.add_object("left", mask=film(board=True)[0][1]["left"])
            frames = enumerate(film(board=True))
            said = [method.step(f, {"left": m["left"]} if given and k else None)["left"] for k, (f, m) in frames]
        reasons = {said[k].reason for k in HIDDEN if said[k].status is Status.OCCLUDED}
        first = min(k for k in HIDDEN if said[k].T_cam_obj is None)
        assert reasons == {"0 mask pixels" if given else f"not found since frame {first}"}


def test_people_are_told_what_is_known():
    since = f"{NOT_FOUND} since frame 31"
    assert (status_word("occluded", since), status_text("occluded", since)) == ("not found", since)
    assert status_text("occluded", f"out of view: {since}") == f"out of view: {since}"
    assert status_text("occluded", "0 mask pixels") == "occluded: 0 mask pixels"


def test_what_a_prompt_selects_too_little_of_says_so_in_every_frame():
    """A program that goes by the reason learns why its object does not start, until it is told better."""
    (first, masks), *later = film()[:7]
    few = np.zeros_like(masks["left"])
    few[tuple(np.argwhere(masks["left"])[:8].T)] = True
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left", mask=few)
        said = [method.step(frame)["left"] for frame in (first, later[0][0])]
        assert [e.reason for e in said] == ["not seen yet: a mask of 8 pixels does not start it"] * 2
        method.correct("left", mask=np.zeros_like(few))
        assert method.step(later[1][0])["left"].reason == "not seen yet", "that was said of something else"
        given = [method.step(frame, {"left": masks["left"]})["left"] for frame, masks in later[2:]]
        assert given[0].reason == "still coming into view"
        assert given[-1].status is Status.TRACKED and not given[-1].reason


@pytest.mark.filterwarnings("ignore::p2p_lib.core.errors.Doubt")
def test_what_is_doubtful_about_a_first_mask_is_said_with_the_first_pose_which_is_doubted():
    (frame, _), (then, _) = film()[:2]
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("wall", clicks=[[160, 20]])
        estimate = method.step(frame)["wall"]
        assert "lie in the plane around them" in method.segmenter.doubts["wall"]
        assert estimate.T_cam_obj is not None and estimate.confidence == 0.5
        assert estimate.reason == method.segmenter.doubts["wall"]
        assert "in the plane" not in method.step(then)["wall"].reason and not method.segmenter.doubts


@pytest.mark.filterwarnings("ignore::p2p_lib.core.errors.Doubt")
@pytest.mark.parametrize("at", [(160, 20), (4, 4)], ids=["it started", "too little to start"])
def test_what_was_doubted_is_forgotten_with_its_object(at):
    """Nobody asks the segmenter while it has no objects: what it said of one that is gone is of no other."""
    (frame, _), (then, _) = film()[:2]
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("wall", clicks=[at])
        method.step(frame)
        method.remove_object("wall")
        method.add_object("wall")
        assert method.step(then)["wall"].reason == "not seen yet: it waits for a mask (step) or for clicks (correct)"


def test_clicks_in_a_frame_of_another_unit_stop_nobody():
    """The others have their estimates, and the one that was clicked on says what was wrong."""
    with Point2Pose(CAMERA, quick()) as method:
        for frame, masks in film()[:2]:
            method.step(frame, {"left": masks["left"]}) if method.objects else method.add_object("left")
        (frame, masks), at = film()[2], np.argwhere(film()[2][1]["right"]).mean(0)[::-1]
        method.add_object("right", clicks=[at])
        told = method.step(replace(frame, depth_m=1000 * frame.depth_m), {"left": masks["left"]})
    assert told["right"].status is Status.INITIALISING and "is it in millimetres?" in told["right"].reason
    assert told["left"].T_cam_obj is None and "is it in millimetres?" in told["left"].reason


@pytest.mark.filterwarnings("ignore::p2p_lib.core.errors.Doubt")
def test_a_correction_of_what_is_hidden_is_answered_in_its_reason():
    hidden, last = film(board=True), [*HIDDEN][-1]
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left", mask=hidden[0][1]["left"])
        for frame, _ in hidden[:last]:
            method.step(frame)
        method.correct("left", negative=[[160, 20]])
        estimate = method.step(hidden[last][0])["left"]
    assert estimate.status is Status.OCCLUDED and "negative clicks on 'left'" in estimate.reason
