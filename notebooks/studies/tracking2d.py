"""Notebook 01: 2D trackers on the same queries, beside the truth: on the video, over time, and their uncertainty."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from pandas import DataFrame

from p2p_lib.core.config import preset
from p2p_lib.core.errors import MissingBackend
from p2p_lib.core.types import Status
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.point_tracks import FOUND_PX, after_query
from p2p_lib.evaluation.tracker_score import TrackerScore, TrackTask
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import WIDTH_IN, logarithmic, panels, status_intervals


class QueryOutcome(IntEnum):
    """What came of asking for a point in a frame."""

    NOT_ASKED = 0
    HIDDEN = 1  # it is, and the tracker says so
    RIGHT = 2  # visible and found within 8 px
    MISSED = 3  # visible, but called hidden
    WRONG = 4  # called visible where it is not


#: Colour and words of what came of asking for a point: right is the quiet one, wrong the colour of lost.
_OUTCOMES = {
    QueryOutcome.RIGHT: ("#CFCFCF", f"found within {FOUND_PX:.0f} px"),
    QueryOutcome.MISSED: ("#222222", "visible, but called hidden"),
    QueryOutcome.WRONG: (style.STATUS[Status.LOST][0], "called visible where it is not"),
    QueryOutcome.HIDDEN: ("#FFFFFF", "hidden, and known to be"),
}
_MIN_ABSENCE = 15  # frames


def compare_trackers(
    task: TrackTask,
    contestants: Mapping[str, tuple[str, Mapping[str, Any]]],
    left_out: Mapping[str, str] | None = None,
) -> dict[str, TrackerScore | str]:
    """The same queries to several trackers: a score by label, or the reason why there is none.

    contestants  label to tracker and settings, e.g. ``"SH(10)": ("builtin", {"tracking.forget_after": 10})``
    left_out     labels that are not to run, with the reason
    """
    scores: dict[str, TrackerScore | str] = dict(left_out or {})
    for label, (name, settings) in contestants.items():
        if label not in scores:
            try:
                scores[label] = task.score(task.tracker(name, preset(seed=task.seed).with_values(dict(settings))))
            except MissingBackend as error:
                scores[label] = str(error)
    return {label: scores[label] for label in contestants}


def tracker_table(scores: Mapping[str, TrackerScore | str]) -> DataFrame:
    """A row per tracker; one that did not run has dashes and the reason."""
    rows = []
    for label, score in scores.items():
        row: dict[str, Any] = {"tracker": label}
        if isinstance(score, TrackerScore):
            plain = score.as_dict()
            row |= {"AJ": plain["aj"], "delta_avg": plain["delta_avg"], "OA": plain["oa"]}
            found = plain["redetection"]["found_same_view"]
            row["found again [%]"] = np.nan if found is None else round(100 * found, 1)
            row["CPU [ms/frame]"] = round(plain["cpu_ms"]["mean"], 1)
        rows.append({**row, "why not": score if isinstance(score, str) else ""})
    return DataFrame(rows).round(3)


def outcomes(
    uv_true: np.ndarray, visible_true: np.ndarray, uv_px: np.ndarray, visible: np.ndarray, scored: np.ndarray
) -> np.ndarray:
    """(T, N) uint8 of :class:`QueryOutcome`; pixels are those of the image as it is."""
    near = visible_true & (np.linalg.norm(uv_px - uv_true, axis=-1) < FOUND_PX)
    outcome = np.where(near, QueryOutcome.RIGHT, QueryOutcome.WRONG)
    silent = np.where(visible_true, QueryOutcome.MISSED, QueryOutcome.HIDDEN)
    return np.where(scored, np.where(visible, outcome, silent), QueryOutcome.NOT_ASKED).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Reliability:
    """How far off predictions are, by how uncertain they said they were: bins of equally many predictions.

    uncertainty  (B,) median of the bin
    median_px, p90_px  (B,) error that half, and nine in ten, of the bin stay below
    rank_correlation  Spearman's, of uncertainty and error over all predictions
    """

    uncertainty: np.ndarray
    median_px: np.ndarray
    p90_px: np.ndarray
    rank_correlation: float


def reliability(error_px: np.ndarray, uncertainty: np.ndarray) -> Reliability:
    """Errors (M,) of predictions against their uncertainty (M,); equal uncertainties stay in one order."""
    from scipy.stats import spearmanr

    parts = [part for part in np.array_split(np.argsort(uncertainty, kind="stable"), 10) if len(part)]
    return Reliability(
        np.array([np.median(uncertainty[part]) for part in parts]),
        np.array([np.median(error_px[part]) for part in parts]),
        np.array([np.quantile(error_px[part], 0.9) for part in parts]),
        float(spearmanr(uncertainty, error_px).statistic) if len(error_px) > 1 else float("nan"),
    )


def score_outcomes(score: TrackerScore) -> np.ndarray:
    """(T, N) uint8 of :class:`QueryOutcome`: what came of every query in every frame."""
    truth, run = score.truth, score.run
    scored = after_query(score.queries.frame, len(truth.uv_px)) & truth.known
    return outcomes(truth.uv_px, truth.visible, run.uv_px, run.visible, scored)


def score_reliability(score: TrackerScore) -> Reliability:
    """Reliability of the uncertainty over all predictions that are called visible of points that are."""
    truth, run = score.truth, score.run
    both = run.visible & truth.visible & truth.known & np.isfinite(run.uv_px[..., 0])
    error_px = np.linalg.norm(run.uv_px[both] - truth.uv_px[both], axis=-1)
    return reliability(error_px, run.uncertainty[both])


class TrackScene:
    """A tracker's answers on the video that it was asked about, ready to be drawn."""

    def __init__(self, sequence: Sequence, score: TrackerScore):
        self.sequence, self.score = sequence, score
        self.outcomes = score_outcomes(score)
        self._colours = style.object_colours(sequence.objects)
        self._points = {name: score.queries.points.object == k for k, name in enumerate(sequence.truth)}
        self.region_px = overlay.region_around(score.truth.uv_px[score.truth.visible], sequence.camera, (24, 24))

    def draw(self, index: int, width_px: int = 480, trail: int = 12) -> np.ndarray:
        """Frame ``index`` around the points: dots in the object's colour are right, vermillion rings are wrong.

        Small dark dots are missed points at their true place, lines the right part of the last ``trail`` frames.
        """
        frame, camera, score = self.sequence.frame(index), self.sequence.camera, self.score
        image, seen_by = overlay.zoomed(frame.rgb, camera, self.region_px, width_px)
        uv_px, true_px = (overlay.zoomed_px(uv, camera, seen_by) for uv in (score.run.uv_px, score.truth.uv_px))
        past, came = slice(max(index - trail, 0), index + 1), self.outcomes[index]
        path_px = np.where((self.outcomes[past] == QueryOutcome.RIGHT)[..., None], uv_px[past], np.nan)
        for name, points in self._points.items():
            right, missed, wrong = (
                points & (came == k) for k in (QueryOutcome.RIGHT, QueryOutcome.MISSED, QueryOutcome.WRONG)
            )
            image = overlay.draw_trail(image, path_px[:, right].swapaxes(0, 1), self._colours[name], 1)
            image = overlay.draw_points(image, true_px[index, missed], _OUTCOMES[QueryOutcome.MISSED][0], 0.7)
            image = overlay.draw_points(image, uv_px[index, right], self._colours[name], 2.5)
            image = overlay.draw_points(image, uv_px[index, wrong], _OUTCOMES[QueryOutcome.WRONG][0], 4, filled=False)
        kinds = (QueryOutcome.RIGHT, QueryOutcome.WRONG, QueryOutcome.MISSED)
        counts = ", ".join(f"{(came == k).sum()} {k.name.lower()}" for k in kinds)
        return overlay.draw_caption(image, f"{frame.time_s:.2f} s: {counts}")

    def story(self, count: int = 6, columns: int = 3, width_px: int = 400) -> np.ndarray:
        """One sheet of frames: before, while and after all points of an object are hidden."""
        return overlay.montage([self.draw(i, width_px) for i in self.moments(count)], columns)

    def absences(self) -> list[tuple[str, int, int]]:
        """Objects and spans [start, stop) of frames in which truth sees none of their points, by their start."""
        found = []
        for name, points in self._points.items():
            spans = status_intervals(np.any(self.score.truth.visible[:, points], 1))
            found += [(name, a, b) for seen, a, b in spans if seen == "False" and a > 0 and b - a >= _MIN_ABSENCE]
        return sorted(found, key=lambda span: span[1])

    def moments(self, count: int) -> list[int]:
        """Frames that tell the story: for each absence just before, its middle, and soon after the return."""
        last, spans = len(self.sequence) - 1, [(a, b) for _, a, b in self.absences()]
        wanted = [max(a - 12, 1) for a, _ in spans] + [(a + b) // 2 for a, b in spans]
        wanted += [min(b + 12, last) for _, b in spans]
        fill = np.linspace(last // 4, last, count).astype(int).tolist()
        return sorted(list(dict.fromkeys(wanted + fill))[:count])


@style.styled
def found_over_time(scores: Mapping[str, TrackerScore | str], times_s: np.ndarray) -> Figure:
    """Share of the points in sight that each tracker has, over time; below it how many are in sight."""
    ran = {label: score for label, score in scores.items() if isinstance(score, TrackerScore)}
    figure, (axis, below) = panels(2, (WIDTH_IN, 3.8), [3, 1])
    for colour, (label, score) in zip(style.METHODS, ran.items(), strict=False):
        came = score_outcomes(score)
        in_sight = ((came != QueryOutcome.NOT_ASKED) & score.truth.visible).sum(1)
        share = np.where(in_sight > 0, (came == QueryOutcome.RIGHT).sum(1) / np.maximum(in_sight, 1), np.nan)
        known = {"color": style.NEUTRAL[0], "ls": "--"} if label == "oracle" else {"color": colour}
        axis.plot(times_s, 100 * share, label=label, **known)
    below.fill_between(times_s, in_sight, color=style.NEUTRAL[1], lw=0)
    axis.set(ylabel=f"within {FOUND_PX:.0f} px [%]", ylim=(0, 103))
    axis.set_title(f"Points in sight that are found, {next(iter(ran.values())).info['sequence']}")
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower right", ncols=len(ran), fontsize=8)
    below.set(ylabel="in sight", xlim=(times_s[0], times_s[-1]), ylim=(0, None))
    below.set_xlabel("time [s]", loc="left")
    figure.align_ylabels([axis, below])
    return figure


@style.styled
def outcome_bands(scores: Mapping[str, TrackerScore], times_s: np.ndarray) -> Figure:
    """Every query as a line of time, one panel per tracker: found, missed, wrong, hidden.

    Lines are sorted by object, then by query frame; a point has the same line in all panels.
    """
    colours = ListedColormap(["#F3F3F3", *(_OUTCOMES[k][0] for k in sorted(_OUTCOMES))])
    figure, axes = panels(len(scores), (WIDTH_IN, 1.0 + 1.7 * len(scores)))
    for axis, (label, score) in zip(axes, scores.items(), strict=True):
        order = np.lexsort([score.queries.frame, score.queries.points.object])
        extent = (times_s[0], times_s[-1], len(order), 0)
        pixels = {"vmin": 0, "vmax": 4, "aspect": "auto", "interpolation": "nearest", "extent": extent}
        axis.imshow(score_outcomes(score)[:, order].T, colours, **pixels)
        axis.set(title=label, ylabel="points")
        axis.grid(visible=False)
    axes[-1].set_xlabel("time [s]", loc="left")
    edge = {"edgecolor": "#333333", "linewidth": 0.3}
    patches = [Patch(facecolor=fill, label=words, **edge) for fill, words in _OUTCOMES.values()]
    figure.legend(handles=patches, loc="outside lower right", ncols=2, fontsize=8)
    return figure


@style.styled
def reliability_plot(rows: Mapping[str, Reliability], uncertain_px: Mapping[str, float]) -> Figure:
    """Actual error against stated uncertainty, one panel per tracker.

    uncertain_px  trackers whose uncertainty states a standard deviation, and the one that they call 1/2
                  (``tracking.uncertain_px``): a dashed line shows what they state
    """
    figure, axes = panels(len(rows), (WIDTH_IN, 3.4), side_by_side=True)
    for axis, (label, row) in zip(axes, rows.items(), strict=True):
        # The colour that it has beside all the others.
        colour = style.METHODS[2 if label == "plain LK" else 0]
        axis.fill_between(row.uncertainty, row.median_px, row.p90_px, color=colour, alpha=0.2, lw=0)
        axis.plot(row.uncertainty, row.median_px, "o-", color=colour, markersize=4, label="half are nearer")
        axis.plot(row.uncertainty, row.p90_px, "^-", color=colour, markersize=4, lw=0.8, label="nine in ten are")
        if label in uncertain_px:
            stated_px = uncertain_px[label] * row.uncertainty / (1 - row.uncertainty)
            axis.plot(row.uncertainty, stated_px, "--", color=style.NEUTRAL[0], label="standard deviation stated")
        axis.set(xlabel=r"uncertainty $\sigma_t$", title=f"{label}: rank correlation {row.rank_correlation:.2f}")
        logarithmic(axis.yaxis)
    low, high = zip(*(axis.get_ylim() for axis in axes))
    for axis in axes:
        axis.set_ylim(min(low), max(high))
    axes[0].set_ylabel("error [px]")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower right", ncols=3, fontsize=8)
    return figure
