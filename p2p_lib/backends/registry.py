"""2D trackers by name: the embedded ones, and the third-party models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from p2p_lib.backends import cotracker, tapir, tapnextpp
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.stages import tracking
from p2p_lib.stages.short_horizon import ShortHorizon
from p2p_lib.stages.tracking import PointTracker

#: Trackers by the name that --tracker takes.
TRACKERS: dict[str, Callable[..., PointTracker]] = {
    **tracking.TRACKERS,
    "tapir": tapir.load,
    "tapnextpp": tapnextpp.load,
    "cotracker3": cotracker.load,
}


def make_tracker(
    tracker: str | PointTracker, config: TrackingConfig, rng: np.random.Generator | None = None
) -> PointTracker:
    """The tracker of this name, or the one given, with the memory that the configuration grants it.

    Unknown names are refused with the list of those there are.
    """
    if isinstance(tracker, str):
        if tracker not in TRACKERS:
            raise BadInput("tracker", repr(tracker), "one of " + ", ".join(TRACKERS))
        tracker = TRACKERS[tracker](config, rng)
    return ShortHorizon(tracker, config.forget_after) if config.forget_after else tracker
