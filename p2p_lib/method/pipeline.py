"""Point2Pose: the algorithm of the paper on one screen (paper: Fig. "Overview of the framework").

>>> tracker = Point2Pose(camera, preset("default"))
>>> tracker.add_object("mug", clicks=[[312, 207], [320, 240]])
>>> for frame in video:
...     estimates = tracker.step(frame)
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core.backends import (
    DEFAULT_DETECTOR,
    DEFAULT_SEGMENTER,
    DEFAULT_TRACKER,
    make_detector,
    make_segmenter,
    make_tracker,
)
from p2p_lib.core.camera import Camera
from p2p_lib.core.clicks import check_apart, check_clicks, check_depth
from p2p_lib.core.config import Config, preset
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import PointTracker, Segmenter
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, PoseEstimate, Tracks
from p2p_lib.method.object_model import NO_IDS, Requests
from p2p_lib.method.object_tracker import ObjectTracker
from p2p_lib.method.observation import Observation
from p2p_lib.method.scene import Scene
from p2p_lib.method.search import Sighting

#: Object to (H, W) bool; None where nobody knows.
Masks = dict[str, np.ndarray | None]
#: The camera is located every so many frames while all objects have poses.
_LOCATE_EVERY = 5
NOTHING_TRACKED = Tracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))


class Point2Pose:
    """Causal 6D tracking of any number of unknown rigid objects in one RGB-D stream."""

    def __init__(
        self,
        camera: Camera,
        config: Config | None = None,
        tracker: str | PointTracker = DEFAULT_TRACKER,
        detector: str = DEFAULT_DETECTOR,
        segmenter: str | Segmenter = DEFAULT_SEGMENTER,
    ):
        self.camera = camera
        self.config = config or preset()
        self._rng = np.random.default_rng(self.config.seed)
        self.tracker = make_tracker(tracker, self.config.tracking, self._rng)
        self.detector = make_detector(detector, self.config.sampling, self._rng)
        rng = np.random.default_rng([self.config.seed, 1])
        self.segmenter = make_segmenter(segmenter, camera, self.config.segmentation, rng)
        scene_rng = np.random.default_rng([self.config.seed, 2])
        self.scene = Scene(camera, self.config.depth, scene_rng) if self.config.method.scene else None
        self.objects: dict[str, ObjectTracker] = {}
        self.masks: Masks = {}
        self.tracks = NOTHING_TRACKED
        self.stopwatch = Stopwatch()
        self._first_masks: dict[str, np.ndarray] = {}
        self._streaming = False
        self._unlocated = _LOCATE_EVERY
        self._first_clicks: dict[str, np.ndarray] = {}
        self._clicked: set[str] = set()  # the objects that the segmenter looks after
        self._waiting: deque[tuple[Frame, Masks, dict[str, np.ndarray]]] = deque()  # frames without an answer yet

    def add_object(self, name: str, mask: np.ndarray | None = None, clicks: ArrayLike | None = None) -> None:
        """Follow one more object from the next frame on.

        mask    (H, W) bool: where it is in the next frame
        clicks  (N, 2) pixels on the object in the next frame: the segmenter finds its mask there and in
                every frame to come. :class:`BadInput` for clicks outside the image or on another object's
                click; ``step`` raises it for clicks where there is no depth
        With neither the object is started by the first mask that ``step`` gets for it.
        """
        if name in self.objects:
            raise BadInput("add_object", repr(name), "a name not in use", f"In use: {', '.join(self.objects)}.")
        if mask is not None and clicks is not None:
            raise BadInput(f"object {name!r}", "a mask and clicks", "one of them")
        if mask is not None:
            self._first_masks[name] = self._checked(name, mask)
            if not self._first_masks[name].any():
                del self._first_masks[name]
                raise BadInput(f"mask of {name!r}", "an empty mask", "at least one pixel of the object")
        if clicks is not None:
            clicks = check_clicks(name, clicks, self.camera)
            check_apart(name, clicks, self._first_clicks)
            self._first_clicks[name] = clicks
            self._clicked.add(name)
        self.objects[name] = ObjectTracker(
            name,
            self.camera,
            self.config,
            self.detector,
            np.random.default_rng([self.config.seed, *name.encode()]),
            self.stopwatch,
        )

    def remove_object(self, name: str) -> None:
        """Stop following an object; its points are dropped from the tracker."""
        if name not in self.objects:
            raise BadInput("remove_object", repr(name), "one of " + (", ".join(self.objects) or "no objects"))
        if len(ids := self.objects.pop(name).map.ids):
            self.tracker.drop(ids)
        self._first_masks.pop(name, None)
        self._first_clicks.pop(name, None)
        self._clicked.discard(name)
        if name in self.segmenter.names:
            self.segmenter.remove(name)

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray] | None = None) -> dict[str, PoseEstimate]:
        """One frame in, one estimate per object out.

        masks  object -> (H, W) bool, the visible pixels of objects that have no clicks. One that is left out is
               hidden in this frame; None says that nobody knows, and those objects go by their points alone.

        Where the 2D tracker answers late, so does this: the estimates are of the frame ``latency_frames`` ago,
        as each says, and there are none for the first of the stream until then. ``self.masks`` keeps the masks
        that they were made with, the segmenter's included, and ``self.tracks`` everybody's 2D tracks.
        """
        with self.stopwatch.frame():
            return self._advance(frame, self._given(frame, masks), self._taken_clicks())

    def finish(self) -> Iterator[dict[str, PoseEstimate]]:
        """After the last frame: the estimates still owed, oldest first. None are unless the tracker answers late."""
        waiting = list(self._waiting)
        for _ in range(self.tracker.latency_frames if waiting else 0):
            with self.stopwatch.frame():
                owed = len(self._waiting) == self.tracker.latency_frames
                estimates = self._advance(*waiting[-1])  # the last image again
            if owed:
                yield estimates
        self._waiting.clear()

    def _advance(self, frame: Frame, masks: Masks, clicks: dict[str, np.ndarray]) -> dict[str, PoseEstimate]:
        """Track into a frame, then segment and estimate at the frame that the tracks are of."""
        tracks = self._track(frame, masks)
        self._waiting.append((frame, masks, clicks))
        if len(self._waiting) <= self.tracker.latency_frames:
            return {}
        frame, masks, clicks = self._waiting.popleft()
        frame = self._located(frame)
        # An object added since then is not in that frame's masks yet. The order of the objects means nothing.
        objects = {name: self.objects[name] for name in sorted(self.objects) if name in masks}
        self.tracks = tracks
        sightings = self._sightings(frame, masks, objects)
        self.masks = masks | self._segment(frame, clicks, sightings)
        seen = {
            name: obj.observe(frame, self.masks[name], self.tracks, sightings.get(name))
            for name, obj in objects.items()
        }
        self._apply({name: obj.misplaced(seen[name]) for name, obj in objects.items()})
        seen |= self._redetect(seen)
        steps = {name: obj.step(seen[name]) for name, obj in objects.items()}
        self._apply({name: step.requests for name, step in steps.items()})
        return {name: steps[name].estimate for name in self.objects if name in steps}

    def _located(self, frame: Frame) -> Frame:
        """The frame with the camera's pose, as far as it is known: often while an object is away, else now and then."""
        self._unlocated += 1
        every = 1 if any(obj.away for obj in self.objects.values()) else _LOCATE_EVERY
        if self.scene is None or frame.T_world_cam is not None or self._unlocated < every:
            return frame
        self._unlocated = 0
        with self.stopwatch("scene"):
            known = [mask for mask in self.masks.values() if mask is not None]
            occupied = np.logical_or.reduce(known) if known else None
            return replace(frame, T_world_cam=self.scene.locate(frame, occupied))

    def _sightings(self, frame: Frame, masks: Masks, objects: Mapping[str, ObjectTracker]) -> dict[str, Sighting]:
        """Absent objects that show again; the tracker looks for their points there."""
        found = {}
        for name, obj in objects.items():
            obs = obj.observe(frame, masks[name], self.tracks) if obj.away else None
            sighting = None if obs is None else obj.sighted(obs)
            if sighting is not None:
                found[name] = sighting
                with self.stopwatch("tracking"):
                    expected = self.tracker.suggest(obj.map.ids, obj.points_px(obs, sighting.T_cam_obj))
                    self.tracks = self.tracks if expected is None else expected
        return found

    def _redetect(self, seen: Mapping[str, Observation]) -> dict[str, Observation]:
        """Guided re-detection: the tracker looks for points where their objects expect them; what is seen then."""
        if self.tracker.latency_frames:
            return {}
        expected = {name: self.objects[name].expected_px(obs) for name, obs in seen.items()}
        with self.stopwatch("tracking"):
            for name, uv_px in expected.items():
                found = None if uv_px is None else self.tracker.suggest(self.objects[name].map.ids, uv_px)
                self.tracks = self.tracks if found is None else found
        sought = [name for name, uv_px in expected.items() if uv_px is not None]
        return {name: self.objects[name].seen_anew(seen[name], self.tracks) for name in sought}

    def _apply(self, requests: Mapping[str, Requests]) -> None:
        """The one place where the shared tracker is changed, after all objects have been looked at."""
        rejected = np.concatenate([NO_IDS, *(request.reject for request in requests.values())])
        if len(rejected):
            self.tracker.reject(rejected)
        for name, request in requests.items():
            dropped = request.drop
            if len(request.keys):
                unused = self.objects[name].map.assign(request.keys, self.tracker.add(request.add_px))
                dropped = np.concatenate([dropped, unused])
            if len(dropped):
                self.tracker.drop(dropped)

    def _given(self, frame: Frame, masks: Mapping[str, np.ndarray] | None) -> Masks:
        """Every object's checked mask in this frame; None for one of which nobody knows (yet)."""
        if frame.shape != (self.camera.height, self.camera.width):
            got = f"{frame.shape[1]}x{frame.shape[0]}"
            raise BadInput(f"frame {frame.index}", got, f"{self.camera.width}x{self.camera.height} as the camera")
        if unknown := sorted(set(masks or {}) - set(self.objects)):
            known = ", ".join(self.objects) or "none yet"
            raise BadInput("masks", f"unknown object {unknown[0]!r}", f"objects added before: {known}")
        if twice := sorted(set(masks or {}) & self._clicked):
            raise BadInput(f"mask of {twice[0]!r}", "a mask of an object with clicks", "masks of the others alone")
        for name, clicks in self._first_clicks.items():
            check_depth(name, clicks, frame)
        hidden = None if masks is None else np.zeros(frame.shape, bool)
        given = self._first_masks | {name: self._checked(name, mask) for name, mask in (masks or {}).items()}
        self._first_masks = {}
        return {name: given.get(name, None if name in self._clicked else hidden) for name in self.objects}

    def _taken_clicks(self) -> dict[str, np.ndarray]:
        """The clicks that wait for the frame to come, which has come."""
        clicks, self._first_clicks = self._first_clicks, {}
        return clicks

    def _segment(self, frame: Frame, clicks: dict[str, np.ndarray], sightings: Mapping[str, Sighting]) -> Masks:
        """Masks of the objects that were clicked on in this frame or before."""
        clicks = {name: at for name, at in sorted(clicks.items()) if name in self.objects}  # some may be gone again
        if not self.segmenter.names and not clicks:
            return {}
        with self.stopwatch("segmentation"):
            hints = {
                name: self.objects[name].hint(frame, self.tracks, sightings.get(name)) for name in self.segmenter.names
            }
            self._apply({name: requests for name, (_, requests) in hints.items()})
            labels = self.segmenter.segment(frame, clicks, {name: hint for name, (hint, _) in hints.items()})
            return {name: labels == label for label, name in enumerate(self.segmenter.names, 1)}

    def _track(self, frame: Frame, masks: dict[str, np.ndarray | None]) -> Tracks:
        """All objects' points in a single pass of the 2D tracker."""
        with self.stopwatch("tracking"):
            if not self._streaming:
                self.tracker.start(frame, self.camera)
                self._streaming = True
                return NOTHING_TRACKED
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
