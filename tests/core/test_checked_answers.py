"""What a detector or a segmenter must not answer is refused with its name, the frame and what was expected."""

import numpy as np
import pytest

from p2p_lib import Point2Pose
from p2p_lib.core.checked_answers import check_candidates, check_labels
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from tests.method.test_pipeline import CAMERA, assert_same, film, quick

H, W = 30, 60
FRAME = Frame(7, 0.2, np.zeros((H, W, 3), np.uint8), np.ones((H, W), np.float32))
MASK = np.zeros((H, W), bool)
MASK[5:25, 35:55] = True
INSIDE = np.array([[40.0, 10.0], [50.0, 20.0], [36.4, 6.0]])
SCORES = np.array([0.9, 0.5, 0.1])


class Part:
    name = "theirs"

    def __init__(self, names=()):
        self.names = names


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (None, r"got NoneType, expected Candidates\(uv_px, score\)"),
        (INSIDE, r"got float64 \(3, 2\), expected Candidates"),
        (Candidates(INSIDE, SCORES[:2]), r"got uv_px float64 \(3, 2\), score float64 \(2,\), expected NumPy arrays"),
        (Candidates(INSIDE.tolist(), SCORES), r"got uv_px list, score float64 \(3,\)"),
        (Candidates(INSIDE * np.nan, SCORES), r"got 3 of 3 points outside the image, one at \[nan, nan\]"),
        (Candidates(INSIDE, SCORES * np.nan), "got 3 of 3 points outside the image"),
        (Candidates(INSIDE + np.array([100.0, 0.0]), SCORES), "got 3 of 3 points outside the image, one at .*of 60x30"),
        (Candidates(INSIDE[:, ::-1] / 2, SCORES), r"got 3 of 3 points outside the mask.* A pixel is \(u, v\)"),
    ],
)
def test_what_is_no_set_of_candidates_is_refused(found, said):
    with pytest.raises(BadInput, match=rf"detector 'theirs' \(Part\), frame 7: detect\(\): {said}"):
        check_candidates(Part(), FRAME, MASK, found)


def test_candidates_inside_the_mask_or_none_at_all_pass():
    check_candidates(Part(), FRAME, MASK, Candidates(INSIDE, SCORES))
    check_candidates(Part(), FRAME, MASK, Candidates(INSIDE[:0], SCORES[:0]))


@pytest.mark.parametrize(
    ("labels", "names", "said"),
    [
        (None, ("box",), r"got NoneType, expected a NumPy array \(30, 60\) of whole numbers. 0 is no object"),
        (MASK, ("box",), r"got bool \(30, 60\)"),
        (MASK[::2, ::2].astype(int), ("box",), r"got int64 \(15, 30\)"),
        (MASK.astype(int) * 3, ("box",), r"got label 3, expected 0 to 1\. 0 is no object"),
        (MASK.astype(int) - 1, ("box",), r"got label -1, expected 0 to 1"),
        (MASK.astype(int), (), r"got names \(\), expected 'box' among them, which a prompt has started"),
    ],
)
def test_what_is_no_label_image_is_refused(labels, names, said):
    prompts = [Prompt("box", 7, points_px=[[40, 10]])]
    with pytest.raises(BadInput, match=rf"segmenter 'theirs' \(Part\), frame 7: segment\(\): {said}"):
        check_labels(Part(names), FRAME, prompts, labels)


def test_labels_of_the_objects_that_it_follows_pass():
    check_labels(Part(("box",)), FRAME, [Prompt("box", 7, points_px=[[40, 10]])], MASK.astype(np.int32))


def test_a_tracker_takes_such_answers_from_nobody():
    class Swapped:
        name = "swapped"

        def detect(self, frame, mask):
            return np.stack(np.nonzero(mask))

    class Bare:
        name, names = "bare", ("left",)

        def segment(self, frame, prompts=(), hints=None):
            return np.zeros(frame.shape, bool)

        def remove(self, name):
            pass

    frame, masks = film()[0]
    with Point2Pose(CAMERA, quick(), detector=Swapped()) as method:
        method.add_object("left", mask=masks["left"])
        with pytest.raises(BadInput, match=r"detector 'swapped' \(Swapped\), frame 0"):
            method.step(frame)
    with Point2Pose(CAMERA, quick(), segmenter=Bare()) as method:
        method.add_object("left", mask=masks["left"])
        with pytest.raises(BadInput, match=r"segmenter 'bare' \(Bare\), frame 0"):
            method.step(frame)


@pytest.mark.parametrize("at", [1, 4])
def test_a_frame_at_which_the_tracker_fails_is_left_out(at):
    """What follows is of its own frame: it was answered with the frame before, as if that had been late."""
    frames = film()[:8]
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left", mask=frames[0][1]["left"])
        track, found = method.tracker.original.track, []
        for frame, masks in frames:
            if frame.index == at:
                method.tracker.original.track = lambda *_: (_ for _ in ()).throw(RuntimeError("a hiccup"))
                with pytest.raises(RuntimeError, match="hiccup"):
                    method.step(frame, {"left": masks["left"]})
                method.tracker.original.track = track
            else:
                found.append(method.step(frame, {"left": masks["left"]}))
    assert [each["left"].frame_index for each in found] == [frame.index for frame, _ in frames if frame.index != at]
    with Point2Pose(CAMERA, quick()) as method:
        method.add_object("left", mask=frames[0][1]["left"])
        rest = [(frame, masks) for frame, masks in frames if frame.index != at]
        assert_same(found, [method.step(frame, {"left": masks["left"]}) for frame, masks in rest])
