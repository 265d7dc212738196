"""Around track and segment: an absent object is looked for where motion, scene, shape and colour say.

The camera is located while the 2D tracker runs. Sought objects are looked for before the frame is segmented, and the
tracker looks for their points there; the observations then show which tracks are on something else.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import replace
from functools import cache
from typing import Any, cast

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.image import either
from p2p_lib.core.interfaces import Hint, LazyHints, PointTracker, Segmenter
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame
from p2p_lib.extended.image_search import Sighting
from p2p_lib.extended.observation import OurObservation
from p2p_lib.extended.remembered import Remembered, follow
from p2p_lib.extended.scene import CameraTracker
from p2p_lib.extended.two_maps import TwoMaps
from p2p_lib.method.frontend import FrameInputs, Frontend, Masks
from p2p_lib.method.object_model import Requests

#: The camera is located every so many frames: while all objects have poses; while one is away.
_LOCATE_EVERY, _LOCATE_EVERY_AWAY = 5, 2


class Reacquisition(Frontend):
    """The paper's front end with the mechanisms that are ``on``; ``scene`` locates the camera."""

    def __init__(
        self,
        camera: Camera,
        tracker: PointTracker,
        segmenter: Segmenter,
        objects: dict[str, TwoMaps],
        stopwatch: Stopwatch,
        executor: Executor,
        on: Container[str],
        scene: CameraTracker | None,
    ):
        # To the paper's steps an object's two maps are its ObjectTracker, but for hint(), which is not asked for here.
        super().__init__(camera, tracker, segmenter, cast(Any, objects), stopwatch, executor)
        self.maps, self.on, self.scene = objects, on, scene
        self._unlocated = _LOCATE_EVERY
        self._sightings: Mapping[str, Sighting] = {}
        self._turn = 0  # counts frames: which remembered object is searched for

    def track(self, inputs: FrameInputs) -> FrameInputs | None:
        """As in the paper; the camera is located meanwhile."""
        answers = len(self.waiting) >= self.tracker.latency_frames
        locating = self._locate((self.waiting[0] if self.waiting else inputs).frame) if answers else None
        tracked = super().track(inputs)
        if locating is None or tracked is None:
            return tracked
        with self.stopwatch("scene"):
            return replace(tracked, frame=replace(tracked.frame, T_world_cam=locating.result()))

    def _locate(self, frame: Frame) -> Future[np.ndarray | None] | None:
        """The camera's pose, computed in the background: often while an object is away, else now and then."""
        self._unlocated += 1
        sought = any(obj.outlook.sought for obj in self.maps.values())
        every = _LOCATE_EVERY_AWAY if sought else _LOCATE_EVERY
        if self.scene is None or frame.T_world_cam is not None or self._unlocated < every:
            return None
        self._unlocated = 0
        known = [mask for mask in self.masks.values() if mask is not None]
        return self.executor.submit(self.scene.locate, frame, either(known) if known else None)

    def segment(self, inputs: FrameInputs) -> None:
        """As in the paper, after the search for sought objects."""
        self._sightings = self._sighted(inputs.frame, inputs.masks)
        super().segment(self._recalled(inputs))

    def _recalled(self, inputs: FrameInputs) -> FrameInputs:
        """With the masks of remembered objects that are found: of those that are away each frame looks for one.

        For all, while nothing has a pose: then no other object waits for it.
        """
        known = {n: obj for n, obj in sorted(self.maps.items()) if isinstance(obj, Remembered) and obj.recalls}
        sought = [name for name in known if name in inputs.masks and name not in inputs.prompts]
        if sought and any(obj.life.has_pose for obj in self.maps.values()):
            self._turn += 1
            sought = [sought[self._turn % len(sought)]]
        for name in sought:
            inputs = self._recall(name, known[name], inputs)
        return inputs

    def _recall(self, name: str, known: Remembered, inputs: FrameInputs) -> FrameInputs:
        """With the mask of one remembered object, if it is found."""
        masks = self.masks | {n: mask for n, mask in inputs.masks.items() if mask is not None}
        others = [mask for other, mask in masks.items() if other != name and mask is not None]
        with self.stopwatch("search"):
            found = known.find(inputs.frame, inputs.masks[name], either(others) if others else None)
        if known.forsaken:
            self.apply({name: known.withdraw()})
            if name in self.segmenter.names:
                self.segmenter.remove(name)
        if found is None:
            return inputs
        self.tracks = follow(known, found, self.tracker, self.tracks)
        self._sightings = {**self._sightings, name: found.sighting}
        return replace(inputs, masks=inputs.masks | {name: found.mask})

    def _sighted(self, frame: Frame, masks: Masks) -> dict[str, Sighting]:
        """Sought objects that show by shape and colour; the tracker looks for their points there."""
        objects = {name: self.maps[name] for name in sorted(self.maps) if name in masks}
        sought = [name for name, obj in objects.items() if obj.outlook.sought]
        seen = {name: objects[name].observe(frame, masks[name], self.tracks) for name in sought}
        looked = {name: objects[name].outlook.sighted(obs) for name, obs in seen.items()}
        found = {name: sighting for name, sighting in looked.items() if sighting is not None}
        self._suggest({name: objects[name].outlook.points_px(seen[name], at.T_cam_obj) for name, at in found.items()})
        return found

    def hints(self, frame: Frame, sought: Sequence[str]) -> Mapping[str, Hint]:
        """Where these objects should be; tracks of the absent that agree on no pose are rejected."""
        hint = cache(lambda name: self._hint(self.maps[name], frame, self._sightings.get(name)))
        if "rejection" in self.on:
            self.apply({name: hint(name)[1] for name in sought if self.maps[name].outlook.sought})
        return LazyHints(sought, lambda name: hint(name)[0])

    def _hint(self, obj: TwoMaps, frame: Frame, sighting: Sighting | None) -> tuple[Hint, Requests]:
        return obj.outlook.hint(obj.observe(frame, None, self.tracks, sighting))

    def observe(self, inputs: FrameInputs) -> Mapping[str, OurObservation]:
        """What the frame shows of every object, after misplaced tracks are rejected and missing points looked for."""
        seen = {}
        for name, mask in self.masks.items():
            by_whom = inputs.masks[name] is not None, name in inputs.prompts
            seen[name] = self.maps[name].observe(inputs.frame, mask, self.tracks, self._sightings.get(name), *by_whom)
        if "rejection" in self.on:
            self.apply(self._misplaced(seen, inputs.masks))
        return seen | self._redetect(seen) if "redetection" in self.on else seen

    def _misplaced(self, seen: Mapping[str, OurObservation], given: Masks) -> dict[str, Requests]:
        """Tracks of absent objects that are on something else.

        An empty mask by the segmenter rejects only tracks on other objects: it was made by means of these tracks.
        """
        nowhere = {name for name, obs in seen.items() if given[name] is None and obs.mask_px == 0}
        elsewhere = ~either(self.masks.values()) if nowhere else None
        within = {name: elsewhere if name in nowhere else obs.mask for name, obs in seen.items()}
        return {name: self.maps[name].outlook.misplaced(obs, within[name]) for name, obs in seen.items()}

    def _redetect(self, seen: Mapping[str, OurObservation]) -> dict[str, OurObservation]:
        """Guided re-detection: the tracker looks for points where objects expect them; the new observations."""
        looked = {name: self.maps[name].outlook.expected_px(obs) for name, obs in seen.items()}
        expected = {name: uv_px for name, uv_px in looked.items() if uv_px is not None}
        self._suggest(expected)
        return {name: self.maps[name].seen_anew(seen[name], self.tracks) for name in expected}

    def _suggest(self, expected_px: Mapping[str, np.ndarray]) -> None:
        """Have the tracker look for points where their objects expect them, unless it answers late."""
        if self.tracker.latency_frames:
            return
        with self.stopwatch("tracking"):
            for name, uv_px in expected_px.items():
                found = self.tracker.suggest(self.maps[name].map.ids, uv_px)
                self.tracks = self.tracks if found is None else found
