"""Notebooks 00, 07 and 10: a run and its scores over time, and its returns after occlusion as a table.

Values in, Matplotlib figures out; nothing is shown or saved here.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np
from pandas import DataFrame, Series

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Status
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.confidence import pose_error
from p2p_lib.evaluation.protocol import Evaluation, ObjectScore
from p2p_lib.figures import style
from p2p_lib.figures.plots import WIDTH_IN, gaps, logarithmic, panels, status_intervals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ALIGNED = {"first": "aligned at the first scored frame", "all": "aligned by one constant over all frames"}
_EDGE = {"edgecolor": "#333333", "linewidth": 0.3}


@style.styled
def error_over_time(run: Run, evaluation: Evaluation) -> Figure:
    """ADD, rotation and translation error of every object over time, above its statuses.

    Only scored frames have an error. Where an object is occluded or lost its colour shades the time; a scored frame
    without a pose, whose error is infinite, is a cross at the upper edge.
    """
    names = [name for name in run.objects if name in evaluation.objects]
    colours = style.object_colours(run.objects)
    figure, axes = panels(4, (WIDTH_IN, 6.4), [3, 2, 2, 0.42 * len(run.objects)])
    for name in names:
        _draw_errors(axes, name, run.objects[name], evaluation.objects[name], colours[name])
    for axis, unit in zip(axes, ("ADD [mm]", "rotation [°]", "translation [mm]")):
        axis.set_ylabel(unit)
        _at_least_a_decade(axis)
    axes[0].legend(loc="upper left", ncols=len(names))
    axes[0].set_title(f"Error over time, {run.info['sequence']}, {_ALIGNED[evaluation.align]}")
    draw_strip(axes[3], run)
    figure.align_ylabels(axes[:3])
    return figure


@style.styled
def status_strip(run: Run) -> Figure:
    """One line per object: its status at every moment."""
    figure, (axis,) = panels(1, (WIDTH_IN, 1.0 + 0.32 * len(run.objects)))
    draw_strip(axis, run)
    axis.set_title(f"Status over time, {run.info['sequence']}")
    return figure


@style.styled
def accuracy_threshold(evaluation: Evaluation) -> Figure:
    """The fraction of scored frames below a threshold, from 0.1 mm on; the legend has the AUC (exact form)."""
    figure, axes = panels(2, (WIDTH_IN, 2.9), side_by_side=True)
    colours = style.object_colours(evaluation.info.get("objects") or evaluation.objects)
    for axis, (key, title) in zip(axes, (("add_m", "ADD"), ("adds_m", "ADD-S"))):
        for name, score in evaluation.objects.items():
            errors_m = getattr(score, key)
            threshold_m, fraction = accuracy_curve(errors_m)
            label = f"{name}: {metrics.auc_exact(errors_m):.1f} %"
            axis.step(1e3 * threshold_m, 100 * fraction, where="post", color=colours[name], label=label)
        logarithmic(axis.xaxis)
        axis.set(xlabel=f"threshold on {title} [mm]", xlim=(0.1, 1e3 * metrics.MAX_M), ylim=(0, 102))
        axis.set_title(f"{title}: AUC to {100 * metrics.MAX_M:g} cm")
        axis.legend(loc="lower right")
    axes[0].set_ylabel("frames below [%]")
    figure.suptitle(evaluation.info.get("sequence"), x=0.01, ha="left", fontsize=9)
    return figure


def accuracy_curve(errors_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thresholds and the fraction of errors at or below each: the corners of the accuracy-threshold curve."""
    below = np.sort(errors_m[errors_m < metrics.MAX_M])
    fraction = np.arange(len(below) + 1) / max(len(errors_m), 1)
    return np.r_[0.0, below, metrics.MAX_M], np.r_[fraction, fraction[-1]]


@style.styled
def stage_timings(run: Run) -> Figure:
    """Mean milliseconds per stage, in frames that added a keyframe and in the others.

    The first frame, a keyframe in which prompts become masks besides, is in no mean; the legend has its total.
    """
    if len(run.timings.get("total_ms", ())) < 2:
        raise BadInput("timings", "a run without timings, or of one frame", "what p2p run wrote of two frames or more")
    key = run.timings["keyframe"][1:] > 0
    # A stage that did not run took no time.
    ms = {name: np.nan_to_num(values[1:]) for name, values in run.timings.items() if name.endswith("_ms")}
    order = sorted(ms, key=lambda name: (name == "total_ms", -ms[name].mean()))
    figure, (axis,) = panels(1, (WIDTH_IN, 0.6 + 0.36 * len(order)))
    for k, (which, colour, label) in enumerate(zip((~key, key), style.NEUTRAL, ("other frames", "keyframes"))):
        if which.any():
            means = [ms[name][which].mean() for name in order]
            at = np.arange(len(order)) + 0.4 * k - 0.2
            bars = axis.barh(at, means, 0.38, color=colour, label=f"{label} ({which.sum()})")
            axis.bar_label(bars, [f"{m:.1f}" if m else "" for m in means], padding=2, fontsize=7)
    axis.set_yticks(range(len(order)), [name.removesuffix("_ms") for name in order])
    axis.invert_yaxis()
    axis.margins(x=0.08)
    axis.grid(axis="y", visible=False)
    axis.set(xlabel="milliseconds a frame, mean")
    axis.legend(loc="upper right", title=f"not counted: the first frame, {run.timings['total_ms'][0]:.0f} ms")
    axis.set_title(f"Where the time goes, {run.info['sequence']}, tracker {run.info['tracker']}")
    return figure


def _draw_errors(axes: list[Axes], name: str, obj: ObjectRun, score: ObjectScore, colour: str) -> None:
    """One object's three lines over all frames; what is not scored is left out."""
    add_mm = 1e3 * Series(score.add_m, score.frame_index).reindex(obj.frame_index).to_numpy()
    failed = np.isinf(add_mm)
    for axis, values in zip(axes, (np.where(failed, np.nan, add_mm), *pose_error(obj, score))):
        # The frame of the alignment has no error at all, which a logarithm cannot show: below a micrometre is none.
        shown = np.where(~np.isnan(add_mm) & (values > 1e-3), values, np.nan)
        axis.plot(obj.time_s, shown, color=colour, marker=".", markersize=2.5, label=name)
        for start, stop in gaps(obj):
            axis.axvspan(*_span_s(obj, start, stop), color=colour, alpha=0.13, lw=0)
    if failed.any():  # an empty line would claim the figure's corner for itself
        look = {"color": colour, "markersize": 4, "transform": axes[0].get_xaxis_transform(), "clip_on": False}
        axes[0].plot(obj.time_s[failed], np.full(failed.sum(), 0.97), "x", **look)


def _at_least_a_decade(axis: Axes) -> None:
    """A logarithmic axis on which a drift of a millimetre and a flip of the object both have their place."""
    values = np.concatenate([line.get_ydata() for line in axis.get_lines() if line.get_marker() != "x"])
    values = values[np.isfinite(values)]
    low, high = (values.min(), values.max()) if len(values) else (1.0, 10.0)
    logarithmic(axis.yaxis)
    axis.set_ylim(min(low / 1.6, high / 6), max(high * 1.6, low * 6))


def draw_strip(axis: Axes, run: Run, named: Iterable[str] | None = None) -> None:
    """Statuses as coloured, hatched bars, a line per object; a legend of those ``named``, else of those that occur."""
    from matplotlib.patches import Patch

    names, occurring, times_s = list(run.objects), set(), []
    for k, obj in enumerate(run.objects.values()):
        for status, start, stop in status_intervals(obj.status):
            fill, hatch = style.STATUS[Status(status)]
            left, right = _span_s(obj, start, stop)
            axis.barh(k, right - left, 0.72, left, color=fill, hatch=hatch, **_EDGE)
            occurring.add(status)
            times_s += [left, right]
    axis.set_yticks(range(len(names)), names)
    for label, colour in zip(axis.get_yticklabels(), style.object_colours(names).values()):
        label.set(color=colour, fontweight="bold")
    axis.invert_yaxis()
    axis.grid(visible=False)
    axis.spines["left"].set_visible(False)
    axis.tick_params(left=False)
    axis.set_xlabel("time [s]", loc="left")
    axis.set_xlim(min(times_s), max(times_s))
    patches = [
        Patch(facecolor=fill, hatch=hatch, label=str(status), **_EDGE)
        for status, (fill, hatch) in style.STATUS.items()
        if str(status) in (occurring if named is None else named)
    ]
    if patches:
        axis.figure.legend(handles=patches, loc="outside lower right", ncols=len(patches), fontsize=8)


def _span_s(obj: ObjectRun, start: int, stop: int) -> tuple[float, float]:
    """The time that rows [start, stop) last: up to the next frame, and as long as the last one at the end."""
    end = obj.time_s[stop] if stop < len(obj) else 2 * obj.time_s[-1] - obj.time_s[-2] if len(obj) > 1 else 1.0
    return float(obj.time_s[start]), float(end)


def recovery_table(run: Run, evaluation: Evaluation) -> DataFrame:
    """A row per return after complete occlusion: when, how far the object had moved unseen, how soon it had a pose.

    A good pose is one with an ADD-S of at most 2 cm; a dash where there was none before the object was hidden again.
    """
    rows = []
    for name, score in evaluation.objects.items():
        obj = run.objects[name]
        for event in score.returns:
            gone, back = np.searchsorted(obj.frame_index, [event.hidden_frame, event.return_frame])
            T_before, T_after = obj.T_cam_model[gone - 1], obj.T_cam_model[back]
            row = {
                "object": name,
                "hidden at [s]": obj.time_s[gone].round(2),
                "back at [s]": obj.time_s[back].round(2),
                "moved unseen [cm]": (100 * np.linalg.norm(T_after[:3, 3] - T_before[:3, 3])).round(1),
                "turned unseen [°]": np.degrees(se3.angle_rad(se3.inverse(T_before) @ T_after)).round(1),
                "frames to a good pose": event.frames_to_recovery,
            }
            rows.append(row)
    return DataFrame(rows)
