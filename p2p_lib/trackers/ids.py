"""The numbers of a stream's points: what every tracker keeps of its queries besides its own arrays."""

from __future__ import annotations

import numpy as np

from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Tracks


class PointIds:
    """The live points of a stream, a row each.

    live  (N,) int64, increasing
    """

    def __init__(self) -> None:
        self._next: int | None = None
        self.live = np.zeros(0, np.int64)

    def start(self) -> None:
        """Begin a stream: no points, numbers from 0."""
        self._next, self.live = 0, np.zeros(0, np.int64)

    def check_started(self) -> int:
        """The next number; :class:`BadInput` before a stream has begun."""
        if self._next is None:
            raise BadInput("tracker", "queries or a frame to track before any start", "start(frame) first")
        return self._next

    def add(self, count: int) -> np.ndarray:
        """Rows for new points at the end; returns their ids (count,)."""
        first = self.check_started()
        ids = np.arange(first, first + count)
        self.extend(ids)
        return ids

    def extend(self, ids: np.ndarray) -> None:
        """Rows at the end for points that another tracker has numbered, higher than all before."""
        self._next = max([self._next or 0, *(ids[-1:] + 1)])
        self.live = np.concatenate([self.live, ids])

    def drop(self, ids: np.ndarray) -> np.ndarray:
        """Take these points out; returns which of the rows (N,) bool remain."""
        keep = ~np.isin(self.live, ids)
        self.live = self.live[keep]
        return keep

    def unseen(self) -> Tracks:
        """Tracks in which no point is visible, with arrays to be filled."""
        n = len(self.live)
        return Tracks(self.live.copy(), np.full((n, 2), np.nan), np.zeros(n, bool), np.ones(n))
