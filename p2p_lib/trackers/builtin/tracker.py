"""The built-in tracker: the order in which a frame goes through its parts (see the package's text)."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame, Tracks, joined
from p2p_lib.trackers.builtin import recognition
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.motion_segments import MIN_FOUND, MIN_SUGGESTED, MotionSegments
from p2p_lib.trackers.builtin.rigid_motion import PointPrediction
from p2p_lib.trackers.builtin.tracked_points import Points
from p2p_lib.trackers.ids import PointIds

_EYE = np.eye(2)
#: Errors of a prediction beyond its covariance, px: of a point that is seen, of one that is not.
_PREDICTION_PX, _UNSEEN_PX = 0.5, 1.0
#: Error of a point that each match adds while nothing else carries it, px.
_CHAINED_PX = 0.35
#: A point farther from its segment's prediction than this many variances is another one.
_FAR_CHI2 = 16.0
#: Cosine of surface normal and view below which a point counts as turned away.
_MIN_COSINE = 0.1


class BuiltinTracker:
    """Long-range point tracker. Implements :class:`p2p_lib.core.interfaces.PointTracker`."""

    name = "builtin"
    latency_frames = 0

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        self.config = config
        self._ids = PointIds()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame; without a camera, one with a common field of view is assumed."""
        h, w = frame.shape
        self._ids.start()
        self._frames = 0
        self._search: np.ndarray | None = None
        self._points = Points.new(np.zeros((0, 2)), self.config.templates)
        self._segments = MotionSegments(self.config)
        self._camera = camera or Camera(0.95 * w, 0.95 * w, (w - 1) / 2, (h - 1) / 2, w, h)
        self._now = Image.of(frame, self._camera)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        uv = np.asarray(uv_px, np.float32).reshape(-1, 2)
        ids = self._ids.add(len(uv))
        new = len(self._points) + np.arange(len(uv))
        self._points = joined([self._points, Points.new(uv, self.config.templates)])
        recognition.store_templates(self._points, new, self._now, 0)
        self._segments.assign(self._points, new, self._now)
        self._segments.add_landmarks(self._points, self._now, first=True)
        self._segments.remember(self._points, self._now, self._search)
        return ids

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        kept = self._ids.drop(ids)
        gone = self._points.template[~kept]
        self._points.templates.let_go(gone[gone >= 0])
        self._points = self._points.select(kept)
        self._segments.compact(self._points)

    def reject(self, ids: np.ndarray) -> None:
        """Take these tracks for invisible until they are found again."""
        p, wrong = self._points, np.isin(self._ids.live, ids)
        self._segments.invalidate(p, wrong)
        p.visible &= ~wrong
        p.verified &= ~wrong
        # Their last position is wrong: no place to search first.
        p.hidden_for[wrong] = self.config.linger_frames + 1

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Guided re-detection: search for lost segments where the caller expects their points in the newest frame.

        ids, uv_px  (N,), (N, 2): points of one rigid object, the visible ones too, for they fix its rotation.
        """
        p = self._points
        usable = np.isin(ids, self._ids.live) & np.isfinite(uv_px).all(1)
        rows = np.searchsorted(self._ids.live, np.asarray(ids)[usable])
        known = self._segments.posed(p)
        lost = self._segments.suggest(p, rows, uv_px[usable], self._now)
        self._find_predicted(None, MIN_SUGGESTED)
        self._segments.restore(lost)
        if (self._segments.posed(p) & ~known).any():
            self._reconcile(None)
            p.hidden_for[p.visible] = 0
        return self._tracks()

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        self._ids.check_started()
        before, self._now = self._now, Image.of(frame, self._camera)
        self._frames, self._search = self._frames + 1, search
        p, cfg, now = self._points, self.config, self._now
        recognition.follow(p, before, now, cfg)
        self._segments.fit(p, now, search)
        if urgent or self._frames % cfg.redetect_every == 0:
            self._segments.search(now, search)
        self._find_predicted(search)
        self._reconcile(search)
        p.hidden_for = np.where(p.visible, 0, p.hidden_for + 1)
        if self._frames % cfg.update_every == 0:
            recognition.update_templates(p, now, cfg, self._frames // cfg.update_every)
            recognition.sharpen_templates(p, np.flatnonzero(p.visible & ~p.verified & self._segments.posed(p)), now)
            self._segments.assign(p, np.flatnonzero(p.verified & (p.segment < 0)), now)
            self._segments.add_landmarks(p, now)
        self._segments.remember(p, now, search)
        return self._tracks()

    def _tracks(self) -> Tracks:
        """The points as the caller gets them."""
        p = self._points
        # A bounded, monotonous reading of the standard deviation: 1/2 at uncertain_px.
        sigma_px = np.sqrt(np.trace(p.cov, axis1=1, axis2=2))
        uncertainty = np.where(p.visible, sigma_px / (sigma_px + self.config.uncertain_px), 1.0)
        return Tracks(self._ids.live.copy(), p.uv.astype(float), p.visible.copy(), uncertainty.astype(float))

    def _exposed(self, predicted: PointPrediction, search: np.ndarray | None) -> np.ndarray:
        """Whether predicted points face the camera, with their own surface or no depth measured at their pixels."""
        z = self._now.depth_at(predicted.uv_px)
        own = (z == 0) | (np.abs(z - predicted.z_m) <= self.config.depth_jump_m)
        return own & (predicted.cosine > _MIN_COSINE) & self._now.inside(predicted.uv_px, search)

    def _find_predicted(self, search: np.ndarray | None, fewest: float = MIN_FOUND) -> None:
        """Search for the points that were not followed where their segments predict them, a share of them at least."""
        p, cfg = self._points, self.config
        textured = p.contrast >= cfg.textureless_contrast
        rows = np.flatnonzero(~p.verified & textured & self._segments.posed(p, cfg.linger_frames))
        if len(rows):
            predicted = self._segments.predict(p, rows, self._now)
            pick = np.flatnonzero(self._exposed(predicted, search) & (predicted.sigma_px < cfg.search_px))
            sigma_px = np.hypot(predicted.sigma_px, _CHAINED_PX * np.sqrt(p.chained[rows]))[pick]
            where = predicted.uv_px[pick], predicted.warp[pick], sigma_px
            rows = rows[pick]
            recognition.find(p, rows, *where, self._now, cfg)
        # What was badly predicted for long says nothing of whether its segment is there.
        self._segments.fit_found(p, self._now, rows[p.chained[rows] <= cfg.linger_frames], fewest)

    def _reconcile(self, search: np.ndarray | None) -> None:
        """Compare points with their segments' predictions: what faces away or is hidden is invisible.

        Points that agree are averaged with their prediction; others take it as it is, visible if it is accurate.
        """
        p, cfg = self._points, self.config
        p.visible = p.verified.copy()
        rows = np.flatnonzero(self._segments.posed(p) & ~p.leaving)
        if not len(rows):
            return
        predicted = self._segments.predict(p, rows, self._now)
        exposed, off, cov = self._exposed(predicted, search), p.uv[rows] - predicted.uv_px, p.cov[rows].astype(float)
        inverse = np.linalg.inv(cov + predicted.cov_px2 + _PREDICTION_PX**2 * _EYE)
        seen = p.verified[rows] & (((off[:, None] @ inverse)[:, 0] * off).sum(1) < _FAR_CHI2)
        self._segments.update_positions(p, rows[seen & exposed & (p.coasting[rows] == 0)], self._now)
        gain = np.where(seen[:, None, None], cov @ inverse, _EYE)
        p.uv[rows] -= (gain @ off[..., None])[..., 0].astype(np.float32)
        # Corners that were matched are seen beside a point that is not, but from match to match errors add up.
        p.chained[rows] = np.where(p.verified[rows], 0, p.chained[rows] + self._segments.matched(p)[rows])
        chained = p.chained[rows]
        unseen_px = np.where(chained > 0, _CHAINED_PX * np.sqrt(chained), _UNSEEN_PX)[:, None, None]
        p.cov[rows] = np.where(seen[:, None, None], (_EYE - gain) @ cov, predicted.cov_px2 + unseen_px**2 * _EYE)
        p.warp[rows[~seen]] = predicted.warp[~seen]
        p.verified[rows] = seen & exposed
        reliable = (predicted.sigma_px < cfg.max_predicted_sigma_px) & (chained <= cfg.linger_frames)
        p.visible[rows] = exposed & (seen | reliable)
