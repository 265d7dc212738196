"""What the segmenter remembers of one object between two frames."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.image import bounds
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import colour_codes, histogram
from p2p_lib.segmenters.builtin.motion import Past
from p2p_lib.segmenters.builtin.patch import Box, approximate_median

if TYPE_CHECKING:
    from p2p_lib.segmenters.builtin.bystanders import Bystanders


@dataclass(frozen=True, eq=False)
class Seen:
    """Where an object was: its mask (rows, columns) bool in a box of the image, and its median depth (m)."""

    box: Box
    mask: np.ndarray
    z_m: float

    @property
    def centre_px(self) -> np.ndarray:
        """(2,) centre of the box."""
        return np.array([self.box.left + self.box.right, self.box.top + self.box.bottom]) / 2


@dataclass(frozen=True, eq=False)
class Target:
    """One object between two frames.

    seen       in the newest frame; None while it is absent
    colours    (4096,) histogram of the colours it has shown; None if it has not been seen yet
    size_m     (2,) its largest width and height so far
    room_m     (2,) how far parts that move with it reach from the centre of what was seen, in x and y
    past       frames that it was seen in, with its poses
    confident  whether enough points agreed on its pose when it was cut out last
    proven     whether its points were ever on it since it was found; found by colours alone it may be something else
    bystanders what was beside it when it vanished; None while it is seen, and where nobody expects it
    denied     (4096,) histogram of the colours that corrections have taken from its mask; None before any
    given      the newest frame with a mask that was given and not empty. It is learnt from only when needed, which it
               never is where every frame brings a mask
    """

    seen: Seen | None = None
    colours: np.ndarray | None = None
    size_m: np.ndarray | None = None
    room_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    past: Past = field(default_factory=Past)
    confident: bool = False
    proven: bool = True
    bystanders: Bystanders | None = None
    denied: np.ndarray | None = None
    given: tuple[Frame, np.ndarray] | None = None

    def with_given(self, frame: Frame, mask: np.ndarray) -> Target:
        """With a mask (H, W) bool that was given: an empty one says that the object is hidden."""
        return replace(self, seen=None, given=(frame, mask) if mask.any() else self.given)

    def anew(self, frame: Frame, taken: np.ndarray) -> Target:
        """Of a correction that has ``taken`` pixels (H, W) bool from its mask: all else is learnt anew."""
        if not taken.any():
            return Target(denied=self.denied)
        denied = histogram(colour_codes(frame.rgb[taken]))
        return Target(denied=denied if self.denied is None else (self.denied + denied) / 2)

    def with_learnt(self, previous: Frame | None, focal_px: np.ndarray, config: SegmentationConfig) -> Target:
        """With colours and size updated from the last given mask."""
        if self.given is None:
            return self
        frame, mask = self.given
        seen = seen_in(frame, mask, Box(0, 0, *mask.shape[::-1]), config.min_px)
        target = self.with_seen(frame, seen, focal_px, config)
        return replace(target, given=None, seen=target.seen if frame is previous else None)

    def with_seen(self, frame: Frame, seen: Seen | None, focal_px: np.ndarray, config: SegmentationConfig) -> Target:
        """With colours and size updated from where it is ``seen`` in a frame, None where it is absent."""
        if seen is None:
            return replace(self, seen=None)
        size_m = np.array(seen.mask.shape[::-1]) * seen.z_m / focal_px
        some = np.s_[:: 1 + max(seen.mask.shape) // config.side_px,] * 2
        colours = histogram(colour_codes(frame.rgb[seen.box.slices][some][seen.mask[some]]))
        if self.colours is None or self.size_m is None:
            return replace(self, seen=seen, colours=colours, size_m=size_m)
        rate = config.colour_rate
        colours = (1 - rate) * self.colours + rate * colours
        return replace(self, seen=seen, bystanders=None, colours=colours, size_m=np.maximum(size_m, self.size_m))


def seen_in(frame: Frame, mask: np.ndarray, box: Box, min_px: int, z_m: float | None = None) -> Seen | None:
    """Where a mask (rows, columns) of a box lies; None with fewer pixels than ``min_px``.

    z_m  its depth if fewer than ``min_px`` pixels of it are measured; None if unknown: then it counts as absent
    """
    if np.count_nonzero(mask) < min_px:
        return None
    inner = rows, columns = bounds(mask)
    box = Box(box.left + columns.start, box.top + rows.start, box.left + columns.stop, box.top + rows.stop)
    mask, depth_m = mask[inner], frame.depth_m[box.slices]
    measured = mask & (depth_m > 0)
    z_m = approximate_median(depth_m[measured]) if np.count_nonzero(measured) >= min_px else z_m
    return None if z_m is None else Seen(box, mask, z_m)
