"""Scores of 2D point tracks: arrays in, numbers out.

Average Jaccard, delta_avg and occlusion accuracy are those of TAP-Vid (Doersch et al., NeurIPS 2022),
query-first: a point is scored in the frames after its query. Re-detection is ours: whether a point that was
gone for long is found again. All arrays are (T, N) over frames and points, positions (T, N, 2).
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from pandas import DataFrame

#: TAP-Vid measures pixels after both axes of the image are scaled to this many.
RASTER_PX = 256
THRESHOLDS_PX = (1, 2, 4, 8, 16)
#: Re-detection: frames of absence, radius in pixels of the image as it is, visible frames to be found in.
MIN_ABSENT_FRAMES, FOUND_PX, FOUND_WITHIN_FRAMES = 30, 8.0, 5
#: A return counts as "the same surface again" up to this angle from a view it was seen from.
SAME_VIEW_DEG = 40.0


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
) -> dict[str, Any]:
    """TAP-Vid scores over the ``scored`` (T, N) frames; positions in pixels of an image of ``shape`` (H, W).

    Shares in [0, 1], NaN where nothing could be scored: ``jaccard`` and ``within`` for each of :data:`THRESHOLDS_PX`
    (``"1_px"``), their means ``aj`` and ``delta_avg``, and ``oa`` of frames whose visibility is right. A predicted
    position that is NaN is wrong at every threshold.
    """
    off = (uv_px - uv_true) * (RASTER_PX / np.array(shape[::-1], float))
    off_sq = np.where(np.isfinite(off).all(-1), (off**2).sum(-1), np.inf)[scored]
    truly, predicted = visible_true[scored], visible[scored]
    near = off_sq < np.square(THRESHOLDS_PX, dtype=float)[:, None]
    hits = (near & truly & predicted).sum(1)
    false = (predicted & ~(near & truly)).sum(1)
    with np.errstate(invalid="ignore"):
        within = (near & truly).sum(1) / truly.sum()
        jaccard = hits / (truly.sum() + false)
    names = [f"{px}_px" for px in THRESHOLDS_PX]
    return {
        "aj": float(jaccard.mean()),
        "delta_avg": float(within.mean()),
        "oa": float((truly == predicted).mean()) if truly.size else float("nan"),
        "jaccard": dict(zip(names, jaccard.tolist(), strict=True)),
        "within": dict(zip(names, within.tolist(), strict=True)),
    }


def redetections(
    uv_true: np.ndarray,
    visible_true: np.ndarray,
    known: np.ndarray,
    view: np.ndarray,
    uv_px: np.ndarray,
    visible: np.ndarray,
    query_frame: np.ndarray,
) -> DataFrame:
    """A row for every return of a point after at least 30 frames in a row in which it was truly invisible.

    known  (T, N) bool: truth says whether the point is visible; an absence with unknown frames is none
    view   (T, N, 3) unit vectors from the point to the camera, in the object's frame

    Columns: ``point``; ``frame``, the first in which it shows again; ``view_deg``, the angle from there to the nearest
    view it was seen from since its query; ``share_found`` of the first 5 visible frames, in which it is called visible
    within 8 px; ``found``, whether it is in one of them.
    """
    from pandas import DataFrame

    seen = visible_true & known & (np.arange(len(known))[:, None] >= query_frame)
    right = visible & (np.linalg.norm(uv_px - uv_true, axis=-1) < FOUND_PX)
    rows = []
    for k in range(seen.shape[1]):
        frames = np.flatnonzero(seen[:, k])
        returns = np.flatnonzero(np.diff(frames) > MIN_ABSENT_FRAMES) + 1
        for at, end in pairwise([*returns, len(frames)]):
            frame = frames[at]
            if known[frames[at - 1] : frame, k].all():
                cosine = (view[frames[:at], k] @ view[frame, k]).max()
                share = right[frames[at : min(end, at + FOUND_WITHIN_FRAMES)], k].mean()
                rows.append((k, frame, np.degrees(np.arccos(np.clip(cosine, -1, 1))), share, share > 0))
    columns = {"point": int, "frame": int, "view_deg": float, "share_found": float, "found": bool}
    return DataFrame(rows, columns=list(columns)).astype(columns)


def redetection_shares(returns: DataFrame) -> dict[str, float | int]:
    """Counts and shares over all :func:`redetections`, and over those within 40 degrees of a known view."""
    same = returns[returns.view_deg <= SAME_VIEW_DEG]
    return {
        "returns": len(returns),
        "found": float(returns.found.mean()),
        "found_frames": float(returns.share_found.mean()),
        "returns_same_view": len(same),
        "found_same_view": float(same.found.mean()),
        "found_frames_same_view": float(same.share_found.mean()),
    }
