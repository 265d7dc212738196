"""Figures of a benchmark show what its runs found; what is not there is said."""

import numpy as np
import pytest

from p2p_lib.benchmark import load_benchmark, read_plan, run_benchmarks
from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets.keypoint_log import load_keypoints
from p2p_lib.evaluation.consistency import reprojected
from p2p_lib.evaluation.protocol import evaluate
from p2p_lib.figures.provenance import describe
from studies import final_figures


def test_histograms_hold_every_scored_frame_once(whole):
    figure = final_figures.error_histograms(whole)
    for axis in figure.axes:
        # Two sequences of 6 and 5 frames with two seeds.
        assert [t.get_text() for t in figure.legends[0].get_texts()] == [
            "Ours (22 frames)",
            "No multi-hypothesis (22 frames)",
        ]
        shares = [patch.get_data().values.sum() for patch in axis.patches]
        beyond = [line.get_ydata()[0] for line in axis.get_lines() if line.get_marker() == "x"]
        np.testing.assert_allclose(np.add(shares, beyond), 100)
        first, second = (patch.get_linewidth() for patch in axis.patches)
        assert first > second, "which lies on it, and may be the same"


def test_a_strip_has_a_line_for_each_method(whole):
    strip = final_figures.recovery_strip(whole, count=3, width_px=120)
    height = (strip.shape[0] - 4) / 2
    assert strip.shape[1] == 3 * 120 + 2 * 4 and height == int(height)
    first, second = strip[: int(height)], strip[int(height) + 4 :]
    # The same moments below each other: they differ in the method's name and, hardly, in its boxes.
    assert 0 < (np.abs(first.astype(int) - second).max(-1) > 40).mean() < 0.2


def test_a_tracks_error_is_its_distance_from_the_true_keypoint(whole):
    run, camera = whole.run("Ours"), whole.video("Ours").camera
    T_obj_model = evaluate(run).objects["object"].T_obj_model
    keypoints, T_cam_model = load_keypoints(run.path)["object"], run.objects["object"].T_cam_model[3]
    uv_px, error_px = reprojected(keypoints, 3, camera, T_cam_model @ se3.inverse(T_obj_model))
    assert len(uv_px) == len(error_px) >= 8 and np.median(error_px) < 0.3
    # The board lies 0.5 m before a camera of 200 px: a truth 1 cm off is 4 px off.
    off = T_obj_model @ se3.from_rt(np.eye(3), np.array([0.01, 0, 0]))
    _, error_px = reprojected(keypoints, 3, camera, T_cam_model @ se3.inverse(off))
    assert np.median(error_px) == pytest.approx(4, abs=0.3)


def test_tracks_are_drawn_where_they_are_known(whole):
    figure = final_figures.tracks_by_error(whole, "Ours", count=2)
    assert len(figure.axes) == 3, "two images and the scale"
    words = [axis.get_title(loc="left") for axis in figure.axes[:2]]
    least, most = (float(title.removeprefix("ADD ").removesuffix(" mm")) for title in words)
    assert least < most, "the best pose first"


def test_a_reconstruction_that_was_not_made_is_said(whole):
    with pytest.raises(MissingData, match="no reconstructed surface"):
        final_figures.reconstruction_sheet(whole, "Ours")
    with pytest.raises(BadInput, match="expected a method that ran: No multi-hypothesis, Ours"):
        whole.run("Theirs")


def test_the_note_of_a_picture_names_the_runs(whole):
    note = describe(whole)
    assert note["benchmark"] == "slides" and len(note["runs"]) == 8


def test_results_in_full_are_shown_and_the_quick_form_runs_where_there_are_none(whole, plan, tmp_path):
    name = str(plan)
    full = final_figures.results_to_show([name], whole.out, "full", [name])
    assert [b.profile for b in full.values()] == ["full"]
    nothing = load_benchmark(plan, tmp_path)
    assert nothing.counts() == {"done": 0, "failed": 0, "not run": 8}
    assert {outcome.reason for _, outcome in nothing.results} == {f"not run yet: p2p benchmark {plan}"}
    assert not any(tmp_path.iterdir()), "looking leaves nothing behind"
    (unasked,) = final_figures.results_to_show([name], tmp_path, "quick", []).values()
    assert unasked.counts() == {"done": 0, "failed": 0, "not run": 2}
    (quick,) = final_figures.results_to_show([name], tmp_path, "full", [name]).values()
    assert quick.profile == "quick" and quick.counts()["done"] == 2


def test_an_image_is_of_the_first_plan_that_was_run(whole, plan, tmp_path):
    results = {"not run": load_benchmark(plan, tmp_path), "run": whole, "run too": load_benchmark(plan, whole.out)}
    assert final_figures.first_with_runs(results, "not run", "run", "run too") is whole


def test_plans_that_share_runs_share_them_in_one_call(plan, tmp_path, here):
    here()
    twin = read_plan(plan).model_copy(update={"name": "twin"})
    one, two = run_benchmarks([plan, twin], tmp_path, "quick", progress=False)
    assert one.counts() == two.counts() == {"done": 2, "failed": 0, "not run": 0}
    assert len(list((tmp_path / "records").iterdir())) == 2
    assert (tmp_path / "slides-quick/results.csv").is_file() and (tmp_path / "twin-quick/results.csv").is_file()
