"""2D trackers and detectors by name: the embedded ones, and the third-party models."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from p2p_lib.backends import cotracker, superpoint, tapir, tapnextpp
from p2p_lib.core.config import SamplingConfig, TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.stages import tracking
from p2p_lib.stages.detectors import FarthestDetector, OrbDetector, UniformDetector
from p2p_lib.stages.sampling import CornerDetector, Detector
from p2p_lib.stages.short_horizon import ShortHorizon
from p2p_lib.stages.tracking import PointTracker

#: Trackers by the name that --tracker takes.
TRACKERS: dict[str, Callable[..., PointTracker]] = {
    **tracking.TRACKERS,
    "tapir": tapir.load,
    "tapnextpp": tapnextpp.load,
    "cotracker3": cotracker.load,
}

#: Detectors by the name that --detector takes.
DETECTORS: dict[str, Callable[..., Detector]] = {
    "corners": CornerDetector,
    "uniform": UniformDetector,
    "farthest": FarthestDetector,
    "orb": OrbDetector,
    "superpoint": superpoint.load,
}
#: The one that runs when none is named.
DEFAULT_DETECTOR = "corners"


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


def make_detector(name: str, config: SamplingConfig, rng: np.random.Generator | None = None) -> Detector:
    """The detector called ``name``; unknown names are refused with the list of those there are."""
    if name not in DETECTORS:
        raise BadInput("detector", repr(name), "one of " + ", ".join(DETECTORS))
    return DETECTORS[name](config, rng)
