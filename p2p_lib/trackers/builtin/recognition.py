"""Points by their looks: following them, finding them where they should be, and remembering new appearances.

What is found is written into :class:`p2p_lib.trackers.builtin.tracked_points.Points`: the place, the warp, how
sure, and that the point is ``verified``.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.trackers.builtin.appearance import Alignment, align, take
from p2p_lib.trackers.builtin.image import Picture, flow
from p2p_lib.trackers.builtin.tracked_points import Points

_EYE = np.eye(2, dtype=np.float32)


def follow(p: Points, before: Picture, now: Picture, cfg: TrackingConfig) -> None:
    """Lucas-Kanade proposes, the appearance that fits best decides."""
    at = np.flatnonzero(p.verified | ((p.body < 0) & (p.hidden_for <= cfg.linger_frames)))
    p.verified[:] = False
    if not len(at):
        return
    here = p.uv[at]
    there, found = flow(before, now, here, cfg.window_px, cfg.levels)
    there = np.where(found[:, None], there, here)
    k = fitting(p, at)
    A = p.warp[at] @ np.linalg.inv(p.view[at, k])
    seen = align(now.fine, p.fine[at, k], there, A, cfg.iterations)
    moved_px = np.linalg.norm(seen.uv_px - there, axis=1)
    good = (seen.ncc >= cfg.min_ncc) & (moved_px < cfg.search_px) & _plausible(p, at, k, seen, now, cfg)
    _settle(p, at, k, seen, good)
    bad = ~good & (seen.ncc > cfg.coast_ncc) & now.inside(there)
    _coast(p, at[bad], before, now, here[bad], there[bad], cfg)


def _coast(p: Points, at: np.ndarray, before: Picture, now: Picture, here, there, cfg: TrackingConfig) -> None:
    """Points that changed their looks go on by Lucas-Kanade alone for a while, if it comes home again."""
    if not len(at):
        return
    home, found = flow(now, before, there, cfg.window_px, cfg.levels)
    error_px = np.linalg.norm(home - here, axis=1)
    p.verified[at] = found & (error_px < cfg.forward_backward_px) & (p.coasting[at] < cfg.coast_frames)
    p.uv[at] = there
    p.coasting[at] += 1
    p.cov[at] += cfg.coast_sigma_px**2 / 2 * _EYE


def find(
    p: Points,
    at: np.ndarray,
    uv_px: np.ndarray,
    warp: np.ndarray,
    sigma_px: np.ndarray,
    now: Picture,
    cfg: TrackingConfig,
) -> None:
    """Look for the points at these rows near uv_px (M, 2), known up to sigma_px (M,), coarse to fine."""
    if not len(at):
        return
    p.warp[at] = warp
    k = fitting(p, at)
    A = p.warp[at] @ np.linalg.inv(p.view[at, k])
    rough = align(now.coarse, p.coarse[at, k], uv_px / 2, A, cfg.iterations)
    seen = align(now.fine, p.fine[at, k], 2 * rough.uv_px, rough.A, cfg.iterations)
    off_px = np.linalg.norm(seen.uv_px - uv_px, axis=1)
    own_px = np.sqrt(np.trace(seen.cov_px2, axis1=1, axis2=2))
    near = off_px < np.minimum(cfg.search_px, 2 + 3 * np.hypot(sigma_px, own_px))
    _settle(p, at, k, seen, (seen.ncc >= cfg.return_ncc) & near & _plausible(p, at, k, seen, now, cfg))


def fitting(p: Points, at: np.ndarray) -> np.ndarray:
    """The appearance of each of these points that its present warp distorts least; the older in doubt."""
    A = p.warp[at][:, None] @ np.linalg.inv(p.view[at])
    squared = A @ A.transpose(0, 1, 3, 2) - _EYE
    distortion = np.sqrt((squared**2).sum((2, 3))) + 0.1 * np.arange(A.shape[1])
    distortion[np.arange(A.shape[1]) >= p.count[at][:, None]] = np.inf
    return distortion.argmin(1)


def _settle(p: Points, at: np.ndarray, k: np.ndarray, seen: Alignment, good: np.ndarray) -> None:
    """Those of the points that are ``good`` (M,) are where ``seen`` found their appearances k."""
    at, k = at[good], k[good]
    p.uv[at], p.warp[at] = seen.uv_px[good], seen.A[good] @ p.view[at, k]
    p.cov[at] = seen.cov_px2[good] + p.view_cov[at, k]
    p.verified[at], p.coasting[at], p.ncc[at] = True, 0, seen.ncc[good]


def _plausible(
    p: Points, at: np.ndarray, k: np.ndarray, seen: Alignment, now: Picture, cfg: TrackingConfig
) -> np.ndarray:
    """Whether brightness, contrast, colour and foreshortening are those of the appearance, about."""
    off = np.abs(now.chroma_at(seen.uv_px) - p.colour[at, k]).max(1)
    stretch = np.abs(np.linalg.det(seen.A))
    return (
        (off < cfg.colour_change)
        & (np.abs(seen.lighter) < cfg.grey_change)
        & (np.abs(np.log(seen.stronger)) < np.log(cfg.contrast_change))
        & (np.abs(np.log(stretch)) < np.log(cfg.area_change))
    )


def renew(p: Points, now: Picture, cfg: TrackingConfig, turn: int) -> None:
    """Remember how points look whose view has changed much since any appearance of theirs."""
    at = np.flatnonzero(p.verified & p.visible & (p.coasting == 0))
    A = p.warp[at] @ np.linalg.inv(p.view[at, fitting(p, at)])
    stretch = np.linalg.svd(A, compute_uv=False)
    far = (stretch.max(1) > cfg.renew_stretch) | (stretch.min(1) < 1 / cfg.renew_stretch)
    far |= p.ncc[at] < cfg.renew_ncc
    far &= p.sigma_px[at] < cfg.renew_sigma_px
    remember(p, in_turn(p, at[far], cfg.tries, turn), now, turn)


def remember(p: Points, rows: np.ndarray, now: Picture, turn: int) -> None:
    """Store the present looks of these points as one more appearance; a full set gives up its last but first."""
    if not len(rows):
        return
    slots = p.view.shape[1]
    k = np.where(p.count[rows] < slots, p.count[rows], 1 + turn % (slots - 1))
    uv = p.uv[rows]
    p.view[rows, k], p.view_cov[rows, k] = p.warp[rows], p.cov[rows]
    p.fine[rows, k], p.coarse[rows, k] = take(now.fine, uv), take(now.coarse, uv / 2)
    p.colour[rows, k] = now.chroma_at(uv)
    p.count[rows] = np.minimum(p.count[rows] + 1, slots)


def in_turn(p: Points, rows: np.ndarray, count: int, turn: int) -> np.ndarray:
    """At most ``count`` of these points: those that vanished last, and of the others everyone in turn."""
    if len(rows) <= count:
        return rows
    late = p.hidden_for[rows] > 2
    order = np.argsort(late * (1 + (p.ids[rows] * 7919 + turn * 104729) % 1000), kind="stable")
    return np.sort(rows[order[:count]])
