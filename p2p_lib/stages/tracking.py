"""2D point tracking (paper: section "2D Point Tracker").

A tracker follows query points q = (t_q, u_q) through the video, causally, all objects' points in one
pass, and gives each point's pixel u_t, visibility delta_t and uncertainty sigma_t.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.stages.embedded_tracker import EmbeddedTracker
from p2p_lib.stages.lk_tracker import LkTracker


class PointTracker(Protocol):
    """A streaming, causal 2D point tracker."""

    name: str
    latency_frames: int  # how many frames late `track` answers; 0 = at once

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame, forgetting any earlier one.

        camera  that took the pictures, if somebody knows; a tracker may use it to reason in 3D
        """

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids (N,) int64, increasing."""

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame; rows sorted by id.

        search  (H, W) bool says where the objects are known to be, if somebody knows; a tracker may
                use it to spare itself work elsewhere. None means the whole picture
        urgent  the caller waits for invisible points to come back: worth more work in this frame
        """

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""

    def reject(self, ids: np.ndarray) -> None:
        """The caller found these tracks wrong in the newest frame (they contradict the rigid motion).

        A tracker may use it, e.g. to look for the points anew; ignoring it is allowed.
        """

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks | None:
        """The caller expects points ids (N,) of one rigid body at uv_px (N, 2) in the newest frame.

        NaN where it expects none. A tracker may look there for those that it holds for invisible. Returns the newest
        frame's tracks with what it found, or None where it has nothing to add: ignoring it is allowed.
        """


#: Trackers by the name that --tracker takes.
TRACKERS = {"lk": LkTracker, "embedded": EmbeddedTracker}
#: The one that runs when none is named.
DEFAULT_TRACKER = "embedded"
