"""Trackers whose model takes all its queries at once: each frame in which points are added opens a further rollout.

A rollout costs a pass of the network per frame and holds a state as large as an image's, so only so many run. The
memory of the others is their queries and the frame that these were made in: from it they are asked again, in turn.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.image import in_image
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.ids import PointIds

#: Rollouts that run: a pass per frame each. Of a 640 x 480 video the kept frames are 0.9 MB each.
MAX_ROLLOUTS, MAX_KEPT = 16, 96
#: Kept queries that are asked again per frame, each with two passes: usually, and where the caller waits for points.
ASKED_AGAIN, ASKED_URGENTLY = 1, 3


class Rollout(Protocol):
    """A model's run over the stream with a fixed set of Q queries, which it was made with."""

    def step(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the next image; uv_px (Q, 2), visible (Q,), uncertainty (Q,) of the frame answered."""


@dataclass(eq=False)
class _Queries:
    """Queries that were made in one frame, by rows: their ids, the image, where they were in it.

    rollout   their run over the stream; None where they are only kept
    seen      how many of them were visible in the newest frame in which they were asked
    asked_at  when they were asked last
    """

    ids: np.ndarray
    rgb: np.ndarray
    uv_px: np.ndarray
    rollout: Rollout | None
    seen: int
    asked_at: int


class RolloutTracker(PointTracker):
    """A tracker over a model of rollouts, which takes neither rejections nor suggestions.

    begin           makes a rollout with queries (Q, 2) in the first of some images; the others have come since
    latency_frames  how many images after a frame its answer comes

    A late model answers for the frame ``latency_frames`` ago, and queries are taken to be in that frame: the one that
    the caller is at. Of more than :data:`MAX_ROLLOUTS` those run that have the most visible points. The queries of the
    others are kept with the image in which they were made, and asked again in turn, those first that are many and have
    waited long: a rollout begins with that image and jumps to the newest. What it sees is reported; where it sees more
    than one that runs, it takes that one's place. So an object's points stay known however long it is hidden, at
    up to 20 passes of the network a frame, and 24 where the caller waits for points: a beginning rollout makes two.
    Beyond :data:`MAX_KEPT` images the fewest queries go, and their points stay invisible until they are dropped.
    """

    def __init__(self, name: str, begin: Callable[[list[np.ndarray], np.ndarray], Rollout], latency_frames: int):
        self.name, self.latency_frames, self._make = name, latency_frames, begin
        self._ids = PointIds()

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._ids.start()
        self._now = 0
        self._queries: list[_Queries] = []
        self._new_ids, self._new_uv = np.zeros(0, np.int64), np.zeros((0, 2))  # queries since the last image
        self._recent = deque([frame.rgb], maxlen=self.latency_frames + 1)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame answered; returns their ids."""
        uv = np.asarray(uv_px, float).reshape(-1, 2)
        ids = self._ids.add(len(uv))
        self._new_ids, self._new_uv = np.concatenate([self._new_ids, ids]), np.concatenate([self._new_uv, uv])
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; rows of the frame answered."""
        self._ids.check_started()
        self._now += 1
        self._begin_new()
        kept = [queries for queries in self._queries if queries.rollout is None]
        kept.sort(key=lambda queries: self._live(queries) * (self._now - queries.asked_at), reverse=True)
        for queries in kept[: ASKED_URGENTLY if urgent else ASKED_AGAIN]:
            self._begin(queries)
        self._recent.append(frame.rgb)
        tracks = self._ids.unseen()
        for queries in self._queries:
            if queries.rollout is not None:
                self._step(queries, queries.rollout, frame, tracks)
        self._bound()
        return tracks

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._begin_new()
        self._ids.drop(ids)
        self._queries = [queries for queries in self._queries if self._live(queries)]

    def _begin_new(self) -> None:
        """A rollout for the queries added since the last image, if there are any."""
        if len(self._new_ids):
            count = len(self._new_ids)
            self._queries.append(_Queries(self._new_ids, self._recent[0], self._new_uv, None, count, self._now))
            self._begin(self._queries[-1])
            self._new_ids, self._new_uv = np.zeros(0, np.int64), np.zeros((0, 2))

    def _begin(self, queries: _Queries) -> None:
        """A rollout of these queries; the image in which they were made stands in the place of the one answered."""
        queries.rollout = self._make([queries.rgb, *list(self._recent)[1:]], queries.uv_px)

    def _step(self, queries: _Queries, rollout: Rollout, frame: Frame, tracks: Tracks) -> None:
        """Put what a rollout of these queries says of the next frame into the tracks."""
        uv, visible, uncertainty = rollout.step(frame.rgb)
        live = np.isin(queries.ids, tracks.ids)
        rows = np.searchsorted(tracks.ids, queries.ids[live])
        tracks.uv_px[rows], tracks.uncertainty[rows] = uv[live], np.clip(uncertainty[live], 0, 1)
        tracks.visible[rows] = visible[live] & in_image(uv[live], frame.shape, -0.5)
        queries.seen, queries.asked_at = int(tracks.visible[rows].sum()), self._now

    def _bound(self) -> None:
        """End the rollouts that see the fewest points, and forget the fewest of the kept queries, beyond the limits."""
        running = sorted((q for q in self._queries if q.rollout is not None), key=lambda q: q.seen, reverse=True)
        for queries in running[MAX_ROLLOUTS:]:
            queries.rollout = None
        kept = sorted((q for q in self._queries if q.rollout is None), key=self._live, reverse=True)
        self._queries = [queries for queries in self._queries if queries not in kept[MAX_KEPT:]]

    def _live(self, queries: _Queries) -> int:
        """How many of them nobody has dropped."""
        return int(np.isin(queries.ids, self._ids.live).sum())
