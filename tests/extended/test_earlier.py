"""Clicks, boxes and masks of an earlier frame: they are of what was clicked on, or of nothing."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core.earlier import has_moved, selected
from p2p_lib.core.errors import BadInput, Doubt
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, Status
from p2p_lib.extended.default import Point2Pose
from tests.fixtures.made_memory import made_memory
from tests.method.test_pipeline import CAMERA, assert_same, clicks_on, film, quick, with_holes

THEN, MASKS = film()[0]
ON = {name: clicks_on(mask) for name, mask in MASKS.items()}


def seen_again(index: int, seed: int = 0) -> Frame:
    """What the first frame shows, as a camera that stands still sees it later."""
    rng = np.random.default_rng(seed)
    rgb = np.clip(THEN.rgb + rng.integers(-4, 5, THEN.rgb.shape), 0, 255).astype(np.uint8)
    depth_m = THEN.depth_m + rng.normal(0, 5e-4, THEN.shape).astype(np.float32) * (THEN.depth_m > 0)
    return Frame(index, index / 30, rgb, depth_m)


@pytest.mark.parametrize("order", [("left", "right"), ("right", "left")])
def test_clicks_of_an_earlier_frame_select_what_they_selected_there(order):
    """As ``p2p click`` shows it: of all objects at once, in whichever order they are told."""
    prompts = [Prompt(name, points_px=ON[name]) for name in MASKS]
    shown, _ = selected(THEN, prompts, CAMERA, quick().segmentation)
    with Point2Pose(CAMERA, quick()) as method:
        for name in order:
            method.add_object(name, clicks=ON[name], frame=THEN)
        estimates = method.step(seen_again(30))
        for name, mask in shown.items():
            np.testing.assert_array_equal(method.masks[name], mask)
            assert estimates[name].status is Status.TRACKED
        assert not method.refused


def test_clicks_on_what_has_moved_are_refused_until_a_newer_image_is_clicked_on():
    """The others go on as if nothing had been said; the estimate says what to do."""
    (now, masks), (later, _) = film()[9:11]
    with Point2Pose(CAMERA, quick()) as method, Point2Pose(CAMERA, quick()) as alone:
        for each in (method, alone):
            each.add_object("right", mask=MASKS["right"])
            each.step(THEN)
        method.add_object("left", clicks=ON["left"], frame=THEN)
        found = method.step(now)
        why = (
            "prompt of 'left' in frame 0: got pixels that have changed by frame 9, expected what stands still meanwhile"
        )
        assert found["left"].reason == str(method.refused["left"]) == f"{why}. Click again on a newer image."
        assert found["left"].status is Status.INITIALISING and not method.masks["left"]
        assert_same([{"right": found["right"]}], [alone.step(now)])
        method.correct("left", clicks=clicks_on(masks["left"]), frame=now)
        again = replace(now, index=later.index, time_s=later.time_s)
        assert method.step(again)["left"].T_cam_obj is not None and not method.refused


def test_what_is_said_without_a_frame_is_of_the_next_one():
    """Also where something else was said before of an earlier one, which no longer counts."""
    now, masks = film()[9]
    with Point2Pose(CAMERA, quick()) as method, Point2Pose(CAMERA, quick()) as alone:
        method.add_object("left", clicks=ON["left"], frame=THEN)
        method.correct("left", clicks=clicks_on(masks["left"]))
        alone.add_object("left", clicks=clicks_on(masks["left"]))
        assert_same([method.step(now)], [alone.step(now)])


def test_a_correction_of_an_earlier_frame_holds_where_nothing_has_moved():
    """The wall is where it was; the carton is not: what was said of that is ignored, and the estimate says so."""
    (_, (second, _), (third, masks)), (now, _) = film()[:3], film()[9]
    on_wall = [[160, 20]]
    with Point2Pose(CAMERA, quick()) as method, Point2Pose(CAMERA, quick()) as alone:
        for each in (method, alone):
            each.add_object("left", mask=MASKS["left"])
            each.step(THEN)
        method.correct("left", negative=on_wall, frame=THEN)
        alone.correct("left", negative=on_wall)
        assert_same([method.step(second)], [alone.step(second)])
        method.step(third)
        expected = (alone.step(third), alone.step(now))[1]["left"]
        for said in ({"clicks": clicks_on(masks["left"])}, {"mask": masks["left"]}):
            method.correct("left", **said, frame=third)
        with pytest.warns(
            Doubt, match=r"correction of 'left': it is ignored: .* changed by frame 9, .* Click again on"
        ):
            estimate = method.step(now)["left"]
        assert "it is ignored: prompt of" in estimate.reason and "Click again on a newer image." in estimate.reason
        assert_same([{"left": replace(estimate, reason=expected.reason)}], [{"left": expected}])


def test_what_cannot_be_meant_of_an_earlier_frame_is_refused_at_once():
    holes = with_holes(THEN, ON["left"])
    small = Frame(0, 0.0, THEN.rgb[:100], THEN.depth_m[:100])
    with Point2Pose(CAMERA, quick()) as method:
        for frame, match in ((holes, "no depth in frame 0"), (small, "frame 0: got 400x100"), (3, "frame: got int")):
            with pytest.raises(BadInput, match=match):
                method.add_object("left", clicks=ON["left"], frame=frame)
        with pytest.raises(BadInput, match="at least one"):
            method.add_object("left", frame=THEN)
        with pytest.raises(BadInput, match="add_object with a memory"):
            method.add_object("left", memory=made_memory(), frame=THEN)
        assert not method.objects


@pytest.mark.filterwarnings("ignore::p2p_lib.core.errors.Doubt")
def test_what_is_doubtful_about_a_mask_of_an_earlier_frame_is_said_with_the_first_pose():
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("wall", clicks=[[160, 20]], frame=THEN)
        first, second = (method.step(seen_again(index, index))["wall"] for index in (30, 31))
        assert first.T_cam_obj is not None and first.confidence == 0.5
        assert "in frame 0" in first.reason and "lie in the plane around them" in first.reason
        assert "in the plane" not in second.reason


def test_what_selected_nothing_in_an_earlier_frame_starts_nothing(monkeypatch):
    nothing = {"left": np.zeros(THEN.shape, bool)}
    monkeypatch.setattr("p2p_lib.core.objects.selected", lambda *asked: (nothing, {}))
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left", clicks=ON["left"], frame=THEN)
        assert "nothing found there" in method.step(seen_again(1))["left"].reason


def test_a_mask_without_pixels_cannot_have_moved():
    assert not has_moved(Prompt("left", mask=np.zeros(THEN.shape, bool)), THEN, film()[9][0])


def test_clicks_on_a_frame_that_comes_later_are_refused_as_such():
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left", clicks=ON["left"], frame=seen_again(9, 9))
        told = method.step(seen_again(3, 3))["left"]
        assert "frame: got frame 9, which is newer, expected one before frame 3" in told.reason
