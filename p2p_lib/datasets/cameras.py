"""Live cameras: a RealSense, one of its recordings, or a folder played at some rate.

A camera does not wait. :class:`Newest` reads it in a thread of its own and lets a few frames wait while one takes long,
so that a tracker that is slower than the camera skips frames instead of falling behind.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Condition, Event, Thread
from time import monotonic
from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput, P2PError, WrongSize, advised, doubt, wrong_size
from p2p_lib.core.plugins import check_part, find, is_place
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import LIVE, Sequence, open_sequence
from p2p_lib.datasets.truth import ObjectTruth

DEFAULT_RATE_HZ = 30.0
#: So many frames may wait: a search or a keyframe takes as long as some frames, and those after it make up for that.
DEFAULT_BACKLOG = 4
#: So many images of another size in a row are no slip.
_ODD_IN_A_ROW = 30
#: How long a camera that was closed may take to come back from ``read``, s.
_PATIENCE_S = 3.0


class LiveCamera(Protocol):
    """A stream of frames; a frame's index counts the camera's own from 0, so that dropped ones leave gaps."""

    @property
    def name(self) -> str:
        """What results call it."""

    @property
    def camera(self) -> Camera:
        """Its intrinsics, and the size of its images."""

    def read(self) -> Frame | None:
        """The next frame, as soon as there is one; None after the last, or once closed."""

    def close(self) -> None:
        """Stop; a ``read`` that waits comes back."""


@dataclass(frozen=True, eq=False)
class Stream:
    """A camera that plays no sequence, as one: no masks, no truth, and no frames but one that is kept to click on."""

    name: str
    camera: Camera
    kept: Frame | None = None
    format: str = LIVE
    path: None = None
    objects: tuple[str, ...] = ()
    times_s: np.ndarray = field(default_factory=lambda: np.zeros(0))
    frame_names: tuple[str, ...] = ()
    truth: dict[str, ObjectTruth] = field(default_factory=dict)
    model_places: Mapping[str, tuple[Path, ...]] = field(default_factory=dict)

    def __len__(self) -> int:
        return int(self.kept is not None)

    def frame(self, i: int) -> Frame:
        """The frame that is kept, whatever its number; :class:`BadInput` where none is."""
        if self.kept is None:
            raise BadInput(f"{self.name}: frame", i, "none: the images of a live camera are not kept")
        return self.kept

    def masks(self, i: int) -> None:
        """None."""

    def visible_px(self, i: int) -> None:
        """Unknown."""


class FolderCamera:
    """A sequence on disk that plays like a camera: frame i is there i / rate_hz seconds after the first.

    The clock starts when the second is asked for: until then somebody may have clicked on the first.
    """

    def __init__(self, sequence: Sequence, rate_hz: float = DEFAULT_RATE_HZ):
        if not 0 < rate_hz <= 1000:
            raise BadInput("rate", rate_hz, "frames per second, above 0 and at most 1000")
        self.name, self.camera = sequence.name, sequence.camera
        self.sequence, self._rate_hz, self._closed = sequence, rate_hz, Event()
        self._next, self._start_s = 0, 0.0

    def read(self) -> Frame | None:
        """The next frame at its time; at once where that is past."""
        if self._next >= len(self.sequence):
            return None
        if self._next <= 1:
            self._start_s = monotonic()
        due_s = self._start_s + self._next / self._rate_hz
        if self._closed.wait(max(0.0, due_s - monotonic())):
            return None
        self._next += 1
        return self.sequence.frame(self._next - 1)

    def close(self) -> None:
        """Play no further."""
        self._closed.set()


class OddImages:
    """Images of another size than the camera's, which are left out: with a warning once one follows that fits.

    So many in a row, or all that there are, have another camera: :class:`BadInput`.
    """

    def __init__(self) -> None:
        self._row: list[WrongSize] = []
        self._some_fit = False

    def leave_out(self, error: WrongSize) -> None:
        """One more; raises :class:`BadInput` where it is one too many."""
        self._row.append(error)
        if len(self._row) >= _ODD_IN_A_ROW:
            raise self._refusal()

    def fits(self) -> None:
        """One that fits: what was left out before it is said."""
        self._some_fit = True
        for one in self._row:
            doubt(one.name, f"{one.got}, not {one.expected}", "It is left out.")
        self._row.clear()

    def end(self) -> None:
        """No more come: what was left out is said, and all of them are refused."""
        if self._row and not self._some_fit:
            raise self._refusal()
        self.fits()

    def _refusal(self) -> P2PError:
        fix = f"{len(self._row)} in a row were: make its camera, a p2p_lib.Camera, that of the images which it gives."
        return advised(self._row[0], fix)


class OwnCamera:
    """Somebody else's camera: what it gives is checked, and it is closed once, however often that is asked for.

    Images of another size than its ``camera`` says are left out, with a warning. Raises :class:`BadInput` for one that
    lacks something, or has no :class:`~p2p_lib.core.camera.Camera`.
    """

    def __init__(self, spec: str, own: LiveCamera):
        self._spec, self._own, self._closed, self._last = spec, own, False, -1
        self._odd = OddImages()
        check_part("camera", own, {"camera": None, "read": (), "close": ()}, spec)
        if not isinstance(own.camera, Camera):
            raise BadInput(f"camera {spec}: camera", type(own.camera).__name__, "a p2p_lib.Camera")
        self.name, self.camera = own.name, own.camera

    def read(self) -> Frame | None:
        """Its next frame of the right size; :class:`BadInput` for anything else.

        And where there is none: so many in a row, or all until its end, have another size.
        """
        while True:
            try:
                frame = self._next()
            except WrongSize as error:
                self._odd.leave_out(error)
                continue
            (self._odd.end if frame is None else self._odd.fits)()
            return frame

    def _next(self) -> Frame | None:
        """What it gives next; :class:`BadInput` for what is no frame, and an index that is not above the last one."""
        frame = self._own.read()
        if frame is not None and not isinstance(frame, Frame):
            raise BadInput(f"camera {self._spec}: read()", type(frame).__name__, "a p2p_lib.Frame, or None at the end")
        if frame is not None and frame.index <= self._last:
            got = f"index {frame.index} after {self._last}"
            fix = "Count the camera's own images from 0: those that were dropped leave gaps."
            raise BadInput(f"camera {self._spec}: read()", got, "an index that increases", fix)
        self._last = self._last if frame is None else frame.index
        size = self.camera.height, self.camera.width
        if frame is not None and frame.shape != size:
            raise wrong_size(f"camera {self._spec}: image {frame.index}", frame.shape, size, "its camera")
        return frame

    def close(self) -> None:
        """Close it, unless that was done."""
        if not self._closed:
            self._closed = True
            self._own.close()


def open_camera(spec: str, rate_hz: float | None = None) -> LiveCamera:
    """The camera that ``realsense``, ``realsense:RECORDING``, ``folder:PATH`` or ``package.module:Class`` names.

    The class is called without arguments and gives a :class:`LiveCamera`.

    rate_hz  of a folder alone (default 30). PATH is whatever ``p2p run`` takes for a sequence
    """
    kind, _, what = spec.partition(":")
    if kind == "folder" and what:
        return FolderCamera(open_sequence(what), DEFAULT_RATE_HZ if rate_hz is None else rate_hz)
    if kind != "realsense" and is_place(spec) and rate_hz is None:
        return OwnCamera(spec, find("camera", spec, {})())
    if kind != "realsense":
        fix = f"Did you mean folder:{spec}?" if Path(spec).is_dir() else ""
        expected = "realsense, realsense:RECORDING, folder:PATH or your own as module:Class"
        raise BadInput("camera", repr(spec), expected, fix)
    if rate_hz is not None:
        raise BadInput("rate", f"{rate_hz:g} with {spec}", "a rate for folder:PATH alone: other cameras have their own")
    from p2p_lib.datasets.realsense import RealSenseCamera

    return RealSenseCamera(Path(what) if what else None)


class Newest:
    """A camera's newest frames, in turn. A context manager.

    keep     indices of frames that are not dropped
    backlog  how many others wait behind the next one; where more do the oldest is dropped
    stop     the index from which on none is read, to push one before it out; ``stopped`` says that it was reached
    """

    def __init__(self, source: LiveCamera, keep: Collection[int] = (), backlog: int = 0, stop: float = math.inf):
        self._source, self._keep, self._most = source, frozenset(keep), backlog + 1
        self._stop, self.stopped = stop, False
        self._waiting: deque[Frame] = deque()
        self._changed, self._ended, self._closed = Condition(), False, False
        self._error: BaseException | None = None  # what ended the camera
        # A daemon: somebody's camera that waits for ever must not keep the process.
        self._thread = Thread(target=self._grab, daemon=True, name="p2p camera")
        self._thread.start()

    def take(self) -> Frame | None:
        """The next frame; waits for one. None at the end; raises what ended the camera, if anything."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended)
            if self._waiting:
                return self._waiting.popleft()
        if self._error is not None:
            raise self._error
        return None

    def __enter__(self) -> Newest:
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._source.close()
        self._thread.join(_PATIENCE_S)
        if self._thread.is_alive():
            got = f"still in read(), {_PATIENCE_S:g} s after close()"
            doubt(f"camera {self._source.name}", got, "Its close() has to make a read() that waits return None.")

    def _grab(self) -> None:
        try:
            while not self._closed and (frame := self._source.read()) is not None:
                if frame.index < self._stop:
                    with self._changed:
                        self._waiting.append(frame)
                        idle = [waits for waits in self._waiting if waits.index not in self._keep]
                        if len(idle) > self._most:
                            self._waiting.remove(idle[0])
                        self._changed.notify()
                if frame.index >= self._stop - 1:  # the next one may take for ever
                    self.stopped = True
                    return
        except BaseException as error:  # noqa: BLE001 - raised where frames are taken
            self._error = error
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()
