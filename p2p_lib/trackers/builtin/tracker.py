"""The embedded 2D tracker: long-range, without weights, on the CPU.

Every point keeps a few appearances of itself (:mod:`p2p_lib.trackers.builtin.recognition`). From frame to frame
Lucas-Kanade proposes its place, and alignment with the best fitting appearance decides: that takes the
drift out, and a place that does not look like the point is not one. Points that move together make a
rigid body (:mod:`p2p_lib.trackers.builtin.motion_segments`), whose pose says where all its points are, how they are
warped and which of them face the camera: those not followed are looked for there. A body that is nowhere is
looked for in the whole picture by the corners that were once on it (:mod:`p2p_lib.trackers.builtin.landmarks`).
Whatever is found is verified by alignment.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.builtin import recognition
from p2p_lib.trackers.builtin.image import Picture
from p2p_lib.trackers.builtin.motion_segments import Bodies
from p2p_lib.trackers.builtin.rigid_motion import Prediction
from p2p_lib.trackers.builtin.tangent_planes import usual_camera
from p2p_lib.trackers.builtin.tracked_points import Points

_EYE = np.eye(2)
#: What a body's pose does not know of its points: errors that its points share, px.
_SHARED_PX, _GUESS_PX = 0.5, 1.0
#: A point farther from its body's word than this many variances is not it.
_FAR = 16.0


class BuiltinTracker:
    """Long-range point tracker; see the module's text. Implements :class:`p2p_lib.core.interfaces.PointTracker`."""

    name = "builtin"
    latency_frames = 0

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        self.config = config
        self._now: Picture | None = None
        self._clear()

    def _clear(self) -> None:
        self._next_id, self._frames = 0, 0
        self._points = Points.new(np.zeros(0, np.int64), np.zeros((0, 2)), self.config.appearances)
        self._bodies = Bodies(self.config)

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame, of this camera; without one, of a usual one."""
        self._clear()
        self._camera = camera or usual_camera(*frame.shape[::-1])
        self._now = Picture.of(frame, self._camera)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        if self._now is None:
            raise BadInput("tracker", "queries before a frame", "start(frame) first")
        uv = np.asarray(uv_px, np.float32).reshape(-1, 2)
        ids = np.arange(self._next_id, self._next_id + len(uv))
        self._next_id += len(uv)
        new = len(self._points) + np.arange(len(uv))
        self._points = self._points.joined(Points.new(ids, uv, self.config.appearances))
        recognition.remember(self._points, new, self._now, 0)
        self._bodies.adopt(self._points, new, self._now)
        return ids

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._points = self._points.select(~np.isin(self._points.ids, ids))
        self._bodies.compact(self._points)

    def reject(self, ids: np.ndarray) -> None:
        """Take these tracks for invisible until they are found again."""
        p, gone = self._points, np.isin(self._points.ids, ids)
        self._bodies.doubt(p, gone)
        p.visible &= ~gone
        p.verified &= ~gone
        # Where it was is wrong: not the place to look first.
        p.hidden_for[gone] = self.config.linger_frames + 1

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks:
        """Look for bodies that are lost where the caller expects their points in the newest frame.

        ids, uv_px  (N,), (N, 2): all points of one rigid body, the visible ones too: they say how it is turned.
        """
        p = self._points
        at = p.rows(ids)
        ok = (at >= 0) & np.isfinite(uv_px).all(1)
        known = self._bodies.posed(p)
        self._bodies.suggest(p, at[ok], uv_px[ok], self._now)
        self._look(None)
        if (self._bodies.posed(p) & ~known).any():
            self._judge(None)
            self._check_depth()
            p.hidden_for[p.visible] = 0
        return self._told()

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        if self._now is None:
            raise BadInput("tracker", "a frame to track before any start", "start(frame) first")
        before, self._now = self._now, Picture.of(frame, self._camera)
        self._frames += 1
        p, cfg, now = self._points, self.config, self._now
        recognition.follow(p, before, now, cfg)
        self._bodies.fit(p, now)
        if urgent or self._frames % cfg.redetect_every == 0:
            self._bodies.search(now, search, None if urgent else self._frames // cfg.redetect_every)
        self._look(search)
        self._judge(search)
        self._check_depth()
        p.hidden_for = np.where(p.visible, 0, p.hidden_for + 1)
        if self._frames % cfg.renew_every == 0:
            recognition.renew(p, now, cfg, self._frames // cfg.renew_every)
            self._bodies.adopt(p, np.flatnonzero(p.verified & (p.body < 0)), now)
            self._bodies.join(p)
            self._bodies.survey(p, now)
        return self._told()

    def _told(self) -> Tracks:
        """The points as the caller gets them."""
        p = self._points
        # A bounded, monotonous reading of the standard deviation: 1/2 at uncertain_px.
        uncertainty = np.where(p.visible, p.sigma_px / (p.sigma_px + self.config.uncertain_px), 1.0)
        return Tracks(p.ids.copy(), p.uv.astype(float), p.visible.copy(), uncertainty.astype(float))

    def _exposed(self, told: Prediction, search: np.ndarray | None) -> np.ndarray:
        """Whether predicted points face the camera, and the surface there is theirs or was not measured."""
        z = self._now.depth_at(told.uv_px)
        theirs = (z == 0) | (np.abs(z - told.z_m) <= self.config.depth_jump_m)
        return theirs & (told.cosine > self.config.min_cosine) & self._now.inside(told.uv_px, search)

    def _look(self, search: np.ndarray | None) -> None:
        """Look for the points that were not followed where their bodies say they are."""
        p, cfg = self._points, self.config
        bare = p.fine.contrast[:, 0] < cfg.bare_contrast
        rows = np.flatnonzero(~p.verified & ~bare & self._bodies.posed(p, cfg.linger_frames))
        tried = np.zeros(len(p), bool)
        if len(rows):
            told = self._bodies.predict(p, rows, self._now)
            pick = np.flatnonzero(self._exposed(told, search) & (told.sigma_px < cfg.search_px))
            pick = pick[np.isin(rows[pick], recognition.in_turn(p, rows[pick], cfg.tries, self._frames))]
            tried[rows[pick]] = True
            recognition.find(p, rows[pick], told.uv_px[pick], told.warp[pick], told.sigma_px[pick], self._now, cfg)
        self._bodies.fit(p, self._now, lost_only=True)
        self._bodies.keep(p, tried)

    def _judge(self, search: np.ndarray | None) -> None:
        """Hold points against their bodies: what is turned away or hidden is invisible, what is vague follows."""
        p, cfg = self._points, self.config
        p.visible = p.verified.copy()
        rows = np.flatnonzero(self._bodies.posed(p) & ~p.loose)
        if not len(rows):
            return
        told = self._bodies.predict(p, rows, self._now)
        exposed, off, mine = self._exposed(told, search), p.uv[rows] - told.uv_px, p.cov[rows].astype(float)
        inverse = np.linalg.inv(mine + told.cov_px2 + _SHARED_PX**2 * _EYE)
        seen = p.verified[rows] & (((off[:, None] @ inverse)[:, 0] * off).sum(1) < _FAR)
        self._bodies.learn(p, rows[seen & exposed & (p.coasting[rows] == 0)], self._now)
        gain = np.where(seen[:, None, None], mine @ inverse, _EYE)
        p.uv[rows] -= (gain @ off[..., None])[..., 0].astype(np.float32)
        p.cov[rows] = np.where(seen[:, None, None], (_EYE - gain) @ mine, told.cov_px2 + _GUESS_PX**2 * _EYE)
        p.warp[rows[~seen]] = told.warp[~seen]
        p.verified[rows] = seen & exposed
        p.visible[rows] = exposed & (seen | (told.sigma_px < cfg.guess_px))

    def _check_depth(self) -> None:
        """A point whose depth jumps has slid off its object or something has come before it."""
        p, cfg = self._points, self.config
        z = self._now.depth_at(p.uv)
        jumped = p.visible & (z > 0) & (p.depth_m > 0) & (np.abs(z - p.depth_m) > cfg.depth_jump_m)
        # While a point is hidden its object goes anywhere: what it comes back to is not held against it.
        p.visible[jumped] = False
        p.depth_m = np.where(p.visible & (z > 0), z, np.where(p.visible, p.depth_m, 0)).astype(np.float32)
