"""How much texture an object shows, how well its points are tracked, and how right its pose is.

The paper's analysis of texture: the mean magnitude of the Sobel gradient in the object's mask stands for visible
texture; the error of the 2D tracks is the distance of the tracker's answers from the object's keypoints projected
with true poses, of those that it calls visible and that are; the pose is judged by the area under the ADD curve.
All three per sequence, or per window of frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Sequence as Rows
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.datasets import ycbmultitrack
from p2p_lib.datasets.sequence import Sequence, open_sequence
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.protocol import Evaluation
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.studies.recorded_tracker import KeypointTracks, RecordedTracker
from p2p_lib.synthetic import scenario_dir

#: The mask's outermost pixels are left out: their gradient is that of the outline, not of what is printed.
MARGIN_PX = 3


@dataclass(frozen=True)
class Measure:
    """One object over some frames of a sequence.

    start, stop   frames [start, stop) of the sequence, of which ``frames`` are scored
    texture       mean Sobel gradient magnitude in the mask, grey levels per pixel
    track_px      median error of its 2D tracks; NaN where there was none
    tracks        tracks per scored frame
    add_auc, adds_auc  percent, exact form over 0 to 0.1 m, failures as zero
    """

    sequence: str
    object: str
    start: int
    stop: int
    frames: int
    texture: float
    track_px: float
    tracks: float
    add_auc: float
    adds_auc: float


@dataclass(frozen=True, eq=False)
class ObjectTexture:
    """One object of a run, over its m scored frames.

    frame_index    (m,) of the sequence
    texture        (m,) mean Sobel gradient magnitude in the mask; NaN where the mask is too thin
    add_m, adds_m  (m,) metres; infinite where there was no pose
    tracks         of its keypoints, in all frames
    """

    sequence: str
    object: str
    frame_index: np.ndarray
    texture: np.ndarray
    add_m: np.ndarray
    adds_m: np.ndarray
    tracks: KeypointTracks

    def measure(self, start: int = 0, stop: int | None = None) -> Measure:
        """Over the frames [start, stop); :class:`MissingData` where none of them is scored."""
        stop = int(self.frame_index[-1]) + 1 if stop is None else stop
        at = (self.frame_index >= start) & (self.frame_index < stop)
        if not at.any():
            raise MissingData(f"{self.object} of {self.sequence}", f"no scored frame from {start} to {stop}")
        error_px = self.tracks.error_px[np.isin(self.tracks.frame, self.frame_index[at])]
        return Measure(
            self.sequence,
            self.object,
            start,
            stop,
            int(at.sum()),
            float(np.nanmean(self.texture[at])),
            float(np.median(error_px)) if len(error_px) else float("nan"),
            len(error_px) / int(at.sum()),
            metrics.auc_exact(self.add_m[at]),
            metrics.auc_exact(self.adds_m[at]),
        )

    def windows(self, size: int = 15) -> list[Measure]:
        """One measure per window of ``size`` frames; those with fewer than half of them scored are left out."""
        first, last = int(self.frame_index[0]), int(self.frame_index[-1])
        starts = np.arange(first, last + 1, size)
        scored = ((self.frame_index >= starts[:, None]) & (self.frame_index < starts[:, None] + size)).sum(1)
        return [self.measure(start, start + size) for start in starts[2 * scored >= size].tolist()]


def sobel_magnitude(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32: magnitude of the 3x3 Sobel gradient of the brightness, scaled to grey levels per pixel."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    across, down = (cv2.Sobel(gray, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (1, 0))
    return cv2.magnitude(across, down)


def visible_texture(rgb: np.ndarray, mask: np.ndarray, margin_px: int = MARGIN_PX) -> float:
    """Mean Sobel gradient magnitude over a mask (H, W) without its rim; NaN where nothing of it is left."""
    side = 2 * margin_px + 1
    inner = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderValue=0) > 0
    return float(sobel_magnitude(rgb)[inner].mean()) if inner.any() else float("nan")


def fading_label(contrast: float, frames: int, seed: int = 0) -> Sequence:
    """``synthetic/fading_label`` at a contrast of its print: for one seed all else is the same."""
    folder = scenario_dir("fading_label", seed, contrast=float(contrast), frames=frames)
    return ycbmultitrack.load(folder, f"synthetic/fading_label {seed}, contrast {contrast:g}", None, None)


def present(names: Iterable[str], left_out: str = "") -> dict[str, Sequence | str]:
    """The sequences of these names or folders, or the reason why there is none: ``left_out`` for all, or missing."""
    found: dict[str, Sequence | str] = {}
    for name in names:
        try:
            found[name] = left_out or open_sequence(name)
        except MissingData as error:
            found[name] = str(error)
    return found


def study(
    sequence: Sequence,
    evaluation: Evaluation,
    recorded: RecordedTracker,
    models: Mapping[str, str | Path] | None = None,
) -> dict[str, ObjectTexture]:
    """Texture, tracks and pose of each object that a run of the pipeline with a recorded tracker was scored on.

    models  object to mesh, besides those that lie with the sequence; the others' surface is the measured depth
    """
    tracks = recorded.keypoints(TrueScene.of(sequence, models))
    texture: dict[str, list[float]] = {name: [] for name in evaluation.objects}
    for i in sorted({int(i) for score in evaluation.objects.values() for i in score.frame_index}):
        rgb, masks = sequence.frame(i).rgb, sequence.masks(i) or {}
        for name, score in evaluation.objects.items():
            if i in score.frame_index:
                texture[name].append(visible_texture(rgb, masks[name]) if name in masks else float("nan"))
    return {
        name: ObjectTexture(
            sequence.name, name, score.frame_index, np.array(texture[name]), score.add_m, score.adds_m, tracks[name]
        )
        for name, score in evaluation.objects.items()
    }


@dataclass(frozen=True)
class RankCorrelation:
    """Spearman's rho of n pairs and its 95 % confidence interval, by bootstrap over independent groups of pairs."""

    rho: float
    low: float
    high: float
    pairs: int
    groups: int


def rank_correlation(
    x: np.ndarray, y: np.ndarray, groups: Rows | None = None, seed: int = 0, resamples: int = 2000
) -> RankCorrelation:
    """Spearman's rank correlation of x (n,) and y (n,) with a bootstrap confidence interval (percentiles).

    groups  (n,) which pairs belong together: windows of one sequence are not independent, so whole sequences are
            drawn; by default every pair stands for itself. Pairs that are not finite are left out.

    Raises :class:`BadInput` for fewer than three groups.
    """
    from scipy import stats

    x, y = np.asarray(x, float), np.asarray(y, float)
    group = np.arange(len(x)) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    keep = np.isfinite(x) & np.isfinite(y)
    x, y, group = x[keep], y[keep], np.unique(group[keep], return_inverse=True)[1]
    count = int(group.max(initial=-1)) + 1
    if count < 3:
        raise BadInput("rank correlation", f"{count} independent groups", "at least three")
    members = [np.flatnonzero(group == k) for k in range(count)]

    def rho(drawn: np.ndarray) -> float:
        rows = np.concatenate([members[k] for k in drawn])
        ranks = stats.rankdata(x[rows]), stats.rankdata(y[rows])
        # A draw of one value alone has no order: no correlation.
        return float(np.corrcoef(*ranks)[0, 1]) if min(np.ptp(r) for r in ranks) > 0 else 0.0

    rng = np.random.default_rng(seed)
    method = {"n_resamples": resamples, "vectorized": False, "method": "percentile", "rng": rng}
    drawn = stats.bootstrap((np.arange(count),), rho, **method)
    interval = drawn.confidence_interval
    return RankCorrelation(rho(np.arange(count)), float(interval.low), float(interval.high), len(x), count)


def correlate(windows: Rows[Measure], seed: int = 0) -> tuple[RankCorrelation, RankCorrelation]:
    """Texture with track error, and texture with ADD AUC, over windows; those of one object belong together."""
    groups = [f"{w.sequence}: {w.object}" for w in windows]
    shown = np.array([w.texture for w in windows])
    track_px, add_auc = (np.array([getattr(w, key) for w in windows]) for key in ("track_px", "add_auc"))
    return rank_correlation(shown, track_px, groups, seed), rank_correlation(shown, add_auc, groups, seed)
