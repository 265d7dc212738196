"""Recovery after complete occlusion, as the paper's recovery experiment counts it.

An event is a stretch of at least ten frames in which an object that was seen before is not visible, followed
by one in which it is. The object is recovered at the first visible frame whose ADD-S is at most 2 cm. What has not been
right before is not recovered: a map that was begun after the absence says nothing of how the object has moved since.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

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


def recovery_events(frame_index: np.ndarray, adds_m: np.ndarray) -> tuple[RecoveryEvent, ...]:
    """The returns of an object from the frames (m,) in which it is visible, which are scored, and its errors there."""
    good = adds_m <= MAX_ADDS_M
    returns = np.flatnonzero(np.diff(frame_index) > MIN_HIDDEN_FRAMES) + 1
    events = []
    for first, end in pairwise([*returns, len(frame_index)]):
        found = np.flatnonzero(good[first:end]) if good[:first].any() else np.zeros(0, int)
        returned = int(frame_index[first])
        delay = int(frame_index[first + found[0]]) - returned if len(found) else None
        events.append(RecoveryEvent(int(frame_index[first - 1]) + 1, returned, delay))
    return tuple(events)


def recovered_within(frames_to_recovery: Iterable[int | None], within: Iterable[int] = WITHIN_FRAMES) -> dict[int, int]:
    """For each N, the number of returns after which the object was recovered within N frames."""
    delays = [delay for delay in frames_to_recovery if delay is not None]
    return {n: sum(delay <= n for delay in delays) for n in within}


def returns_of(events: Iterable[RecoveryEvent]) -> str:
    """The returns of an object for people."""
    delays = [event.frames_to_recovery for event in events]
    after = ", ".join("never" if delay is None else str(delay) for delay in delays)
    return f"returns after an absence: {len(delays)}; frames until it was found again (ADD-S of 2 cm at most): {after}"
