"""Trackers whose model takes all its queries at once: each frame in which points are added opens a further rollout."""

from __future__ import annotations

from collections import deque
from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.image import in_image
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.ids import PointIds

# Each rollout costs a whole pass per frame and holds the memory of a whole image.
MAX_ROLLOUTS = 16


class Rollout(Protocol):
    """A model's run over the stream with a fixed set of Q queries, which it was made with."""

    def step(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the next image; uv_px (Q, 2), visible (Q,), uncertainty (Q,) of the frame answered."""


class RolloutModel(Protocol):
    """What makes rollouts.

    latency_frames  how many images after a frame its answer comes
    """

    name: str
    latency_frames: int

    def begin(self, images: list[np.ndarray], uv_px: np.ndarray) -> Rollout:
        """A rollout with queries (Q, 2) in the first of the images; the others are those that came since."""


class RolloutTracker(PointTracker):
    """A tracker over a :class:`RolloutModel`, which takes neither rejections nor suggestions.

    A late model answers for the frame ``latency_frames`` ago, and queries are taken to be in that frame: the one
    that the caller is at. A rollout ends with its last point. Beyond :data:`MAX_ROLLOUTS` the one with the fewest
    visible points ends; its points stay invisible until they are dropped.
    """

    def __init__(self, model: RolloutModel):
        self.name, self.latency_frames = model.name, model.latency_frames
        self._model = model
        self._ids = PointIds()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._ids.start()
        self._visible = np.zeros(0, bool)
        self._rollouts: list[tuple[np.ndarray, Rollout]] = []  # ids by row, and the run
        self._new_ids, self._new_uv = np.zeros(0, np.int64), np.zeros((0, 2))  # queries since the last image
        self._recent = deque([frame.rgb], maxlen=self.latency_frames + 1)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame answered; returns their ids."""
        uv = np.asarray(uv_px, float).reshape(-1, 2)
        ids = self._ids.add(len(uv))
        self._new_ids, self._new_uv = np.concatenate([self._new_ids, ids]), np.concatenate([self._new_uv, uv])
        self._visible = np.concatenate([self._visible, np.ones(len(uv), bool)])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; rows of the frame answered."""
        self._ids.check_started()
        self._open()
        self._recent.append(frame.rgb)
        tracks = self._ids.unseen()
        for ids, rollout in self._rollouts:
            uv, visible, uncertainty = rollout.step(frame.rgb)
            live = np.isin(ids, tracks.ids)
            rows = np.searchsorted(tracks.ids, ids[live])
            tracks.uv_px[rows], tracks.uncertainty[rows] = uv[live], np.clip(uncertainty[live], 0, 1)
            tracks.visible[rows] = visible[live] & in_image(uv[live], frame.shape, -0.5)
        self._visible = tracks.visible.copy()
        return tracks

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._open()
        self._visible = self._visible[self._ids.drop(ids)]
        self._rollouts = [(own, run) for own, run in self._rollouts if np.isin(own, self._ids.live).any()]

    def _open(self) -> None:
        """A rollout for the queries added since the last image, if there are any."""
        if not len(self._new_ids):
            return
        self._rollouts.append((self._new_ids, self._model.begin(list(self._recent), self._new_uv)))
        self._new_ids, self._new_uv = np.zeros(0, np.int64), np.zeros((0, 2))
        if len(self._rollouts) > MAX_ROLLOUTS:
            seen = [np.isin(own, self._ids.live[self._visible]).sum() for own, _ in self._rollouts]
            del self._rollouts[int(np.argmin(seen))]
