"""A tracker that knows the truth, for experiments on what comes after tracking: spoiled as much as one chooses."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import OracleConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks, joined
from p2p_lib.evaluation.true_tracks import NO_POINTS, TrueScene

# What is drawn for a frame; each kind has a stream of its own, so that points added later change no earlier draw.
_NOISE, _DROPOUT, _OUTLIER, _PLACE = range(4)


class OracleTracker:
    """True tracks of a sequence's own frames. Implements :class:`p2p_lib.core.interfaces.PointTracker`.

    A query belongs to the object whose mask holds it, and lies on that object's true surface; one that lies on
    no object is never visible again. A visible point is reported with Gaussian noise; a chosen share is called
    invisible, another is put anywhere on a ring around the truth without saying so. The uncertainty is 0 where
    visible, 1 elsewhere. What is drawn depends on the seed, the frame and the point's id alone.
    """

    name = "oracle"
    latency_frames = 0

    def __init__(self, scene: TrueScene, config: OracleConfig | None = None, seed: int = 0):
        self.config = config or OracleConfig()
        self._scene, self._seed = scene, seed
        self._frame: Frame | None = None  # the newest

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._frame, self._next_id = frame, 0
        self._ids, self._points = np.zeros(0, np.int64), NO_POINTS

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        if self._frame is None:
            raise BadInput("tracker", "queries before a frame", "start(frame) first")
        uv = np.asarray(uv_px, float).reshape(-1, 2)
        ids = np.arange(self._next_id, self._next_id + len(uv))
        self._next_id += len(uv)
        self._ids = np.concatenate([self._ids, ids])
        new = self._scene.lift(self._frame, self._scene.owners(self._frame, uv), uv)
        self._points = joined([self._points, new])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Where truth has the points in the next frame, spoiled as configured."""
        if self._frame is None:
            raise BadInput("tracker", "a frame to track before any start", "start(frame) first")
        self._frame, cfg = frame, self.config
        sight = self._scene.see(frame, self._points)
        visible = sight.visible & (self._uniform(_DROPOUT) >= cfg.dropout)
        uv = sight.uv_px + cfg.noise_px * self._rng(_NOISE).standard_normal((self._next_id, 2))[self._ids]
        stray = self._uniform(_OUTLIER) < cfg.outliers
        turn = 2 * np.pi * self._uniform(_PLACE)
        uv += np.where(stray, cfg.outlier_px, 0)[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
        visible &= self._scene.sequence.camera.inside(uv)
        return Tracks(self._ids.copy(), np.where(visible[:, None], uv, np.nan), visible, 1.0 - visible)

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        keep = ~np.isin(self._ids, ids)
        self._ids, self._points = self._ids[keep], self._points.select(keep)

    def reject(self, ids: np.ndarray) -> None:
        """Ignored: it knows better."""

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Ignored: it knows better."""

    def _rng(self, kind: int) -> np.random.Generator:
        return np.random.default_rng([self._seed, self._frame.index, kind])

    def _uniform(self, kind: int) -> np.ndarray:
        """A number in [0, 1) for each live point."""
        return self._rng(kind).random(self._next_id)[self._ids]
