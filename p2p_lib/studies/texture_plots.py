"""Texture, tracks and poses: pictures with tracks coloured by their error, and what goes with what.

Studies (:class:`~p2p_lib.studies.texture.ObjectTexture`) and their measures come by label, which is the contrast
of a print or the name of a real object; contrasts are drawn in the order given, dark to bright.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import panels
from p2p_lib.figures.scenes import Scene
from p2p_lib.studies.texture import Measure, ObjectTexture, RankCorrelation, correlate

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from pandas import DataFrame

_WIDTH_IN = 8.0
#: Tracks this far off or farther are drawn in the brightest colour.
FAR_PX = 8.0
#: What the labels of the synthetic studies are.
LEGEND = "contrast of the print, synthetic"
_TEXTURE = "mean Sobel gradient in the mask [grey levels / px]"
_TRACK, _ADD = "median 2D track error [px]", "ADD AUC [%]"


def draw_tracks(
    scene: Scene, study: ObjectTexture, index: int, region_px: tuple[int, int, int, int], width_px: int = 260
) -> np.ndarray:
    """Frame ``index``, cut to a region: true box white and dashed, estimate in colour, a dot per keypoint in sight.

    Dots are where the tracker has the keypoints, coloured by how far that is from the truth: dark blue is right,
    yellow is off by :data:`FAR_PX` or more.
    """
    image = scene.draw(scene.row(index), region_px, width_px, axes=False, trail=0)
    camera = scene.sequence.camera
    _, seen_by = overlay.zoomed(scene.sequence.frame(index).rgb, camera, region_px, width_px)
    scale = np.array([seen_by.fx / camera.fx, seen_by.fy / camera.fy])
    shift = np.array([seen_by.cx, seen_by.cy]) - scale * [camera.cx, camera.cy]
    here = study.tracks.select(study.tracks.frame == index)
    return overlay.draw_points(image, scale * here.uv_px + shift, overlay.value_colours(here.error_px, 0, FAR_PX), 3)


def texture_story(pictures: Mapping[str, np.ndarray], measures: Mapping[str, Sequence[Measure]], title: str) -> Figure:
    """The page's one figure: pictures side by side, and below them track error and ADD against visible texture."""
    from matplotlib.figure import Figure

    with style.applied():
        high = _WIDTH_IN / len(pictures) * max(p.shape[0] / p.shape[1] for p in pictures.values())
        figure = Figure((_WIDTH_IN, high + 3.3), layout="constrained")
        top, bottom = figure.subfigures(2, 1, height_ratios=[high + 0.45, 2.85])
        for axis, (label, picture) in zip(np.atleast_1d(top.subplots(1, len(pictures))), pictures.items()):
            axis.imshow(picture)
            axis.set_title(label, fontsize=9)
            axis.set_axis_off()
        axes = bottom.subplots(1, 2)
        _against_texture(axes, measures, size=55)
        handles, labels = axes[0].get_legend_handles_labels()
        bottom.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8, title=LEGEND)
        top.suptitle(title, x=0.01, ha="left", fontsize=9)
    return figure


def windows_against_texture(
    windows: Mapping[str, Sequence[Measure]], correlations: Sequence[RankCorrelation] = ()
) -> Figure:
    """Every window of every study; above the panels the rank correlations with track error and with ADD AUC."""
    with style.applied():
        figure, axes = panels(2, (_WIDTH_IN, 3.4), [1, 1], side_by_side=True)
        _against_texture(axes, windows, size=16)
        for axis, found in zip(axes, correlations):
            axis.set_title(f"Spearman {found.rho:+.2f}, 95 % [{found.low:+.2f}, {found.high:+.2f}], n = {found.pairs}")
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8, title=LEGEND)
    return figure


def real_against_texture(real: Mapping[str, Sequence[Measure]], synthetic: Mapping[str, Sequence[Measure]]) -> Figure:
    """Every window of real objects, a colour for each, before those of the synthetic ones in grey."""
    with style.applied():
        figure, axes = panels(2, (_WIDTH_IN, 3.4), [1, 1], side_by_side=True)
        behind = {"synthetic": [w for many in synthetic.values() for w in many]}
        _against_texture(axes, behind | dict(real), size=16, colours=[style.NEUTRAL[1], *style.OBJECTS])
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    return figure


def same_frames(windows: Mapping[str, Sequence[Measure]]) -> Figure:
    """One line per window of frames, through all contrasts: what differs along it is the contrast and nothing else.

    Where a label has windows of several sequences, those of the first are drawn.
    """
    import matplotlib

    with style.applied():
        figure, axes = panels(2, (_WIDTH_IN, 3.3), [1, 1], side_by_side=True)
        spans = sorted({(w.start, w.stop) for many in windows.values() for w in many})
        for span, colour in zip(spans, matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(spans)))):
            line = [next((w for w in many if (w.start, w.stop) == span), None) for many in windows.values()]
            for axis, key in zip(axes, ("track_px", "add_auc")):
                values = [np.nan if w is None else getattr(w, key) for w in line]
                axis.plot(values, "o-", ms=3.5, color=colour, label=f"frames {span[0]} to {span[1] - 1}")
        for axis, label in zip(axes, (_TRACK, _ADD)):
            axis.set_xticks(range(len(windows)), windows)
            axis.set(xlabel=LEGEND, ylabel=label)
        axes[0].set_yscale("log")
        axes[0].yaxis.set_major_formatter("{x:g}")
        axes[1].set_ylim(0, 102)
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def track_errors(studies: Mapping[str, ObjectTexture]) -> Figure:
    """The share of a study's tracks that lie within so many pixels of the truth."""
    with style.applied():
        figure, (axis,) = panels(1, (_WIDTH_IN, 3.0), [1])
        for (label, study), colour in zip(studies.items(), _colours(len(studies))):
            error_px = np.sort(study.tracks.error_px)
            share = np.arange(1, len(error_px) + 1) / max(len(error_px), 1)
            axis.step(error_px, 100 * share, where="post", color=colour, label=f"{label} ({len(error_px)} answers)")
        axis.set(xscale="log", xlim=(0.05, 200), ylim=(0, 101))
        axis.set(xlabel="distance from the true place [px]", ylabel="tracks within [%]")
        axis.xaxis.set_major_formatter("{x:g}")
        axis.legend(loc="upper left", title=LEGEND)
    return figure


def measure_table(measures: Mapping[str, Measure | str], head: str = LEGEND) -> DataFrame:
    """A row per label: what it shows, how it was tracked, how right its pose was; or dashes and the reason."""
    from pandas import DataFrame

    rows = [
        {head: label, "why not": m}
        if isinstance(m, str)
        else {
            head: label,
            "scored frames": m.frames,
            "Sobel [grey levels/px]": round(m.texture, 2),
            "median track error [px]": round(m.track_px, 2),
            "tracks per frame": round(m.tracks, 1),
            _ADD: round(m.add_auc, 1),
            "ADD-S AUC [%]": round(m.adds_auc, 1),
            "why not": "",
        }
        for label, m in measures.items()
    ]
    table = DataFrame(rows)
    reasons = table.pop("why not")
    return table.assign(**{"why not": reasons}) if reasons.any() else table


def correlation_table(windows: Mapping[str, Sequence[Measure]], seed: int = 0) -> DataFrame:
    """A row per label: Spearman's rho of texture with track error and with ADD AUC, and its 95 % interval.

    A dash where the windows are of fewer than three objects or sequences.
    """
    from pandas import DataFrame

    rows = []
    for label, many in windows.items():
        objects = {(w.sequence, w.object) for w in many}
        row = {"": label, "windows": len(many), "sequences or objects": len(objects)}
        found = correlate(many, seed) if len(objects) > 2 else (None, None)
        for what, rho in zip(("track error", "ADD AUC"), found):
            row[f"texture and {what}"] = rho and f"{rho.rho:+.2f} [{rho.low:+.2f}, {rho.high:+.2f}]"
        rows.append(row)
    return DataFrame(rows)


def _against_texture(
    axes: Sequence[Axes], measures: Mapping[str, Sequence[Measure]], size: float, colours: Sequence | None = None
) -> None:
    """Track error and ADD AUC over texture, a colour per label."""
    for (label, many), colour in zip(measures.items(), cycle(_colours(len(measures)) if colours is None else colours)):
        for axis, key in zip(axes, ("track_px", "add_auc")):
            x, y = ([getattr(m, name) for m in many] for name in ("texture", key))
            axis.scatter(x, y, size, color=[colour], edgecolors="#333333", linewidths=0.5, label=label)
    for axis, label in zip(axes, (_TRACK, _ADD)):
        axis.set(xscale="log", xlabel=_TEXTURE, ylabel=label)
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter("")
        low, high = axis.get_xlim()
        axis.set_xticks([t for t in (0.5, 1, 2, 5, 10, 20) if low <= t <= high])
    axes[0].set_yscale("log")
    axes[0].yaxis.set_major_formatter("{x:g}")
    axes[1].set_ylim(0, 102)


def _colours(count: int) -> np.ndarray:
    """(count, 4) dark to bright, but not so bright that a line is lost on white."""
    import matplotlib

    return matplotlib.colormaps["cividis"](np.linspace(0, 0.85, max(count, 2)))[:count]
