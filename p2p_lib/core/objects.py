"""Objects come and go: which are followed, and the prompts for the next frame."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from threading import RLock
from typing import Any, Generic, NoReturn, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.core.depth import depth_trouble
from p2p_lib.core.earlier import check_still, selected, with_mask
from p2p_lib.core.errors import BadInput, did_you_mean, doubt
from p2p_lib.core.files import file_name
from p2p_lib.core.interfaces import PointTracker, Segmenter
from p2p_lib.core.journal import Journal
from p2p_lib.core.mask_length import UsualLengths
from p2p_lib.core.prediction import Prediction, Predictor
from p2p_lib.core.prompts import Prompt, check_apart, check_depth, check_frame, check_prompt, given_masks
from p2p_lib.core.types import DOUBTED, NOT_FOUND, NOT_SEEN, OUT_OF_VIEW, Frame, PoseEstimate, Status


class Followed(Protocol):
    """What follows one object, as :class:`Objects` needs it; users find what it has learnt beyond that."""

    @property
    def ids(self) -> np.ndarray:
        """The 2D tracker's ids of all its points."""

    def step(self, obs: Any) -> Any:
        """What it makes of an observation of its own kind."""


FollowedT = TypeVar("FollowedT", bound=Followed)


class Objects(ABC, Generic[FollowedT]):
    """What a user adds, corrects and removes; whoever tracks them says what it is to ``begin`` one.

    One thread at a time calls it, whichever that is: another one that comes meanwhile gets :class:`BadInput`, and
    nothing has changed. :meth:`predict` alone may be asked at any time.

    objects  what follows each of them, by name
    closed   whether it has been ended
    journal  tells the logger what becomes of them
    refused  of objects whose last prompt did not fit the frame that it was made on: why it was not used
    """

    config: Config

    def __init__(self, camera: Camera):
        if not isinstance(camera, Camera):
            fix = "Make one: Camera(fx, fy, cx, cy, width, height), or Camera.from_K(K, width, height)."
            raise BadInput("tracker camera", type(camera).__name__, "a p2p_lib.Camera", fix)
        self.camera = camera
        self.objects: dict[str, FollowedT] = {}
        self.refused: dict[str, BadInput] = {}
        self._ignored: dict[str, str] = {}  # of corrections of the newest frame
        self._prompts: dict[str, Prompt] = {}  # in the frame to come
        self._earlier: dict[str, Frame] = {}  # that prompts are of, where it is not the one to come
        self._doubts: dict[tuple[str, int], str] = {}  # about masks made of prompts, by object and frame of each
        self._next_map: dict[str, int] = {}  # by object, which no pose of its name has had yet
        self._without: dict[str, int] = {}  # objects without a pose, and the first frame without
        self._unstarted: dict[str, str] = {}  # objects, and why what was selected of them last did not start them
        self._turn, self.closed = RLock(), False
        self._predictor, self.journal, self._lengths = Predictor(), Journal(), UsualLengths(camera)
        self._cameras: deque[tuple[float, np.ndarray | None]] = deque()  # time and T_world_cam of frames, as given

    @contextmanager
    def alone(self) -> Iterator[None]:
        """While one thread is inside no other one can be; nobody can once it is closed."""
        self._check_open()
        if not self._turn.acquire(blocking=False):
            fix = "Put a lock around its calls, or give each thread a tracker of its own."
            raise BadInput("tracker", "a call from a second thread meanwhile", "one thread at a time", fix)
        try:
            yield
        finally:
            self._turn.release()

    def _check_open(self) -> None:
        if self.closed:
            raise BadInput("tracker", "a call after close()", "an open tracker", "Make a new one, or reset() this one.")

    def close(self) -> None:
        """End the threads once their work is done; afterwards nothing can be tracked. Once more does nothing."""
        if not self.closed:
            with self.alone():
                self.closed = True
                self.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        fix = "save(path) keeps what it knows, and Point2Pose.load(path) goes on with it"
        raise TypeError(f"a tracker cannot be copied or pickled: {fix}")

    @abstractmethod
    def end(self) -> None:
        """End what runs beside the calls; nothing is called afterwards."""

    @property
    @abstractmethod
    def tracker(self) -> PointTracker:
        """The 2D tracker."""

    @property
    @abstractmethod
    def segmenter(self) -> Segmenter:
        """What finds the objects in frames without their masks."""

    @abstractmethod
    def begin(self, name: str) -> None:
        """A new object, without anything known of it."""

    def _check_known(self, what: str, name: str) -> None:
        """Refuse a name that no object has, asked for by the call ``what``."""
        if not isinstance(name, str) or name not in self.objects:
            expected = "one of " + (", ".join(self.objects) or "no objects")
            raise BadInput(what, repr(name)[:120], expected, did_you_mean(str(name), self.objects))

    def add_object(
        self,
        name: str,
        mask: np.ndarray | None = None,
        clicks: ArrayLike | None = None,
        negative: ArrayLike | None = None,
        box: ArrayLike | None = None,
        *,
        frame: Frame | None = None,
    ) -> None:
        """Follow one more object from the next frame on. The segmenter finds it in every frame that brings no mask.

        mask      (H, W) bool: its pixels in the next frame
        clicks    (N, 2) pixels on it in the next frame; ``negative`` (M, 2) are not of it
        box       (4,) left, top, right, bottom: all of it is inside in the next frame
        frame     the earlier frame that they are of, where it is not the next one: what they select in it is the
                  object's mask in the next one, where nothing has moved in and about it since

        With none of them it is started by the first mask that ``step`` gets for it, or by :meth:`correct`, and its
        estimates say until then that it waits for them. Raises :class:`BadInput` for what does not fit, and nothing has
        changed. What shows to be unusable in the next frame itself, as clicks where no depth was measured, or something
        has moved since the ``frame`` that they are of, is forgotten with that frame: ``refused`` and the reason of the
        object's estimates say why, until :meth:`correct` says something better.
        """
        if file_name("object name", name) in self.objects:
            raise BadInput("add_object", repr(name), "a name not in use", f"In use: {', '.join(self.objects)}.")
        if mask is clicks is negative is box is frame is None:
            with self.alone():
                self.begin(name)
        else:
            self.tell(_prompt(name, mask, clicks, negative, box), frame)

    def correct(
        self,
        name: str,
        *,
        mask: np.ndarray | None = None,
        clicks: ArrayLike | None = None,
        negative: ArrayLike | None = None,
        box: ArrayLike | None = None,
        frame: Frame | None = None,
    ) -> None:
        """Mend an object's mask in the next frame; arguments as of :meth:`add_object`. The last correction counts."""
        self._check_known("correct", name)
        self.tell(_prompt(name, mask, clicks, negative, box), frame)

    def tell(self, prompt: Prompt, frame: Frame | None = None) -> None:
        """A prompt for the next frame, whichever that is: it starts its object, or corrects its mask.

        frame  the earlier one that it is of, as of :meth:`add_object`
        """
        name, known = prompt.name, self.segmenter.names
        check_prompt(prompt, self.camera)
        others = (other for other in self._prompts if other != name and self._earlier.get(other) is frame)
        check_apart(map(self._prompts.__getitem__, others), prompt)
        if frame is not None:
            check_frame(frame, self.camera)
            check_depth(prompt, frame)
        if name not in known and not prompt.starts:
            what = "an empty mask" if prompt.mask is not None else "negative clicks alone"
            raise BadInput(f"object {name!r}", what, "a click on it, a box or at least one pixel of its mask")
        with self.alone():
            if name not in self.objects:
                self.begin(name)
            self._prompts[name] = prompt
            self._earlier.pop(name, None)
            self._earlier |= {} if frame is None else {name: frame}
            self.refused.pop(name, None)
            self._unstarted.pop(name, None)

    def remove_object(self, name: str) -> None:
        """Stop following an object; its points are dropped from the tracker.

        Under the same name another one may be added; its poses are in other maps (``map_id``).
        """
        self._check_known("remove_object", name)
        with self.alone():
            if len(ids := self.objects.pop(name).ids):
                self.tracker.drop(ids)
            for kept in (self._prompts, self._earlier, self.refused, self._without, self._unstarted):
                kept.pop(name, None)
            self._predictor.forget(name)
            self.journal.forget(name)
            self._lengths.forget(name)
            if name in self.segmenter.names:
                self.segmenter.remove(name)

    def predict(self, name: str, time_s: float) -> Prediction | None:
        """Where an object is at a time to come, if it goes on as it does; its velocity, and how sure both are.

        time_s  not before the newest pose of more confidence than 0.5. The covariance grows with the time since:
                after a second it says little

        None until there is such a pose. Any thread may ask, also while :meth:`step` is at work: it is told what was
        known before. Raises :class:`BadInput` for an unknown name, an earlier time and what is no time.
        """
        self._check_open()
        self._check_known("predict", name)
        return self._predictor.predict(name, time_s)

    def take_prompts(
        self, frame: Frame, masks: Mapping[str, np.ndarray | None]
    ) -> tuple[dict[str, np.ndarray | None], dict[str, Prompt]]:
        """Every object's mask in this frame, None for one to be found, and the prompts for this frame.

        Every prompt since the last frame belongs to this one, or to an earlier one that was named; one that does not
        fit it is ``refused``.
        """
        check_frame(frame, self.camera)
        prompts, stale, doubts = self._carried(frame)
        given, refused = given_masks(frame, masks, prompts, self.objects, self.camera)
        refused |= stale
        self._cameras.append((frame.time_s, frame.T_world_cam))
        while len(self._cameras) > self.tracker.latency_frames + 1:
            self._cameras.popleft()
        self._prompts, self._earlier = {}, {}
        self.refused |= refused
        self._ignored = {}
        for name, error in refused.items():
            if name in self.segmenter.names:
                self._ignored[name] = doubt(f"correction of {name!r}", f"it is ignored: {error}", "", name)
        taken = {name: prompt for name, prompt in prompts.items() if name not in refused}
        self._doubts |= {(name, frame.index): doubts.get(name, "") for name in taken}
        self.journal.corrected(frame.index, taken.keys() & set(self.segmenter.names))
        return given, taken

    def _carried(self, now: Frame) -> tuple[dict[str, Prompt], dict[str, BadInput], dict[str, str]]:
        """The prompts as they hold in a frame, why others do not, and what is doubtful about the masks made of them.

        Clicks of an earlier frame become the masks that they select there, all together, but for those that correct.
        """
        held, refused, doubts = dict(self._prompts), dict[str, BadInput](), dict[str, str]()
        for then in dict.fromkeys(self._earlier.values()):
            names, made = [name for name, of in self._earlier.items() if of is then], dict[str, np.ndarray]()
            starting = [held[name] for name in names if name not in self.segmenter.names]
            if any(prompt.mask is None for prompt in starting):
                made, said = selected(then, starting, self.camera, self.config.segmentation)
                doubts |= said
            for name in names:
                try:
                    held[name] = with_mask(held[name], made)
                    check_still(held[name], then, now)
                except BadInput as error:
                    refused[name] = error
                    del held[name]
        return held, refused, doubts

    def explained(
        self, estimate: PoseEstimate, frame: Frame, mask: np.ndarray | None, given: np.ndarray | None
    ) -> PoseEstimate:
        """An estimate that says what is known of why it is as it is, and where its object is in the world.

        mask, given  (H, W) bool, that by which the object was looked for in the frame, and that which the caller gave;
                     None where there was none

        Where its frame was given with a ``T_world_cam``, its pose is in the world, too; the scene that a tracker finds
        is no world of the user's. In the frame of a prompt that made a doubtful mask, or one much longer than before,
        the object's pose is doubted.
        """
        name = estimate.object
        of_prompt = self._doubts.pop((name, frame.index), None)
        said = of_prompt or getattr(self.segmenter, "doubts", {}).get(name, "")
        grown = self._lengths.doubt(name, frame, mask, of_prompt is not None) * (estimate.T_cam_obj is not None)
        if said or grown:
            estimate = replace(estimate, confidence=min(estimate.confidence, DOUBTED))
        self._next_map[name] = max(self._next_map.get(name, 0), estimate.map_id + 1)
        T_world_cam = next((T for time_s, T in reversed(self._cameras) if time_s == estimate.time_s), None)
        self._predictor.add(estimate, T_world_cam)
        if estimate.T_cam_obj is not None and T_world_cam is not None:
            estimate = replace(estimate, T_world_obj=T_world_cam @ estimate.T_cam_obj)
        pixels = 0 if mask is None else np.count_nonzero(mask)
        if estimate.status is Status.INITIALISING and (said or pixels):
            few = f": a mask of {pixels} pixels does not start it" * (estimate.reason == NOT_SEEN)
            self._unstarted[name] = estimate.reason + (f": {said}" if said else few)
        reason = self._reason(estimate, frame, mask, given is not None)
        told = said if estimate.status is not Status.INITIALISING else ""  # there it is the reason
        parts = (reason, grown, told, self._ignored.get(name, ""), frame.remark)
        return replace(estimate, reason="; ".join(filter(None, parts)))

    def _reason(self, estimate: PoseEstimate, frame: Frame, mask: np.ndarray | None, mask_given: bool) -> str:
        """Why an estimate has its status, with what prompts, depth and earlier frames tell of it.

        Of an object that has not started, what was wrong with its prompt, and with what that selected. Where nobody
        gave a mask, an object without pixels may be hidden, or in view and not found; since when, is sure.
        """
        name = estimate.object
        if estimate.T_cam_obj is not None:
            self._without.pop(name, None)
        elif estimate.status != Status.INITIALISING:
            self._without.setdefault(name, estimate.frame_index)
        elif name in self.refused:
            return str(self.refused[name])
        if estimate.reason and (trouble := depth_trouble(frame, mask)):
            return trouble
        if estimate.status is Status.INITIALISING:
            return self._unstarted.get(name, estimate.reason)
        if estimate.status != Status.OCCLUDED or mask_given:
            return estimate.reason
        known = f"{OUT_OF_VIEW}: " * estimate.reason.startswith(OUT_OF_VIEW)
        return f"{known}{NOT_FOUND} since frame {self._without[name]}"


def _prompt(
    name: str,
    mask: np.ndarray | None,
    clicks: ArrayLike | None,
    negative: ArrayLike | None,
    box: ArrayLike | None,
) -> Prompt:
    """The prompt of the arguments of :meth:`Objects.add_object`."""
    fields: dict[str, Any] = {"mask": mask, "points_px": clicks, "negative_px": negative, "box_px": box}
    return Prompt(name, **{key: value for key, value in fields.items() if value is not None})
