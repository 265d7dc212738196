"""A 2D tracker that passes everything on and keeps what it was asked and what it answered.

Handed to the pipeline in the place of a tracker, it changes nothing; afterwards it knows the track of every
keypoint that the pipeline ever followed, beside the true surface point behind the pixel at which it began.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.interfaces import PointTracker
from p2p_lib.core.types import Frame, Tracks, joined
from p2p_lib.evaluation.true_tracks import NO_POINTS, SurfacePoints, TrueScene


@dataclass(frozen=True, eq=False)
class KeypointTracks:
    """One object's keypoints as the 2D tracker had them, a row for each and each frame after it began.

    There is a row where the tracker calls the keypoint visible and its surface point is truly in sight.

    frame    (M,) index in the sequence; id (M,) of the keypoint
    uv_px    (M, 2) where the tracker has it
    true_px  (M, 2) where its surface point is, by the true pose
    """

    frame: np.ndarray
    id: np.ndarray
    uv_px: np.ndarray
    true_px: np.ndarray

    @property
    def error_px(self) -> np.ndarray:
        """(M,) distance of the two."""
        return np.linalg.norm(self.uv_px - self.true_px, axis=1)

    def select(self, rows: np.ndarray) -> KeypointTracks:
        """The rows at these indices or under this mask."""
        return KeypointTracks(self.frame[rows], self.id[rows], self.uv_px[rows], self.true_px[rows])


class RecordedTracker:
    """See the module's text. Implements :class:`p2p_lib.core.interfaces.PointTracker`, by another one."""

    def __init__(self, tracker: PointTracker):
        self.name, self.latency_frames = tracker.name, tracker.latency_frames
        self._tracker = tracker
        self._fed: list[int] = []  # indices of the frames so far
        self._queries: list[tuple[int, np.ndarray, np.ndarray]] = []
        self._answers: list[tuple[int, Tracks]] = []

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream, and a new record."""
        self._fed, self._queries, self._answers = [frame.index], [], []
        self._tracker.start(frame, camera)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """New queries in the newest frame that was answered."""
        ids = self._tracker.add(uv_px)
        self._queries.append((self._newest(), ids, np.asarray(uv_px, float).reshape(-1, 2)))
        return ids

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """The tracker's answer, written down with the frame that it is of."""
        self._fed.append(frame.index)
        tracks = self._tracker.track(frame, search, urgent)
        self._answers.append((self._newest(), tracks))
        return tracks

    def drop(self, ids: np.ndarray) -> None:
        """Passed on; the record stays."""
        self._tracker.drop(ids)

    def reject(self, ids: np.ndarray) -> None:
        """Passed on."""
        self._tracker.reject(ids)

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> None:
        """Passed on."""
        self._tracker.suggest(ids, uv_px)

    def _newest(self) -> int:
        """Index of the frame that the newest answer is of."""
        return self._fed[max(len(self._fed) - 1 - self.latency_frames, 0)]

    def keypoints(self, scene: TrueScene) -> dict[str, KeypointTracks]:
        """Every object's keypoints beside the truth; a keypoint belongs to the object whose mask it began in."""
        ids, points = self._began(scene)
        columns = []
        for index, tracks in self._answers:
            tracks = tracks.select(tracks.ids[tracks.visible])
            mine = points.select(np.searchsorted(ids, tracks.ids))
            sight = scene.see(scene.sequence.frame(index), mine)
            columns.append(
                (np.full(len(tracks), index), tracks.ids, tracks.uv_px, sight.uv_px, sight.visible, mine.object)
            )
        frame, id, uv_px, true_px, in_sight, owner = map(np.concatenate, zip(*columns, strict=True))
        every = KeypointTracks(frame, id, uv_px, true_px)
        return {name: every.select(in_sight & (owner == k)) for k, name in enumerate(scene.objects)}

    def _began(self, scene: TrueScene) -> tuple[np.ndarray, SurfacePoints]:
        """The ids of all queries, increasing, and the surface points behind their pixels; NaN where none is met."""
        ids, points = [np.zeros(0, np.int64)], NO_POINTS
        for index, new_ids, uv_px in self._queries:
            frame = scene.sequence.frame(index)
            ids.append(new_ids)
            points = joined([points, scene.lift(frame, scene.owners(frame, uv_px), uv_px)])
        ids = np.concatenate(ids)
        return np.sort(ids), points.select(np.argsort(ids))
