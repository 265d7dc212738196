"""What is plotted is what was measured."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from p2p_lib.core.errors import BadInput
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.confidence import pose_error
from p2p_lib.figures import plots, style
from studies import run_plots


@given(st.lists(st.sampled_from(["tracked", "occluded", "lost"]), max_size=60))
def test_intervals_are_the_statuses_again(status):
    spans = plots.status_intervals(np.array(status, dtype="U12"))
    assert [kind for kind, start, stop in spans for _ in range(start, stop)] == status
    assert all(a[0] != b[0] and a[2] == b[1] for a, b in pairwise(spans))
    assert all(start < stop for _, start, stop in spans)


def test_gaps_are_where_no_pose_is(made):
    for obj in made.run.objects.values():
        inside = np.zeros(len(obj), bool)
        for start, stop in plots.gaps(obj, at_least=1):
            inside[start:stop] = True
        assert (inside == ~obj.has_pose).all() and inside.any()
    assert len(plots.gaps(made.run.objects["box"], at_least=2)) == 1  # the single lost frame is no gap


def test_waiting_for_the_first_sight_is_no_gap(made):
    obj = made.run.objects["can"]
    late = type(obj)(**{**vars(obj), "status": np.where(obj.frame_index < 6, "initialising", obj.status)})
    assert plots.gaps(late) == plots.gaps(obj)


def test_pose_error_is_what_was_put_in(made):
    obj, score = made.run.objects["box"], made.evaluation.objects["box"]
    deg, mm = pose_error(obj, score)
    for i, T_error in made.wrong.items():
        if T_error is None:
            assert np.isnan(deg[i]) and np.isnan(mm[i])
        else:
            assert deg[i] == pytest.approx(np.degrees(Rotation.from_matrix(T_error[:3, :3]).magnitude()), abs=1e-4)
            assert mm[i] == pytest.approx(1e3 * np.linalg.norm(T_error[:3, 3]), abs=1e-3)
    right = [i for i in np.flatnonzero(obj.has_pose) if i not in made.wrong]
    assert np.nanmax(deg[right]) < 1e-3 and np.nanmax(mm[right]) < 1e-3


@given(st.lists(st.floats(0, 0.3) | st.just(np.inf), min_size=1, max_size=50))
def test_area_of_the_curve_is_the_auc(errors):
    errors = np.array(errors)
    threshold, share = run_plots.accuracy_curve(errors)
    area = (np.diff(threshold) * share[:-1]).sum() / metrics.MAX_M * 100
    assert area == pytest.approx(metrics.auc_exact(errors), abs=1e-9)
    assert (np.diff(threshold) >= 0).all() and (np.diff(share) >= 0).all() and threshold[-1] == metrics.MAX_M


def test_error_plot_shows_the_scores(made):
    figure = run_plots.error_over_time(made.run, made.evaluation)
    top = figure.axes[0]
    lines = {line.get_label(): line for line in top.get_lines()}
    for name, score in made.evaluation.objects.items():
        values = lines[name].get_ydata()
        rows = np.searchsorted(made.run.objects[name].frame_index, score.frame_index)
        expected = np.where(np.isfinite(score.add_m) & (score.add_m > 1e-6), 1e3 * score.add_m, np.nan)
        assert np.allclose(values[rows], expected, equal_nan=True)
        unscored = np.setdiff1d(np.arange(len(values)), rows)
        assert np.isnan(values[unscored]).all() and len(unscored)
        assert lines[name].get_color() == style.object_colours(made.run.objects)[name]
    crosses = [line for line in top.get_lines() if line.get_marker() == "x"]
    failed = sum(int(np.isinf(score.add_m).sum()) for score in made.evaluation.objects.values())
    assert sum(len(line.get_xdata()) for line in crosses) == failed == 1
    shaded = [patch for patch in top.patches if patch.get_alpha()]
    assert len(shaded) == sum(len(plots.gaps(obj)) for obj in made.run.objects.values()) == 2
    assert made.run.info["sequence"] in top.get_title(loc="left")


def test_strip_has_a_bar_per_span(made):
    axis = run_plots.status_strip(made.run).axes[0]
    spans = [span for obj in made.run.objects.values() for span in plots.status_intervals(obj.status)]
    assert len(axis.patches) == len(spans)
    obj = made.run.objects["box"]
    bars = [bar for bar in axis.patches if abs(bar.get_y() + bar.get_height() / 2) < 0.1]
    bars.sort(key=lambda bar: bar.get_x())
    for bar, (status, start, _) in zip(bars, plots.status_intervals(obj.status), strict=True):
        assert bar.get_x() == pytest.approx(obj.time_s[start])
        assert (bar.get_hatch() or "") == style.STATUS[status][1]
    ends = [bar.get_x() + bar.get_width() for bar in bars]
    assert np.allclose(ends[:-1], [bar.get_x() for bar in bars[1:]])


def test_accuracy_plot_names_the_auc(made):
    figure = run_plots.accuracy_threshold(made.evaluation)
    for axis, key in zip(figure.axes, ("add_auc", "adds_auc")):
        said = [text.get_text() for text in axis.get_legend().get_texts()]
        scores = made.evaluation.as_dict()["objects"]
        assert said == [f"{name}: {scores[name][key]:.1f} %" for name in scores]


def test_timings_are_means_of_the_columns(made):
    timings = {name: values.copy() for name, values in made.run.timings.items()}
    timings["total_ms"][0], timings["keyframe"][0] = 5000.0, 1.0  # the first frame, which is no part of the means
    figure = run_plots.stage_timings(replace(made.run, timings=timings))
    axis = figure.axes[0]
    widths = {label.get_text(): bar.get_width() for label, bar in zip(axis.get_yticklabels(), axis.containers[0])}
    assert widths["tracking"] == pytest.approx(12.0)
    assert widths["total"] == pytest.approx(made.run.timings["total_ms"][1:].mean())
    assert axis.get_legend().get_title().get_text() == "not counted: the first frame, 5000 ms"
    assert [*widths][-1] == "total" and next(iter(widths)) == "tracking"
    without = type(made.run)(**{**vars(made.run), "timings": {}})
    with pytest.raises(BadInput, match="timings"):
        run_plots.stage_timings(without)


def test_figures_are_nobodys_global_state(made):
    import matplotlib.pyplot as plt

    assert isinstance(run_plots.status_strip(made.run), Figure)
    assert plt.get_fignums() == []


def test_score_table_has_the_numbers(made):
    table = made.evaluation.as_frame().set_index("object")
    plain = made.evaluation.as_dict()
    assert list(table.index) == [*plain["objects"], "mean"]
    assert table.loc["box", "ADD AUC [%]"] == pytest.approx(plain["objects"]["box"]["add_auc"], abs=0.005)
    assert table.loc["mean", "ADD-S AUC [%]"] == pytest.approx(plain["mean"]["adds_auc"], abs=0.005)
    assert table.loc["mean", "lost"] == table.loc["box", "lost"] == 1


def test_recovery_table_says_what_happened_unseen(made):
    table = run_plots.recovery_table(made.run, made.evaluation)
    for row in table.itertuples(index=False):
        name, hidden_s, back_s, moved_cm, turned_deg, frames = row
        obj = made.run.objects[name]
        gone, back = np.searchsorted(obj.time_s, [hidden_s - 0.005, back_s - 0.005])
        before, after = obj.T_cam_model[gone - 1], obj.T_cam_model[back]
        assert moved_cm == pytest.approx(100 * np.linalg.norm(after[:3, 3] - before[:3, 3]), abs=0.06)
        turn = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).magnitude()
        assert turned_deg == pytest.approx(np.degrees(turn), abs=0.06)
        assert frames == 0  # the truth is back at once
        assert not obj.has_pose[gone:back].any()
