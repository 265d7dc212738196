"""The sampling objective as maps, what choices of points are worth, and the life of a keypoint map's points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.image import nearest_px
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Status
from p2p_lib.datasets.sequence import Sequence as Video
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import panels
from p2p_lib.method.sampling import Terms, choose, distance_px, terms
from p2p_lib.studies.map_history import MapHistory
from p2p_lib.studies.sampling_study import ChoiceScore, Situation, compare_choices, greedy_terms

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_WIDTH_IN = 8.0
_TERMS = (r"$\lambda\, s$", r"$(1-\lambda)\min(d/r_{ideal}, 1)$", r"$-\beta\,\rho(d)$", r"$J$")
# A point whose measured depth is off by more lies on a side that cannot be seen.
_IN_SIGHT_M = 0.01
_TERM_COLOURS = ("#0072B2", "#56B4E9", "#D55E00")


def term_maps(situation: Situation, candidates: Candidates, after: Sequence[int]) -> Figure:
    """The terms of J and their sum once so many points are chosen, one row each.

    The score exists where the detector offers a candidate: dots. The other terms exist everywhere on the object.
    Rings are what is chosen already, the cross is what is taken next.
    """
    from matplotlib.figure import Figure

    config, (left, top, right, bottom) = situation.config.sampling, region(situation.mask)
    chosen = choose(candidates, np.zeros((0, 2)), config.points, config)
    v, u = np.mgrid[top:bottom, left:right]
    pixels = np.stack([u.ravel(), v.ravel()], 1).astype(float)
    outside = ~situation.mask[top:bottom, left:right]
    grey = cv2.cvtColor(situation.frame.rgb[top:bottom, left:right], cv2.COLOR_RGB2GRAY)
    extent = (left - 0.5, right - 0.5, bottom - 0.5, top - 0.5)
    height = 1.75 * (bottom - top) / (right - left)
    with style.applied():
        figure = Figure((_WIDTH_IN, 0.9 + len(after) * (height + 0.25)), layout="constrained")
        axes = figure.subplots(len(after), 4, squeeze=False)
        limits = [(0, config.score_weight), (0, 1 - config.score_weight), (-config.cluster_weight, 0), (-0.5, 1)]
        for line, (row, k) in enumerate(zip(axes, after, strict=True)):
            taken = candidates.uv_px[chosen[:k]]
            dense = terms(np.zeros(len(pixels)), distance_px(pixels, taken), config)
            dots = terms(candidates.score, distance_px(candidates.uv_px, taken), config)
            for n, (axis, (low, high)) in enumerate(zip(row, limits, strict=True)):
                axis.imshow(grey, "gray", vmin=-150, vmax=300, extent=extent)
                colours = {"cmap": "cividis", "vmin": low, "vmax": high}
                if n in (1, 2):
                    values = (dense.spread, dense.crowding)[n - 1].reshape(outside.shape)
                    shown = axis.imshow(np.ma.masked_array(values, outside), extent=extent, **colours)
                else:
                    values = dots.trackability if n == 0 else dots.total
                    order = np.argsort(values)
                    shown = axis.scatter(*candidates.uv_px[order].T, 7, values[order], linewidths=0, **colours)
                if n != 2:  # a ring would hide the few pixels that crowding is about
                    axis.scatter(*taken.T, 26, facecolors="none", edgecolors="black", linewidths=1.8)
                    axis.scatter(*taken.T, 26, facecolors="none", edgecolors="white", linewidths=0.9)
                if k < len(chosen):
                    following = candidates.uv_px[chosen[k]]
                    axis.plot(*following, "x", color="black", markersize=8, markeredgewidth=3)
                    axis.plot(*following, "x", color=style.AXES[0], markersize=7, markeredgewidth=1.6)
                axis.set(xticks=[], yticks=[], xlim=(left, right), ylim=(bottom, top))
                axis.spines[:].set_visible(False)
                if not line:
                    axis.set_title(_TERMS[n], fontsize=9, loc="center")
                if line == len(after) - 1:
                    figure.colorbar(shown, ax=axes[:, n], location="bottom", shrink=0.85, aspect=18, pad=0.02)
            row[0].set_ylabel(f"after {k}")
        figure.suptitle(f"{situation.video.name}, {situation.name}, frame {situation.frame.index}", x=0.01, ha="left")
    return figure


def greedy_plot(situation: Situation, candidates: Candidates) -> tuple[Figure, Terms]:
    """What every choice was worth when taken, and the terms, if choosing went on until nothing is worth its cost.

    The dotted line is K, after which the pipeline stops.
    """
    config = situation.config.sampling
    nothing = np.zeros((0, 2))
    chosen = choose(candidates, nothing, len(candidates.score), config)
    parts = greedy_terms(candidates, chosen, nothing, config)
    k = np.arange(1, len(chosen) + 1)
    with style.applied():
        figure, (axis,) = panels(1, (_WIDTH_IN, 3.0), [1])
        upper = parts.trackability + parts.spread
        zero = np.zeros(len(k))
        layers = ((zero, parts.trackability), (parts.trackability, upper), (parts.crowding, zero))
        for (low, high), colour, label in zip(layers, _TERM_COLOURS, _TERMS, strict=False):
            axis.fill_between(k, low, high, step="mid", color=colour, lw=0, label=label)
        axis.plot(k, parts.total, color="black", lw=1.2, label=_TERMS[3])
        axis.axvline(config.points + 0.5, color="black", lw=0.9, ls=":")
        axis.text(config.points + 2, 0.97, f"K = {config.points}", va="top", transform=axis.get_xaxis_transform())
        axis.set(xlabel=f"choice, of {len(candidates.score)} candidates", ylabel="worth", xlim=(0.5, len(k) + 0.5))
        axis.set_title(f"What each choice was worth when it was taken, {situation.video.name}, {situation.name}")
        figure.legend(*axis.get_legend_handles_labels(), loc="outside lower right", ncols=4, fontsize=8)
    return figure, parts


def choice_sheet(situation: Situation, scores: Sequence[ChoiceScore], columns: int = 3, width_px: int = 300) -> Any:
    """What each way chose in a situation, side by side."""
    colour = style.object_colours(situation.video.objects)[situation.name]
    box = region(situation.mask)
    pictures = []
    for score in scores:
        image, seen_by = overlay.zoomed(situation.frame.rgb, situation.video.camera, box, width_px)
        s = seen_by.fx / situation.video.camera.fx
        uv = (score.uv_px - [box[0], box[1]] + 0.5) * s - 0.5
        pictures.append(overlay.draw_caption(overlay.draw_points(image, uv, colour, 4), score.label, 0.5))
    return overlay.montage(pictures, columns)


def choice_table(scores: Sequence[ChoiceScore]) -> DataFrame:
    """Means over the situations, a row per way to choose."""
    from pandas import DataFrame

    rows = []
    for label in dict.fromkeys(score.label for score in scores):
        mine = [score for score in scores if score.label == label]
        kept = [s.kept for s in mine if np.isfinite(s.kept)]
        shares = 100 * np.mean([s.coverage for s in mine]), 100 * np.mean(kept) if kept else np.nan
        held = np.mean([s.turn_deg for s in mine]), 1e3 * np.mean([s.error_m for s in mine])
        rows.append((label, round(shares[0], 1), round(held[0], 3), round(held[1], 3), round(shares[1], 1)))
    heads = ("choice", "covered [%]", "worst turn [°]", "pose error [mm]", "still tracked [%]")
    return DataFrame(rows, columns=heads)


def choice_plot(table: DataFrame) -> Figure:
    """The table as dots: more is better left and right, less in the middle."""
    columns = {
        "covered [%]": "more is better",
        "pose error [mm]": "less is better",
        "still tracked [%]": "more is better",
    }
    with style.applied():
        figure, axes = panels(3, (_WIDTH_IN, 2.6), [1] * 3, side_by_side=True)
        rows = np.arange(len(table))
        for axis, (column, sense) in zip(axes, columns.items(), strict=True):
            colours = [_TERM_COLOURS[0] if label == "J" else style.NEUTRAL[0] for label in table["choice"]]
            axis.scatter(table[column], rows, 40, colours, zorder=3)
            axis.axvline(table[column][0], color=_TERM_COLOURS[0], lw=0.8, ls=":")
            axis.set_yticks(rows, table["choice"] if axis is axes[0] else [""] * len(rows))
            axis.invert_yaxis()
            axis.set_xlabel(column)
            axis.set_title(sense, fontsize=8)
            axis.margins(x=0.15)
    return figure


def spacing_plot(
    situations: Sequence[Situation], r_ideal_px: Sequence[float], frames_on: int = 0
) -> tuple[Figure, DataFrame]:
    """Coverage and conditioning against r_ideal, means over situations; and the numbers."""
    ways = {f"{r:g}": ("corners", {"sampling.r_ideal_px": float(r)}) for r in r_ideal_px}
    table = choice_table(compare_choices(situations, ways, frames_on=frames_on))
    with style.applied():
        figure, axes = panels(2, (_WIDTH_IN, 2.5), [1, 1], side_by_side=True)
        for axis, column in zip(axes, ("covered [%]", "pose error [mm]"), strict=True):
            axis.plot(r_ideal_px, table[column], "o-", color=style.NEUTRAL[0], markersize=4)
            axis.axvline(situations[0].config.sampling.r_ideal_px, color=style.NEUTRAL[0], lw=0.8, ls=":")
            axis.set(xlabel=r"$r_{ideal}$ [px]", ylabel=column, xscale="log")
            axis.set_xticks(list(r_ideal_px), [f"{r:g}" for r in r_ideal_px])
            axis.xaxis.set_minor_locator(_no_ticks())
    return figure, table


def life_lines(history: MapHistory, video: Video) -> Figure:
    """Every point of a map as a line of time: hollow while pending, filled as a keypoint, ended when retired."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    colour = style.object_colours(video.objects)[history.name]
    order, total = np.lexsort([history.promoted, history.born]), len(history.keyframe)
    born, gone = history.born[order], history.gone[order]
    keypoint = np.minimum(history.promoted[order], gone)
    fill, _ = style.STATUS[Status.INITIALISING]
    with style.applied():
        figure, (axis,) = panels(1, (_WIDTH_IN, 4.2), [1])
        rows = np.arange(len(order))
        pending = {"color": fill, "edgecolor": "#333333", "linewidth": 0.3}
        axis.barh(rows, keypoint - born, 1.0, born, **pending)
        axis.barh(rows, gone - keypoint, 1.0, keypoint, color=colour)
        ended = gone < total
        axis.plot(gone[ended], rows[ended], "x", color=style.STATUS[Status.LOST][0], markersize=3)
        for t in np.flatnonzero(history.keyframe):
            axis.axvline(t, color=style.NEUTRAL[1], lw=0.7, zorder=0)
        axis.set(xlabel="frame", ylabel="points by birth", xlim=(0, total), ylim=(len(order), -1))
        axis.grid(visible=False)
        axis.set_title(f"Life of the map of {history.name}, {video.name}: {len(order)} points")
        handles = [
            Patch(facecolor=fill, edgecolor="#333333", linewidth=0.4, label="pending"),
            Patch(facecolor=colour, label="keypoint"),
            Line2D([], [], marker="x", ls="", color=style.STATUS[Status.LOST][0], markersize=4, label="retired"),
            Line2D([], [], color=style.NEUTRAL[1], lw=0.7, label="keyframe"),
        ]
        figure.legend(handles=handles, loc="outside lower right", ncols=4, fontsize=8)
    return figure


def promotion_sheet(video: Video, history: MapHistory, frames: Sequence[int], width_px: int = 300) -> Any:
    """The part of the map that is in sight, on the video at a few frames: pending points are rings, keypoints dots."""
    colour = style.object_colours(video.objects)[history.name]
    masks = [(video.masks(t) or {})[history.name] for t in frames]
    box = region(np.logical_or.reduce(masks))
    pictures = []
    for t in frames:
        frame = video.frame(t)
        image, seen_by = overlay.zoomed(frame.rgb, video.camera, box, width_px)
        alive = (history.born <= t) & (t < history.gone)
        promoted = history.promoted <= t
        p_obj = np.where(promoted[:, None], history.p_promoted, history.p_born)
        p_cam = se3.transform(history.T_cam_obj[t], p_obj)
        u, v = nearest_px(video.camera.project(p_cam), frame.shape)
        alive &= np.abs(frame.depth_m[v, u] - p_cam[:, 2]) < _IN_SIGHT_M
        uv = seen_by.project(p_cam)
        image = overlay.draw_points(image, uv[alive & promoted], colour, 3)
        image = overlay.draw_points(image, uv[alive & ~promoted], style.TRUTH, 4, filled=False)
        said = f"{t}: {(alive & promoted).sum()} keypoints, {(alive & ~promoted).sum()} pending"
        pictures.append(overlay.draw_caption(image, said, 0.4))
    return overlay.montage(pictures, len(frames))


def promotion_moments(history: MapHistory, count: int = 4) -> list[int]:
    """Frames from the keyframe that brought most points which were promoted, until nine in ten of them were."""
    late = ~history.founding & (history.promoted < len(history.keyframe))
    births, counts = np.unique(history.born[late], return_counts=True)
    start = int(births[counts.argmax()])
    end = int(np.quantile(history.promoted[late & (history.born == start)], 0.9))
    return np.unique(np.linspace(start, max(end, start + count - 1), count).astype(int)).tolist()


def error_plot(histories: Mapping[str, MapHistory]) -> Figure:
    """How far points lay from the true surface point when they were born, and when they were promoted."""
    with style.applied():
        figure, (axis,) = panels(1, (_WIDTH_IN, 2.8), [1])
        for colour, (name, history) in zip(style.OBJECTS, histories.items(), strict=False):
            passed = np.isfinite(history.promoted_error_m) & ~history.founding & np.isfinite(history.born_error_m)
            for errors, line, word in (
                (history.born_error_m, "--", "when born"),
                (history.promoted_error_m, "-", "when promoted"),
            ):
                values = 1e3 * np.sort(errors[passed])
                share = 100 * np.arange(1, len(values) + 1) / max(len(values), 1)
                axis.step(values, share, line, where="post", color=colour, label=f"{name}, {word}")
        axis.set(xlabel="distance from the true point [mm]", ylabel="points below [%]", xlim=(0, None), ylim=(0, 102))
        axis.legend(loc="lower right", fontsize=8)
        axis.set_title("Points that were promoted")
    return figure


def region(mask: np.ndarray, margin_px: int = 12) -> tuple[int, int, int, int]:
    """The rectangle (left, top, right, bottom) around a mask, with a margin."""
    v, u = np.nonzero(mask)
    h, w = mask.shape
    left, top = max(u.min() - margin_px, 0), max(v.min() - margin_px, 0)
    return int(left), int(top), int(min(u.max() + margin_px + 1, w)), int(min(v.max() + margin_px + 1, h))


def _no_ticks() -> Any:
    from matplotlib.ticker import NullLocator

    return NullLocator()
