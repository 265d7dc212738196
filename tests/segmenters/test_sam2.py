"""SAM 2's image part: what it is told, which of its candidates is taken, when it is asked, and with the real weights.

A stand-in of known behaviour sees what one colour is: its candidates are that, that with all that is green, everything.
"""

import warnings
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from p2p_lib.core.backends import make_segmenter
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput, Doubt, MissingBackend
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters import anchored, sam2, sam2_image
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter
from p2p_lib.segmenters.sam2 import Question, Sam2Refiner
from p2p_lib.segmenters.sam2_image import MASK_SIDE, SIDE, MaskCandidates, Sam2Image

CAMERA = Camera(300.0, 300.0, 128, 96, 256, 192)
GREY, RED, GREEN = (90, 90, 90), (220, 40, 40), (40, 200, 40)
AT_RED, AT_GREEN = [[80.0, 60], [70, 80], [90, 90]], [[180.0, 60]]
RED_PX, GREEN_PX = np.s_[50:110, 60:100], np.s_[40:100, 150:210]


def mask_of(part, shift=0):
    mask = np.zeros((192, 256), bool)
    mask[part] = True
    return np.roll(mask, shift, 1)


def frame_of(index=0, shift=0):
    """A red and a green board 40 cm before a grey wall; ``shift`` px to the right."""
    rgb, depth_m = np.full((192, 256, 3), GREY, np.uint8), np.full((192, 256), 1.0, np.float32)
    for part, colour in ((RED_PX, RED), (GREEN_PX, GREEN)):
        mask = mask_of(part, shift)
        rgb[mask], depth_m[mask] = colour, 0.6
    return Frame(index, index / 30, rgb, depth_m)


class Encoder:
    """Passes the image on, smaller."""

    def __init__(self):
        self.fed = []

    def get_outputs(self):
        return [SimpleNamespace(name="image_embed")]

    def run(self, names, feed):
        self.fed.append(feed["image"])
        small = cv2.resize(feed["image"][0].transpose(1, 2, 0), (MASK_SIDE,) * 2, interpolation=cv2.INTER_AREA)
        return [small.transpose(2, 0, 1)[None]]


class Decoder:
    def __init__(self):
        self.fed, self.scores = [], (0.9, 0.8, 0.7)

    def run(self, names, feed):
        self.fed.append(feed)
        image, points, kinds = (
            feed["image_embed"][0].transpose(1, 2, 0),
            feed["point_coords"][0],
            feed["point_labels"][0],
        )
        u, v = (points[np.isin(kinds, (1, 2))][0] * MASK_SIDE / SIDE).astype(int)
        near = np.abs(image - image[v, u]).sum(-1) < 1.5
        green = (image[..., 1] > image[..., 0] + 1) & (image[..., 1] > image[..., 2] + 1)
        logits = np.where(np.stack([near, near | green, np.ones_like(near)]), 9.0, -9.0).astype(np.float32)
        return logits[None], np.array([self.scores], np.float32)


@pytest.fixture
def network():
    return Sam2Image(Encoder(), Decoder())


#: Of the frame in which nothing has moved.
FEATURES = Sam2Image(Encoder(), Decoder()).features(frame_of().rgb)


def iou(one, other):
    return (one & other).sum() / (one | other).sum()


# --- the network ----------------------------------------------------------------------------------


def test_the_network_is_fed_as_its_publisher_says(network):
    frame = frame_of()
    prompt = Prompt("a", points_px=AT_RED, negative_px=AT_GREEN, box_px=[-0.5, -0.5, 127.5, 95.5])
    network.candidates(network.features(frame.rgb), prompt)
    (image,), (fed,) = network._encoder.fed, network._decoder.fed
    assert image.shape == (1, 3, 1024, 1024) and image.dtype == np.float32
    expected = (np.array(GREY) / 255 - (0.485, 0.456, 0.406)) / (0.229, 0.224, 0.225)
    assert np.allclose(image[0, :, 0, 0], expected, atol=1e-5)
    assert fed["point_labels"].tolist() == [[2, 3, 1, 1, 1, 0]]
    corners, first = fed["point_coords"][0, :2], fed["point_coords"][0, 2]
    assert corners.tolist() == [[0, 0], [512, 512]] and np.allclose(first, np.array([80.5, 60.5]) * [4, 1024 / 192])
    assert fed["has_mask_input"].tolist() == [0] and not fed["mask_input"].any() and fed["mask_input"].ndim == 4


def test_masks_are_those_of_the_image_and_stable_where_their_edge_is_sharp():
    sharp, soft = np.full((2, 256, 256), -5.0, np.float32)
    sharp[64:128, 64:192] = 5
    soft[64:128, 64:192] = 0.5
    offered = MaskCandidates(np.stack([sharp, soft]), np.zeros(2), (192, 256))
    truth = mask_of(np.s_[48:96, 64:192])
    assert all(iou(mask, truth) > 0.97 for mask in offered.masks())
    assert offered.stability().tolist() == [1, 0]


# --- which candidate ------------------------------------------------------------------------------


def offered(*masks, score):
    logits = [cv2.resize(np.where(m, 9.0, -9.0).astype(np.float32), (256, 256)) for m in masks]
    return MaskCandidates(np.stack(logits), np.array(score), (192, 256))


def test_another_objects_click_rules_a_candidate_out():
    red, both = mask_of(RED_PX), mask_of(RED_PX) | mask_of(GREEN_PX)
    two = offered(red, both, score=[0.7, 0.99])
    prompt = Prompt("red", points_px=AT_RED)
    assert iou(Question.of_prompt(prompt, both, np.zeros((0, 2)), False).answer(two, FEATURES), both) > 0.95
    assert iou(Question.of_prompt(prompt, both, np.array(AT_GREEN), False).answer(two, FEATURES), red) > 0.95


def test_nothing_is_taken_where_nothing_fits():
    question = Question.of_prompt(Prompt("red", points_px=AT_RED), mask_of(RED_PX), np.zeros((0, 2)), False)
    assert question.answer(offered(mask_of(GREEN_PX), score=[0.99]), FEATURES) is None
    assert question.answer(offered(mask_of(RED_PX), score=[0.1]), FEATURES) is None
    assert question.answer(offered(mask_of(RED_PX), score=[0.9]), FEATURES) is not None
    beside = Question.of_prompt(Prompt("red", points_px=AT_RED), mask_of(RED_PX), np.array(AT_GREEN), False)
    assert beside.answer(offered(mask_of(RED_PX) | mask_of(GREEN_PX), score=[0.99]), FEATURES) is None


def test_of_like_candidates_the_followed_mask_decides():
    red, part = mask_of(RED_PX), mask_of(np.s_[50:110, 60:92])
    two = offered(red, part, score=[0.8, 0.85])
    for followed, expected in ((red, red), (part, part)):
        question = Question.of_followed("red", followed, Hint(), np.zeros((0, 2)))
        assert iou(question.answer(two, FEATURES), expected) > 0.95


def test_a_mask_without_the_objects_keypoints_is_not_believed():
    """The mask has moved to the green board, the keypoints that agree are on the red one."""
    hint = Hint(uv_px=np.array(AT_RED))
    question = Question.of_followed("red", mask_of(GREEN_PX), hint, np.zeros((0, 2)))
    assert question.expected is None and len(question.prompt.points_px) == 3
    two = offered(mask_of(GREEN_PX), mask_of(RED_PX), score=[0.99, 0.8])
    assert iou(question.answer(two, FEATURES), mask_of(RED_PX)) > 0.95
    assert Question.of_followed("red", np.zeros((192, 256), bool), Hint(), np.zeros((0, 2))) is None


def test_specks_and_pinholes_go_and_a_handle_stays():
    mask = mask_of(np.s_[50:150, 50:150])
    mask[80:120, 100:130] = False
    dirty = mask.copy()
    dirty[10:14, 10:14], dirty[60:63, 60:63] = True, False
    question = Question.of_prompt(Prompt("a", points_px=[[55, 55]]), mask, np.zeros((0, 2)), False)
    assert iou(question.answer(offered(dirty, score=[0.9]), FEATURES), mask) > 0.97
    assert not question.answer(offered(dirty, score=[0.9]), FEATURES)[10:14, 10:14].any()


# --- in the segmenter -----------------------------------------------------------------------------


def segmenter(network, every=None, config=None):
    config = config or preset().segmentation
    return BuiltinSegmenter(CAMERA, config, Sam2Refiner(lambda: network, CAMERA, config, every))


def prompts():
    return [Prompt("red", points_px=AT_RED), Prompt("green", points_px=AT_GREEN)]


def test_prompts_become_its_masks_and_are_followed_from_there(network):
    of = segmenter(network)
    network._decoder.scores = (0.7, 0.8, 0.9)  # it holds both boards for one thing, and likelier everything
    labels = of.segment(frame_of(), prompts())
    assert iou(labels == 1, mask_of(RED_PX)) > 0.95 and iou(labels == 2, mask_of(GREEN_PX)) > 0.95
    labels = of.segment(frame_of(1, 3))
    assert iou(labels == 1, mask_of(RED_PX, 3)) > 0.9
    assert len(network._encoder.fed) == 1 and of.name == "builtin+sam2"


def test_the_image_is_encoded_in_every_nth_frame_once_for_all_objects(network):
    of = segmenter(network, every=3)
    of.segment(frame_of(), prompts())
    for k in range(1, 8):
        of.segment(frame_of(k, k))
    assert (len(network._encoder.fed), len(network._decoder.fed)) == (3, 6) and of.name == "sam2"


def test_who_clicks_on_one_image_again_and_again_waits_once(network):
    for said in (prompts()[:1], prompts(), prompts()):
        segmenter(network).segment(frame_of(), said)
    segmenter(network).segment(frame_of(1, 2), prompts())
    assert (len(network._encoder.fed), len(network._decoder.fed)) == (2, 7)


@pytest.mark.parametrize(
    ("said", "on", "beside"),
    [
        ({"negative_px": [[150.0, 150]]}, 3, 1),
        ({"points_px": AT_RED[:1]}, 4, 0),
    ],
)
def test_a_correction_keeps_the_rest_of_the_object(network, said, on, beside):
    """The network is asked with the middle of the mask, too: a click on a part is not meant to select that part."""
    of = segmenter(network)
    of.segment(frame_of(), prompts())
    labels = of.segment(frame_of(1), [Prompt("red", **said)])
    assert iou(labels == 1, mask_of(RED_PX)) > 0.9
    kinds = network._decoder.fed[-1]["point_labels"][0]
    assert ((kinds == 1).sum(), (kinds == 0).sum()) == (on, beside)


def test_a_box_that_corrects_a_mask_is_asked_with_by_itself(network):
    """It says what the whole is: the mask that it replaces may be something else."""
    of = segmenter(network)
    of.segment(frame_of(), prompts())
    of.segment(frame_of(1), [Prompt("red", box_px=(58, 48, 101, 111))])
    kinds = network._decoder.fed[-1]["point_labels"][0]
    assert not (kinds == 1).any() and (kinds == 2).sum() == (kinds == 3).sum() == 1


def test_the_built_in_mask_stays_where_no_candidate_fits(network):
    network._decoder.scores = (0.1, 0.1, 0.1)
    labels = segmenter(network).segment(frame_of(), prompts())
    alone = BuiltinSegmenter(CAMERA, preset().segmentation).segment(frame_of(), prompts())
    assert np.array_equal(labels, alone) and labels.any()


def test_doubts_are_about_the_mask_that_is_used(network):
    """A flat poster: depth says nothing, and the built-in segmenter by itself doubts what it finds."""
    flat = frame_of()
    flat = Frame(0, 0.0, flat.rgb, np.full((192, 256), 0.8, np.float32))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", Doubt)
        labels = segmenter(network).segment(flat, [Prompt("red", points_px=AT_RED)])
    assert iou(labels == 1, mask_of(RED_PX)) > 0.95
    assert len(said) == 1 and f"{(labels == 1).sum()} pixels selected lie" in str(said[0].message)


def test_beside_the_tracking_an_answer_arrives_later_where_the_object_is_then(network):
    """It works at frame 1 while the boards move on by 12 px, which are 2.4 cm at 60 cm."""
    from threading import Event

    go, T_obj = Event(), np.eye(4)
    of = Sam2Refiner(lambda: (go.wait(10), network)[1], CAMERA, preset().segmentation, every=1, background=True)
    go.set()
    first = of.refine(frame_of(), {"red": prompts()[0]}, {"red": mask_of(RED_PX)}, {})
    assert iou(first["red"], mask_of(RED_PX)) > 0.95  # nothing is followed yet: it is waited for
    go.clear()
    poor = mask_of(np.s_[60:100, 60:100])
    at_red, moved = Hint(uv_px=np.array(AT_RED), T_cam_obj=T_obj), T_obj.copy()
    moved[0, 3] = 12 / 300 * 0.6
    assert of.refine(frame_of(1), {}, {"red": poor}, {"red": at_red}) == {}
    asked = of._working.answers
    go.set()
    asked.result(10)
    now = Hint(uv_px=np.array(AT_RED) + np.array([12, 0]), T_cam_obj=moved)
    came = of.refine(frame_of(2, 12), {}, {"red": np.roll(poor, 12, 1)}, {"red": now})
    assert iou(came["red"], mask_of(RED_PX, 12)) > 0.95
    of._working.answers.result(10)
    wrong = Hint(uv_px=now.uv_px, T_cam_obj=T_obj)  # it has not moved, says the pose, and nothing of it is there
    assert of.refine(frame_of(3, 100), {}, {"red": poor}, {"red": wrong}) == {}


# --- by name --------------------------------------------------------------------------------------


def test_without_weights_the_built_in_segmenter_is_alone_and_sam2_says_what_to_fetch(monkeypatch, tmp_path):
    monkeypatch.setenv("P2P_DATA", str(tmp_path))
    config = preset().segmentation
    assert make_segmenter("builtin", CAMERA, config).name == "builtin"
    for name, changed in (("sam2", {}), ("builtin", {"segmentation.first_masks": "sam2"})):
        with pytest.raises(MissingBackend, match=r"onnxruntime|p2p data fetch sam2"):
            make_segmenter(name, CAMERA, preset().with_values(changed).segmentation)


def test_where_the_weights_are_prompts_are_its_own_unless_told_otherwise(monkeypatch):
    monkeypatch.setattr(anchored, "_available", lambda: True)
    config = {
        name: preset().with_values({"segmentation.first_masks": name}).segmentation for name in ("auto", "builtin")
    }
    assert make_segmenter("builtin", CAMERA, config["auto"]).name == "builtin+sam2"
    assert make_segmenter("builtin", CAMERA, config["builtin"]).name == "builtin"


@pytest.mark.parametrize("name", ["builtin", "sam2"])
def test_as_p2p_live_wants_it_it_works_beside_the_tracking(monkeypatch, network, name):
    monkeypatch.setattr(anchored, "_available", lambda: True)
    monkeypatch.setattr(sam2_image, "load", lambda threads: network)
    sam2._network.cache_clear()
    config = preset().with_values({"segmentation.sam2_every": 0}).segmentation
    of = make_segmenter(name, CAMERA, config)
    assert iou(of.segment(frame_of(), prompts()) == 1, mask_of(RED_PX)) > 0.95
    of.segment(frame_of(1, 1))
    working = of._refiner._working
    assert (set() if working is None else set(working.answers.result(10))) == (
        {"red", "green"} if name == "sam2" else set()
    )
    sam2._network.cache_clear()


def test_an_unknown_source_of_first_masks_is_refused():
    with pytest.raises(BadInput, match="auto, builtin, sam2"):
        preset().with_values({"segmentation.first_masks": "sam3"})


def test_real_weights_cut_out_a_mug_in_a_hand(shared_data):
    from p2p_lib.datasets.prompts import load_prompts
    from p2p_lib.datasets.sequence import open_sequence

    if not anchored._available():
        pytest.skip("no weights of sam2, or no onnxruntime. Run: p2p data fetch sam2")
    folder = shared_data / "real_hand" / "mug_in_hand"
    sequence = open_sequence(folder)
    config = preset().with_values({"segmentation.first_masks": "sam2"}).segmentation
    of = make_segmenter("builtin", sequence.camera, config)
    labels = of.segment(sequence.frame(0), load_prompts(shared_data / "prompts" / "mug_in_hand.json"))
    truth = cv2.imread(str(sorted((folder / "reference_masks" / "mug").glob("*.png"))[0]), 0) > 0
    assert iou(labels == 1, truth) > 0.95


def test_another_thing_is_not_the_object_however_well_it_is_followed(network):
    """The object has left, its mask has slid onto the green board: nothing of that looks like the object."""
    refiner = Sam2Refiner(lambda: network, CAMERA, preset().segmentation, every=1)
    refiner.refine(frame_of(), {"red": prompts()[0]}, {"red": mask_of(RED_PX)}, {})
    stays = refiner.refine(frame_of(1), {}, {"red": mask_of(RED_PX)}, {})
    assert iou(stays["red"], mask_of(RED_PX)) > 0.95
    assert not refiner.refine(frame_of(2), {}, {"red": mask_of(GREEN_PX)}, {})["red"].any()


def test_a_mask_that_has_spread_is_mended_by_the_answer_before():
    """The followed mask has taken in a strip beside the object; the newest answer, as the object has moved, has not."""
    red, wider = mask_of(RED_PX), mask_of(np.s_[50:110, 60:115])

    class Undecided(Sam2Image):
        def candidates(self, features, prompt, mask=None):
            return offered(red, wider, score=[0.85, 0.9])

    for T_cam_obj, kept in ((np.eye(4), red), (None, wider)):
        refiner = Sam2Refiner(lambda: Undecided(Encoder(), Decoder()), CAMERA, preset().segmentation, every=4)
        prompt = Prompt("red", points_px=AT_RED, negative_px=[[110.0, 60]])
        assert iou(refiner.refine(frame_of(), {"red": prompt}, {"red": red}, {})["red"], red) > 0.95
        hints = {"red": Hint(uv_px=np.array(AT_RED), T_cam_obj=T_cam_obj)}
        for k in range(1, 4):
            assert refiner.refine(frame_of(k), {}, {"red": red}, hints) == {}
        assert iou(refiner.refine(frame_of(4), {}, {"red": wider}, hints)["red"], kept) > 0.95
