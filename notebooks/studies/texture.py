"""Notebook 08: how much texture an object shows, how well its points are tracked, and how right its pose is.

The paper's analysis of texture: the mean magnitude of the Sobel gradient in the mask; the distance of 2D tracks from
the keypoints projected with true poses, where both call them visible; the area under the ADD curve. All three per
sequence or window of frames, by label: the contrast of a print, or the name of a real object.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any

import cv2
import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from pandas import DataFrame, Series, concat
from scipy import stats

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.interfaces import PointTracker, Wrapper
from p2p_lib.core.types import Frame, Tracks, joined
from p2p_lib.datasets.sequence import Sequence as Video
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.evaluation.true_tracks import NO_POINTS, TrueScene
from p2p_lib.figures import overlay, style
from p2p_lib.figures.plots import WIDTH_IN, logarithmic, panels
from p2p_lib.figures.scenes import Scene
from p2p_lib.synthetic import scenario_dir

#: The mask's outermost pixels are left out: their gradient is that of the outline, not of what is printed.
MARGIN_PX = 3
#: Tracks this far off or farther are drawn in the brightest colour.
FAR_PX = 8.0
#: What the labels of the synthetic studies are.
LEGEND = "contrast of the print, synthetic"
_TEXTURE = "mean Sobel gradient in the mask [grey levels / px]"
_TRACK, _ADD = "median 2D track error [px]", "ADD AUC [%]"
#: What is measured, and its head in a table: AUC in the exact form over 0 to 0.1 m, failures as zero.
_HEADS = {
    "frames": "scored frames",
    "texture": "Sobel [grey levels/px]",
    "track_px": "median track error [px]",
    "tracks": "tracks per frame",
    "add_auc": _ADD,
    "adds_auc": "ADD-S AUC [%]",
}


class RecordedTracker(Wrapper):
    """A 2D tracker that passes everything on to another one and keeps what it was asked and what it answered."""

    def __init__(self, tracker: PointTracker):
        self.original = tracker
        self._frames: list[int] = []
        self._queries: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._answers: list[tuple[int, Tracks]] = []

    def start(self, frame: Frame, *args, **kwargs) -> None:
        """Begin a stream, and a new record."""
        self._frames, self._queries, self._answers = [frame.index], [], []
        self.original.start(frame, *args, **kwargs)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """New queries in the newest frame that was answered."""
        ids = self.original.add(uv_px)
        self._queries.append((self._newest(), ids, np.asarray(uv_px, float).reshape(-1, 2)))
        return ids

    def track(self, frame: Frame, *args, **kwargs) -> Tracks:
        """The tracker's answer, written down with the frame that it is of."""
        self._frames.append(frame.index)
        tracks = self.original.track(frame, *args, **kwargs)
        self._answers.append((self._newest(), tracks))
        return tracks

    def _newest(self) -> int:
        """Index of the frame that the newest answer is of."""
        return self._frames[max(len(self._frames) - 1 - self.original.latency_frames, 0)]

    def keypoints(self, scene: TrueScene) -> dict[str, DataFrame]:
        """Per object whose mask a keypoint began in: ``frame``, ``u_px``, ``v_px`` and ``error_px`` of its track.

        A row where the tracker calls the keypoint visible and its surface point is truly in sight; the error is the
        distance from where the true pose puts that point.
        """
        ids, points = [np.zeros(0, np.int64)], NO_POINTS
        for index, new_ids, uv_px in self._queries:
            frame = scene.sequence.frame(index)
            ids.append(new_ids)
            points = joined([points, scene.lift(frame, scene.owners(frame, uv_px), uv_px)])
        known, found = np.concatenate(ids), []
        for index, tracks in self._answers:
            tracks = tracks.select(tracks.ids[tracks.visible])
            mine = points.select(np.searchsorted(known, tracks.ids))
            sight = scene.see(scene.sequence.frame(index), mine)
            error_px = np.linalg.norm(tracks.uv_px - sight.uv_px, axis=1)
            columns = {"frame": index, "u_px": tracks.uv_px[:, 0], "v_px": tracks.uv_px[:, 1], "error_px": error_px}
            rows = DataFrame(columns | {"owner": mine.object}, index=range(len(tracks)))
            found.append(rows[sight.visible])
        rows = concat(found, ignore_index=True)
        return {name: rows[rows.owner == k].drop(columns="owner") for k, name in enumerate(scene.objects)}


@dataclass(frozen=True, eq=False)
class ObjectTexture:
    """One object of a run, over its scored frames.

    frames  a row each: ``frame`` of the sequence; ``texture``, the mean Sobel gradient magnitude in the mask, NaN where
            it is too thin; ``add_m`` and ``adds_m``, infinite where there was no pose
    tracks  of its keypoints, in all frames, as :meth:`RecordedTracker.keypoints` gives them
    """

    sequence: str
    object: str
    frames: DataFrame
    tracks: DataFrame

    def measure(self, start: int = 0, stop: int | None = None) -> dict[str, Any]:
        """What :data:`_HEADS` names, over the frames [start, stop); :class:`MissingData` where none is scored."""
        stop = int(self.frames.frame.max()) + 1 if stop is None else stop
        rows = self.frames[self.frames.frame.between(start, stop, inclusive="left")]
        if not len(rows):
            raise MissingData(f"{self.object} of {self.sequence}", f"no scored frame from {start} to {stop}")
        error_px = self.tracks.error_px[self.tracks.frame.isin(rows.frame)]
        measured = {
            "frames": len(rows),
            "texture": rows.texture.mean(),
            "track_px": error_px.median(),
            "tracks": len(error_px) / len(rows),
            "add_auc": metrics.auc_exact(rows.add_m.to_numpy()),
            "adds_auc": metrics.auc_exact(rows.adds_m.to_numpy()),
        }
        return {"sequence": self.sequence, "object": self.object, "start": start, "stop": stop, **measured}

    def windows(self, size: int = 15) -> DataFrame:
        """A measure per window of ``size`` frames; those with fewer than half of them scored are left out."""
        first, columns = int(self.frames.frame.min()), ["sequence", "object", "start", "stop", *_HEADS]
        scored = ((self.frames.frame - first) // size).value_counts().sort_index()
        starts = [first + size * int(k) for k in scored.index[2 * scored >= size]]
        return DataFrame([self.measure(start, start + size) for start in starts], columns=columns)


def sobel_magnitude(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32: magnitude of the 3x3 Sobel gradient of the brightness, scaled to grey levels per pixel."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    across, down = (cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0))
    return cv2.magnitude(across, down)


def visible_texture(rgb: np.ndarray, mask: np.ndarray) -> float:
    """Mean Sobel gradient magnitude over a mask (H, W) without its rim; NaN where nothing of it is left."""
    side = 2 * MARGIN_PX + 1
    inner = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0) > 0
    return float(sobel_magnitude(rgb)[inner].mean()) if inner.any() else float("nan")


def fading_label(contrast: float, frames: int, seed: int = 0) -> Video:
    """``synthetic/fading_label`` at a contrast of its print: for one seed all else is the same."""
    folder = scenario_dir("fading_label", seed, contrast=float(contrast), frames=frames)
    video: Any = open_sequence(folder, "ycbmultitrack")
    return replace(video, name=f"synthetic/fading_label {seed}, contrast {contrast:g}")


def present(names: Iterable[str], left_out: str = "") -> dict[str, Video | str]:
    """The sequences of these names or folders, or the reason why there is none: ``left_out`` for all, or missing."""
    found: dict[str, Video | str] = {}
    for name in names:
        try:
            found[name] = left_out or open_sequence(name)
        except MissingData as error:
            found[name] = str(error)
    return found


def study(sequence: Video, evaluation: Evaluation, recorded: RecordedTracker) -> dict[str, ObjectTexture]:
    """Texture, tracks and pose of each object that a run of the method with a recorded tracker was scored on."""
    tracks, studies = recorded.keypoints(TrueScene.of(sequence)), {}
    for name, score in evaluation.objects.items():
        texture = []
        for i in score.frame_index.tolist():
            mask = (sequence.masks(i) or {}).get(name)
            texture.append(np.nan if mask is None else visible_texture(sequence.frame(i).rgb, mask))
        columns = {"frame": score.frame_index, "texture": texture, "add_m": score.add_m, "adds_m": score.adds_m}
        studies[name] = ObjectTexture(sequence.name, name, DataFrame(columns), tracks[name])
    return studies


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's rho of n pairs and its 95 % confidence interval, by bootstrap over independent groups of pairs."""

    rho: float
    low: float
    high: float
    pairs: int
    groups: int

    def __str__(self) -> str:
        return f"{self.rho:+.2f} [{self.low:+.2f}, {self.high:+.2f}]"


def rank_correlation(
    x: np.ndarray, y: np.ndarray, groups: Sequence | None = None, seed: int = 0, resamples: int = 2000
) -> RankCorrelation:
    """Spearman's rank correlation of x (n,) and y (n,) with a bootstrap confidence interval (percentiles).

    groups  (n,) which pairs belong together, as windows of one sequence do; by default each stands for itself

    Pairs that are not finite are left out. Raises :class:`BadInput` for fewer than three groups.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    group = np.arange(len(x)) if groups is None else np.asarray(groups)
    keep = np.isfinite(x) & np.isfinite(y)
    x, y, group = x[keep], y[keep], np.unique(group[keep], return_inverse=True)[1]
    count = int(group.max(initial=-1)) + 1
    if count < 3:
        raise BadInput("rank correlation", f"{count} independent groups", "at least three")
    members = [np.flatnonzero(group == k) for k in range(count)]

    def rho(drawn: np.ndarray) -> float:
        rows = np.concatenate([members[k] for k in drawn])
        # A draw of one value alone has no order: no correlation.
        return float(stats.spearmanr(x[rows], y[rows]).statistic) if np.ptp(x[rows]) and np.ptp(y[rows]) else 0.0

    rng = np.random.default_rng(seed)
    method = {"n_resamples": resamples, "vectorized": False, "method": "percentile", "rng": rng}
    interval = stats.bootstrap((np.arange(count),), rho, **method).confidence_interval
    return RankCorrelation(rho(np.arange(count)), float(interval.low), float(interval.high), len(x), count)


def correlate(windows: DataFrame, seed: int = 0) -> tuple[RankCorrelation, RankCorrelation]:
    """Texture with track error, and texture with ADD AUC, over windows; those of one object belong together."""
    groups = windows.sequence + ": " + windows.object
    to_tracks, to_poses = (windows[key] for key in ("track_px", "add_auc"))
    return (
        rank_correlation(windows.texture, to_tracks, groups, seed),
        rank_correlation(windows.texture, to_poses, groups, seed),
    )


def correlation_table(windows: Mapping[str, DataFrame], seed: int = 0) -> DataFrame:
    """A row per label: texture's rho with track error and with ADD AUC; a dash for fewer than three objects."""
    rows = []
    for label, many in windows.items():
        objects = many.groupby(["sequence", "object"]).ngroups
        track, add = map(str, correlate(many, seed)) if objects > 2 else (None, None)
        row = {"": label, "windows": len(many), "sequences or objects": objects}
        rows.append(row | {"texture and track error": track, "texture and ADD AUC": add})
    return DataFrame(rows)


def measure_table(measures: Mapping[str, Mapping[str, Any] | str], head: str = LEGEND) -> DataFrame:
    """A row per label: what it shows, how it was tracked, how right its pose was; or dashes and the reason."""
    table = DataFrame([{"why not": m} if isinstance(m, str) else dict(m) for m in measures.values()])
    reasons = table.get("why not", Series("", table.index)).fillna("")
    table = table.reindex(columns=_HEADS).round(2).rename(columns=_HEADS)
    table.insert(0, head, list(measures))
    return table.assign(**{"why not": reasons}) if reasons.any() else table


def draw_tracks(
    scene: Scene, study: ObjectTexture, index: int, region_px: tuple[int, int, int, int], width_px: int = 260
) -> np.ndarray:
    """Frame ``index``, cut to a region: true and estimated box, and a dot per keypoint in sight.

    A dot's colour is how far the tracker is from the truth: dark blue is right, yellow :data:`FAR_PX` or more.
    """
    here = study.tracks[study.tracks.frame == index]
    dots = here[["u_px", "v_px"]].to_numpy(), overlay.value_colours(here.error_px, 0, FAR_PX)
    return scene.draw(scene.row(index), region_px, width_px, axes=False, trail=0, dots=dots)


@style.styled
def texture_story(images: Mapping[str, np.ndarray], measures: Mapping[str, DataFrame], title: str) -> Figure:
    """The page's one figure: images side by side, and below them track error and ADD against visible texture."""
    high = WIDTH_IN / len(images) * max(image.shape[0] / image.shape[1] for image in images.values())
    figure = Figure((WIDTH_IN, high + 3.3), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[high + 0.45, 2.85])
    for axis, (label, image) in zip(np.atleast_1d(top.subplots(1, len(images))), images.items()):
        axis.imshow(image)
        axis.set_title(label, fontsize=9)
        axis.set_axis_off()
    axes = bottom.subplots(1, 2)
    _against_texture(axes, measures, 55, _colours(len(measures)))
    bottom.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=9, fontsize=8, title=LEGEND)
    top.suptitle(title, x=0.01, ha="left", fontsize=9)
    return figure


def extremes_story(scenes: Mapping[str, Scene], studies: Mapping[str, ObjectTexture], windows: int = 30) -> Figure:
    """The paper's figure on texture: the objects with the least and the most of it side by side, with their tracks.

    scenes  label to the scene of each study; two labels at least
    """
    least, *_, most = sorted(studies, key=lambda label: studies[label].measure()["texture"])
    images, measures = {}, {label: study.windows(windows) for label, study in studies.items()}
    for label in (least, most):
        frames = studies[label].frames
        middle, measure = int(frames.frame.iloc[len(frames) // 2]), studies[label].measure()
        title = f"{label}: {{texture:.1f}} levels/px, tracks off {{track_px:.1f}} px, ADD {{add_auc:.0f}}"
        title = title.format(**measure)
        images[title] = draw_tracks(scenes[label], studies[label], middle, scenes[label].region(0.03), 330)
    return texture_story(images, measures, "least and most texture; below, a point per window of frames")


@style.styled
def windows_against_texture(
    windows: Mapping[str, DataFrame],
    correlations: Sequence[RankCorrelation] = (),
    synthetic: DataFrame | None = None,
) -> Figure:
    """Every window of every study; above the panels the rank correlations with track error and with ADD AUC.

    synthetic  windows that are drawn in grey behind those of real objects
    """
    figure, axes = panels(2, (WIDTH_IN, 3.4), side_by_side=True)
    real = synthetic is not None
    shown = {"synthetic": synthetic, **windows} if real else windows
    colours = [style.NEUTRAL[1], *style.OBJECTS] if real else _colours(len(windows))
    _against_texture(axes, shown, 16, colours)
    for axis, found in zip(axes, correlations):
        axis.set_title(f"Spearman {found.rho:+.2f}, 95 % [{found.low:+.2f}, {found.high:+.2f}], n = {found.pairs}")
    entries, title = axes[0].get_legend_handles_labels(), None if real else LEGEND
    figure.legend(*entries, loc="outside lower center", ncols=3 if real else 9, fontsize=8, title=title)
    return figure


@style.styled
def same_frames(windows: Mapping[str, DataFrame]) -> Figure:
    """One line per window of frames, through all contrasts; of several sequences the first is drawn."""
    figure, axes = panels(2, (WIDTH_IN, 3.3), side_by_side=True)
    spans = concat(windows).droplevel(1).groupby(["start", "stop"])
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, spans.ngroups))
    for ((start, stop), rows), colour in zip(spans, colours):
        line = rows[~rows.index.duplicated()].reindex(list(windows))
        for axis, key in zip(axes, ("track_px", "add_auc")):
            axis.plot(line[key].to_numpy(), "o-", ms=3.5, color=colour, label=f"frames {start} to {stop - 1}")
    for axis, label in zip(axes, (_TRACK, _ADD)):
        axis.set_xticks(range(len(windows)), windows)
        axis.set(xlabel=LEGEND, ylabel=label)
    logarithmic(axes[0].yaxis)
    axes[1].set_ylim(0, 102)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


@style.styled
def track_errors(studies: Mapping[str, ObjectTexture]) -> Figure:
    """The fraction of a study's tracks that lie within so many pixels of the truth."""
    figure, (axis,) = panels(1, (WIDTH_IN, 3.0))
    for (label, study), colour in zip(studies.items(), _colours(len(studies))):
        error_px = study.tracks.error_px
        axis.ecdf(error_px, color=colour, label=f"{label} ({len(error_px)} answers)")
    logarithmic(axis.xaxis)
    axis.set(xlim=(0.05, 200), ylim=(0, 1.01), xlabel="distance from the true place [px]", ylabel="tracks within")
    axis.yaxis.set_major_formatter(PercentFormatter(1))
    axis.legend(loc="upper left", title=LEGEND)
    return figure


def _against_texture(axes: Sequence[Axes], measures: Mapping[str, DataFrame], size: float, colours: Iterable) -> None:
    """Track error and ADD AUC over texture, a colour per label."""
    for (label, many), colour in zip(measures.items(), cycle(colours)):
        for axis, key in zip(axes, ("track_px", "add_auc")):
            edge = {"edgecolors": "#333333", "linewidths": 0.5}
            axis.scatter(many.texture, many[key], size, color=[colour], label=label, **edge)
    for axis, label in zip(axes, (_TRACK, _ADD)):
        axis.set(xlabel=_TEXTURE, ylabel=label)
    for scale in (axes[0].xaxis, axes[1].xaxis, axes[0].yaxis):
        logarithmic(scale)
        low, high = scale.get_view_interval()
        scale.set_ticks([t for t in (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100) if low <= t <= high])
    axes[1].set_ylim(0, 102)


def _colours(count: int) -> np.ndarray:
    """(count, 4) dark to bright, but not so bright that a line is lost on white."""
    return matplotlib.colormaps["cividis"](np.linspace(0, 0.85, max(count, 2)))[:count]
