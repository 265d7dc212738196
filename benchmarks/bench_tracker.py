"""The built-in 2D tracker by itself, beside plain Lucas-Kanade on the same 256 points of ``synthetic/crossing``."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from common import Section, Times, compared

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.true_tracks import Queries, TrueScene, draw_queries
from p2p_lib.trackers.builtin.tracker import BuiltinTracker
from p2p_lib.trackers.lk import LkTracker


def step(tracker: PointTracker, frame: Frame, camera: Camera, queries: Queries) -> None:
    """One frame, its new queries included."""
    tracker.track(frame) if frame.index else tracker.start(frame, camera)
    new = queries.uv_px[queries.frame == frame.index]
    if len(new):
        tracker.add(new)


def sections(quick: bool) -> Iterator[Section]:
    """Both trackers in turn, frame by frame."""
    sequence = open_sequence("synthetic/crossing")
    queries = draw_queries(TrueScene.of(sequence), np.random.default_rng(0))
    trackers = {tracker.name: tracker for tracker in (BuiltinTracker(preset().tracking), LkTracker(preset().tracking))}
    spent, frames = {name: Times() for name in trackers}, range(5 if quick else len(sequence))
    for i in frames:
        frame = sequence.frame(i)
        for name, tracker in trackers.items():
            spent[name].run(lambda: step(tracker, frame, sequence.camera, queries))  # noqa: B023
    table = compared({name: times.at(frames[2:]) for name, times in spent.items()}, LkTracker.name)
    words = (
        f"{len(queries)} points on the objects, new queries and searches for lost segments included, {len(frames)} "
        "frames. Plain Lucas-Kanade, the peer, loses what is hidden for good, and with it work."
    )
    yield Section("tracker", "2D tracker alone", words, {"One frame": table})
