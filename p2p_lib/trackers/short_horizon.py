"""SH(n): a tracker without long memory (paper: P2P-SH(10), the ablation on recovery).

Whatever tracker it is, a point that was invisible for n frames in a row is dropped from it and stays
invisible for good.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks


class ShortHorizon:
    """A tracker that forgets points after ``forget_after`` invisible frames in a row.

    Its rows stay until the caller drops them, as with any other point. Implements
    :class:`p2p_lib.core.interfaces.PointTracker`; names itself ``TRACKER-sh(n)``.
    """

    def __init__(self, tracker: PointTracker, forget_after: int):
        self.name = f"{tracker.name}-sh({forget_after})"
        self.latency_frames = tracker.latency_frames
        self._tracker, self._forget_after = tracker, forget_after
        self._clear()

    def _clear(self) -> None:
        self._ids = np.zeros(0, np.int64)
        self._hidden_for = np.zeros(0, np.int64)

    @property
    def _gone(self) -> np.ndarray:
        """(N,) bool: points that were forgotten."""
        return self._hidden_for >= self._forget_after

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._clear()
        self._tracker.start(frame, camera)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        ids = self._tracker.add(uv_px)
        self._ids = np.concatenate([self._ids, ids])
        self._hidden_for = np.concatenate([self._hidden_for, np.full(len(ids), -self.latency_frames)])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow the points that are not forgotten; rows of all, sorted by id."""
        live = np.flatnonzero(~self._gone)
        told = self._tracker.track(frame, search, urgent).select(self._ids[live])
        result = self._with_forgotten(told, live)
        self._hidden_for[live] = np.where(told.visible, 0, self._hidden_for[live] + 1)
        self._tracker.drop(self._ids[live][self._gone[live]])
        return result

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._tracker.drop(self._ids[np.isin(self._ids, ids) & ~self._gone])
        keep = ~np.isin(self._ids, ids)
        self._ids, self._hidden_for = self._ids[keep], self._hidden_for[keep]

    def reject(self, ids: np.ndarray) -> None:
        """Handed on."""
        self._tracker.reject(self._known(ids))

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Handed on, for the points that are not forgotten."""
        known = np.isin(ids, self._known(ids))
        told = self._tracker.suggest(ids[known], uv_px[known])
        if told is None:
            return None
        live = np.flatnonzero(~self._gone)
        told = told.select(self._ids[live])
        self._hidden_for[live[told.visible]] = 0
        return self._with_forgotten(told, live)

    def _with_forgotten(self, told: Tracks, live: np.ndarray) -> Tracks:
        """The tracks of the ``live`` rows among those of all."""
        n = len(self._ids)
        uv, visible, uncertainty = np.full((n, 2), np.nan), np.zeros(n, bool), np.ones(n)
        uv[live], visible[live], uncertainty[live] = told.uv_px, told.visible, told.uncertainty
        return Tracks(self._ids.copy(), uv, visible, uncertainty)

    def _known(self, ids: np.ndarray) -> np.ndarray:
        return np.asarray(ids)[np.isin(ids, self._ids[~self._gone])]
