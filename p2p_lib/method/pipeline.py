"""Point2Pose: what becomes of a frame, for all objects (paper: Fig. "Overview of the framework").

What a caller writes:

    tracker = Point2Pose(camera, preset("paper"))
    tracker.add_object("mug", clicks=[[312, 207], [320, 240]])
    for frame in video:
        estimates = tracker.step(frame)
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from p2p_lib.core import backends
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import uninterrupted
from p2p_lib.core.config import Config, as_config
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import PointTracker, Segmenter
from p2p_lib.core.objects import Objects
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, PoseEstimate, Status, Tracks
from p2p_lib.method.frontend import Asked, Frontend, Masks
from p2p_lib.method.object_tracker import ObjectTracker

_LOG = logging.getLogger("p2p_lib")


@dataclass(frozen=True)
class Parts:
    """What the method is composed of; the paper's parts by default.

    before  looks at a frame before anything else does
    front   tracks, segments and observes for all objects
    object  makes the tracker of one object
    """

    before: Callable[[Frame], Frame] | None = None
    front: Callable[..., Frontend] = Frontend
    object: Callable[..., Any] = ObjectTracker


class Point2Pose(Objects):
    """Causal 6D tracking of any number of unknown rigid objects in one RGB-D stream.

    config  parameters, or the name of a preset

    What becomes of the objects is logged as ``p2p_lib``. :meth:`close` ends its threads, and so does the end of a
    ``with`` block.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | str = "paper",
        tracker: str | PointTracker = backends.DEFAULT_TRACKER,
        detector: str = backends.DEFAULT_DETECTOR,
        segmenter: str | Segmenter = backends.DEFAULT_SEGMENTER,
        parts: Parts | None = None,
    ):
        super().__init__(camera)
        self.config = as_config(config)
        if parts is None and self.config.method.mechanisms != "none":
            fix = "p2p_lib.Point2Pose composes them."
            raise BadInput("config method.mechanisms", repr(self.config.method.mechanisms), "none", fix)
        self._parts = parts or Parts()
        rng = np.random.default_rng(self.config.seed)
        tracker = backends.make_tracker(tracker, self.config.tracking, rng)
        self.detector = backends.make_detector(detector, self.config.sampling, rng)
        segmenter = backends.make_segmenter(segmenter, camera, self.config.segmentation)
        self.frame: Frame | None = None
        self.stopwatch = Stopwatch()
        self._beside = ThreadPoolExecutor(2, "p2p")
        self.front = self._parts.front(camera, tracker, segmenter, self.objects, self.stopwatch, self._beside)
        self._status: dict[str, Status] = {}

    @property
    def tracker(self) -> PointTracker:
        """The 2D tracker."""
        return self.front.tracker

    @property
    def segmenter(self) -> Segmenter:
        """What finds the objects in frames without their masks."""
        return self.front.segmenter

    @property
    def masks(self) -> Masks:
        """Object to (H, W) bool, None where nobody knows: those that the newest estimates were made with."""
        return self.front.masks

    @property
    def tracks(self) -> Tracks:
        """The 2D tracks of all objects in the frame that the newest estimates are of."""
        return self.front.tracks

    # -- a frame -------------------------------------------------------------------------------

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray | None] | None = None) -> dict[str, PoseEstimate]:
        """One frame in, one estimate per object out.

        masks  object -> (H, W) bool, its visible pixels, which are taken as they are; an empty mask says that it is
               hidden. The segmenter looks after the objects that are left out, or whose mask is None.

        Where the 2D tracker answers late, so does this: the estimates are of the frame ``latency_frames`` ago,
        and there are none for the first of the stream until then. ``self.frame`` is the one that they are of (None
        while there are none), ``self.masks`` keeps the masks that they were made with, the segmenter's included, and
        ``self.tracks`` the 2D tracks of all objects.
        """
        with self.alone(), self.stopwatch.frame(), uninterrupted():
            tracked = self.front.track(self._asked(frame, masks or {}))
            self.frame = None if tracked is None else tracked.frame
            if tracked is None:
                return {}
            self.front.segment(tracked)
            seen = self.front.observe(tracked)
            steps = {name: self.objects[name].step(obs) for name, obs in seen.items()}
            self.front.apply({name: step.requests for name, step in steps.items()})
            answers = {name: steps[name].estimate for name in self.objects if name in steps}
            estimates = {n: self.explained(answer, tracked.masks[n] is not None) for n, answer in answers.items()}
        self._log(estimates)
        return estimates

    def _asked(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> Asked:
        """The frame, with every object's checked mask in it: None for one that the segmenter has to find."""
        given, said = self.take_said(frame, masks)
        return Asked(self._parts.before(frame) if self._parts.before else frame, given, said)

    def finish(self) -> Iterator[dict[str, PoseEstimate]]:
        """After the last frame: the estimates that a tracker which answers late still owes, oldest first."""
        waiting = list(self.front.waiting)
        for _ in range(self.tracker.latency_frames if waiting else 0):
            owed, last = len(self.front.waiting) == self.tracker.latency_frames, waiting[-1]
            estimates = self.step(last.frame, {n: m for n, m in last.masks.items() if n in self.objects})
            if owed:
                yield estimates
        self.front.waiting.clear()

    def begin(self, name: str) -> None:
        """A new object, without anything known of it."""
        rng = np.random.default_rng([self.config.seed, *name.encode()])
        made_of = self.camera, self.config, self.detector, rng, self.stopwatch, self._beside
        self.objects[name] = self._parts.object(name, *made_of)

    def _log(self, estimates: Mapping[str, PoseEstimate]) -> None:
        """Say what has become of objects since the frame before."""
        for name, estimate in estimates.items():
            if estimate.status != self._status.get(name):
                self._status[name] = estimate.status
                why = f" ({estimate.reason})" if estimate.reason else ""
                _LOG.info("frame %d: %s is %s%s", estimate.frame_index, name, estimate.status, why)

    # -- the end -------------------------------------------------------------------------------

    def close(self) -> None:
        """End the threads, after what they are at; nothing can be tracked any more."""
        self.closed = True
        self._beside.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
