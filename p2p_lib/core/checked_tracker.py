"""What a 2D point tracker promises (:class:`~p2p_lib.core.interfaces.PointTracker`), checked as it answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.checked_answers import bad_answer, kind_of
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import PointTracker, Wrapper
from p2p_lib.core.types import Frame, Tracks

#: The kinds of a column of tracks: NumPy's letters, and what they are called.
_COLUMNS = {
    "ids": ("iu", "whole numbers"),
    "uv_px": ("fiu", "numbers"),
    "visible": ("b", "bool"),
    "uncertainty": ("fiu", "numbers"),
}


class CheckedTracker(Wrapper):
    """A tracker whose answers are checked: :class:`BadInput` names it, the frame, and what cannot be used.

    Implements :class:`~p2p_lib.core.interfaces.PointTracker`; whatever else the tracker has is reached through it.
    """

    def __init__(self, tracker: PointTracker):
        self.name, self.latency_frames = tracker.name, tracker.latency_frames
        self.original, self._frame = tracker, -1
        self._last, self._live = -1, np.zeros(0, np.int64)
        if not isinstance(self.latency_frames, int | np.integer) or self.latency_frames < 0:
            raise self._bad("latency_frames", repr(self.latency_frames), "a whole number of frames from 0")

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._frame, self._last, self._live = frame.index, -1, np.zeros(0, np.int64)
        self.original.start(frame, camera)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids (N,), above all that were given before."""
        ids, n = self.original.add(uv_px), len(uv_px)
        if not isinstance(ids, np.ndarray) or ids.dtype.kind not in "iu" or ids.shape != (n,):
            raise self._bad("add()", kind_of(ids), f"the ids of {n} points, a NumPy array ({n},) of whole numbers")
        if (falls := np.flatnonzero(np.diff(ids.astype(np.int64), prepend=self._last) <= 0)).size:
            at = int(falls[0])
            got = f"id {ids[at]} after {ids[at - 1] if at else self._last}"
            raise self._bad("add()", got, "ids that increase from call to call", "No id is given twice in a stream.")
        self._live = np.concatenate([self._live, ids])
        self._last = int(max([self._last, *ids[-1:]]))
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        self._frame = frame.index
        return self._checked("track()", lambda: self.original.track(frame, search, urgent))

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._live = self._live[~np.isin(self._live, ids)]
        self.original.drop(ids)

    def reject(self, ids: np.ndarray) -> None:
        """Handed on."""
        self.original.reject(ids)

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Handed on; the newest frame's tracks, or None."""
        return self._checked("suggest()", lambda: self.original.suggest(ids, uv_px), or_none=True)

    def _checked(self, call: str, answer: Callable[[], Any], or_none: bool = False) -> Any:
        """Tracks with a row for each live query, sorted, of which what is visible is somewhere."""
        try:
            tracks = answer()
        except BadInput as error:
            if error.name != Tracks.__name__:
                raise
            raise self._bad(call, str(error.got), error.expected) from None
        if tracks is None and or_none:
            return None
        if not isinstance(tracks, Tracks):
            raise self._bad(call, kind_of(tracks), "Tracks(ids, uv_px, visible, uncertainty)")
        for name, (kinds, called) in _COLUMNS.items():
            column = getattr(tracks, name)
            if not isinstance(column, np.ndarray) or (column.dtype.kind not in kinds and len(column)):
                raise self._bad(f"{call} {name}", kind_of(column), f"a NumPy array of {called}")
        ids, uv_px, visible = tracks.ids, tracks.uv_px, tracks.visible
        if (falls := np.flatnonzero(ids[1:] <= ids[:-1])).size:
            got = f"a row of id {ids[falls[0] + 1]} after one of id {ids[falls[0]]}"
            raise self._bad(call, got, "rows sorted by id, one of each", "order = np.argsort(ids) sorts them.")
        if (lacking := self._live[~np.isin(self._live, ids)]).size:
            got = f"no row of {len(lacking)} of {len(self._live)} points, the first of id {lacking[0]}"
            fix = "A point that is not seen has a row, too: visible False."
            raise self._bad(call, got, "a row of each id from add() until drop()", fix)
        if (nowhere := visible & ~np.isfinite(uv_px).all(1)).any():
            at = uv_px[nowhere][0].tolist()
            got = f"{nowhere.sum()} of {np.count_nonzero(visible)} visible points at no pixel, the first at {at}"
            fix = "Of a point that is nowhere: visible False."
            raise self._bad(call, got, "finite uv_px of every visible point", fix)
        unsure = tracks.uncertainty[visible]
        if (odd := unsure[~((unsure >= 0) & (unsure <= 1))]).size:
            raise self._bad(call, f"uncertainty {odd[0]:g} of a visible point", "a number in [0, 1]")
        return tracks

    def _bad(self, call: str, got: str, expected: str, fix: str = "") -> BadInput:
        return bad_answer("tracker", self.original, self._frame, call, got, expected, fix)
