"""A tracker that knows the truth, for experiments on what comes after tracking: spoiled as much as one chooses."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import OracleConfig
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks, joined
from p2p_lib.evaluation.true_tracks import NO_POINTS, TrueScene
from p2p_lib.trackers.ids import PointIds

# What is drawn for a frame; each kind has a stream of its own, so that points added later change no earlier draw.
_NOISE, _DROPOUT, _OUTLIER, _PLACE, _SLIDE = range(5)


class OracleTracker(PointTracker):
    """True tracks of a sequence's own frames; rejections and suggestions are ignored.

    A query belongs to the object whose mask holds it, and lies on that object's true surface; one that lies on
    no object is never visible again. A visible point is reported with Gaussian noise, new in each frame, and with an
    error that lasts, as of a track that slides; a chosen share is called invisible, another is put anywhere on a ring
    around the truth without saying so, both for some frames on end. The uncertainty is 0 where visible, 1 elsewhere.
    What is drawn depends on the seed, the frame and the point's id alone.
    """

    name = "oracle"
    latency_frames = 0

    def __init__(self, scene: TrueScene, config: OracleConfig | None = None, seed: int = 0):
        self.config = config or OracleConfig()
        self._scene, self._seed = scene, seed
        self._ids = PointIds()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._ids.start()
        self._frame, self._points = frame, NO_POINTS

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        uv = np.asarray(uv_px, float).reshape(-1, 2)
        ids = self._ids.add(len(uv))
        new = self._scene.lift(self._frame, self._scene.owners(self._frame, uv), uv)
        self._points = joined([self._points, new])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Where truth has the points in the next frame, spoiled as configured."""
        self._ids.check_started()
        self._frame, cfg = frame, self.config
        true = self._scene.see(frame, self._points)
        span, since = divmod(frame.index, cfg.lasting_frames)
        part = since / cfg.lasting_frames
        visible = true.visible & (self._drawn(_DROPOUT, span, "random") >= cfg.dropout)
        uv = true.uv_px + cfg.noise_px * self._drawn(_NOISE, frame.index, "standard_normal", 2)
        ends = (self._drawn(_SLIDE, span + k, "standard_normal", 2) for k in (0, 1))
        uv += cfg.slide_px * sum(np.sqrt(weight) * end for weight, end in zip((1 - part, part), ends, strict=True))
        stray = self._drawn(_OUTLIER, span, "random") < cfg.outliers
        turn = 2 * np.pi * self._drawn(_PLACE, span, "random")
        uv += np.where(stray, cfg.outlier_px, 0)[:, None] * np.stack([np.cos(turn), np.sin(turn)], 1)
        visible &= self._scene.sequence.camera.inside(uv)
        return Tracks(self._ids.live.copy(), np.where(visible[:, None], uv, np.nan), visible, 1.0 - visible)

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._points = self._points.select(self._ids.drop(ids))

    def _drawn(self, kind: int, time: int, distribution: str, *columns: int) -> np.ndarray:
        """Numbers of a distribution of :class:`numpy.random.Generator` at a time, a row for each live point."""
        rng, live = np.random.default_rng([self._seed, time, kind]), self._ids.live
        return getattr(rng, distribution)((live.max(initial=-1) + 1, *columns))[live]
