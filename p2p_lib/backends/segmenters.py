"""Segmenters by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from p2p_lib.backends import sam2
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.stages.segmentation import EmbeddedSegmenter, Segmenter

#: Segmenters by the name that --masks takes.
SEGMENTERS: dict[str, Callable[..., Segmenter]] = {"embedded": EmbeddedSegmenter, "sam2": sam2.load}
#: The one that runs when none is named.
DEFAULT_SEGMENTER = "embedded"


def make_segmenter(name: str, camera: Camera, config: SegmentationConfig, rng: np.random.Generator) -> Segmenter:
    """The segmenter called ``name``; unknown names are refused with the list of those there are."""
    if name not in SEGMENTERS:
        raise BadInput("segmenter", repr(name), "one of " + ", ".join(SEGMENTERS))
    return SEGMENTERS[name](camera, config, rng)
