"""Plain Lucas-Kanade, the reference that every other tracker is measured against.

OpenCV's pyramidal LK (21 px window, 3 levels), checked forward and backward within 1 px. A point that
does not come home is invisible for good: nothing brings it back.
"""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.image import in_image
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks, joined
from p2p_lib.trackers.ids import PointIds

_WINDOW_PX, _LEVELS = (21, 21), 3
_FORWARD_BACKWARD_PX = 1.0


class LkTracker(PointTracker):
    """The reference tracker. It has no use for suggestions: nothing brings an invisible point back."""

    name = "lk"
    latency_frames = 0

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        self._ids = PointIds()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._ids.start()
        self._gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        self._tracks = self._ids.unseen()

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        uv = np.asarray(uv_px, np.float32).reshape(-1, 2)
        ids = self._ids.add(len(uv))
        self._tracks = joined([self._tracks, Tracks(ids, uv, np.ones(len(uv), bool), np.zeros(len(uv)))])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        self._ids.check_started()
        previous, self._gray = self._gray, cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        now = self._tracks
        at = np.flatnonzero(now.visible)
        if len(at):
            here = now.uv_px[at].astype(np.float32)
            there, found = _flow(previous, self._gray, here)
            home, back = _flow(self._gray, previous, there)
            error_px = np.linalg.norm(home - here, axis=1)
            ok = (found[:, 0] > 0) & (back[:, 0] > 0) & (error_px < _FORWARD_BACKWARD_PX)
            ok &= in_image(there, frame.shape)
            now.uv_px[at], now.visible[at] = there, ok
            now.uncertainty[at] = np.where(ok, 0.5 * error_px / _FORWARD_BACKWARD_PX, 1.0)
        uv = np.where(now.visible[:, None], now.uv_px, np.nan)
        return Tracks(now.ids.copy(), uv, now.visible.copy(), now.uncertainty.copy())

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._ids.drop(ids)
        self._tracks = self._tracks.select(self._ids.live)

    def reject(self, ids: np.ndarray) -> None:
        """Take these tracks for invisible."""
        self._tracks.visible[np.isin(self._ids.live, ids)] = False


def _flow(one: np.ndarray, other: np.ndarray, uv_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where points (N, 2) float32 of one grey image are in the other, and (N, 1) whether they were found."""
    empty = np.empty_like(uv_px)  # to be filled
    there, found, _ = cv2.calcOpticalFlowPyrLK(one, other, uv_px, empty, winSize=_WINDOW_PX, maxLevel=_LEVELS)
    return there, found
