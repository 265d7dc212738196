"""2D point tracking (paper: section "2D Point Tracker").

A tracker follows query points q = (t_q, u_q) through the video, causally, all objects' points in one
pass, and gives each point's pixel u_t, visibility delta_t and uncertainty sigma_t. The embedded
tracker needs no weights: pyramidal Lucas-Kanade checked forward-backward, and re-detection of
invisible points by descriptor wherever they show up again.
"""

from __future__ import annotations

from typing import Protocol

import cv2
import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks


class PointTracker(Protocol):
    """A streaming, causal 2D point tracker."""

    name: str
    latency_frames: int  # how many frames late `track` answers; 0 = at once

    def start(self, frame: Frame) -> None:
        """Begin a stream at this frame, forgetting any earlier one."""

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids (N,) int64, increasing."""

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; rows sorted by id.

        search  (H, W) bool says where the objects are known to be, if somebody knows; a tracker may
                use it to spare itself work elsewhere. None means the whole picture
        urgent  the caller waits for invisible points to come back: worth more work in this frame
        """

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""

    def reject(self, ids: np.ndarray) -> None:
        """The caller found these tracks wrong in the newest frame (they contradict the rigid motion).

        A tracker may use it, e.g. to look for the points anew; ignoring it is allowed.
        """


class LkTracker:
    """The embedded tracker: Lucas-Kanade, forward-backward check, re-detection by SIFT descriptor."""

    name = "lk"
    latency_frames = 0

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        self.config = config
        self._sift = cv2.SIFT_create(config.features, contrastThreshold=config.contrast, enable_precise_upscale=True)
        self._gray: np.ndarray | None = None
        self._clear()

    def _clear(self) -> None:
        self._next_id, self._frames = 0, 0
        self._ids = np.zeros(0, np.int64)
        self._uv = np.zeros((0, 2), np.float32)
        self._visible = np.zeros(0, bool)
        self._uncertainty = np.zeros(0, np.float32)
        self._hidden_for = np.zeros(0, np.int64)
        self._described = np.zeros(0, bool)
        self._descriptors = np.zeros((0, 128), np.float32)

    def start(self, frame: Frame) -> None:
        """Begin a stream at this frame."""
        self._clear()
        self._gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        if self._gray is None:
            raise BadInput("tracker", "queries before a frame", "start(frame) first")
        uv = np.asarray(uv_px, np.float32).reshape(-1, 2)
        ids = np.arange(self._next_id, self._next_id + len(uv))
        self._next_id += len(uv)
        described, descriptors = self._describe(uv)
        self._ids = np.concatenate([self._ids, ids])
        self._uv = np.concatenate([self._uv, uv])
        self._visible = np.concatenate([self._visible, np.ones(len(uv), bool)])
        self._uncertainty = np.concatenate([self._uncertainty, np.zeros(len(uv), np.float32)])
        self._hidden_for = np.concatenate([self._hidden_for, np.zeros(len(uv), np.int64)])
        self._described = np.concatenate([self._described, described])
        self._descriptors = np.concatenate([self._descriptors, descriptors])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        if self._gray is None:
            raise BadInput("tracker", "a frame to track before any start", "start(frame) first")
        previous, self._gray = self._gray, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        self._frames += 1
        self._follow(previous)
        if urgent or self._frames % self.config.redetect_every == 0:
            self._redetect(search)
        self._hidden_for = np.where(self._visible, 0, self._hidden_for + 1)
        if self.config.forget_after:
            self._described &= self._hidden_for < self.config.forget_after
        uv = np.where(self._visible[:, None], self._uv, np.nan).astype(float)
        return Tracks(self._ids.copy(), uv, self._visible.copy(), self._uncertainty.astype(float))

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        keep = ~np.isin(self._ids, ids)
        for name in ("_ids", "_uv", "_visible", "_uncertainty", "_hidden_for", "_described", "_descriptors"):
            setattr(self, name, getattr(self, name)[keep])

    def reject(self, ids: np.ndarray) -> None:
        """Take these tracks for invisible until their descriptor is seen again."""
        self._visible &= ~np.isin(self._ids, ids)

    def _follow(self, previous: np.ndarray) -> None:
        """Lucas-Kanade there and back; a point that does not come home is invisible."""
        at = np.flatnonzero(self._visible)
        if not len(at):
            return
        cfg = self.config
        flow = {"winSize": (cfg.window_px, cfg.window_px), "maxLevel": cfg.levels}
        here = self._uv[at]
        there, found, _ = cv2.calcOpticalFlowPyrLK(previous, self._gray, here, None, **flow)
        home, found_back, _ = cv2.calcOpticalFlowPyrLK(self._gray, previous, there, None, **flow)
        error_px = np.linalg.norm(home - here, axis=1)
        h, w = self._gray.shape
        ok = (found[:, 0] > 0) & (found_back[:, 0] > 0) & (error_px < cfg.forward_backward_px)
        ok &= (there >= 0).all(1) & (there <= [w - 1, h - 1]).all(1)
        self._uv[at] = there
        self._visible[at] = ok
        self._uncertainty[at] = np.where(ok, np.clip(error_px / cfg.forward_backward_px, 0, 1) * 0.5, 1.0)

    def _redetect(self, search: np.ndarray | None) -> None:
        """Give invisible points the place whose descriptor is clearly nearest to theirs."""
        wanted = np.flatnonzero(~self._visible & self._described)
        if not len(wanted):
            return
        uv, descriptors = self._features(search)
        if len(uv) < 2:
            return
        distance = np.sqrt(np.maximum(2 - 2 * self._descriptors[wanted] @ descriptors.T, 0))
        best = np.argmin(distance, 1)
        rows = np.arange(len(wanted))
        nearest = distance[rows, best]
        # A second detection of the very same corner is no rival.
        rival = np.linalg.norm(uv[None] - uv[best][:, None], axis=-1) > 3
        second = np.where(rival, distance, np.inf).min(1)
        mutual = np.argmin(distance, 0)[best] == rows
        ok = mutual & (nearest < self.config.ratio * second)
        at = wanted[ok]
        self._uv[at], self._visible[at] = uv[best[ok]], True
        self._uncertainty[at] = np.clip(nearest[ok] / 2, 0, 1)

    def _features(self, region: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """SIFT positions (M, 2) and root-SIFT descriptors (M, 128), unit length, in a region of the picture."""
        x0, y0, x1, y1 = 0, 0, self._gray.shape[1], self._gray.shape[0]
        crop_mask = None
        if region is not None:
            x, y, w, h = cv2.boundingRect(region.astype(np.uint8))
            if not w:
                return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
            x0, y0, x1, y1 = max(0, x - 16), max(0, y - 16), min(x1, x + w + 16), min(y1, y + h + 16)
            crop_mask = np.ascontiguousarray(region[y0:y1, x0:x1]).astype(np.uint8)
        points, raw = self._sift.detectAndCompute(self._gray[y0:y1, x0:x1], crop_mask)
        if not points:
            return np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32)
        uv = cv2.KeyPoint.convert(points) + np.float32([x0, y0])
        return uv, np.sqrt(raw / np.maximum(np.abs(raw).sum(1, keepdims=True), 1e-9))

    def _describe(self, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The descriptor of the SIFT feature at each query, where there is one within 1.5 px."""
        descriptors = np.zeros((len(uv), 128), np.float32)
        if not len(uv):
            return np.zeros(0, bool), descriptors
        region = np.zeros(self._gray.shape, np.uint8)
        px = np.clip(np.rint(uv).astype(int), 0, np.array(self._gray.shape[::-1]) - 1)
        region[px[:, 1], px[:, 0]] = 1
        features, found = self._features(cv2.dilate(region, np.ones((5, 5), np.uint8)) > 0)
        if not len(features):
            return np.zeros(len(uv), bool), descriptors
        distance = np.linalg.norm(features[None] - uv[:, None], axis=-1)
        nearest = distance.argmin(1)
        described = distance[np.arange(len(uv)), nearest] < 1.5
        descriptors[described] = found[nearest[described]]
        return described, descriptors


#: Trackers by the name that --tracker takes.
TRACKERS = {"lk": LkTracker}
#: The one that runs when none is named.
DEFAULT_TRACKER = "lk"


def make_tracker(name: str, config: TrackingConfig, rng: np.random.Generator | None = None) -> PointTracker:
    """The tracker called ``name``; unknown names are refused with the list of those there are."""
    if name not in TRACKERS:
        raise BadInput("tracker", repr(name), "one of " + ", ".join(TRACKERS))
    return TRACKERS[name](config, rng)
