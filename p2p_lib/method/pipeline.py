"""Point2Pose: what becomes of a frame, for all objects (paper: Fig. "Overview of the framework").

What a caller writes:

    tracker = Point2Pose(camera, preset("default"))
    tracker.add_object("mug", clicks=[[312, 207], [320, 240]])
    for frame in video:
        estimates = tracker.step(frame)
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import cache, reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core import backends
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import uninterrupted
from p2p_lib.core.config import Config, preset
from p2p_lib.core.errors import BadInput, doubt
from p2p_lib.core.interfaces import Hint, PointTracker, Segmenter
from p2p_lib.core.prompts import Prompt, check_apart, check_depth, check_mask, check_not_on, check_prompt
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, PoseEstimate, Status, Tracks
from p2p_lib.method.agreement import Standing
from p2p_lib.method.object_model import NO_IDS, Requests
from p2p_lib.method.object_tracker import ObjectTracker
from p2p_lib.method.observation import Observation
from p2p_lib.recovery.scene import Scene
from p2p_lib.recovery.search import Sighting

_LOG = logging.getLogger("p2p_lib")
#: Object to (H, W) bool; None where nobody knows.
Masks = dict[str, np.ndarray | None]
#: The camera is located every so many frames: while all objects have poses, while one is away.
_LOCATE_EVERY, _LOCATE_EVERY_AWAY = 5, 2
#: Few depth cameras see half of their pixels farther than this, m.
_FAR_M = 50.0
#: The share of pixels among which the nearest may be wild.
_NEAREST = 0.05
NOTHING_TRACKED = Tracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, bool), np.zeros(0))


class Point2Pose:
    """Causal 6D tracking of any number of unknown rigid objects in one RGB-D stream.

    config  parameters, or the name of a preset (default: ``default``)

    What becomes of the objects is logged as ``p2p_lib``.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | str | None = None,
        tracker: str | PointTracker = backends.DEFAULT_TRACKER,
        detector: str = backends.DEFAULT_DETECTOR,
        segmenter: str | Segmenter = backends.DEFAULT_SEGMENTER,
    ):
        self.camera = camera
        self.config = preset(config) if isinstance(config, str) else config or preset()
        if not isinstance(self.config, Config):
            raise BadInput("config", type(config).__name__, 'a Config, or the name of a preset: "default", "paper"')
        self._rng = np.random.default_rng(self.config.seed)
        self.tracker = backends.make_tracker(tracker, self.config.tracking, self._rng)
        self.detector = backends.make_detector(detector, self.config.sampling, self._rng)
        rng = np.random.default_rng([self.config.seed, 1])
        self.segmenter = backends.make_segmenter(segmenter, camera, self.config.segmentation, rng)
        scene_rng = np.random.default_rng([self.config.seed, 2])
        self.scene = Scene(camera, self.config.depth, scene_rng) if self.config.method.scene else None
        self.objects: dict[str, ObjectTracker] = {}
        self.frame: Frame | None = None
        self.masks: Masks = {}
        self.tracks = NOTHING_TRACKED
        self.stopwatch = Stopwatch()
        self._streaming = False
        self._unlocated = _LOCATE_EVERY
        self._beside = ThreadPoolExecutor(2, "p2p")
        self._time_s: float | None = -np.inf  # of the frame before; None once it is said that time runs backwards
        self._standing = Standing()
        self._status: dict[str, Status] = {}
        self._said: dict[str, Prompt] = {}  # what is said of objects in the frame to come
        #: Of objects whose last prompt did not fit the frame that it was made on: why it was not used.
        self.refused: dict[str, BadInput] = {}
        self._waiting: deque[tuple[Frame, Masks, dict[str, Prompt], bool]] = deque()  # frames without an answer yet

    def add_object(
        self,
        name: str,
        mask: np.ndarray | None = None,
        clicks: ArrayLike | None = None,
        negative: ArrayLike | None = None,
        box: ArrayLike | None = None,
    ) -> None:
        """Follow one more object from the next frame on. The segmenter finds it in every frame that brings no mask.

        mask      (H, W) bool: its pixels in the next frame
        clicks    (N, 2) pixels on it in the next frame; ``negative`` (M, 2) are not of it
        box       (4,) left, top, right, bottom: all of it is inside in the next frame

        With none of them it is started by the first mask that ``step`` gets for it. Raises :class:`BadInput` for what
        does not fit, and nothing has changed. What shows to be unusable in the next frame itself, as clicks where no
        depth was measured, is forgotten with that frame: :attr:`refused` and the reason of the object's estimates say
        why, until :meth:`correct` says something better.
        """
        if name in self.objects:
            raise BadInput("add_object", repr(name), "a name not in use", f"In use: {', '.join(self.objects)}.")
        if mask is clicks is negative is box is None:
            self._begin(name)
        else:
            self.tell(_prompt(name, mask=mask, clicks=clicks, negative=negative, box=box))

    def correct(self, name: str, **said: ArrayLike | None) -> None:
        """Mend an object's mask in the next frame; arguments as of :meth:`add_object`. The last correction counts."""
        if name not in self.objects:
            raise BadInput("correct", repr(name), "one of " + (", ".join(self.objects) or "no objects"))
        self.tell(_prompt(name, **said))

    def tell(self, prompt: Prompt) -> None:
        """What is said of an object in the next frame, whichever that is: starts the object, or corrects its mask."""
        name, known = prompt.name, self.segmenter.names
        check_prompt(prompt, self.camera)
        check_apart((other for other in self._said.values() if other.name != name), prompt)
        if name not in known and not prompt.starts:
            what = "an empty mask" if prompt.mask is not None else "clicks beside it alone"
            raise BadInput(f"object {name!r}", what, "a click on it, a box or at least one pixel of its mask")
        if name not in self.objects:
            self._begin(name)
        self._said[name] = prompt
        self.refused.pop(name, None)

    def _begin(self, name: str) -> None:
        rng = np.random.default_rng([self.config.seed, *name.encode()])
        self.objects[name] = ObjectTracker(
            name, self.camera, self.config, self.detector, rng, self.stopwatch, self._beside
        )

    def remove_object(self, name: str) -> None:
        """Stop following an object; its points are dropped from the tracker."""
        if name not in self.objects:
            raise BadInput("remove_object", repr(name), "one of " + (", ".join(self.objects) or "no objects"))
        if len(ids := self.objects.pop(name).ids):
            self.tracker.drop(ids)
        self._said.pop(name, None)
        self.refused.pop(name, None)
        if name in self.segmenter.names:
            self.segmenter.remove(name)

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray | None] | None = None) -> dict[str, PoseEstimate]:
        """One frame in, one estimate per object out.

        masks  object -> (H, W) bool, its visible pixels, which are taken as they are; an empty mask says that it is
               hidden. The segmenter looks after the objects that are left out, or whose mask is None.

        Where the 2D tracker answers late, so does this: the estimates are of the frame ``latency_frames`` ago,
        and there are none for the first of the stream until then. ``self.frame`` is the one that they are of (None
        while there are none), ``self.masks`` keeps the masks that they were made with, the segmenter's included, and
        ``self.tracks`` everybody's 2D tracks.
        """
        with self.stopwatch.frame():
            given = self._given(frame, masks or {})
            said, self._said = self._said, {}
            self._check_time(frame)
            self._standing = self._standing.with_frame(frame)
            half, still = self._standing.for_long(frame.time_s)
            if half and self.config.method.gates == "all":
                frame = self._without_depth(frame)
            return self._advance(frame, given, said, still)

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

    @uninterrupted()
    def _advance(self, frame: Frame, masks: Masks, said: dict[str, Prompt], still: bool) -> dict[str, PoseEstimate]:
        """Track into a frame, then estimate at the frame that the tracks are of: earlier where they come late."""
        self._waiting.append((frame, masks, said, still))
        answers = len(self._waiting) > self.tracker.latency_frames
        locating = self._locate(self._waiting[0][0]) if answers else None
        tracks = self._track(frame, masks)
        if not answers:
            self.frame = None
            return {}
        for obj in self.objects.values():
            obj.adopt()
        frame, masks, said, still = self._waiting.popleft()
        if locating is not None:
            with self.stopwatch("scene"):
                frame = replace(frame, T_world_cam=locating.result())
        self.frame, self.tracks = frame, tracks
        return self._estimate(frame, masks, said, still)

    def _estimate(self, frame: Frame, masks: Masks, said: dict[str, Prompt], still: bool) -> dict[str, PoseEstimate]:
        """One tracked frame: segment, observe, re-detect, each object's step; what they ask for is done last."""
        # An object added since then is not in that frame's masks yet. The order of the objects means nothing.
        objects = {name: self.objects[name] for name in sorted(self.objects) if name in masks}
        sightings = self._sightings(frame, masks, objects)
        self.masks = self._segment(frame, masks, said, sightings)
        seen = {
            name: obj.observe(frame, self.masks[name], self.tracks, sightings.get(name), masks[name] is not None, still)
            for name, obj in objects.items()
        }
        self._apply(self._misplaced(seen, masks))
        seen |= self._redetect(seen)
        steps = {name: obj.step(seen[name]) for name, obj in objects.items()}
        self._apply({name: step.requests for name, step in steps.items()})
        estimates = {name: self._explained(steps[name].estimate) for name in self.objects if name in steps}
        self._log(estimates)
        return estimates

    def _explained(self, estimate: PoseEstimate) -> PoseEstimate:
        """An estimate that says, where its object has not started, what was wrong with its prompt."""
        if estimate.status != Status.INITIALISING or estimate.object not in self.refused:
            return estimate
        return replace(estimate, reason=str(self.refused[estimate.object]))

    def _log(self, estimates: Mapping[str, PoseEstimate]) -> None:
        """Say what has become of objects since the frame before."""
        for name, estimate in estimates.items():
            if estimate.status != self._status.get(name):
                self._status[name] = estimate.status
                why = f" ({estimate.reason})" if estimate.reason else ""
                _LOG.info("frame %d: %s is %s%s", estimate.frame_index, name, estimate.status, why)

    def _without_depth(self, frame: Frame) -> Frame:
        """A frame of which depth and colour are not of one moment: points can wait for depth."""
        got = "one is the same image again and again while the other goes on"
        doubt("depth and colour", got, "Until both go on, depth counts as missing.")
        return replace(frame, depth_m=np.zeros_like(frame.depth_m))

    def _check_time(self, frame: Frame) -> None:
        """Warn, once, of frames that come in another order than they were taken."""
        if self._time_s is not None and frame.time_s <= self._time_s:
            got = f"{frame.time_s:.6f} s after {self._time_s:.6f} s"
            doubt(f"time of frame {frame.index}", got, "It did not go on: give frames as they were taken.")
            self._time_s = None
        elif self._time_s is not None:
            self._time_s = frame.time_s

    def _locate(self, frame: Frame) -> Future[np.ndarray | None] | None:
        """The camera's pose, sought beside the 2D tracker: often while an object is away, else now and then."""
        self._unlocated += 1
        away = any(obj.outlook.away for obj in self.objects.values())
        every = _LOCATE_EVERY_AWAY if away else _LOCATE_EVERY
        if self.scene is None or frame.T_world_cam is not None or self._unlocated < every:
            return None
        self._unlocated = 0
        known = [mask for mask in self.masks.values() if mask is not None]
        return self._beside.submit(self.scene.locate, frame, _either(known) if known else None)

    def _sightings(self, frame: Frame, masks: Masks, objects: Mapping[str, ObjectTracker]) -> dict[str, Sighting]:
        """Sought objects that show by shape and colour; the tracker looks for their points there."""
        sought = [name for name, obj in objects.items() if obj.outlook.sought]
        seen = {name: objects[name].observe(frame, masks[name], self.tracks) for name in sought}
        looked = {name: objects[name].outlook.sighted(obs) for name, obs in seen.items()}
        found = {name: sighting for name, sighting in looked.items() if sighting is not None}
        self._suggest({name: objects[name].outlook.points_px(seen[name], at.T_cam_obj) for name, at in found.items()})
        return found

    def _suggest(self, expected_px: Mapping[str, np.ndarray]) -> None:
        """Have the tracker look for points where their objects expect them, unless it answers late."""
        if self.tracker.latency_frames:
            return
        with self.stopwatch("tracking"):
            for name, uv_px in expected_px.items():
                found = self.tracker.suggest(self.objects[name].map.ids, uv_px)
                self.tracks = self.tracks if found is None else found

    def _misplaced(self, seen: Mapping[str, Observation], given: Masks) -> dict[str, Requests]:
        """Tracks of absent objects that are on something else.

        Where the segmenter finds nothing of an object it went by these very tracks: only other objects are elsewhere.
        """
        nowhere = {name for name, obs in seen.items() if given[name] is None and obs.mask_px == 0}
        elsewhere = ~_either(self.masks.values()) if nowhere else None
        within = {name: elsewhere if name in nowhere else obs.mask for name, obs in seen.items()}
        return {name: self.objects[name].outlook.misplaced(obs, within[name]) for name, obs in seen.items()}

    def _redetect(self, seen: Mapping[str, Observation]) -> dict[str, Observation]:
        """Guided re-detection: the tracker looks for points where their objects expect them; what is seen then."""
        looked = {name: self.objects[name].outlook.expected_px(obs) for name, obs in seen.items()}
        expected = {name: uv_px for name, uv_px in looked.items() if uv_px is not None}
        self._suggest(expected)
        return {name: self.objects[name].seen_anew(seen[name], self.tracks) for name in expected}

    def _apply(self, requests: Mapping[str, Requests]) -> None:
        """Hand what all objects ask for to the shared tracker: nobody's answer depends on who is asked first."""
        rejected = np.concatenate([NO_IDS, *(request.reject for request in requests.values())])
        if len(rejected) and self.config.method.redetection:
            self.tracker.reject(rejected)
        for name, request in requests.items():
            dropped = request.drop
            if len(request.keys):
                unused = self.objects[name].map.assign(request.keys, self.tracker.add(request.add_px))
                dropped = np.concatenate([dropped, unused])
            if len(dropped):
                self.tracker.drop(dropped)

    def _given(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> Masks:
        """Every object's checked mask in this frame; None for one that the segmenter has to find."""
        if not isinstance(frame, Frame):
            got = f"{type(frame).__name__} {getattr(frame, 'shape', '')}".strip()
            raise BadInput("frame", got, "Frame(index, time_s, rgb, depth_m)", "Colour needs its depth and its time.")
        if frame.shape != (self.camera.height, self.camera.width):
            got = f"{frame.shape[1]}x{frame.shape[0]}"
            raise BadInput(f"frame {frame.index}", got, f"{self.camera.width}x{self.camera.height} as the camera")
        if unknown := sorted(set(masks) - set(self.objects)):
            known = ", ".join(self.objects) or "none yet"
            raise BadInput("masks", f"unknown object {unknown[0]!r}", f"objects added before: {known}")
        given = {name: Prompt(name, frame.index, mask=mask) for name, mask in masks.items() if mask is not None}
        for name, prompt in given.items():
            check_mask(name, prompt.mask, self.camera)
        for name, prompt in given.items():
            if prompt.mask is not None and prompt.mask.all():
                doubt(f"mask of {name!r}", f"the whole image in frame {frame.index}", "Is it inverted?")
        for name in list(self._said):
            try:
                _check_said(self._said[name], frame, given)
            except BadInput as error:
                self.refused[name] = error
                del self._said[name]
                if name in self.segmenter.names:  # its estimates go on and cannot say so
                    doubt(f"correction of {name!r}", f"{error.name}: {error.got}", f"It is not used. {error.fix}")
        given = {name: prompt for name, prompt in self._said.items() if prompt.mask is not None} | given
        return {name: given[name].mask if name in given else None for name in self.objects}

    def _segment(self, frame: Frame, masks: Masks, said: dict[str, Prompt], sightings: Mapping[str, Sighting]) -> Masks:
        """Every object's mask: the one given, else the segmenter's, which learns from those that are given."""
        masks = {name: mask for name, mask in sorted(masks.items()) if name in self.objects}  # some may be gone again
        said = {name: prompt for name, prompt in sorted(said.items()) if name in masks}
        said |= {name: Prompt(name, frame.index, mask=mask) for name, mask in masks.items() if mask is not None}
        if not self.segmenter.names and not said:
            return masks
        with self.stopwatch("segmentation"):
            sought = [name for name in self.segmenter.names if name in masks and masks[name] is None]
            hint = cache(lambda name: self._hint(self.objects[name], frame, sightings.get(name)))
            hints = _Hints(sought, lambda name: hint(name)[0])
            self._apply({name: hint(name)[1] for name in sought if self.objects[name].outlook.sought})
            labels = self.segmenter.segment(frame, said.values(), hints)
            label_of = {name: label for label, name in enumerate(self.segmenter.names, 1)}
            looked_after = [name for name, mask in masks.items() if mask is None and name in label_of]
            return masks | {name: labels == label_of[name] for name in looked_after}

    def _hint(self, obj: ObjectTracker, frame: Frame, sighting: Sighting | None) -> tuple[Hint, Requests]:
        return obj.outlook.hint(obj.observe(frame, None, self.tracks, sighting))

    def _track(self, frame: Frame, masks: dict[str, np.ndarray | None]) -> Tracks:
        """All objects' points in a single pass of the 2D tracker."""
        with self.stopwatch("tracking"):
            if not self._streaming:
                _check_unit(frame)
                self.tracker.start(frame, self.camera)
                self._streaming = True
                return NOTHING_TRACKED
            known = [mask for mask in masks.values() if mask is not None]
            search = _either(known) if len(known) == len(masks) > 0 else None
            urgent = any(obj.outlook.awaited(masks[name]) for name, obj in self.objects.items())
            return self.tracker.track(frame, search, urgent)


def _check_said(prompt: Prompt, frame: Frame, given: Mapping[str, Prompt]) -> None:
    """Refuse what is said of an object in a frame where depth or the masks given with it say otherwise."""
    check_depth(prompt, frame)
    for other in given.values():
        check_not_on(prompt, other, frame.index)
    if prompt.name in given and prompt.mask is None:
        fix = "Leave it out of the masks, or do not click on it."
        raise BadInput(f"mask of {prompt.name!r}", f"a mask and clicks in frame {frame.index}", "one of them", fix)


def _either(masks: Iterable[np.ndarray | None]) -> np.ndarray:
    """(H, W) bool: what any of some masks holds; None holds nothing."""
    return reduce(np.logical_or, (mask for mask in masks if mask is not None))  # its ufunc would copy all of them first


def _check_unit(frame: Frame) -> None:
    """Refuse depth that cannot be in metres, since nothing is near; warn of what hardly is."""
    measured = frame.depth_m[frame.depth_m > 0]
    if not len(measured):
        return
    near_m, middle_m = np.quantile(measured, [_NEAREST, 0.5]).tolist()
    what, fix = f"depth of frame {frame.index}", "Is it in millimetres? Give metres (p2p: --depth-scale 0.001)."
    if near_m > _FAR_M:
        raise BadInput(what, f"{near_m:.0f} m and more", f"objects nearer than {_FAR_M:g} m", fix)
    if middle_m > _FAR_M:
        doubt(what, f"{middle_m:.0f} m in the middle", fix)


class _Hints(Mapping[str, Hint]):
    """The hints of some objects, each made when it is asked for: they cost, and a segmenter needs but some."""

    def __init__(self, names: Sequence[str], make: Callable[[str], Hint]):
        self._names, self._make = names, make

    def __getitem__(self, name: str) -> Hint:
        if name not in self._names:
            raise KeyError(name)
        return self._make(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _prompt(name: str, **said: ArrayLike | None) -> Prompt:
    """The prompt of the arguments of :meth:`Point2Pose.add_object`; TypeError for any other."""
    field = {"mask": "mask", "clicks": "points_px", "negative": "negative_px", "box": "box_px"}
    if unknown := sorted(set(said) - set(field)):
        raise TypeError(f"unknown argument {unknown[0]!r}, expected some of {', '.join(field)}")
    values: dict[str, Any] = {field[key]: value for key, value in said.items() if value is not None}
    return Prompt(name, **values)
