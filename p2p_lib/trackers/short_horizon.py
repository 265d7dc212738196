"""SH(n): a tracker without long memory (paper: P2P-SH(10), the ablation on recovery).

Whatever tracker it is, a point that was invisible for n frames in a row is dropped from it and stays
invisible for good.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.ids import PointIds


class ShortHorizon:
    """A tracker that forgets points after ``forget_after`` invisible frames in a row.

    Its rows stay until the caller drops them, as with any other point. Implements
    :class:`p2p_lib.core.interfaces.PointTracker`; names itself ``TRACKER-sh(n)``.
    """

    def __init__(self, tracker: PointTracker, forget_after: int):
        self.name = f"{tracker.name}-sh({forget_after})"
        self.latency_frames = tracker.latency_frames
        self._tracker, self._forget_after = tracker, forget_after
        self._ids = PointIds()

    @property
    def _followed(self) -> np.ndarray:
        """Ids of the points that are not forgotten."""
        return self._ids.live[self._hidden_for < self._forget_after]

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._ids.start()
        self._hidden_for = np.zeros(0, np.int64)
        self._tracker.start(frame, camera)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        ids = self._tracker.add(uv_px)
        self._ids.extend(ids)
        self._hidden_for = np.concatenate([self._hidden_for, np.full(len(ids), -self.latency_frames)])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow the points that are not forgotten; rows of all, sorted by id."""
        followed = self._followed
        tracks = self._with_forgotten(self._tracker.track(frame, search, urgent))
        self._hidden_for = np.where(tracks.visible, 0, self._hidden_for + 1)
        self._tracker.drop(np.setdiff1d(followed, self._followed))
        return tracks

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._tracker.drop(self._followed[np.isin(self._followed, ids)])
        self._hidden_for = self._hidden_for[self._ids.drop(ids)]

    def reject(self, ids: np.ndarray) -> None:
        """Handed on, for the points that are not forgotten."""
        self._tracker.reject(np.asarray(ids)[np.isin(ids, self._followed)])

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Handed on, for the points that are not forgotten."""
        known = np.isin(ids, self._followed)
        tracks = self._tracker.suggest(ids[known], uv_px[known])
        if tracks is None:
            return None
        tracks = self._with_forgotten(tracks)
        self._hidden_for[tracks.visible] = 0
        return tracks

    def _with_forgotten(self, tracks: Tracks) -> Tracks:
        """The tracks of the points that are not forgotten among those of all."""
        live = self._hidden_for < self._forget_after
        tracks, everyone = tracks.select(self._ids.live[live]), self._ids.unseen()
        everyone.uv_px[live], everyone.visible[live] = tracks.uv_px, tracks.visible
        everyone.uncertainty[live] = tracks.uncertainty
        return everyone
