"""2D trackers by name: the embedded one, its plain reference, and the third-party models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.stages import tracking
from p2p_lib.stages.tracking import PointTracker

#: Trackers by the name that --tracker takes.
TRACKERS: dict[str, Callable[..., PointTracker]] = {**tracking.TRACKERS}


def make_tracker(name: str, config: TrackingConfig, rng: np.random.Generator | None = None) -> PointTracker:
    """The tracker called ``name``; unknown names are refused with the list of those there are."""
    if name not in TRACKERS:
        raise BadInput("tracker", repr(name), "one of " + ", ".join(TRACKERS))
    return TRACKERS[name](config, rng)
