"""Track objects in front of a running camera: what ``p2p live`` calls.

Where a frame takes longer than the camera's, those that came meanwhile wait; of more than a few the oldest are dropped,
and counted.
"""

from __future__ import annotations

import json
import logging
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from p2p_lib.apps.click import Clicker, wait_for_clicks
from p2p_lib.apps.live_click import LiveClicker
from p2p_lib.apps.live_words import FORM, Words
from p2p_lib.core.backends import DEFAULT_SEGMENTER, SEGMENTERS
from p2p_lib.core.compiled import warm_up
from p2p_lib.core.errors import BadInput, MissingData
from p2p_lib.core.memory import load_memories
from p2p_lib.core.options import RunOptions, lengths_m
from p2p_lib.core.prompts import Prompt, doubt_spelling
from p2p_lib.core.types import Frame, PoseEstimate, status_text
from p2p_lib.datasets.cameras import DEFAULT_BACKLOG, LiveCamera, Newest, Stream
from p2p_lib.datasets.models import find_models
from p2p_lib.datasets.run_writer import IfExists, RunWriter
from p2p_lib.evaluation.known_size import Watch
from p2p_lib.extended.default import Point2Pose
from p2p_lib.figures.film import Film
from p2p_lib.figures.scenes import draw_live
from p2p_lib.keeper import Keeper, noted
from p2p_lib.run import described, recall

#: Made-up images that are tracked before a camera starts.
_WARM_FRAMES = 4


@dataclass
class LiveCount:
    """What became of a camera's frames: how many were tracked, how many dropped, in how many seconds."""

    frames: int = 0
    dropped: int = 0
    seconds: float = 0.0
    _last: int | None = field(default=None, repr=False)

    def count(self, frame: Frame) -> None:
        """One more tracked; what lies between it and the one before was dropped."""
        self.dropped += 0 if self._last is None else frame.index - self._last - 1
        self.frames, self._last = self.frames + 1, frame.index

    def until(self, stop: int) -> None:
        """That it was stopped before this frame: what lies between it and the last one tracked was dropped, too."""
        if self._last is not None:
            self.dropped, self._last = self.dropped + stop - self._last - 1, stop - 1

    def __str__(self) -> str:
        rate = f" ({self.frames / self.seconds:.1f} Hz)" if self.seconds else ""
        return f"{self.frames} frames in {self.seconds:.1f} s{rate}, {self.dropped} dropped"


@dataclass(frozen=True, eq=False)
class LiveOptions:
    """What goes with a camera that is tracked.

    first    an image that was taken before, and is the one that the prompts' frame 0 means (see ``p2p live``)
    out      a folder that keeps the run, as :func:`p2p_lib.run.run` writes it; ``if_exists`` as there, without resuming
    overlay  a film of it, .mp4, .gif or .webp, as the tracker sees it
    backlog  how many images may wait while one takes long, before the oldest is dropped; with 0 the newest one wins
    say      told what it waits for before the first image, then where ``words`` come from, and whether ``sizes`` fit
    words    says of objects what comes in meanwhile; there need be no prompts then
    page     shows every frame that was tracked
    """

    first: Frame | None = None
    out: str | Path | None = None
    overlay: str | Path | None = None
    if_exists: IfExists = "refuse"
    backlog: int = DEFAULT_BACKLOG
    say: Callable[[str], object] = lambda line: None
    words: Words | None = None
    page: LiveClicker | None = None

    def __post_init__(self) -> None:
        if self.backlog < 0:
            raise BadInput("backlog", self.backlog, "how many images may wait, from 0")


def track_live(
    camera: LiveCamera,
    prompts: Iterable[Prompt],
    on_estimate: Callable[[PoseEstimate], None],
    options: RunOptions | None = None,
    live: LiveOptions | None = None,
    count: LiveCount | None = None,
) -> LiveCount:
    """Follow the objects of the prompts until the camera ends; every estimate goes to ``on_estimate`` at once.

    prompts  clicks, boxes, masks; those of frame k start their object, or correct its mask, at the camera's k-th image,
             which is not dropped
    options  the method and its parameters; ``masks`` names the segmenter, ``stop`` the image before which it ends,
             ``memory`` what is known of objects, which are looked for without prompts, ``sizes`` how long they are
    count    filled as frames pass, for whoever wants to know meanwhile or after an interruption

    Closes the camera at the end, whatever ends it. Raises :class:`BadInput` for clicks that do not fit.
    """
    options, live, count = options or RunOptions(), live or LiveOptions(), count or LiveCount()
    waiting = sorted(prompts, key=lambda p: p.frame)
    if not (waiting or live.words or options.memory):
        raise BadInput("prompts", "none", "what to follow: clicks, boxes or masks of objects, memories, or words")
    if options.stop is not None and options.stop < 1:
        raise BadInput("stop", options.stop, "the number of an image from 1", "Leave it out to end with Ctrl-C.")
    memories = load_memories(options.memory or ())
    named_so_far = {*memories, *(prompt.name for prompt in waiting)}
    sizes_m = lengths_m(options.sizes, options.sizes or () if live.words else sorted(named_so_far))
    method = _warm_method(camera, options, live.say)
    recall(method, memories, options.frozen)
    tracked = _Tracked(camera, method, options, live, count, waiting, list(waiting), list(memories), sizes_m)
    with ExitStack() as kept:
        listeners = tracked.listeners(kept)
        stop = math.inf if options.stop is None else options.stop
        newest = kept.enter_context(Newest(camera, {p.frame for p in waiting}, live.backlog, stop))
        for estimates in tracked.estimates(newest):
            if (of := method.frame) is not None:
                for estimate in estimates.values():
                    on_estimate(estimate)
                for listen in listeners:
                    listen(of, estimates)
    if waiting:
        if live.first is None and not count.frames:
            raise MissingData(f"camera {camera.name}", "it gave no image", "Is it connected, and not in use elsewhere?")
        got = f"frame {waiting[0].frame}, which never came"
        raise BadInput(f"prompt of {waiting[0].name!r}", got, "a frame of the camera", "Click in an earlier one.")
    return count


Listener = Callable[[Frame, dict[str, PoseEstimate]], object]


@dataclass(frozen=True, eq=False)
class _Tracked:
    """A camera, its tracker and what goes with them; ``waiting`` are the ``prompts`` whose image is to come."""

    camera: LiveCamera
    method: Point2Pose
    options: RunOptions
    live: LiveOptions
    count: LiveCount
    waiting: list[Prompt]
    prompts: list[Prompt]
    memories: list[str]
    sizes_m: Mapping[str, float]

    def estimates(self, newest: Newest) -> Iterator[dict[str, PoseEstimate]]:
        """Those of image after image, of which each takes its prompts, and what words say meanwhile."""
        method, count, first, words, start_s = self.method, self.count, self.live.first, self.live.words, monotonic()
        frame = first or newest.take()
        if frame is not None and words is not None and words.reads:
            self.live.say(f"{self.camera.name} runs; objects are told on standard input, a line each: {FORM}")
        while frame is not None:
            while self.waiting and self.waiting[0].frame <= (0 if frame is first else frame.index):
                prompt = self.waiting.pop(0)
                doubt_spelling(prompt.name, method.objects)
                method.tell(prompt)
            self.prompts.extend(words.tell(method, frame) if words else [])
            yield method.step(frame)
            if frame is not first:  # which may be long ago
                count.count(frame)
                if count.frames == 2 and count.dropped:  # it took as long as first masks or a search do
                    self.live.say(f"{count.dropped} images came while the first frame was worked on, and were dropped")
            count.seconds = monotonic() - start_s
            frame = newest.take()
        if newest.stopped and self.options.stop is not None:
            count.until(self.options.stop)
        yield from method.finish()

    def listeners(self, kept: ExitStack) -> list[Listener]:
        """What every frame is shown to; ``kept`` ends them."""
        listeners, live, method = list[Listener](), self.live, self.method
        if (page := live.page) is not None:
            listeners.append(lambda frame, estimates: page.see(frame, method.masks))
        if live.overlay is not None:
            listeners.append(_filmed(kept.enter_context(Film(live.overlay)), self.camera.name, method, live.first))
        if live.out is not None:
            listeners.append(kept.enter_context(self._kept(live.out)))
        if self.sizes_m:
            watch = Watch(self.sizes_m, live.say)
            listeners.append(lambda frame, estimates: watch.add(frame, method.masks, method.camera))
            kept.callback(watch.end)
        return listeners

    @contextmanager
    def _kept(self, out: str | Path) -> Iterator[Listener]:
        """Keeps every frame in a run's folder; Ctrl-C is how one stops a camera, so that it ends the run well."""
        camera, method, prompts = self.camera, self.method, self.prompts
        sequence = getattr(camera, "sequence", None) or Stream(camera.name, camera.camera)
        objects = tuple(dict.fromkeys([*(prompt.name for prompt in prompts), *self.memories]))
        # The models of all its objects: any may be added yet.
        how: dict[str, Any] = {"models": find_models(sequence), "if_exists": self.live.if_exists}
        writer = RunWriter(out, sequence, method.config, method.tracker.name, "clicks", objects, **how)
        writer.info |= described(method, self.options, prompts, sequence.path)
        keeper, stopped = Keeper(writer, method, self.options.save_masks, prompts, self.sizes_m), None

        def listen(frame: Frame, estimates: dict[str, PoseEstimate]) -> None:
            writer.info["stop"] = frame.index + 1
            keeper.add(frame, estimates)

        with writer, noted(keeper.doubts):
            try:
                yield listen
            except KeyboardInterrupt as stop:
                stopped = stop
                writer.keep_whole_frames()
            if writer.begun and writer.info["objects"]:
                writer.info["prompts"] = [prompt.as_dict() for prompt in prompts]  # those that came meanwhile, too
                keeper.save_maps()
                keeper.judge()
        if stopped:
            raise stopped


def _warm_method(camera: LiveCamera, options: RunOptions, say: Callable[[str], object]) -> Point2Pose:
    """A tracker of which the first image of a camera need not wait for anything that could be loaded before."""
    config = options.config().with_values({"segmentation.sam2_every": 0})  # no image waits for it
    parts = camera.camera, config, options.tracker, options.detector, segmenter_of(options)
    method = Point2Pose(*parts)
    warm_up(say)
    named = options.tracker if isinstance(options.tracker, str) else ""
    if named.startswith("builtin") and parts[-1] in (DEFAULT_SEGMENTER, "sam2"):
        _warm_up(Point2Pose(*parts))
    return method


def segmenter_of(options: RunOptions) -> Any:
    """The segmenter that ``masks`` names, the built-in one without it; :class:`BadInput` for other sources of masks."""
    masks = replace(options, masks=options.masks or DEFAULT_SEGMENTER).mask_source()
    if masks.name != "clicks":
        raise BadInput("masks", repr(options.masks), f"the name of a segmenter: {', '.join(SEGMENTERS)}")
    return masks.segmenter


def _warm_up(method: Point2Pose) -> None:
    """Load, and fill on made-up images, what the first of a camera would wait for, and later ones be dropped.

    What becomes of the made-up object is nothing that a log should have.
    """
    h, w = method.camera.height, method.camera.width
    print_ = np.kron(np.random.default_rng(0).integers(0, 255, (h // 8, w // 8, 3)), np.ones((8, 8, 1)))
    rgb, depth_m = np.full((h, w, 3), 90, np.uint8), np.full((h, w), 1.0, np.float32)
    part = np.s_[h // 3 : 2 * h // 3, w // 3 : 2 * w // 3]
    rgb[part], depth_m[part] = print_[part], 0.6
    log = logging.getLogger("p2p_lib")
    was, log.disabled = log.disabled, True
    try:
        method.add_object("made up", clicks=[[w / 2, h / 2]])
        for k in range(_WARM_FRAMES):
            method.step(Frame(k, k / 30, np.roll(rgb, 2 * k, 1), np.roll(depth_m, 2 * k, 1)))
    finally:
        log.disabled = was


def _filmed(film: Film, name: str, method: Point2Pose, first: Frame | None) -> Listener:
    """Draws every frame into a film, but for one that was taken before."""
    times_s: list[float] = []
    names: dict[str, None] = {}  # of all objects so far, by which each keeps its colour

    def listen(frame: Frame, estimates: dict[str, PoseEstimate]) -> None:
        names.update(dict.fromkeys(method.objects))
        if frame is not first:
            times_s.append(frame.time_s)
            image = draw_live(method, frame, estimates, name, times_s[0], names)
            film.add(image, frame.time_s - times_s[0])

    return listen


def click_first(
    camera: LiveCamera, say: Callable[[str], object], open_browser: bool = True
) -> tuple[tuple[Prompt, ...], Frame]:
    """Let the user click on objects in the camera's next image: the prompts, and that image, for ``track_live``."""
    image = camera.read()
    if image is None:
        raise BadInput(camera.name, "no image", "one to click on")
    with tempfile.TemporaryDirectory() as folder:
        page = Clicker(Stream(camera.name, camera.camera, image), Path(folder) / "prompts.json")
        return wait_for_clicks(page, say, open_browser), image


def text_line(estimate: PoseEstimate, least: float = -1.0) -> str:
    """An estimate as a line for people: time, object, status; its place in the camera's frame, or why it has none.

    least  what a pose has to be more confident than to be told
    """
    head = f"{estimate.time_s:.2f} s  {estimate.object}: "
    if estimate.T_cam_obj is None or estimate.confidence <= least:
        return head + status_text(estimate.status, _unsure(estimate, least))
    x, y, z = estimate.T_cam_obj[:3, 3]
    return f"{head}{estimate.status}  {x:.3f} {y:.3f} {z:.3f} m  confidence {estimate.confidence:.2f}"


def _unsure(estimate: PoseEstimate, least: float) -> str:
    """The reason of an estimate, before it that its pose is not told."""
    withheld = estimate.T_cam_obj is not None and estimate.confidence <= least
    why = f"its pose is not told: confidence {estimate.confidence:.2f}, not above {least:g}" if withheld else ""
    return "; ".join(filter(None, (why, estimate.reason)))


def json_line(estimate: PoseEstimate, least: float = -1.0) -> str:
    """An estimate as a line of JSON, with time_s, frame, object, status, confidence, map_id and reason.

    ``T_cam_obj`` (4x4, metres) and ``covariance`` (6x6, [rotation rad, translation m] on the right) are null without
    a pose, ``T_world_obj`` as well where the camera does not say where it stands.

    least  what a pose has to be more confident than to be told; else all three are null, and the reason says so
    """
    told = estimate.confidence > least
    line = {
        "time_s": round(estimate.time_s, 6),
        "frame": estimate.frame_index,
        "object": estimate.object,
        "status": str(estimate.status),
        "confidence": round(estimate.confidence, 4),
        "T_cam_obj": estimate.T_cam_obj if told else None,
        "map_id": estimate.map_id,
        "covariance": estimate.covariance if told else None,
        "reason": _unsure(estimate, least),
        "T_world_obj": estimate.T_world_obj if told else None,
    }
    return json.dumps(line, allow_nan=False, default=np.ndarray.tolist)
