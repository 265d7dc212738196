"""Scores of 2D point tracks: arrays in, numbers out.

Average Jaccard, delta_avg and occlusion accuracy are those of TAP-Vid (Doersch et al., NeurIPS 2022),
query-first: a point is scored in the frames after its query. Re-detection is ours: whether a point that was
gone for long is found again. All arrays are (T, N) over frames and points, positions (T, N, 2).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

#: TAP-Vid measures pixels after both axes of the picture are scaled to this many.
RASTER_PX = 256
THRESHOLDS_PX = (1, 2, 4, 8, 16)
#: Re-detection: frames of absence, radius in pixels of the picture as it is, visible frames to be found in.
MIN_ABSENT_FRAMES, FOUND_PX, FOUND_WITHIN_FRAMES = 30, 8.0, 5
#: A return counts as "the same surface again" up to this angle from a view it was seen from.
SAME_VIEW_DEG = 40.0


@dataclass(frozen=True)
class TapVid:
    """The TAP-Vid scores, shares in [0, 1]; NaN where nothing could be scored.

    jaccard, within  one for each of :data:`THRESHOLDS_PX`; ``aj`` and ``delta_avg`` are their means
    oa               share of scored frames whose visibility is right
    """

    aj: float
    delta_avg: float
    oa: float
    jaccard: tuple[float, ...]
    within: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Redetections:
    """Returns of points after a long absence, one row each.

    point, frame  (E,) which point, and the first frame in which it shows again
    view_deg      (E,) angle from there to the nearest view it was seen from since its query
    found         (E,) bool: within 8 px and called visible in at least one of the first 5 visible frames
    share_found   (E,) share of those up to 5 frames in which it was
    """

    point: np.ndarray
    frame: np.ndarray
    view_deg: np.ndarray
    found: np.ndarray
    share_found: np.ndarray

    def as_dict(self, max_view_deg: float = SAME_VIEW_DEG) -> dict[str, float | int]:
        """Counts and shares over all returns, and over those within ``max_view_deg`` of a known view."""
        same = self.view_deg <= max_view_deg
        return {
            "returns": len(self.point),
            "found": _share(self.found),
            "found_frames": _share(self.share_found),
            "returns_same_view": int(same.sum()),
            "found_same_view": _share(self.found[same]),
            "found_frames_same_view": _share(self.share_found[same]),
        }


def after_query(query_frame: np.ndarray, frames: int) -> np.ndarray:
    """(T, N) bool: the frames after each point's query, which the query-first protocol scores."""
    return np.arange(frames)[:, None] > query_frame[None]


def tapvid(
    uv_true: np.ndarray,
    visible_true: np.ndarray,
    uv_px: np.ndarray,
    visible: np.ndarray,
    scored: np.ndarray,
    shape: tuple[int, int],
) -> TapVid:
    """TAP-Vid scores over the ``scored`` (T, N) frames; positions in pixels of a picture of ``shape`` (H, W).

    A predicted position that is NaN is wrong at every threshold.
    """
    off = (uv_px - uv_true) * (RASTER_PX / np.array(shape[::-1], float))
    off_sq = np.where(np.isfinite(off).all(-1), (off**2).sum(-1), np.inf)[scored]
    truly, said = visible_true[scored], visible[scored]
    if not truly.size:
        nothing = (np.nan,) * len(THRESHOLDS_PX)
        return TapVid(np.nan, np.nan, np.nan, nothing, nothing)
    near = off_sq < np.square(THRESHOLDS_PX, dtype=float)[:, None]
    hits = (near & truly & said).sum(1)
    false = (said & ~(near & truly)).sum(1)
    with np.errstate(invalid="ignore"):
        within = (near & truly).sum(1) / truly.sum()
        jaccard = hits / (truly.sum() + false)
    return TapVid(
        float(jaccard.mean()),
        float(within.mean()),
        float((truly == said).mean()),
        tuple(map(float, jaccard)),
        tuple(map(float, within)),
    )


class Outcome(IntEnum):
    """What came of asking for a point in a frame."""

    NOT_ASKED = 0
    HIDDEN = 1  # it is, and the tracker says so
    RIGHT = 2  # visible and found within 8 px
    MISSED = 3  # visible, but called hidden
    WRONG = 4  # called visible where it is not


def outcomes(
    uv_true: np.ndarray, visible_true: np.ndarray, uv_px: np.ndarray, visible: np.ndarray, scored: np.ndarray
) -> np.ndarray:
    """(T, N) uint8 of :class:`Outcome`; pixels are those of the picture as it is."""
    near = visible_true & (np.linalg.norm(uv_px - uv_true, axis=-1) < FOUND_PX)
    said = np.where(near, Outcome.RIGHT, Outcome.WRONG)
    silent = np.where(visible_true, Outcome.MISSED, Outcome.HIDDEN)
    return np.where(scored, np.where(visible, said, silent), Outcome.NOT_ASKED).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Reliability:
    """How far off predictions are, by how uncertain they said they were: bins of equally many predictions.

    uncertainty  (B,) median of the bin
    median_px, p90_px  (B,) error that half, and nine in ten, of the bin stay below
    count        (B,) predictions
    rank_correlation  Spearman's, of uncertainty and error over all predictions
    """

    uncertainty: np.ndarray
    median_px: np.ndarray
    p90_px: np.ndarray
    count: np.ndarray
    rank_correlation: float


def reliability(error_px: np.ndarray, uncertainty: np.ndarray, bins: int = 10) -> Reliability:
    """Errors (M,) of predictions against their uncertainty (M,); equal uncertainties stay in one order."""
    from scipy.stats import spearmanr

    parts = [part for part in np.array_split(np.argsort(uncertainty, kind="stable"), bins) if len(part)]
    return Reliability(
        np.array([np.median(uncertainty[part]) for part in parts]),
        np.array([np.median(error_px[part]) for part in parts]),
        np.array([np.quantile(error_px[part], 0.9) for part in parts]),
        np.array([len(part) for part in parts]),
        float(spearmanr(uncertainty, error_px).statistic) if len(error_px) > 1 else float("nan"),
    )


def redetections(
    uv_true: np.ndarray,
    visible_true: np.ndarray,
    known: np.ndarray,
    view: np.ndarray,
    uv_px: np.ndarray,
    visible: np.ndarray,
    query_frame: np.ndarray,
) -> Redetections:
    """Every return of a point after at least 30 frames in a row in which it was truly invisible.

    known  (T, N) bool: truth says whether the point is visible; an absence with unknown frames is none
    view   (T, N, 3) unit vectors from the point to the camera, in the object's frame
    """
    seen = visible_true & known
    seen &= np.arange(len(seen))[:, None] >= query_frame
    point, frame = np.nonzero(seen.T)  # by point, then by frame
    new_point = np.diff(point, prepend=-1) > 0
    unknown_before = np.vstack([np.zeros(known.shape[1], int), np.cumsum(~known, 0)])
    last = np.concatenate([[0], frame[:-1]])[: len(frame)]
    certain = unknown_before[frame, point] == unknown_before[last, point]
    returns = ~new_point & (frame - last > MIN_ABSENT_FRAMES) & certain
    stretch_start = np.flatnonzero(new_point | (np.diff(frame, prepend=0) > MIN_ABSENT_FRAMES))
    stretch = np.searchsorted(stretch_start, np.arange(len(frame)), side="right") - 1
    first = np.flatnonzero(returns)
    rows = first[:, None] + np.arange(FOUND_WITHIN_FRAMES)
    within = rows < len(frame)
    rows = np.minimum(rows, max(len(frame) - 1, 0))
    within &= stretch[rows] == stretch[first][:, None]
    at = frame[rows], point[rows]
    off_px = np.linalg.norm(uv_px[at] - uv_true[at], axis=-1)
    good = within & visible[at] & (off_px < FOUND_PX)
    return Redetections(
        point[first],
        frame[first],
        _nearest_view_deg(seen, view, point[first], frame[first]),
        good.any(1),
        good.sum(1) / np.maximum(within.sum(1), 1),
    )


def _nearest_view_deg(seen: np.ndarray, view: np.ndarray, point: np.ndarray, frame: np.ndarray) -> np.ndarray:
    """(E,) angle between the view at ``frame`` and the nearest one in which the point was seen before."""
    if not len(point):
        return np.zeros(0)
    cosine = np.einsum("tec,ec->te", view[:, point], view[frame, point])
    earlier = seen[:, point] & (np.arange(len(seen))[:, None] < frame)
    nearest = np.where(earlier, cosine, -1.0).max(0)
    return np.degrees(np.arccos(np.clip(nearest, -1, 1)))


def _share(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else float("nan")
