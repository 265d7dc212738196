"""2D point tracks beside the truth: on the video, over time, and how far their uncertainty can be believed."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.point_tracks import FOUND_PX, Outcome, Reliability, after_query, outcomes, reliability
from p2p_lib.evaluation.tracker_score import TrackerScore
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import panels, status_intervals

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame

_WIDTH_IN = 8.0
_WORDS = {
    Outcome.RIGHT: f"found within {FOUND_PX:.0f} px",
    Outcome.MISSED: "visible, but called hidden",
    Outcome.WRONG: "called visible where it is not",
    Outcome.HIDDEN: "hidden, and known to be",
}


class TrackScene:
    """A tracker's answers on the video that it was asked about, ready to be drawn."""

    def __init__(self, sequence: Sequence, score: TrackerScore):
        self.sequence, self.score = sequence, score
        self.outcomes = score_outcomes(score)
        names = tuple(sequence.truth)
        colours = style.object_colours(sequence.objects)
        self._points = {name: np.flatnonzero(score.queries.points.object == k) for k, name in enumerate(names)}
        self._colours = {name: colours[name] for name in names}

    def draw(
        self,
        index: int,
        region_px: tuple[int, int, int, int] | None = None,
        width_px: int | None = None,
        trail: int = 12,
    ) -> np.ndarray:
        """Frame ``index``: dots in the object's colour are right, vermillion rings are wrong.

        Points that truth sees and the tracker does not are small dark dots at their true place. Lines are the
        paths of the last ``trail`` frames, as far as the tracker was right in them.
        """
        frame, camera, run = self.sequence.frame(index), self.sequence.camera, self.score.run
        region_px = region_px or (0, 0, camera.width, camera.height)
        image, seen_by = overlay.zoomed(frame.rgb, camera, region_px, width_px or region_px[2] - region_px[0])
        scale = np.array([seen_by.fx / camera.fx, seen_by.fy / camera.fy])
        shift = np.array([seen_by.cx, seen_by.cy]) - scale * [camera.cx, camera.cy]
        came, first = self.outcomes[index], max(index - trail, 0)
        for name, points in self._points.items():
            on_it = run.visible & (self.outcomes == Outcome.RIGHT)
            path_px = scale * np.where(on_it[..., None], run.uv_px, np.nan)[first : index + 1, points] + shift
            uv = scale * run.uv_px[index, points] + shift
            right = came[points] == Outcome.RIGHT
            for path in path_px[:, right].transpose(1, 0, 2):
                image = overlay.draw_trail(image, path, self._colours[name], 1)
            missed = came[points] == Outcome.MISSED
            true_uv = scale * self.score.truth.uv_px[index, points[missed]] + shift
            image = overlay.draw_points(image, true_uv, style.OUTCOMES[Outcome.MISSED], 0.7)
            image = overlay.draw_points(image, uv[right], self._colours[name], 2.5)
            wrong = came[points] == Outcome.WRONG
            image = overlay.draw_points(image, uv[wrong], style.OUTCOMES[Outcome.WRONG], 4, filled=False)
        counts = ", ".join(
            f"{(came == k).sum()} {k.name.lower()}" for k in (Outcome.RIGHT, Outcome.WRONG, Outcome.MISSED)
        )
        return overlay.draw_caption(image, f"{frame.time_s:.2f} s: {counts}")

    def story(self, count: int = 6, columns: int = 3, width_px: int = 400) -> np.ndarray:
        """One sheet of frames: before, while and after all points of an object are hidden."""
        region_px = self.region()
        return overlay.montage([self.draw(i, region_px, width_px) for i in self.moments(count)], columns)

    def film(self, frames: Iterable[int], width_px: int = 480) -> Iterator[np.ndarray]:
        """The pictures of these frames, one after the other."""
        region_px = self.region()
        return (self.draw(i, region_px, width_px) for i in frames)

    def absences(self, at_least: int = 15) -> list[tuple[str, int, int]]:
        """Objects and spans [start, stop) of frames in which truth sees none of their points."""
        found = []
        for name, points in self._points.items():
            seen = self.score.truth.visible[:, points].any(1)
            spans = status_intervals(np.where(seen, "seen", "gone"))
            found += [(name, a, b) for kind, a, b in spans if kind == "gone" and a > 0 and b - a >= at_least]
        return sorted(found, key=lambda span: span[1])

    def moments(self, count: int) -> list[int]:
        """Frames that tell the story: for each absence just before, its middle, and soon after the return."""
        last = len(self.sequence) - 1
        wanted = [max(a - 12, 1) for _, a, _ in self.absences()] + [(a + b) // 2 for _, a, b in self.absences()]
        wanted += [min(b + 12, last) for _, _, b in self.absences()]
        wanted += np.linspace(last // 4, last, count).astype(int).tolist()
        return sorted(dict.fromkeys(wanted[:count] if len(set(wanted[:count])) == count else wanted))[:count]

    def region(self, margin_px: int = 24) -> tuple[int, int, int, int]:
        """Where in the picture the points are over the whole sequence: left, top, right, bottom."""
        uv, camera = self.score.truth.uv_px[self.score.truth.visible], self.sequence.camera
        left, top = np.maximum(np.floor(uv.min(0)) - margin_px, 0).astype(int)
        right, bottom = np.minimum(np.ceil(uv.max(0)) + margin_px, [camera.width, camera.height]).astype(int)
        return int(left), int(top), int(right), int(bottom)


def score_outcomes(score: TrackerScore) -> np.ndarray:
    """(T, N) uint8 of :class:`Outcome`: what came of every query in every frame."""
    truth, run = score.truth, score.run
    scored = after_query(score.queries.frame, len(truth.uv_px)) & truth.known
    return outcomes(truth.uv_px, truth.visible, run.uv_px, run.visible, scored)


def score_reliability(score: TrackerScore, bins: int = 10) -> Reliability:
    """Reliability of the uncertainty over all predictions that are called visible of points that are."""
    told = score.run.visible & score.truth.visible & score.truth.known & np.isfinite(score.run.uv_px[..., 0])
    error_px = np.linalg.norm(score.run.uv_px[told] - score.truth.uv_px[told], axis=-1)
    return reliability(error_px, score.run.uncertainty[told], bins)


def found_over_time(scores: Mapping[str, TrackerScore | str], times_s: np.ndarray) -> Figure:
    """Share of the points in sight that each tracker has, over time; below it how many are in sight."""
    ran = {label: score for label, score in scores.items() if isinstance(score, TrackerScore)}
    with style.applied():
        figure, (axis, below) = panels(2, (_WIDTH_IN, 3.8), [3, 1])
        for colour, (label, score) in zip(style.METHODS, ran.items(), strict=False):
            came = score_outcomes(score)
            right = (came == Outcome.RIGHT).sum(1)
            in_sight = right + (came == Outcome.MISSED).sum(1)
            in_sight += ((came == Outcome.WRONG) & score.truth.visible).sum(1)
            share = np.where(in_sight > 0, right / np.maximum(in_sight, 1), np.nan)
            axis.plot(times_s, 100 * share, color=colour, label=label)
        below.fill_between(times_s, in_sight, color=style.NEUTRAL[1], lw=0)
        axis.set(ylabel=f"within {FOUND_PX:.0f} px [%]", ylim=(0, 103))
        axis.set_title(f"Points in sight that are found, {next(iter(ran.values())).info['sequence']}")
        figure.legend(*axis.get_legend_handles_labels(), loc="outside lower right", ncols=len(ran), fontsize=8)
        below.set(ylabel="in sight", xlim=(times_s[0], times_s[-1]), ylim=(0, None))
        below.set_xlabel("time [s]", loc="left")
        figure.align_ylabels([axis, below])
    return figure


def outcome_bands(scores: Mapping[str, TrackerScore], times_s: np.ndarray) -> Figure:
    """Every query as a line of time, one panel per tracker: found, missed, wrong, hidden.

    Lines are sorted by object, then by query frame; a point has the same line in all panels.
    """
    from matplotlib.colors import ListedColormap
    from matplotlib.patches import Patch

    colours = ["#F3F3F3", *(style.OUTCOMES[k] for k in sorted(style.OUTCOMES))]
    with style.applied():
        figure, axes = panels(len(scores), (_WIDTH_IN, 1.0 + 1.7 * len(scores)), [1] * len(scores))
        for axis, (label, score) in zip(axes, scores.items(), strict=True):
            order = np.lexsort([score.queries.frame, score.queries.points.object])
            extent = (times_s[0], times_s[-1], len(order), 0)
            came = score_outcomes(score)[:, order].T
            axis.imshow(
                came, ListedColormap(colours), vmin=0, vmax=4, aspect="auto", interpolation="nearest", extent=extent
            )
            axis.set_title(label)
            axis.grid(visible=False)
            axis.set_ylabel("points")
        axes[-1].set_xlabel("time [s]", loc="left")
        patches = [
            Patch(facecolor=style.OUTCOMES[k], edgecolor="#333333", linewidth=0.3, label=_WORDS[k]) for k in _WORDS
        ]
        figure.legend(handles=patches, loc="outside lower right", ncols=2, fontsize=8)
    return figure


def reliability_plot(rows: Mapping[str, Reliability], uncertain_px: Mapping[str, float] | None = None) -> Figure:
    """Actual error against stated uncertainty, one panel per tracker.

    uncertain_px  trackers whose uncertainty states a standard deviation, and the one that they call 1/2
                  (``tracking.uncertain_px``): a dashed line shows what they state
    """
    with style.applied():
        figure, axes = panels(len(rows), (_WIDTH_IN, 3.4), [1] * len(rows), side_by_side=True)
        for axis, (label, row) in zip(axes, rows.items(), strict=True):
            # The colour that it has beside all the others.
            colour = style.METHODS[2 if label == "plain LK" else 0]
            axis.fill_between(row.uncertainty, row.median_px, row.p90_px, color=colour, alpha=0.2, lw=0)
            axis.plot(row.uncertainty, row.median_px, "o-", color=colour, markersize=4, label="half are nearer")
            axis.plot(row.uncertainty, row.p90_px, "^-", color=colour, markersize=4, lw=0.8, label="nine in ten are")
            if half_px := (uncertain_px or {}).get(label):
                stated_px = half_px * row.uncertainty / (1 - row.uncertainty)
                axis.plot(row.uncertainty, stated_px, "--", color=style.NEUTRAL[0], label="standard deviation stated")
            axis.set(xlabel=r"uncertainty $\sigma_t$", yscale="log")
            axis.yaxis.set_major_formatter("{x:g}")
            axis.set_title(f"{label}: rank correlation {row.rank_correlation:.2f}")
        edges = np.array([axis.get_ylim() for axis in axes])
        for axis in axes:
            axis.set_ylim(edges[:, 0].min(), edges[:, 1].max())
        axes[0].set_ylabel("error [px]")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower right", ncols=3, fontsize=8)
    return figure


def tracker_table(scores: Mapping[str, TrackerScore | str]) -> DataFrame:
    """A row per tracker; one that did not run has dashes and the reason."""
    from pandas import DataFrame

    rows = [_row(label, score) for label, score in scores.items()]
    heads = ("tracker", "AJ", "delta_avg", "OA", "found again [%]", "CPU [ms/frame]", "why not")
    return DataFrame(rows, columns=heads)


def _row(label: str, score: TrackerScore | str) -> tuple:
    if isinstance(score, str):
        return (label, *[np.nan] * 5, score)
    plain = score.as_dict()
    again, cost = plain["redetection"]["found_same_view"], plain["cpu_ms"]["mean"]
    shares = (round(plain[key], 3) for key in ("aj", "delta_avg", "oa"))
    return (label, *shares, round(100 * again, 1), round(cost, 1), "")
