"""Trackers whose model takes all its queries at once: each frame in which points are added opens a further rollout.

A rollout costs a pass of the network per frame and holds a state as large as an image's, so only so many run. The
memory of the others is their queries and two images: that in which these were made, and the newest that showed most of
them. From these they are asked again, in turn, and so are those that run and have seen nothing for a while.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.image import in_image
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.trackers.ids import PointIds

#: Rollouts that run: a pass per frame each. Of a 640 x 480 video the kept images are 0.9 MB each.
MAX_ROLLOUTS, MAX_KEPT = 16, 96
#: Queries that are asked again per frame, each with two passes: usually, and where the caller waits for points.
ASKED_AGAIN, ASKED_URGENTLY = 1, 3
#: A rollout that has seen nothing for so many frames may have forgotten what it looks for.
PATIENCE = 30
#: An image shows queries well where this share of them is visible with less uncertainty than that.
_MOST, _SURE = 0.75, 0.5


class Rollout(Protocol):
    """A model's run over the stream with a fixed set of Q queries, which it was made with."""

    def step(self, rgb: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Take the next image; uv_px (Q, 2), visible (Q,), uncertainty (Q,) of the frame answered."""


@dataclass(frozen=True, eq=False)
class _View:
    """An image, and where some queries are in it: uv_px (N, 2), NaN where one is not seen."""

    rgb: np.ndarray
    uv_px: np.ndarray


@dataclass(frozen=True, eq=False)
class _Run:
    """A rollout of those queries (N,) bool that the view showed which it began with."""

    rollout: Rollout
    of: np.ndarray


@dataclass(eq=False)
class _Queries:
    """Queries that were made in one frame, by rows: their ids.

    made      the view in which they were made, which shows all of them
    newest    that of the newest frame: what is seen for sure, and was not rejected
    best      the newest that showed most of them
    run       over the stream; None where they are only kept
    seen      how many of them were visible in the newest frame
    seen_at   the newest frame in which any was; asked, asked_at: how often they were asked again, and when last
    """

    ids: np.ndarray
    made: _View
    newest: _View
    best: _View
    run: _Run | None
    seen: int
    seen_at: int
    asked: int = 0
    asked_at: int = 0


class RolloutTracker(PointTracker):
    """A tracker over a model of rollouts, which takes neither rejections nor suggestions.

    begin           makes a rollout with queries (Q, 2) in the first of some images; the others have come since
    latency_frames  how many images after a frame its answer comes

    A late model answers for the frame ``latency_frames`` ago, and queries are taken to be in that frame: the one that
    the caller is at. Of more than :data:`MAX_ROLLOUTS` those run that have the most visible points. Queries of which
    none runs, or has seen anything for :data:`PATIENCE` frames, are asked again in turn, those first that are many and
    have waited long: a rollout begins with a view of them and jumps to the newest image. The view is by turns the
    newest that showed most of them, since what comes back mostly looks as it left, and that in which they were made,
    where they are exact. What it sees is reported, and where it sees more than one that runs, it takes that one's
    place. So an object's points stay known however long it is hidden, at up to 20 passes of the network a frame, and
    24 where the caller waits for points: a beginning rollout makes two. Beyond :data:`MAX_KEPT` of the kept the fewest
    go, and their points stay invisible until they are dropped.
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
        asked = self._ask_again(ASKED_URGENTLY if urgent else ASKED_AGAIN)
        self._recent.append(frame.rgb)
        tracks = self._ids.unseen()
        for queries in self._queries:
            if runs := [run for run in (queries.run, asked.get(queries)) if run is not None]:
                self._follow(queries, runs, frame, tracks)
        self._bound()
        return tracks

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._begin_new()
        self._ids.drop(ids)
        self._queries = [queries for queries in self._queries if self._live(queries)]

    def reject(self, ids: np.ndarray) -> None:
        """These points are not asked again from where they are in the newest frame."""
        for queries in self._queries:
            wrong = np.isin(queries.ids, ids)[:, None]
            queries.newest = replace(queries.newest, uv_px=np.where(wrong, np.nan, queries.newest.uv_px))

    def _begin_new(self) -> None:
        """A rollout for the queries added since the last image, if there are any."""
        if len(self._new_ids):
            made = _View(self._recent[0], self._new_uv)
            queries = _Queries(self._new_ids, made, made, made, self._begin(made), len(self._new_ids), self._now)
            self._queries.append(queries)
            self._new_ids, self._new_uv = np.zeros(0, np.int64), np.zeros((0, 2))

    def _begin(self, view: _View) -> _Run:
        """A rollout of the queries that a view shows, whose image stands in the place of the one answered."""
        shown = np.isfinite(view.uv_px[:, 0])
        return _Run(self._make([view.rgb, *list(self._recent)[1:]], view.uv_px[shown]), shown)

    def _ask_again(self, most: int) -> dict[_Queries, _Run]:
        """Rollouts for some of the queries that have none, or one that may have forgotten them."""
        for queries in self._queries:
            shown = np.isfinite(queries.newest.uv_px[:, 0]).sum()
            queries.best = queries.newest if shown and shown >= _MOST * self._live(queries) else queries.best
        waiting = [queries for queries in self._queries if self._waits(queries)]
        waiting.sort(key=lambda q: self._live(q) * (self._now - max(q.seen_at, q.asked_at)), reverse=True)
        asked = {}
        for queries in waiting[:most]:
            asked[queries] = self._begin(queries.made if queries.asked % 2 else queries.best)
            queries.asked, queries.asked_at = queries.asked + 1, self._now
        return asked

    def _waits(self, queries: _Queries) -> bool:
        """Whether they are to be asked again; with some that the view did not show they are now and then."""
        if queries.run is None:
            return True
        whole = (queries.run.of | ~np.isin(queries.ids, self._ids.live)).all()
        return self._now - (queries.seen_at if whole else min(queries.seen_at, queries.asked_at)) > PATIENCE

    def _follow(self, queries: _Queries, runs: list[_Run], frame: Frame, tracks: Tracks) -> None:
        """Go on with the rollout that sees the most in the next frame, and put what it says into the tracks."""
        live, answers = np.isin(queries.ids, tracks.ids), []
        for run in runs:
            uv, visible, uncertainty = np.full((len(live), 2), np.nan), np.zeros(len(live), bool), np.ones(len(live))
            uv[run.of], visible[run.of], uncertainty[run.of] = run.rollout.step(frame.rgb)
            answers.append((uv, visible & live & in_image(uv, frame.shape, -0.5), np.clip(uncertainty, 0, 1)))
        best = int(np.argmax([visible.sum() for _, visible, _ in answers]))
        queries.run, (uv, visible, uncertainty) = runs[best], answers[best]
        rows = np.searchsorted(tracks.ids, queries.ids[live])
        tracks.uv_px[rows], tracks.visible[rows], tracks.uncertainty[rows] = uv[live], visible[live], uncertainty[live]
        queries.seen = int(visible.sum())
        queries.seen_at = self._now if queries.seen else queries.seen_at
        queries.newest = _View(self._recent[0], np.where((visible & (uncertainty < _SURE))[:, None], uv, np.nan))

    def _bound(self) -> None:
        """End the rollouts that see the fewest points, and forget the fewest of the kept queries, beyond the limits."""
        running = sorted((q for q in self._queries if q.run is not None), key=lambda q: q.seen, reverse=True)
        for queries in running[MAX_ROLLOUTS:]:
            queries.run = None
        kept = sorted((q for q in self._queries if q.run is None), key=self._live, reverse=True)
        self._queries = [queries for queries in self._queries if queries not in kept[MAX_KEPT:]]

    def _live(self, queries: _Queries) -> int:
        """How many of them nobody has dropped."""
        return int(np.isin(queries.ids, self._ids.live).sum())
