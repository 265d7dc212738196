"""The steps that all objects share: track in one pass, segment, observe, and pass requests to the tracker."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.checked_answers import labelled
from p2p_lib.core.depth import check_metres
from p2p_lib.core.image import either
from p2p_lib.core.interfaces import Hint, LazyHints, PointTracker, Segmenter
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.method.object_model import NO_IDS, Requests
from p2p_lib.method.object_tracker import ObjectTracker
from p2p_lib.method.observation import Observation

#: Object to (H, W) bool; None where unknown.
Masks = dict[str, np.ndarray | None]
NOTHING_TRACKED = Tracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))


@dataclass(frozen=True, eq=False)
class FrameInputs:
    """A frame, the masks given with it (None: to be segmented) and the prompts for it, by object."""

    frame: Frame
    masks: Masks
    prompts: dict[str, Prompt]


@dataclass(eq=False)
class Frontend:
    """Tracks, segments and observes for all objects; ``tracks`` and ``masks`` are the newest."""

    camera: Camera
    tracker: PointTracker
    segmenter: Segmenter
    objects: dict[str, ObjectTracker]
    stopwatch: Stopwatch
    executor: Executor
    tracks: Tracks = NOTHING_TRACKED
    masks: Masks = field(default_factory=dict)
    waiting: deque[FrameInputs] = field(default_factory=deque)  # frames without an answer of the tracker yet
    _streaming: bool = False

    def track(self, inputs: FrameInputs) -> FrameInputs | None:
        """Follow all points into a frame; returns the frame of the tracks, None while a late tracker has none."""
        tracks = self._tracked(inputs.frame, inputs.masks)
        self.waiting.append(inputs)  # only then: a frame at which the tracker fails is left out
        if len(self.waiting) <= self.tracker.latency_frames:
            return None
        for obj in self.objects.values():
            obj.adopt()
        self.tracks = tracks
        return self.waiting.popleft()

    def _tracked(self, frame: Frame, masks: Masks) -> Tracks:
        """All objects' points in a single pass of the 2D tracker."""
        with self.stopwatch("tracking"):
            if not self._streaming:
                check_metres(frame)
                self.tracker.start(frame, self.camera)
                self._streaming = True
                return NOTHING_TRACKED
            known = [mask for mask in masks.values() if mask is not None]
            search = either(known) if len(known) == len(masks) > 0 else None
            urgent = any(obj.awaited(masks[name]) for name, obj in self.objects.items())
            return self.tracker.track(frame, search, urgent)

    def segment(self, inputs: FrameInputs) -> None:
        """Every object's mask: the one given, else the segmenter's, which learns from those that are given."""
        frame = inputs.frame
        # With a late tracker objects may have come or gone since. Sorted: the caller's order must not matter.
        self.masks = masks = {name: mask for name, mask in sorted(inputs.masks.items()) if name in self.objects}
        prompts = {name: prompt for name, prompt in sorted(inputs.prompts.items()) if name in masks}
        prompts |= {name: Prompt(name, frame.index, mask=mask) for name, mask in masks.items() if mask is not None}
        if not self.segmenter.names and not prompts:
            return
        with self.stopwatch("segmentation"):
            sought = [name for name in self.segmenter.names if name in masks and masks[name] is None]
            labels = labelled(self.segmenter, frame, tuple(prompts.values()), self.hints(frame, sought))
            label_of = {name: label for label, name in enumerate(self.segmenter.names, 1)}
            looked_after = [name for name, mask in masks.items() if mask is None and name in label_of]
            self.masks = masks | {name: labels == label_of[name] for name in looked_after}

    def hints(self, frame: Frame, sought: Sequence[str]) -> Mapping[str, Hint]:
        """Where the ``sought`` objects should be."""
        objects = self.objects
        return LazyHints(sought, lambda name: objects[name].hint(objects[name].observe(frame, None, self.tracks)))

    def observe(self, inputs: FrameInputs) -> Mapping[str, Observation]:
        """What the frame shows of every object."""
        return {name: self.objects[name].observe(inputs.frame, mask, self.tracks) for name, mask in self.masks.items()}

    def apply(self, requests: Mapping[str, Requests]) -> None:
        """Pass all objects' requests to the shared tracker, after all steps: the order of objects does not matter."""
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
