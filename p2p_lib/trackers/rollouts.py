"""Trackers whose model takes all its queries at once: each frame in which points are added opens a further rollout."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.image import in_image
from p2p_lib.core.types import Frame, Tracks

# Each rollout costs a whole pass per frame and holds the memory of a whole picture.
MAX_ROLLOUTS = 16


class Rollout(Protocol):
    """A model's run over the stream with a fixed set of Q queries, which it was made with."""

    def step(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the next picture; uv_px (Q, 2), visible (Q,), uncertainty (Q,) of the frame answered."""


class RolloutModel(Protocol):
    """What makes rollouts.

    latency_frames  how many pictures after a frame its answer comes
    """

    name: str
    latency_frames: int

    def begin(self, pictures: list[np.ndarray], uv_px: np.ndarray) -> Rollout:
        """A rollout with queries (Q, 2) in the first of the pictures; the others are those that came since."""


class RolloutTracker:
    """Implements :class:`p2p_lib.core.interfaces.PointTracker` over a :class:`RolloutModel`.

    A late model answers for the frame ``latency_frames`` ago, and queries are taken to be in that frame: the one
    that the caller is at. A rollout ends with its last point. Beyond :data:`MAX_ROLLOUTS` the one with the fewest
    visible points ends; its points stay invisible until they are dropped.
    """

    def __init__(self, model: RolloutModel):
        self.name, self.latency_frames = model.name, model.latency_frames
        self._model = model
        self._recent: deque[np.ndarray] = deque(maxlen=model.latency_frames + 1)
        self._clear()

    def _clear(self) -> None:
        self._next_id = 0
        self._ids = np.zeros(0, np.int64)
        self._visible = np.zeros(0, bool)
        self._rollouts: list[tuple[np.ndarray, Rollout]] = []  # ids by row, and the run
        self._new: list[np.ndarray] = []  # queries added since the last picture
        self._recent.clear()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._clear()
        self._recent.append(frame.rgb)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame answered; returns their ids."""
        if not self._recent:
            raise BadInput("tracker", "queries before a frame", "start(frame) first")
        uv = np.asarray(uv_px, float).reshape(-1, 2)
        ids = np.arange(self._next_id, self._next_id + len(uv))
        self._next_id += len(uv)
        self._new.append(uv)
        self._ids = np.concatenate([self._ids, ids])
        self._visible = np.concatenate([self._visible, np.ones(len(uv), bool)])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; rows of the frame answered."""
        if not self._recent:
            raise BadInput("tracker", "a frame to track before any start", "start(frame) first")
        self._open()
        self._recent.append(frame.rgb)
        n = len(self._ids)
        uv, visible, uncertainty = np.full((n, 2), np.nan), np.zeros(n, bool), np.ones(n)
        for ids, rollout in self._rollouts:
            told_uv, told_visible, told_uncertainty = rollout.step(frame.rgb)
            live = np.isin(ids, self._ids)
            rows = np.searchsorted(self._ids, ids[live])
            uv[rows], uncertainty[rows] = told_uv[live], np.clip(told_uncertainty[live], 0, 1)
            visible[rows] = told_visible[live] & in_image(told_uv[live], frame.shape, -0.5)
        self._visible = visible
        return Tracks(self._ids.copy(), uv, visible, uncertainty)

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._open()
        keep = ~np.isin(self._ids, ids)
        self._ids, self._visible = self._ids[keep], self._visible[keep]
        self._rollouts = [(own, run) for own, run in self._rollouts if np.isin(own, self._ids).any()]

    def reject(self, ids: np.ndarray) -> None:
        """Ignored."""

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """Ignored."""

    def _open(self) -> None:
        """A rollout for the queries added since the last picture, if there are any."""
        uv = np.concatenate([np.zeros((0, 2)), *self._new])
        self._new = []
        if not len(uv):
            return
        ids = np.arange(self._next_id - len(uv), self._next_id)
        self._rollouts.append((ids, self._model.begin(list(self._recent), uv)))
        if len(self._rollouts) > MAX_ROLLOUTS:
            seen = [np.isin(own, self._ids[self._visible]).sum() for own, _ in self._rollouts]
            del self._rollouts[int(np.argmin(seen))]
