"""A mask is corrected by clicks: what the page shows is what a run does, and the run draws it and says what is odd."""

import re
import warnings

import numpy as np
import pytest

from p2p_lib.apps.check import check_folder
from p2p_lib.apps.click import Clicker
from p2p_lib.core.config import preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.first_masks import FILE
from p2p_lib.datasets.images import read_rgb
from p2p_lib.datasets.prompts import prompts_in
from p2p_lib.datasets.runs import load_run
from p2p_lib.extended.default import Point2Pose
from p2p_lib.run import run
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter
from tests.method.test_late_tracker import Late

FAST = {"method.surface": "false", "method.graph": "false"}
FRAMES, AT = 8, 4  # in which the mask is moved by the flow alone
HANDLE = 388.0, 262.0


@pytest.fixture(scope="module")
def before(tmp_path_factory, opening):
    """The bundled mug, its start, and a run of it."""
    sequence = opening("mug", FRAMES)
    (start,) = prompts_in(sequence.masks(0))
    out = tmp_path_factory.mktemp("runs") / "before"
    run(sequence, out, prompts=[start], stop=FRAMES, save_masks=True, settings=FAST, progress=False)
    return sequence, start, load_run(out)


def corrected(before, out, **said):
    """A run with a correction, what it said, and what it doubted of the clicks."""
    sequence, start, _ = before
    lines, prompts = [], [start, Prompt(start.name, AT, **said)]
    with warnings.catch_warnings(record=True) as doubts:
        warnings.simplefilter("always")
        how = {"stop": FRAMES, "save_masks": True, "settings": FAST, "say": lines.append}
        run(sequence, out, prompts=prompts, progress=True, **how)
    found = [str(d.message) for d in doubts if str(d.message).startswith(("clicks on", "correction of"))]
    return load_run(out), [line for line in lines if "masks of" in line], found


def test_the_page_shows_what_a_correction_makes_of_a_runs_mask(before, tmp_path):
    """A click beside it takes the handle off, one that agrees changes nothing: the same pixels there and in the run."""
    sequence, start, was = before
    kept = was.masks(sequence, AT)[start.name]
    with Clicker(sequence, tmp_path / "prompts.json", run=was) as clicker:
        for said, changes in (({"negative_px": [HANDLE]}, True), ({"points_px": [HANDLE]}, False)):
            shown, doubts = clicker.made([Prompt(start.name, AT, **said)], clicker.kept_masks(AT))
            run_, _, doubted = corrected(before, tmp_path / str(changes), **said)
            np.testing.assert_array_equal(run_.masks(sequence, AT)[start.name], shown[start.name])
            lost = kept & ~shown[start.name]
            assert bool(lost.any()) == changes and lost.sum() < kept.sum() / 4
            assert not (shown[start.name] & ~kept).any() and doubts == doubted == []


def test_a_click_brings_back_a_part_of_another_colour(before):
    """The mug without its handle, of which nothing has the colours."""
    sequence, start, _ = before
    mug, frame = sequence.masks(AT)[start.name], sequence.frame(AT)
    segmenter = BuiltinSegmenter(sequence.camera, preset().segmentation)
    segmenter.segment(frame, [Prompt("mug", AT, mask=mug & (np.arange(640) < HANDLE[0] - 20))])
    found = segmenter.segment(frame, [Prompt("mug", AT, points_px=[HANDLE])]) == 1
    assert (found & mug).sum() > 0.98 * (found | mug).sum()


def test_clicks_beside_it_take_the_table_off(before):
    """A strip of it on both sides; what of the mask is nearer to its middle than to the clicks counts as it was."""
    sequence, start, _ = before
    mug, frame = sequence.masks(AT)[start.name], sequence.frame(AT)
    wrong = mug.copy()
    wrong[301:360, 201:420] = True
    segmenter = BuiltinSegmenter(sequence.camera, preset().segmentation)
    segmenter.segment(frame, [Prompt("mug", AT, mask=wrong)])
    found = segmenter.segment(frame, [Prompt("mug", AT, negative_px=[(410.0, 340.0), (215.0, 330.0)])]) == 1
    assert (wrong & mug).sum() < 0.7 * wrong.sum() and (found & mug).sum() > 0.95 * (found | mug).sum()


def test_a_correction_is_drawn_and_one_that_grows_is_doubted(before, tmp_path):
    sequence, start, was = before
    wrong = sequence.masks(AT)[start.name].copy()
    wrong[250:440, 100:600] = True
    run_, (first, again), doubted = corrected(before, tmp_path / "run", mask=wrong)
    assert first.startswith(f"First masks of {start.name} in frame 0: ")
    assert again == f"Corrected masks of {start.name} in frame {AT}: {tmp_path / 'run' / FILE}"
    one, two = (read_rgb(of.path / FILE) for of in (was, run_))
    np.testing.assert_array_equal(two[: len(one), : one.shape[1]], one)
    assert len(two) > len(one)
    (doubt,) = doubted
    assert re.match(rf"correction of '{start.name}' in frame {AT}: its mask is \d+ cm long now, \d\.\d times", doubt)
    assert (doubt, start.name) in [(str(of), of.object) for of in run_.doubts]


@pytest.mark.parametrize(("late", "too_much"), [(0, False), (0, True), (2, True)])
def test_the_estimate_says_that_a_correction_takes_in_a_neighbour(late, too_much, opening):
    """In Python, live and ROS, too, also where a tracker answers late; one that takes in nothing is as sure as ever."""
    sequence = opening("crossing", AT + 3)
    method, estimates, said = Point2Pose(sequence.camera, preset().with_values(FAST), tracker=Late(late)), {}, []
    method.add_object("can", mask=sequence.masks(0)["can"])
    for index in range(AT + late + 1):
        if index == AT:
            masks = sequence.masks(AT)
            method.correct("can", mask=masks["can"] | masks["box"] if too_much else masks["can"])
        with warnings.catch_warnings(record=True) as doubts:
            warnings.simplefilter("always")
            estimates |= {e.frame_index: e for e in method.step(sequence.frame(index)).values()}
        said += [str(doubt.message) for doubt in doubts]
    found = estimates[AT]
    assert found.T_cam_obj is not None and (found.confidence <= 0.5) == too_much
    assert [text for text in said if text in found.reason] == said and len(said) == too_much
    start = rf"correction of 'can' in frame {AT}: its mask is \d+ cm long now, \d\.\d times"
    assert not too_much or re.match(start, said[0])


def test_an_object_that_is_added_again_is_not_compared_with_the_one_before(opening):
    sequence = opening("crossing", AT + 3)
    with Point2Pose(sequence.camera, preset().with_values(FAST)) as method:
        for index, names in enumerate((["can"], ["can", "box"])):
            masks = sequence.masks(index)
            method.add_object("can", mask=np.logical_or.reduce([masks[name] for name in names]))
            found = method.step(sequence.frame(index))["can"]
            assert found.confidence == 1 and "as long as before" not in found.reason
            method.remove_object("can")


def test_a_box_around_too_much_is_doubted_on_the_page_and_by_a_check(before, tmp_path):
    """Before a run is made of it; what clicks make of a mask nobody knows before a run."""
    sequence, start, was = before
    wrong, right = (Prompt(start.name, AT, box_px=box) for box in ((20, 250, 620, 470), (240, 165, 405, 340)))
    with Clicker(sequence, tmp_path / "prompts.json", run=was) as clicker:
        for prompt, many in ((wrong, True), (right, False)):
            _, doubts = clicker.made([prompt], clicker.kept_masks(AT))
            checked = [f.text for f in check_folder(sequence, prompts=[start, prompt]) if "clicks" in f.name]
            for texts in (doubts, checked):
                assert any("times as long as before" in text for text in texts) == many


def test_the_page_compares_a_correction_with_the_run_before_not_with_the_mask_that_is_wrong(before, tmp_path):
    sequence, start, was = before
    wrong = np.zeros((480, 640), bool)
    wrong[250:470, 20:620] = True
    with Clicker(sequence, tmp_path / "prompts.json", run=was) as clicker:
        _, doubts = clicker.made([Prompt(start.name, AT, box_px=(20, 250, 620, 470))], {start.name: wrong})
    assert any("times as long as before" in text for text in doubts)


def test_a_mask_that_says_hidden_is_no_trouble_to_a_check(before):
    """An empty mask in a later frame says that the object is not in view: it has no length."""
    sequence, start, _ = before
    hidden = Prompt(start.name, AT, mask=np.zeros((480, 640), bool))
    assert not [f.text for f in check_folder(sequence, prompts=[start, hidden]) if "clicks" in f.name]


def test_a_misspelt_object_is_asked_about(before, tmp_path):
    sequence, start, _ = before
    with pytest.raises(BadInput, match="Did you mean mug"):
        run(sequence, tmp_path / "none", prompts=[start], objects=["mugg"], progress=False)
