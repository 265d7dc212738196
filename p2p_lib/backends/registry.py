"""2D trackers by name: the embedded one, its plain reference, and the third-party models."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.stages import tracking
from p2p_lib.stages.tracking import LkTracker, PointTracker

#: What OpenCV's own examples do: the reference that trackers are compared with. It never finds a point again.
PLAIN_LK = {"window_px": 21, "levels": 3, "forward_backward_px": 1.0, "redetect_every": 1_000_000_000}


def plain_lk(config: TrackingConfig, rng: np.random.Generator | None = None) -> PointTracker:
    """Plain Lucas-Kanade: 21 px window, 3 levels, forward-backward 1 px, no re-detection."""
    tracker = LkTracker(replace(config, **PLAIN_LK), rng)
    tracker.name = "lk-plain"
    return tracker


#: Trackers by the name that --tracker takes.
TRACKERS: dict[str, Callable[..., PointTracker]] = {**tracking.TRACKERS, "lk-plain": plain_lk}


def make_tracker(name: str, config: TrackingConfig, rng: np.random.Generator | None = None) -> PointTracker:
    """The tracker called ``name``; unknown names are refused with the list of those there are."""
    if name not in TRACKERS:
        raise BadInput("tracker", repr(name), "one of " + ", ".join(TRACKERS))
    return TRACKERS[name](config, rng)
