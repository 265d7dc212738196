"""Point2Pose: the algorithm of the paper on one screen (paper: Fig. "Overview of the framework").

>>> tracker = Point2Pose(camera, preset("default"))
>>> tracker.add_object("mug", mask=first_mask)
>>> for frame in video:
...     estimates = tracker.step(frame, masks)
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping

import numpy as np

from p2p_lib.backends.registry import DEFAULT_DETECTOR, make_detector, make_tracker
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config, preset
from p2p_lib.core.errors import BadInput, MissingBackend
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, PoseEstimate, Tracks
from p2p_lib.stages.tracking import DEFAULT_TRACKER, PointTracker
from p2p_lib.tracked_object import TrackedObject


class Point2Pose:
    """Causal 6D tracking of any number of unknown rigid objects in one RGB-D stream."""

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        tracker: str | PointTracker = DEFAULT_TRACKER,
        detector: str = DEFAULT_DETECTOR,
    ):
        self.camera = camera
        self.config = config or preset()
        self._rng = np.random.default_rng(self.config.seed)
        self.tracker = make_tracker(tracker, self.config.tracking, self._rng)
        self.detector = make_detector(detector, self.config.sampling, self._rng)
        self.objects: dict[str, TrackedObject] = {}
        self.stopwatch = Stopwatch()
        self._first_masks: dict[str, np.ndarray] = {}
        self._streaming = False
        self._waiting: deque[tuple[Frame, dict[str, np.ndarray | None]]] = deque()  # frames without an answer yet

    def add_object(self, name: str, mask: np.ndarray | None = None, clicks: np.ndarray | None = None) -> None:
        """Follow one more object from the next frame on.

        mask    (H, W) bool: where it is in the next frame. Without one the object is started by the
                first mask that ``step`` gets for it.
        clicks  (N, 2) pixels on the object in the next frame, for a segmenter. This version has none:
                raises :class:`MissingBackend`.
        """
        if clicks is not None:
            fix = "Give add_object(name, mask=...), or masks to step."
            raise MissingBackend("segmenter", "clicks need one, and this version has none", fix)
        if name in self.objects:
            raise BadInput("add_object", repr(name), "a name not in use", f"In use: {', '.join(self.objects)}.")
        if mask is not None:
            self._first_masks[name] = self._checked(name, mask)
        self.objects[name] = TrackedObject(
            name, self.camera, self.config, self.tracker, self.detector, self._rng.spawn(1)[0], self.stopwatch
        )

    def remove_object(self, name: str) -> None:
        """Stop following an object; its points are dropped from the tracker."""
        if name not in self.objects:
            raise BadInput("remove_object", repr(name), "one of " + (", ".join(self.objects) or "no objects"))
        self.tracker.drop(self.objects.pop(name).map.ids)
        self._first_masks.pop(name, None)

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray] | None = None) -> dict[str, PoseEstimate]:
        """One frame in, one estimate per object out.

        masks  object -> (H, W) bool, the object's visible pixels. An object that is left out is hidden
               in this frame; None says that nobody knows, and every object goes by its points alone.

        Where the 2D tracker answers late, so does this: the estimates are of the frame ``latency_frames`` ago,
        as each says, and there are none for the first of the stream until then.
        """
        with self.stopwatch.frame():
            return self._advance(frame, self._masks(frame, masks))

    def finish(self) -> Iterator[dict[str, PoseEstimate]]:
        """After the last frame: the estimates still owed, oldest first. None are unless the tracker answers late."""
        waiting = list(self._waiting)
        for _ in range(self.tracker.latency_frames if waiting else 0):
            with self.stopwatch.frame():
                owed = len(self._waiting) == self.tracker.latency_frames
                estimates = self._advance(*waiting[-1])  # the last picture again
            if owed:
                yield estimates
        self._waiting.clear()

    def _advance(self, frame: Frame, masks: dict[str, np.ndarray | None]) -> dict[str, PoseEstimate]:
        """Track into a frame, then estimate at the frame that the tracks are of."""
        tracks = self._track(frame, masks)
        self._waiting.append((frame, masks))
        if len(self._waiting) <= self.tracker.latency_frames:
            return {}
        frame, masks = self._waiting.popleft()
        # An object added since then is not in that frame's masks yet.
        return {name: obj.step(frame, masks[name], tracks) for name, obj in self.objects.items() if name in masks}

    def _masks(self, frame: Frame, masks: Mapping[str, np.ndarray] | None) -> dict[str, np.ndarray | None]:
        """Every object's checked mask in this frame; None for one of which nobody knows."""
        if frame.shape != (self.camera.height, self.camera.width):
            got = f"{frame.shape[1]}x{frame.shape[0]}"
            raise BadInput(f"frame {frame.index}", got, f"{self.camera.width}x{self.camera.height} as the camera")
        if unknown := sorted(set(masks or {}) - set(self.objects)):
            known = ", ".join(self.objects) or "none yet"
            raise BadInput("masks", f"unknown object {unknown[0]!r}", f"objects added before: {known}")
        hidden = None if masks is None else np.zeros(frame.shape, bool)
        given = self._first_masks | {name: self._checked(name, mask) for name, mask in (masks or {}).items()}
        self._first_masks = {}
        return {name: given.get(name, hidden) for name in self.objects}

    def _track(self, frame: Frame, masks: dict[str, np.ndarray | None]) -> Tracks:
        """All objects' points in a single pass of the 2D tracker."""
        with self.stopwatch("tracking"):
            if not self._streaming:
                self.tracker.start(frame)
                self._streaming = True
                return Tracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))
            known = [mask for mask in masks.values() if mask is not None]
            search = np.logical_or.reduce(known) if len(known) == len(masks) > 0 else None
            urgent = any(obj.awaited(masks[name]) for name, obj in self.objects.items())
            return self.tracker.track(frame, search, urgent)

    def _checked(self, name: str, mask: np.ndarray) -> np.ndarray:
        mask = np.asarray(mask)
        if mask.shape != (self.camera.height, self.camera.width):
            got = "x".join(map(str, mask.shape[::-1]))
            raise BadInput(f"mask of {name!r}", got, f"{self.camera.width}x{self.camera.height} as the camera")
        return mask if mask.dtype == bool else mask > 0
