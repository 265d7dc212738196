"""What of the built-in tracker is 2D alone: the same points and templates, without depth and without rigid motion.

The paper claims that long-range *2D* tracks suffice for recovery. The built-in tracker cannot show it, for it reads
depth and knows which points move as one body. This one sees colour alone, as a learned point tracker does: each point
is followed for itself, and one that was lost is sought by its own appearance in the whole image.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.builtin import features, recognition
from p2p_lib.trackers.builtin.tracker import BuiltinTracker

#: The grid on which a point's surroundings are described: two pixels of the image a step.
_STEP_PX = 2 * np.eye(2)
#: A point lies at most about so far from the corner by which it is recognised.
_FROM_CORNER_PX = 3.0
#: Neither depth nor a segment tells that a point is hidden: what is not recognised is soon taken for it.
_COAST_FRAMES = 2
#: A description says nothing of how far a point has turned: these are tried.
_TURNS = np.radians([0, 25, -25, 50, -50, 75, -75])
_ROTATIONS = np.array([[[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]] for a in _TURNS], np.float32)


class ImageOnlyTracker(BuiltinTracker):
    """The built-in tracker without depth. Rigid motion segments need depth, so it has none of these either."""

    name = "builtin2d"

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        super().__init__(replace(config, coast_frames=min(config.coast_frames, _COAST_FRAMES)), rng)

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        super().start(_without_depth(frame), camera)
        self._described = np.zeros((0, features.SIZE), np.float32)  # a row per live point, of when it was added

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        ids = super().add(uv_px)
        self._described = np.concatenate([self._described, self._describe(np.asarray(uv_px, float).reshape(-1, 2))])
        return ids

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._described = self._described[~np.isin(self._ids.live, ids)]
        super().drop(ids)

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Ignored, as by learned trackers: where an object's points must be follows from its rigid motion."""

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        return super().track(_without_depth(frame), search, urgent)

    def _find_predicted(self, search: np.ndarray | None, fewest: float = 0) -> None:
        """There are no predictions: points that were lost are sought among the corners of the whole image."""
        p, cfg, now = self._points, self.config, self._now
        lost = np.flatnonzero(~p.verified & (p.contrast >= cfg.textureless_contrast))
        if not len(lost) or self._frames % cfg.redetect_every:
            return
        corners = features.detect(now.gray, search, cfg.corners)
        if len(corners) <= 2:  # match() compares with the next best place but one
            return
        which, corner = features.match(self._described[lost], self._describe(corners), corners, cfg.match_ratio)
        rows, uv, warp = lost[which], corners[corner], p.warp[lost[which]].copy()
        for rotation in _ROTATIONS:
            left = ~p.verified[rows]
            recognition.find(p, rows[left], uv[left], rotation @ warp[left], _FROM_CORNER_PX, now, cfg)
        left = ~p.verified[rows]
        p.warp[rows[left]] = warp[left]

    def _describe(self, uv_px: np.ndarray) -> np.ndarray:
        return features.describe(self._now.gray, uv_px, [np.tile(_STEP_PX, (len(uv_px), 1, 1))])[:, 0]


def _without_depth(frame: Frame) -> Frame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))
