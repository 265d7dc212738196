"""Which frame an answer is of, where the 2D tracker answers some frames late."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from p2p_lib.core.types import Frame, PoseEstimate

#: What belongs to a frame, and its estimates by object.
Answer = tuple[Any, dict[str, PoseEstimate]]


class Answers:
    """Steps a :class:`~p2p_lib.method.pipeline.Point2Pose`; its estimates come with the frame that they are of."""

    def __init__(self, method: Any):
        self._method = method
        self._waiting: deque[Any] = deque()

    def step(self, frame: Frame, masks: Mapping[str, np.ndarray] | None = None, about: Any = None) -> list[Answer]:
        """One frame in; the one answer that is due by now, or none. ``about`` comes back in the frame's place."""
        self._waiting.append(frame if about is None else about)
        estimates = self._method.step(frame, masks)
        due = len(self._waiting) > self._method.tracker.latency_frames
        return [(self._waiting.popleft(), estimates)] if due else []

    def finish(self) -> Iterator[Answer]:
        """After the last frame: the answers still owed, oldest first."""
        for estimates in self._method.finish():
            yield self._waiting.popleft(), estimates
