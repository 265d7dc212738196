"""Before a frame: is it newer than the one before, is its depth in metres, and is it of the moment of its colour?"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from p2p_lib.core.depth import far_depth
from p2p_lib.core.errors import DEPTH_MOVED, doubt
from p2p_lib.core.types import Frame
from p2p_lib.extended.depth_lag import DepthLag

#: Depth, colour or both may repeat for so long, s: some cameras deliver one of them less often.
_STANDS_S = 0.08
#: So long between frames, s, so many times in a row, is a time in another unit.
_SLOW_S, _SLOW_FRAMES = 10.0, 3
#: What to divide times by that are so long apart at least, s, at the rates of cameras.
_UNITS = {"nanoseconds by 1e9": 1e6, "microseconds by 1e6": 1e3, "milliseconds by 1000": 0.0}


@dataclass(frozen=True, eq=False)
class DoubtedFrame(Frame):
    """A frame with which something is wrong: ``remark`` says what.

    still  whether its camera gives the same image again and again
    """

    remark: str = ""
    still: bool = False

    @classmethod
    def of(cls, frame: Frame, **changes: Any) -> DoubtedFrame:
        """The frame, changed."""
        return cls(**{f.name: getattr(frame, f.name) for f in fields(Frame)} | changes)


class FrameGuard:
    """Looks at every frame before anything else does.

    moments  whether depth counts as missing while it, or colour, stands still
    lag      what moves depth onto colour where a moving camera takes the two apart; None: they are used as they come
    """

    def __init__(self, moments: bool = True, lag: DepthLag | None = None):
        self._moments, self._lag = moments, lag
        self._time_s, self._stopped, self._warned = -np.inf, False, False  # of the frame before
        self._stale, self._slow = StaleFrames(), 0  # how many frames in a row came so slowly
        self._newest: Frame | None = None
        self._counts_up = True

    def __call__(self, frame: Frame) -> Frame:
        """The frame to go on with."""
        if frame is self._newest:  # the last one again, which ends a stream
            return frame
        if self._counts_up and self._newest is not None and frame.index <= self._newest.index:
            got = f"not above that of the frame before ({self._newest.index})"
            doubt(f"index of frame {frame.index}", got, "Count frames up: what is kept of earlier ones goes by it.")
            self._counts_up = False
        remarks, changes = [self._time_remark(frame)], {}
        self._stale = self._stale.with_frame(frame)
        half, still = self._stale.for_long(frame.time_s)
        if half and self._moments:
            got, fix = "one repeats the same image while the other changes", "Depth is ignored until both change."
            doubt("depth and colour", got, fix)
            remarks.append(f"depth and colour: {got}")
            changes["depth_m"] = np.zeros_like(frame.depth_m)  # not of the moment of its colour: points can wait
        if self._newest is not None and (far := far_depth(frame)):  # such a first frame is refused
            remarks.append(far)
            changes["depth_m"] = np.zeros_like(frame.depth_m)
        if not changes and (depth_m := self._of_its_moment(frame)) is not None:
            frame = replace(frame, depth_m=depth_m)
        remark = "; ".join(filter(None, remarks))
        self._newest = DoubtedFrame.of(frame, remark=remark, still=still, **changes) if remark or still else frame
        return self._newest

    def _of_its_moment(self, frame: Frame) -> np.ndarray | None:
        """The depth of a frame where it has to be moved onto its colour; the first time is warned of."""
        if self._lag is None:
            return None
        known, depth_m = self._lag.off_px, self._lag.moved(frame)
        if self._lag.off_px and not known:
            got, fix = self._lag.doubt
            doubt("depth and colour", f"{got} in frame {frame.index}", fix, kind=DEPTH_MOVED)
        return depth_m

    def _time_remark(self, frame: Frame) -> str:
        """What to say of a time that goes back, or no longer on; the first is warned of, too.

        Of frames that all have the same time the first one says so.
        """
        before_s, self._time_s = self._time_s, frame.time_s
        stopped, self._stopped = self._stopped, frame.time_s == before_s
        self._slow = self._slow + 1 if _SLOW_S < frame.time_s - before_s < np.inf else 0
        if self._slow == _SLOW_FRAMES:
            got = f"{frame.time_s - before_s:.0f} s after the frame before, for the third time in a row"
            unit = next(unit for unit, least_s in _UNITS.items() if frame.time_s - before_s >= least_s)
            doubt(f"time of frame {frame.index}", got, f"Times are in seconds: divide {unit}.")
        if frame.time_s > before_s or (stopped and self._stopped):
            return ""
        got = f"{frame.time_s:.6f} s, not later than the frame before ({before_s:.6f} s)"
        if not self._warned:
            doubt(f"time of frame {frame.index}", got, "Give frames in the order in which they were taken.")
            self._warned = True
        return f"its time is {got}"


@dataclass(frozen=True, eq=False)
class StaleFrames:
    """Since when the newest depth and colour have been identical to the last bit, which no sensor measures.

    first_depth, first_rgb  the first frames that had them; None where the newest image is empty
    """

    first_depth: Frame | None = None
    first_rgb: Frame | None = None

    def with_frame(self, frame: Frame) -> StaleFrames:
        """After one more frame."""
        return StaleFrames(_first(self.first_depth, frame, "depth_m"), _first(self.first_rgb, frame, "rgb"))

    def for_long(self, time_s: float) -> tuple[bool, bool]:
        """Whether depth or colour alone has stood still for a while: not of one moment; and whether both have."""
        firsts = [first for first in (self.first_depth, self.first_rgb) if first is not None]
        stand = sum(time_s - first.time_s > _STANDS_S for first in firsts)
        return len(firsts) == 2 and stand == 1, stand == 2


def _first(first: Frame | None, frame: Frame, image: str) -> Frame | None:
    same = first is not None and np.array_equal(frame.sparse[image], first.sparse[image])
    if same and np.array_equal(getattr(frame, image), getattr(first, image)):
        return first
    return frame if getattr(frame, image).any() else None
