"""Recovery after complete occlusion, as the paper's recovery experiment counts it.

An event is a stretch of at least ten frames in which an object that was seen before is not visible, followed
by one in which it is. The object is recovered at the first visible frame whose ADD-S is at most 2 cm. What has not been
right before is not recovered: a map that was begun after the absence says nothing of how the object has moved since.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.datasets.runs import ObjectRun

if TYPE_CHECKING:
    from p2p_lib.evaluation.protocol import ObjectScore

MIN_HIDDEN_FRAMES = 10
MAX_ADDS_M = 0.02
WITHIN_FRAMES = (5, 15, 30)


@dataclass(frozen=True)
class RecoveryEvent:
    """One return of an object.

    hidden_frame        frame index at which it went out of sight, return_frame the first visible one after
    frames_to_recovery  frames from the return to the first good pose (0: at once); None: not before it
                        was hidden again or the run ended
    """

    hidden_frame: int
    return_frame: int
    frames_to_recovery: int | None


def recovery_events(obj: ObjectRun, score: ObjectScore) -> list[RecoveryEvent]:
    """The returns of one object in a run; it is visible in the frames that are scored."""
    visible = np.isin(obj.frame_index, score.frame_index)
    adds_m = np.full(len(obj), np.inf)
    adds_m[visible] = score.adds_m
    seen = np.flatnonzero(visible)
    # Rows of the last visible frame before, and of the first after, each stretch that is long enough.
    gap = np.diff(obj.frame_index[seen]) > MIN_HIDDEN_FRAMES
    before, after = seen[:-1][gap], seen[1:][gap]
    ends = np.append(after[1:], len(obj))
    events = []
    for last, first, end in zip(before, after, ends):
        good = np.flatnonzero(adds_m[first:end] <= MAX_ADDS_M) if (adds_m[:first] <= MAX_ADDS_M).any() else ()
        returned = int(obj.frame_index[first])
        delay = int(obj.frame_index[first + good[0]]) - returned if len(good) else None
        events.append(RecoveryEvent(int(obj.frame_index[last]) + 1, returned, delay))
    return events


def recovered_within(frames_to_recovery: Iterable[int | None], within: Iterable[int] = WITHIN_FRAMES) -> dict[int, int]:
    """For each N, the number of returns after which the object was recovered within N frames."""
    delays = [delay for delay in frames_to_recovery if delay is not None]
    return {n: sum(delay <= n for delay in delays) for n in within}


def returns_of(events: Iterable[RecoveryEvent]) -> str:
    """The returns of an object for people."""
    delays = [event.frames_to_recovery for event in events]
    after = ", ".join("never" if delay is None else str(delay) for delay in delays)
    return f"{len(delays)} returns after an absence, found again after {after} frames"
