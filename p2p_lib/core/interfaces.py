"""What the method asks of the parts beside it: a 2D point tracker, a detector of candidates, a segmenter."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame, Rows, Tracks


class Wrapper:
    """Stands for its ``original``, which has whatever it has not itself."""

    original: Any

    def __getattr__(self, name: str) -> Any:
        if name == "original":  # while it is copied or unpickled there is none yet
            raise AttributeError(name)
        return getattr(self.original, name)


class PointTracker(Protocol):
    """A streaming, causal 2D point tracker (paper: section "2D Point Tracker").

    It follows query points q = (t_q, u_q) of all objects in one pass and gives each point's pixel u_t,
    visibility delta_t and uncertainty sigma_t.
    """

    name: str
    latency_frames: int  # how many frames late `track` answers; 0 = at once

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame, forgetting any earlier one.

        camera  that took the images, if somebody knows; a tracker may use it to reason in 3D
        """

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids (N,) int64, increasing."""

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; rows sorted by id.

        search  (H, W) bool says where the objects are known to be, if somebody knows; a tracker may
                use it to spare itself work elsewhere. None means the whole image
        urgent  the caller waits for invisible points to come back: worth more work in this frame
        """

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""

    def reject(self, ids: np.ndarray) -> None:
        """The caller found these tracks wrong in the newest frame (they contradict the rigid motion).

        A tracker may use it, e.g. to look for the points anew; ignoring it is allowed.
        """
        return None

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """The caller expects points ids (N,) of one rigid body at uv_px (N, 2) in the newest frame.

        NaN where it expects none. A tracker may look there for those that it holds for invisible. Returns the newest
        frame's tracks with what it found, or None where it has nothing to add: ignoring it is allowed.
        """
        return None


@dataclass(frozen=True, eq=False)
class Candidates(Rows):
    """Points a detector offers: uv_px (N, 2) and score (N,) in [0, 1] (paper: p_k, s_k)."""

    uv_px: np.ndarray
    score: np.ndarray


class Detector(Protocol):
    """Offers candidates inside a mask."""

    name: str

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Candidates in ``mask`` (H, W) bool, best first."""


@dataclass(frozen=True, eq=False)
class Hint:
    """Where an object should be, in plain values; empty where nothing is known.

    uv_px       (K, 2) its tracked points whose measured places agree with one rigid motion
    distance_m  (H, W) float32: signed distance of each measured pixel to the object's reconstructed surface
                at the pose those points give, positive in front of it; NaN where unknown. None without a surface
    T_cam_obj   (4, 4) that pose; None where there is none
    sighted     the object has been found there by shape and colour, after an absence
    gone        it lies outside the image, if it has stayed where it was
    place       (4,) where its motion leads, while nothing of it is found: its middle in the camera frame, and how far
                it may be from there, m; None where nobody knows
    """

    uv_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    distance_m: np.ndarray | None = None
    T_cam_obj: np.ndarray | None = None
    sighted: bool = False
    gone: bool = False
    place: np.ndarray | None = None


class LazyHints(Mapping[str, Hint]):
    """The hints of some objects, each made when it is first asked for: they cost, and a segmenter needs but some."""

    def __init__(self, names: Sequence[str], make: Callable[[str], Hint]):
        self._names, self._make = names, cache(make)

    def __getitem__(self, name: str) -> Hint:
        if name not in self._names:
            raise KeyError(name)
        return self._make(name)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


class Segmenter(Protocol):
    """A streaming, causal segmenter of several objects.

    It may have ``doubts``, too: of objects that a prompt of the newest frame has started or corrected, what is doubtful
    about their masks. Their poses in that frame are doubted then, and say so.
    """

    name: str

    @property
    def names(self) -> tuple[str, ...]:
        """The objects that it looks after, in the order in which they came."""

    def segment(
        self,
        frame: Frame,
        prompts: Iterable[Prompt] = (),
        hints: Mapping[str, Hint] | None = None,
    ) -> np.ndarray:
        """(H, W) int32 label image of the next frame: 0 for no object, else 1 + the object's place in ``names``.

        prompts  what is said of objects in this frame, one each: of a new object, which starts it, or of one that is
                 looked after, whose mask it corrects. A mask is labelled as it is, where no later one claims its pixels
        hints    what others know of the objects; a segmenter may use it, and asks for those alone that it uses

        An object that is not to be seen has no pixels. Raises :class:`BadInput` for prompts where there is no depth,
        and nothing has changed then.
        """

    def remove(self, name: str) -> None:
        """Forget an object."""
