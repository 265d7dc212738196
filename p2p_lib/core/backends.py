"""Trackers, detectors and segmenters by name. Each is imported when it is asked for, and only then."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.checked_answers import CheckedDetector
from p2p_lib.core.checked_tracker import CheckedTracker
from p2p_lib.core.config import SamplingConfig, SegmentationConfig, TrackingConfig
from p2p_lib.core.interfaces import Detector, PointTracker, Segmenter
from p2p_lib.core.plugins import check_part, find, knows, load

T = TypeVar("T")

#: 2D trackers by the name that --tracker takes, as module:callable(config, rng).
TRACKERS = {
    "builtin": "p2p_lib.trackers.builtin.tracker:BuiltinTracker",
    "builtin2d": "p2p_lib.trackers.builtin.image_only:ImageOnlyTracker",
    "lk": "p2p_lib.trackers.lk:LkTracker",
    "tapir": "p2p_lib.trackers.tapir:load",
    "tapnextpp": "p2p_lib.trackers.tapnextpp:load",
    "cotracker3": "p2p_lib.trackers.cotracker:load",
}
#: Detectors by the name that --detector takes, as module:callable(config, rng).
DETECTORS = {
    "corners": "p2p_lib.detectors.classical:CornerDetector",
    "uniform": "p2p_lib.detectors.classical:UniformDetector",
    "farthest": "p2p_lib.detectors.classical:FarthestDetector",
    "orb": "p2p_lib.detectors.classical:OrbDetector",
    "superpoint": "p2p_lib.detectors.superpoint:load",
}
#: Segmenters by the name that --masks takes, as module:callable(camera, config).
SEGMENTERS = {
    "builtin": "p2p_lib.segmenters.anchored:builtin",
    "sam2": "p2p_lib.segmenters.anchored:sam2",
    "sam2_video": "p2p_lib.segmenters.sam2_video:load",
    "sam2_video_small": "p2p_lib.segmenters.sam2_video:load_small",
    "sam2_video_base_plus": "p2p_lib.segmenters.sam2_video:load_base_plus",
    "sam2_video_large": "p2p_lib.segmenters.sam2_video:load_large",
}
#: What a part has besides its name, and what each method is called with (:mod:`p2p_lib.core.interfaces`).
PROMISES: dict[str, dict[str, tuple[str, ...] | None]] = {
    "tracker": {
        "latency_frames": None,
        "start": ("frame", "camera"),
        "add": ("uv_px",),
        "track": ("frame", "search", "urgent"),
        "drop": ("ids",),
        "reject": ("ids",),
        "suggest": ("ids", "uv_px"),
    },
    "detector": {"detect": ("frame", "mask")},
    "segmenter": {"names": None, "segment": ("frame", "prompts", "hints"), "remove": ("name",)},
}
#: What runs when none is named.
DEFAULT_TRACKER, DEFAULT_DETECTOR, DEFAULT_SEGMENTER = "builtin", "corners", "builtin"
_RECOGNISER = "p2p_lib.trackers.builtin.recogniser:Recogniser"
_SHORT_HORIZON = "p2p_lib.trackers.short_horizon:ShortHorizon"
#: Names of earlier versions.
ALIASES = {"embedded": "builtin"}


def make_tracker(
    tracker: str | PointTracker, config: TrackingConfig, rng: np.random.Generator | None = None
) -> PointTracker:
    """The tracker of this name, or the one given, checked as it answers, with the memory that the configuration grants.

    A name may be ``package.module:Class``. :class:`BadInput` lists the known names where this one is unknown.
    """
    made = CheckedTracker(_made("tracker", tracker, TRACKERS, config, rng))
    return load(_SHORT_HORIZON)(made, config.forget_after) if config.forget_after else made


def make_detector(detector: str | Detector, config: SamplingConfig, rng: np.random.Generator | None = None) -> Detector:
    """The detector of this name, or the one given, checked as it answers; :class:`BadInput` lists the known names."""
    return CheckedDetector(_made("detector", detector, DETECTORS, config, rng))


def make_segmenter(segmenter: str | Segmenter, camera: Camera, config: SegmentationConfig) -> Segmenter:
    """The segmenter of this name, or the one given; :class:`BadInput` lists the known names."""
    return _made("segmenter", segmenter, SEGMENTERS, camera, config)


def is_segmenter(name: str) -> bool:
    """Whether a name that may be a folder of masks as well stands for a segmenter."""
    return knows("segmenter", ALIASES.get(name, name), SEGMENTERS)


def make_recogniser(camera: Camera) -> Any:
    """What describes objects' landmarks, and finds them again in images of this camera."""
    return load(_RECOGNISER)(camera)


def _made(kind: str, part: str | T, known: dict[str, str], *made_of: Any) -> T:
    """The part of this name, or the one given, which has what the method asks of its kind."""
    name = ALIASES.get(part, part) if isinstance(part, str) else ""
    made = find(kind, name, known)(*made_of) if isinstance(part, str) else part
    check_part(kind, made, PROMISES[kind], name)
    return made
