"""Point2Pose: what becomes of a frame, for all objects (paper: Fig. "Overview of the framework").

What a caller writes:

    tracker = Point2Pose(camera, preset("paper"))
    tracker.add_object("mug", clicks=[[312, 207], [320, 240]])
    for frame in video:
        estimates = tracker.step(frame)
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from p2p_lib.core import backends
from p2p_lib.core.camera import Camera
from p2p_lib.core.compiled import uninterrupted
from p2p_lib.core.config import Config, as_config
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import Detector, PointTracker, Segmenter
from p2p_lib.core.objects import FollowedT, Objects
from p2p_lib.core.prompts import check_frame
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, PoseEstimate, Tracks
from p2p_lib.method.frontend import FrameInputs, Frontend, Masks
from p2p_lib.method.object_tracker import ObjectTracker


@dataclass(frozen=True)
class Parts:
    """What the method is composed of; the paper's parts by default.

    before  takes each frame first and returns the one to use; None: frames are used as they come
    front   tracks, segments and observes for all objects
    object  makes the tracker of one object
    """

    before: Callable[[Frame], Frame] | None = None
    front: Callable[..., Frontend] = Frontend
    object: Callable[..., Any] = ObjectTracker


class Point2Pose(Objects[FollowedT]):
    """Causal 6D tracking of any number of unknown rigid objects in one RGB-D stream.

    config  parameters, or the name of a preset

    What becomes of objects goes to the logger ``p2p_lib``. :meth:`close`, or a ``with`` block's end, ends its threads.
    """

    def __init__(
        self,
        camera: Camera,
        config: Config | str = "paper",
        tracker: str | PointTracker = backends.DEFAULT_TRACKER,
        detector: str | Detector = backends.DEFAULT_DETECTOR,
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
        self._executor = ThreadPoolExecutor(2, "p2p")
        self.front = self._parts.front(camera, tracker, segmenter, self.objects, self.stopwatch, self._executor)

    @property
    def tracker(self) -> PointTracker:
        """The 2D tracker."""
        return self.front.tracker

    @property
    def segmenter(self) -> Segmenter:
        """Finds the objects in frames that bring no mask of them."""
        return self.front.segmenter

    @property
    def masks(self) -> Masks:
        """The masks of the newest estimates: object to (H, W) bool, None where unknown."""
        return self.front.masks

    @property
    def tracks(self) -> Tracks:
        """All objects' 2D tracks in the frame of the newest estimates."""
        return self.front.tracks

    # -- a frame -------------------------------------------------------------------------------

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray | None] | None = None) -> dict[str, PoseEstimate]:
        """One frame in, one estimate per object out.

        masks  object -> (H, W) bool, its visible pixels, used as given; an empty mask says that it is hidden.
               The segmenter finds the objects that are left out, or whose mask is None.

        With a 2D tracker that answers late, the estimates are of the frame ``latency_frames`` ago, and the first
        calls return none. ``self.frame`` is the frame of the estimates (None while there are none); ``self.masks``
        and ``self.tracks`` are the masks, given or segmented, and all objects' 2D tracks in it.
        """
        with self.alone(), self.stopwatch.frame(), uninterrupted():
            tracked = self.front.track(self._inputs(frame, {} if masks is None else masks))
            self.frame = None if tracked is None else tracked.frame
            if tracked is None:
                return {}
            self.front.segment(tracked)
            seen = self.front.observe(tracked)
            steps = {name: self.objects[name].step(obs) for name, obs in seen.items()}
            self.front.apply({name: step.requests for name, step in steps.items()})
            said = {name: steps[name].estimate for name in self.objects if name in steps}
            estimates = {n: self.explained(e, tracked.frame, self.masks[n], tracked.masks[n]) for n, e in said.items()}
        self.journal.note(estimates, self.stopwatch.last_ms["total"])
        return estimates

    def _inputs(self, frame: Frame, masks: Mapping[str, np.ndarray | None]) -> FrameInputs:
        """The frame, every object's checked mask (None: the segmenter has to find it) and the prompts for it."""
        check_frame(frame, self.camera)
        frame = self._parts.before(frame) if self._parts.before else frame
        return FrameInputs(frame, *self.take_prompts(frame, masks))

    def finish(self) -> Iterator[dict[str, PoseEstimate]]:
        """After the last frame: the estimates still owed by a tracker that answers late, oldest first."""
        waiting = list(self.front.waiting)
        for _ in range(self.tracker.latency_frames if waiting else 0):
            owed, last = len(self.front.waiting) == self.tracker.latency_frames, waiting[-1]
            estimates = self.step(last.frame, {n: m for n, m in last.masks.items() if n in self.objects})
            if owed:
                yield estimates
        self.front.waiting.clear()

    def begin(self, name: str) -> None:
        """Start an object of which nothing is known."""
        rng = np.random.default_rng([self.config.seed, *name.encode()])
        made_of = self.camera, self.config, self.detector, rng, self.stopwatch, self._executor
        self.objects[name] = self._parts.object(name, *made_of, map_id=self._next_map.get(name, 0))

    # -- the end -------------------------------------------------------------------------------

    def end(self) -> None:
        """End the threads once their work is done."""
        self._executor.shutdown()
