"""Points by their appearance: follow them, find them where they are predicted, and update their templates.

Results are written into :class:`p2p_lib.trackers.builtin.tracked_points.Points`: position, warp, covariance, and
that the point is ``verified``.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.trackers.builtin.appearance import Alignment, align, take
from p2p_lib.trackers.builtin.image import Image, flow
from p2p_lib.trackers.builtin.tracked_points import Points

_EYE = np.eye(2, dtype=np.float32)
#: The correlation that a coasting point keeps, and the standard deviation that each frame of it adds (px).
_COAST_NCC, _COAST_SIGMA_PX = 0.4, 0.7
#: An older template is preferred to one that is less distorted by no more than this.
_OLDER_DISTORTION = 0.1
#: A place with so many times the contrast of a template is that point without blur.
_SHARPER = 1.4


def follow(p: Points, before: Image, now: Image, cfg: TrackingConfig) -> None:
    """Lucas-Kanade predicts where points moved, alignment with their best template decides."""
    at = np.flatnonzero(p.verified | ((p.segment < 0) & (p.hidden_for <= cfg.linger_frames)))
    p.verified[:] = False
    if not len(at):
        return
    start = p.uv[at]
    moved, tracked = flow(before, now, start, cfg.window_px)
    moved = np.where(tracked[:, None], moved, start)
    k, warp = best_template(p, at)
    seen = align(now.fine, p.templates.fine, p.template[at, k], moved, warp)
    shift_px = np.linalg.norm(seen.uv_px - moved, axis=1)
    good = _settle(p, at, k, seen, (seen.ncc >= cfg.min_ncc) & (shift_px < cfg.search_px), now, cfg)
    changed = ~good & (seen.ncc > _COAST_NCC) & now.inside(moved)
    _coast(p, at[changed], before, now, start[changed], moved[changed], cfg)


def _coast(
    p: Points, at: np.ndarray, before: Image, now: Image, start: np.ndarray, moved: np.ndarray, cfg: TrackingConfig
) -> None:
    """Points whose appearance changed go on by Lucas-Kanade alone for a while, if it is consistent backward."""
    if not len(at):
        return
    back, tracked = flow(now, before, moved, cfg.window_px)
    error_px = np.linalg.norm(back - start, axis=1)
    p.verified[at] = tracked & (error_px < cfg.forward_backward_px) & (p.coasting[at] < cfg.coast_frames)
    p.uv[at] = moved
    p.coasting[at] += 1
    p.cov[at] += _COAST_SIGMA_PX**2 / 2 * _EYE


def find(
    p: Points,
    at: np.ndarray,
    uv_px: np.ndarray,
    warp: np.ndarray,
    sigma_px: np.ndarray | float,
    now: Image,
    cfg: TrackingConfig,
) -> None:
    """Search for the points at these rows near uv_px (M, 2), predicted up to sigma_px (M,), coarse to fine."""
    if not len(at):
        return
    p.warp[at] = warp
    k, warp = best_template(p, at)
    rows = p.template[at, k]
    rough = align(now.coarse, p.templates.coarse, rows, uv_px / 2, warp)
    seen = align(now.fine, p.templates.fine, rows, 2 * rough.uv_px, rough.A)
    off_px = np.linalg.norm(seen.uv_px - uv_px, axis=1)
    own_px = np.sqrt(np.trace(seen.cov_px2, axis1=1, axis2=2))
    near = off_px < np.minimum(cfg.search_px, 2 + 3 * np.hypot(sigma_px, own_px))
    _settle(p, at, k, seen, (seen.ncc >= cfg.return_ncc) & near, now, cfg)


def best_template(p: Points, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The template (M,) of each of these points that its present warp distorts least, and how (M, 2, 2) it appears."""
    A = p.warp[at][:, None] @ p.template_unwarp[at]
    squared = A @ A.transpose(0, 1, 3, 2) - _EYE
    distortion = np.sqrt((squared**2).sum((2, 3))) + _OLDER_DISTORTION * np.arange(A.shape[1])
    distortion[p.template[at] < 0] = np.inf
    best = distortion.argmin(1)
    return best, A[np.arange(len(A)), best]


def _settle(
    p: Points, at: np.ndarray, k: np.ndarray, seen: Alignment, fits: np.ndarray, now: Image, cfg: TrackingConfig
) -> np.ndarray:
    """Put points where their templates k were found, if that ``fits`` (M,) and looks the same; returns which (M,)."""
    # Alignment alone is invariant to colour and contrast: both have to be about those of the template.
    colour_change = np.abs(now.chroma_at(seen.uv_px) - p.chroma[at, k]).max(1)
    contrast_change = np.abs(np.log(seen.contrast_ratio))
    good = fits & (colour_change < cfg.max_colour_change) & (contrast_change < np.log(cfg.max_contrast_change))
    at, k = at[good], k[good]
    p.uv[at], p.warp[at] = seen.uv_px[good], seen.A[good] @ p.template_warp[at, k]
    p.cov[at] = seen.cov_px2[good] + p.template_cov[at, k]
    p.verified[at], p.coasting[at], p.ncc[at] = True, 0, seen.ncc[good]
    return good


def update_templates(p: Points, now: Image, cfg: TrackingConfig, turn: int) -> None:
    """Store a further template of points that no template resembles at the present scale and slant."""
    at = np.flatnonzero(p.verified & p.visible & (p.coasting == 0))
    scales = np.linalg.svd(best_template(p, at)[1], compute_uv=False)
    changed = np.abs(np.log(scales)).max(1) > np.log(cfg.update_scale_change)
    store_templates(p, at[changed | (p.ncc[at] < cfg.update_ncc)], now, turn)


def sharpen_templates(p: Points, at: np.ndarray, now: Image) -> None:
    """Replace the template of points at these rows that was taken in blur: there is more contrast where they are now.

    They are predicted well, and not recognised.
    """
    if not len(at):
        return
    k, _ = best_template(p, at)
    blurred = p.templates.fine.contrast[p.template[at, k]] * _SHARPER < take(now.fine, p.uv[at]).contrast
    store_templates(p, at[blurred], now, k=k[blurred])


def store_templates(p: Points, rows: np.ndarray, now: Image, turn: int = 0, k: np.ndarray | None = None) -> None:
    """Store the present appearance of these points, in the places ``k`` (M,) of their sets, if given.

    Else behind those there are; in a full set it replaces one in ``turn``, never the first.
    """
    if not len(rows):
        return
    if k is None:
        room, count = p.template.shape[1], (p.template[rows] >= 0).sum(1)
        k = np.where(count < room, count, 1 + turn % (room - 1))
    uv = p.uv[rows]
    p.template_warp[rows, k], p.template_cov[rows, k] = p.warp[rows], p.cov[rows]
    p.template_unwarp[rows, k] = np.linalg.inv(p.warp[rows])
    first = p.template[rows, k] < 0
    p.template[rows[first], k[first]] = p.templates.new(int(np.count_nonzero(first)))
    own = p.template[rows, k]
    p.templates.fine[own], p.templates.coarse[own] = take(now.fine, uv), take(now.coarse, uv / 2)
    p.chroma[rows, k] = now.chroma_at(uv)
