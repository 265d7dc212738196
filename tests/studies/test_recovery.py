"""Figures of a return say what the runs say: images, curves, statuses, counts."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core.errors import BadInput
from p2p_lib.evaluation.confidence import Judged, judge
from p2p_lib.evaluation.recovery import RecoveryEvent
from p2p_lib.figures.scenes import Scene
from p2p_lib.synthetic.scenarios import SCENARIOS
from studies import recovery

EVENT = RecoveryEvent(hidden_frame=16, return_frame=21, frames_to_recovery=1)


@pytest.fixture(scope="module")
def scenes(made):
    """The same run under two names."""
    return {label: Scene(made.sequence, made.run, made.evaluation) for label in ("remembers", "forgets")}


def test_a_row_is_found_by_its_frame(scenes):
    assert scenes["remembers"].row(7) == 7
    with pytest.raises(BadInput, match="got 40, expected one of the run, 0 to 39"):
        scenes["remembers"].row(40)


def test_the_strip_has_a_row_per_method_and_says_which_frames(scenes):
    figure = recovery.return_strip(scenes, "can", EVENT)
    titles = [axis.get_title(loc="left") for axis in figure.axes[:5]]
    assert titles[0] == "last in sight\n(frame 14)" and titles[2:4] == ["return\n(frame 21)", "return + 1\n(frame 22)"]
    assert len(figure.axes) == 10 and figure.axes[5].get_ylabel() == "forgets"


def test_the_strip_says_map_and_reason_where_they_are_given(scenes, made):
    obj = made.run.objects["can"]
    said = replace(obj, map_id=np.arange(len(obj)) // 20, reason=np.where(np.arange(len(obj)) == 25, "a new map", ""))
    figure = recovery.strip({"one": scenes["remembers"]}, "can", {"before": 3, "after": 25}, said)
    words = [axis.get_xlabel() for axis in figure.axes]
    assert words == [f"{obj.status[3]}, map 0\n", f"{obj.status[25]}, map 1\na new map"]


def test_an_excerpt_is_these_frames_of_the_scene_at_their_times(tmp_path):
    clip = recovery.excerpt("other_side", range(40, 130, 60), 3, tmp_path / "clip")
    scenario = SCENARIOS["other_side"](3)
    rendered = [scenario.rendered(t).label == 1 for t in (40, 100)]
    assert clip.name == "synthetic/other_side" and len(clip) == 2
    np.testing.assert_allclose(np.diff(clip.times_s), 60 / 30, atol=1e-4)  # the file has microseconds
    T_cam_model = np.linalg.inv(scenario.T_world_cam[[40, 100]]) @ scenario.bodies[0].T_world_model[[40, 100]]
    np.testing.assert_allclose(clip.truth["box"].T_cam_model, T_cam_model, atol=1e-6)
    for i, mask in enumerate(rendered):
        found = clip.masks(i)["box"]
        assert (found & mask).sum() >= 0.95 * max(found.sum(), mask.sum())


def test_pictures_are_cut_to_where_the_object_truly_is(scenes, made):
    frames = [0, 20, 39]
    regions = recovery.around(scenes["remembers"], "can", frames)
    sizes = {(right - left, bottom - top) for left, top, right, bottom in regions}
    assert len(sizes) == 1
    for (left, top, right, bottom), i in zip(regions, frames, strict=True):
        v, u = np.nonzero(made.sequence.masks(i)["can"])
        if len(u):
            assert left <= u.min() and u.max() < right and top <= v.min() and v.max() < bottom


def test_curves_around_the_return_are_those_of_the_run(scenes, made):
    evaluations = dict.fromkeys(scenes, made.evaluation)
    figure = recovery.around_return(scenes, evaluations, "box", RecoveryEvent(12, 18, 0), span=10)
    obj = made.run.objects["box"]
    points, errors, sure = (axis.get_lines()[0] for axis in figure.axes[1:])
    assert points.get_xdata().tolist() == list(range(-16, 10))
    np.testing.assert_array_equal(sure.get_ydata(), np.where(obj.has_pose, obj.confidence, np.nan)[2:28])
    assert np.isnan(sure.get_ydata()).any(), "no pose, no confidence: not one of 0"
    score = made.evaluation.objects["box"]
    (row,) = np.flatnonzero(score.frame_index == 7)
    assert errors.get_ydata()[7 - 2] == 1e3 * score.adds_m[row] > 1 and np.isnan(errors.get_ydata()[8 - 2])
    crosses = [line for line in figure.axes[2].get_lines() if line.get_marker() == "x"]
    assert all(line.get_xdata().tolist() == [8 - 18] for line in crosses)


def test_statuses_of_all_methods_are_in_the_legend(scenes):
    figure = recovery.status_strips(scenes)
    (legend,) = figure.legends
    assert [t.get_text() for t in legend.get_texts()] == ["tracked", "degraded", "occluded", "lost"]
    assert [axis.get_title(loc="left") for axis in figure.axes] == [f"{k}, {scenes[k].sequence.name}" for k in scenes]


def test_the_film_shows_the_methods_side_by_side(scenes):
    pictures = list(recovery.film(scenes, [3, 20], 200))
    assert len(pictures) == 2 and pictures[0].shape[1] == 404 and (pictures[0] != pictures[1]).any()


def test_returns_are_counted_per_method(made):
    table = recovery.recovery_counts({("crossing", "remembers"): (made.run, made.evaluation)})
    assert table.to_dict("records") == [
        {
            "sequence": "crossing",
            "method": "remembers",
            "returns": 0,
            "within 5 frames": 0,
            "within 15 frames": 0,
            "within 30 frames": 0,
            "poses while hidden": 0,
        }
    ]


def test_confidence_marks_wrong_poses(made):
    figure = recovery.confidence_over_time(made.run, made.evaluation)
    _, right, wrong = figure.axes[list(made.evaluation.objects).index("box")].get_lines()
    times = made.run.objects["box"].time_s
    assert times[7] in wrong.get_xdata() and times[20] not in wrong.get_xdata() and times[0] in right.get_xdata()


def test_the_reliability_plot_says_the_share_of_right_poses():
    one = Judged(np.repeat([0.05, 0.55, 0.95], [20, 3, 40]), np.repeat([0, 1, 0], [20, 33, 10]).astype(bool))
    figure = recovery.reliability_plot({"one": one, "all right": Judged(np.ones(30), np.ones(30, bool))})
    _, line, few, other, none = figure.axes[0].get_lines()
    np.testing.assert_allclose(line.get_xydata(), [[0.05, 0], [0.55, np.nan], [0.95, 75]])
    assert few.get_xydata().tolist() == [[0.55, 100]] and few.get_linestyle() == "None", "three poses: not joined"
    assert line.get_label() == "one: ECE 0.16, AUROC 0.82" and other.get_label() == "all right: ECE 0.00, AUROC -"
    assert not len(none.get_xdata())


def test_frames_without_a_pose_claim_nothing(made):
    judged = judge(made.run, made.evaluation)["box"]
    scored = made.evaluation.objects["box"]
    assert len(judged) == len(scored.frame_index) - scored.lost < len(made.run.objects["box"]) + 1
    wrong = {5, 6, 7}  # 5 degrees and 2 cm, put in exactly at the bounds or beyond
    right = dict(zip([i for i in scored.frame_index.tolist() if i != 8], judged.right, strict=True))
    assert all(right[i] for i in right if i not in wrong) and (judged.confidence == 1).all()
