"""The embedded 2D tracker: long-range, without weights, on the CPU.

Every point keeps a few appearances of itself (:mod:`p2p_lib.stages.appearance`). From frame to frame
Lucas-Kanade proposes its place, and alignment with the best fitting appearance decides: that takes the
drift out, and a place that does not look like the point is not one. A point that is not where it
should be is looked for where the visible points around it say it is, and, wherever in the picture it
may be, at the corners whose descriptors look like those that once surrounded it
(:mod:`p2p_lib.stages.features`). Whatever is found is verified by alignment.
"""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.stages import features
from p2p_lib.stages.appearance import Alignment, align, take
from p2p_lib.stages.tracked_points import ANCHORS, NEIGHBOURS, Points, carried

#: Levels on which the corners around a point are described; those searched are features.SCALES.
_ANCHOR_SCALES = (1.0, 0.5)
_EYE = np.eye(2, dtype=np.float32)


class EmbeddedTracker:
    """Long-range point tracker; see the module's text. Implements :class:`p2p_lib.stages.tracking.PointTracker`."""

    name = "embedded"
    latency_frames = 0

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        self.config = config
        self._gray: np.ndarray | None = None
        self._clear()

    def _clear(self) -> None:
        self._next_id, self._frames = 0, 0
        self._points = Points.new(np.zeros(0, np.int64), np.zeros((0, 2)), self.config.appearances)

    def start(self, frame: Frame) -> None:
        """Begin a stream at this frame."""
        self._clear()
        self._see(frame)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        if self._gray is None:
            raise BadInput("tracker", "queries before a frame", "start(frame) first")
        uv = np.asarray(uv_px, np.float32).reshape(-1, 2)
        ids = np.arange(self._next_id, self._next_id + len(uv))
        self._next_id += len(uv)
        held = len(self._points)
        self._points = self._points.joined(Points.new(ids, uv, self.config.appearances))
        self._remember(held + np.arange(len(ids)))
        return ids

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._points = self._points.select(~np.isin(self._points.ids, ids))

    def reject(self, ids: np.ndarray) -> None:
        """Take these tracks for invisible until they are found again."""
        gone = np.isin(self._points.ids, ids)
        self._points.visible &= ~gone
        # Where it was is wrong: not the place to look first.
        self._points.hidden_for[gone] = self.config.linger_frames + 1

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> None:
        """Look for invisible points where the caller expects them in the newest frame, among those it names.

        ids, uv_px  (N,), (N, 2): all points of one rigid body, the visible ones too: they say how it is turned.
        """
        p = self._points
        at = p.rows(ids)
        expected = np.full((len(p), 2), np.nan, np.float32)
        expected[at[at >= 0]] = uv_px[at >= 0]
        wanted = at[at >= 0]
        wanted = wanted[~p.visible[wanted] & np.isfinite(expected[wanted]).all(1)]
        wanted = self._turn(wanted, self.config.tries)
        rows, k, _, A, _ = self._predict(wanted, expected)
        seen, good = self._found(rows, k, expected[rows], A)
        self._settle(rows[good], k[good], seen, good)

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        if self._gray is None:
            raise BadInput("tracker", "a frame to track before any start", "start(frame) first")
        previous = self._gray
        self._see(frame)
        self._frames += 1
        self._follow(previous)
        self._search_near(search)
        self._search_everywhere(search, urgent)
        self._consult(search)
        self._check_depth(frame.depth_m)
        p, cfg = self._points, self.config
        p.hidden_for = np.where(p.visible, 0, p.hidden_for + 1)
        if self._frames % cfg.renew_every == 0:
            self._renew()
        uv = p.uv.astype(float)
        # A bounded, monotonous reading of the standard deviation: 1/2 at uncertain_px.
        uncertainty = np.where(p.visible, p.sigma_px / (p.sigma_px + cfg.uncertain_px), 1.0)
        return Tracks(p.ids.copy(), uv, p.visible.copy(), uncertainty.astype(float))

    def _see(self, frame: Frame) -> None:
        self._gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        self._fine = self._gray.astype(np.float32)
        self._coarse = cv2.pyrDown(self._gray).astype(np.float32)
        quarter = cv2.resize(frame.rgb, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        self._chroma = cv2.cvtColor(quarter, cv2.COLOR_RGB2LAB)[..., 1:].astype(np.float32)

    def _colour(self, uv: np.ndarray) -> np.ndarray:
        """Chroma (N, 2) around places (N, 2)."""
        if not len(uv):
            return np.zeros((0, 2), np.float32)
        x, y = (np.ascontiguousarray((uv[:, i] + 0.5) / 4 - 0.5, np.float32)[:, None] for i in (0, 1))
        return cv2.remap(self._chroma, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]

    def _follow(self, previous: np.ndarray) -> None:
        """Lucas-Kanade proposes, the appearance that fits best decides."""
        p, cfg = self._points, self.config
        at = np.flatnonzero(p.visible)
        if not len(at):
            return
        flow = {"winSize": (cfg.window_px, cfg.window_px), "maxLevel": cfg.levels}
        here = p.uv[at]
        there, found, _ = cv2.calcOpticalFlowPyrLK(previous, self._gray, here, None, **flow)
        there = np.where(found > 0, there, here)
        k = self._fitting(at)
        seen = align(self._fine, p.fine[at, k], there, p.warp[at] @ np.linalg.inv(p.view[at, k]), cfg.iterations)
        moved_px = np.linalg.norm(seen.uv_px - there, axis=1)
        good = (seen.ncc >= cfg.min_ncc) & (moved_px < cfg.search_px) & self._plausible(at, k, seen)
        self._settle(at[good], k[good], seen, good)
        self._coast(at[~good], previous, here[~good], there[~good], seen.ncc[~good], flow)

    def _fitting(self, at: np.ndarray) -> np.ndarray:
        """The appearance of each point that its present warp distorts least; the older in doubt."""
        p = self._points
        A = p.warp[at][:, None] @ np.linalg.inv(p.view[at])
        squared = A @ A.transpose(0, 1, 3, 2) - _EYE
        distortion = np.sqrt((squared**2).sum((2, 3))) + 0.1 * np.arange(A.shape[1])
        distortion[np.arange(A.shape[1]) >= p.count[at][:, None]] = np.inf
        return distortion.argmin(1)

    def _settle(self, at: np.ndarray, k: np.ndarray, seen: Alignment, rows: np.ndarray) -> None:
        """Points ``at`` are where ``seen`` (its ``rows``) found their appearances k."""
        p = self._points
        p.uv[at], p.warp[at] = seen.uv_px[rows], seen.A[rows] @ p.view[at, k]
        p.cov[at] = seen.cov_px2[rows] + p.view_cov[at, k]
        p.visible[at], p.coasting[at], p.ncc[at] = True, 0, seen.ncc[rows]

    def _coast(self, at, previous, here, there, ncc, flow) -> None:
        """Points that changed their looks go on by Lucas-Kanade alone for a while, if it comes home again."""
        p, cfg = self._points, self.config
        if not len(at):
            return
        home, found, _ = cv2.calcOpticalFlowPyrLK(self._gray, previous, there, None, **flow)
        error_px = np.linalg.norm(home - here, axis=1)
        h, w = self._gray.shape
        ok = (found[:, 0] > 0) & (error_px < cfg.forward_backward_px) & (ncc > cfg.coast_ncc)
        ok &= (there >= 0).all(1) & (there <= [w - 1, h - 1]).all(1) & (p.coasting[at] < cfg.coast_frames)
        p.uv[at] = there
        p.visible[at] = ok
        p.coasting[at] += 1
        p.cov[at] += cfg.coast_sigma_px**2 / 2 * _EYE

    def _search_near(self, search: np.ndarray | None) -> None:
        """Look for invisible points where the visible ones around them say, else where they were just now."""
        p, cfg = self._points, self.config
        wanted = np.flatnonzero(~p.visible & ~self._bare())
        rows, k, uv, A, _ = self._predict(wanted, np.where(p.visible[:, None], p.uv, np.nan))
        late = np.setdiff1d(wanted[p.hidden_for[wanted] <= cfg.linger_frames], rows)
        k = np.concatenate([k, self._fitting(late)])
        A = np.concatenate([A, p.warp[late] @ np.linalg.inv(p.view[late, k[len(rows) :]])])
        rows, uv = np.concatenate([rows, late]), np.concatenate([uv, p.uv[late]])
        pick = np.flatnonzero(self._inside(uv, search))
        pick = pick[np.isin(rows[pick], self._turn(rows[pick], cfg.tries))]
        rows, k = rows[pick], k[pick]
        seen, good = self._found(rows, k, uv[pick], A[pick])
        self._settle(rows[good], k[good], seen, good)

    def _turn(self, rows: np.ndarray, count: int) -> np.ndarray:
        """At most ``count`` of these points: those that vanished last, and of the others everyone in turn."""
        if len(rows) <= count:
            return rows
        late = self._points.hidden_for[rows] > 2
        order = np.argsort(late * (1 + (self._points.ids[rows] * 7919 + self._frames * 104729) % 1000), kind="stable")
        return np.sort(rows[order[:count]])

    def _predict(self, wanted: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, ...]:
        """Places of points from those around them: rows, appearance, uv_px, A, sigma_px of those that have enough.

        known  (N, 2) places of the points that may vouch for others, NaN where not
        """
        p = self._points
        if not len(wanted):
            return wanted, wanted, np.zeros((0, 2), np.float32), np.zeros((0, 2, 2), np.float32), np.zeros(0)
        at = p.rows(p.neighbour[wanted])
        now = known[at]
        use = (at >= 0) & np.isfinite(now[..., 0]) & (p.neighbour[wanted] >= 0)
        k = use.sum(2).argmax(1)
        i = np.arange(len(wanted))
        uv, A, sigma_px, ok = carried(p.neighbour_offset[wanted, k], now[i, k], use[i, k], p.sigma_px[at[i, k]])
        return wanted[ok], k[ok], uv[ok], A[ok], sigma_px[ok]

    def _consult(self, search: np.ndarray | None) -> None:
        """Hold every point against those around it: who strays is invisible, who is vague follows them.

        A point without texture of its own is where they say, as long as it looks as bare there.
        """
        p, cfg = self._points, self.config
        bare = self._bare()
        sure = p.visible & ~bare
        at, k, uv, A, sigma_px = self._predict(np.arange(len(p)), np.where(sure[:, None], p.uv, np.nan))
        off = np.linalg.norm(p.uv[at] - uv, axis=1)
        p.visible[at[sure[at] & (off > cfg.stray_px + 3 * np.hypot(sigma_px, p.sigma_px[at]))]] = False
        seen, mine = p.visible[at][:, None, None], p.cov[at]
        # What they say is worth less than its scatter: their errors have much in common. An invisible
        # point is guessed to be there.
        said = (2 * sigma_px**2 + 1)[:, None, None] * _EYE
        gain = np.where(seen, mine @ np.linalg.inv(mine + said), _EYE)
        p.uv[at] += (gain @ (uv - p.uv[at])[..., None])[..., 0]
        p.cov[at] = np.where(seen, (_EYE - gain) @ mine, said)
        vouched = sigma_px < cfg.return_sigma_px
        # Lucas-Kanade and the neighbours agree on a point that no appearance shows: it looks like this now.
        changed = p.visible[at] & (p.coasting[at] > 0) & (off < cfg.stray_px / 3) & vouched
        rows = at[changed]
        p.warp[rows] = A[changed] @ p.view[rows, k[changed]]
        p.coasting[rows] = 0
        self._remember(rows)
        self._carry_bare(at, k, uv, A, bare[at] & vouched & self._inside(uv, search), bare)

    def _carry_bare(self, at, k, uv, A, told: np.ndarray, bare: np.ndarray) -> None:
        """Points without texture are visible where they were ``told`` to be, if that place is as even as theirs."""
        p, cfg = self._points, self.config
        p.visible &= ~bare
        at, k, uv, A = at[told], k[told], uv[told], A[told]
        seen = align(self._fine, p.fine[at, k], uv, A, 0)
        good = self._plausible(at, k, seen) & (seen.stronger * p.fine.contrast[at, k] < 2 * cfg.bare_contrast)
        at, k = at[good], k[good]
        p.uv[at], p.warp[at] = uv[good], A[good] @ p.view[at, k]
        p.visible[at], p.coasting[at], p.ncc[at] = True, 0, 1

    def _check_depth(self, depth_m: np.ndarray) -> None:
        """A point whose depth jumps has slid off its object or something has come before it."""
        p, cfg = self._points, self.config
        px = np.clip(np.rint(p.uv), 0, np.array(depth_m.shape[::-1]) - 1).astype(int)
        now = depth_m[px[:, 1], px[:, 0]]
        jumped = p.visible & (now > 0) & (p.depth_m > 0) & (np.abs(now - p.depth_m) > cfg.depth_jump_m)
        # While a point is hidden its object goes anywhere: what it comes back to is not held against it.
        p.visible[jumped] = False
        p.depth_m = np.where(p.visible & (now > 0), now, np.where(p.visible, p.depth_m, 0)).astype(np.float32)

    def _bare(self) -> np.ndarray:
        """(N,) points whose surroundings were too even to be recognised."""
        return self._points.fine.contrast[:, 0] < self.config.bare_contrast

    def _search_everywhere(self, search: np.ndarray | None, urgent: bool) -> None:
        """Look for invisible points at corners that look like those once around them."""
        p, cfg = self._points, self.config
        wanted = np.flatnonzero(~p.visible & (p.hidden_for >= 1) & ~self._bare())
        if not len(wanted) or not (urgent or self._frames % cfg.redetect_every == 0):
            return
        # A level a time keeps the cost even; who waits for a return gets them all.
        turn = (self._frames // cfg.redetect_every) % len(features.SCALES)
        scales = features.SCALES if urgent else features.SCALES[turn : turn + 1]
        found = features.detect(self._gray, search, cfg.features, scales)
        if len(found) < 2:
            return
        wanted = self._turn(wanted, cfg.tries)
        i, k, j = np.nonzero(p.anchor[wanted].any(-1))
        best, distance, rival = features.nearest(p.anchor[wanted[i], k, j], found, 4.0, cfg.candidates)
        which, rank = np.nonzero(distance < cfg.ratio * rival[:, None])
        best, score = best[which, rank], distance[which, rank] / rival[which]
        i, k, j = i[which], k[which], j[which]
        A = found.frames[best] @ np.linalg.inv(p.anchor_frame[wanted[i], k, j])
        uv = found.uv_px[best] + (A @ p.anchor_offset[wanted[i], k, j][..., None])[..., 0]
        keep = self._inside(uv, search)
        # The best few corners of each point, then those that its neighbours support, then the best of each.
        order = np.lexsort((score, i))
        order = order[keep[order]]
        rank = np.arange(len(order)) - np.searchsorted(i[order], i[order])
        order = order[rank < 2 * cfg.candidates]
        rows, k = wanted[i[order]], k[order]
        seen, good = self._found(rows, k, uv[order], A[order])
        good &= self._support(rows, k, seen, good) >= cfg.support
        pick = np.flatnonzero(good)[np.argsort(-seen.ncc[good], kind="stable")]
        pick = pick[np.unique(rows[pick], return_index=True)[1]]
        self._settle(rows[pick], k[pick], seen, pick)

    def _support(self, rows: np.ndarray, k: np.ndarray, seen: Alignment, good: np.ndarray) -> np.ndarray:
        """How many neighbours are, or may be, where each finding expects them.

        rows, k  point and appearance of each finding (H,); those that are ``good`` speak for one another.
        """
        p = self._points
        may = np.full((len(p), 1 + 2 * self.config.candidates, 2), np.nan)
        may[p.visible, 0] = p.uv[p.visible]
        at = np.flatnonzero(good)
        at = at[np.argsort(rows[at], kind="stable")]
        may[rows[at], 1 + np.arange(len(at)) - np.searchsorted(rows[at], rows[at])] = seen.uv_px[at]
        offset = p.neighbour_offset[rows, k]
        expected = seen.uv_px[:, None] + offset @ seen.A.transpose(0, 2, 1)
        neighbour = p.rows(p.neighbour[rows, k])
        off = np.linalg.norm(may[neighbour] - expected[:, :, None], axis=-1)
        near = np.nan_to_num(off, nan=np.inf).min(2) < 3 + 0.15 * np.linalg.norm(offset, axis=-1)
        return (near & (neighbour >= 0)).sum(1)

    def _inside(self, uv: np.ndarray, search: np.ndarray | None) -> np.ndarray:
        """Whether places (N, 2) lie in the picture, and in the region searched."""
        h, w = self._gray.shape
        inside = (uv >= 0).all(1) & (uv <= [w - 1, h - 1]).all(1)
        if search is not None:
            px = np.clip(np.rint(uv), 0, [w - 1, h - 1]).astype(int)
            inside &= search[px[:, 1], px[:, 0]]
        return inside

    def _found(self, at, k, uv, A) -> tuple[Alignment, np.ndarray]:
        """Align points' appearances k from about uv and A, coarse to fine; and which of them look like the point."""
        p, cfg = self._points, self.config
        rough = align(self._coarse, p.coarse[at, k], uv / 2, A, cfg.iterations)
        seen = align(self._fine, p.fine[at, k], 2 * rough.uv_px, rough.A, cfg.iterations)
        good = (seen.ncc >= cfg.return_ncc) & (np.linalg.norm(seen.uv_px - uv, axis=1) < cfg.search_px)
        sigma_px = np.sqrt(np.trace(seen.cov_px2, axis1=1, axis2=2))
        good &= (sigma_px < cfg.return_sigma_px) & self._plausible(at, k, seen)
        return seen, good

    def _plausible(self, at: np.ndarray, k: np.ndarray, seen: Alignment) -> np.ndarray:
        """Whether brightness, contrast, colour and foreshortening are those of the appearance, about."""
        p, cfg = self._points, self.config
        off = np.abs(self._colour(seen.uv_px) - p.colour[at, k]).max(1)
        stretch = np.abs(np.linalg.det(seen.A))
        return (
            (off < cfg.colour_change)
            & (np.abs(seen.lighter) < cfg.grey_change)
            & (np.abs(np.log(seen.stronger)) < np.log(cfg.contrast_change))
            & (np.abs(np.log(stretch)) < np.log(cfg.area_change))
        )

    def _renew(self) -> None:
        """Remember how points look whose view has changed much since any appearance of theirs."""
        p, cfg = self._points, self.config
        at = np.flatnonzero(p.visible & (p.coasting == 0))
        if not len(at):
            return
        k = self._fitting(at)
        A = p.warp[at] @ np.linalg.inv(p.view[at, k])
        stretch = np.linalg.svd(A, compute_uv=False)
        far = (stretch.max(1) > cfg.renew_stretch) | (stretch.min(1) < 1 / cfg.renew_stretch)
        far |= p.ncc[at] < cfg.renew_ncc
        far &= p.sigma_px[at] < cfg.return_sigma_px
        self._remember(self._turn(at[far], cfg.tries))

    def _remember(self, rows: np.ndarray) -> None:
        """Store the present looks of these points as one more appearance; a full set gives up its last but first."""
        p = self._points
        if not len(rows):
            return
        slots = p.view.shape[1]
        k = np.where(p.count[rows] < slots, p.count[rows], 1 + (self._frames // self.config.renew_every) % (slots - 1))
        uv = p.uv[rows]
        p.view[rows, k], p.view_cov[rows, k] = p.warp[rows], p.cov[rows]
        p.fine[rows, k], p.coarse[rows, k] = take(self._fine, uv), take(self._coarse, uv / 2)
        p.colour[rows, k] = self._colour(uv)
        p.count[rows] = np.minimum(p.count[rows] + 1, slots)
        self._remember_neighbours(rows, k)
        self._remember_corners(rows, k)

    def _remember_neighbours(self, rows: np.ndarray, k: np.ndarray) -> None:
        p = self._points
        around = np.flatnonzero(p.visible)
        gap = np.linalg.norm(p.uv[rows][:, None] - p.uv[around][None], axis=-1)
        gap[rows[:, None] == around[None]] = np.inf
        near = np.argsort(gap, 1, kind="stable")[:, :NEIGHBOURS]
        ok = np.take_along_axis(gap, near, 1) < self.config.neighbour_px
        m = near.shape[1]
        p.neighbour[rows, k], p.neighbour_offset[rows, k] = -1, 0
        p.neighbour[rows, k, :m] = np.where(ok, p.ids[around[near]], -1)
        p.neighbour_offset[rows, k, :m] = p.uv[around[near]] - p.uv[rows][:, None]

    def _remember_corners(self, rows: np.ndarray, k: np.ndarray) -> None:
        p, reach = self._points, self.config.anchor_px
        region = np.zeros(self._gray.shape, np.uint8)
        px = np.clip(np.rint(p.uv[rows]).astype(int), 0, np.array(region.shape[::-1]) - 1)
        region[px[:, 1], px[:, 0]] = 1
        region = cv2.dilate(region, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        p.anchor[rows, k] = 0
        each = ANCHORS // len(_ANCHOR_SCALES)
        for level, scale in enumerate(_ANCHOR_SCALES):
            found = features.detect(self._gray, region, 4 * self.config.features, (scale,))
            if not len(found):
                continue
            offset = p.uv[rows][:, None] - found.uv_px[None]
            gap = np.linalg.norm(offset, axis=-1)
            near = np.argsort(gap, 1, kind="stable")[:, :each]
            i, rank = np.nonzero(np.take_along_axis(gap, near, 1) <= reach / scale)
            at, j = near[i, rank], level * each + rank
            p.anchor[rows[i], k[i], j] = found.descriptors[at]
            p.anchor_frame[rows[i], k[i], j] = found.frames[at]
            p.anchor_offset[rows[i], k[i], j] = offset[i, at]
