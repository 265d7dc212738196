"""The built-in segmenter by itself, with SAM 2 for what prompts say, or anchored by SAM 2 all along."""

from __future__ import annotations

import os
from importlib.util import find_spec

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.paths import data_dir
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter


def builtin(camera: Camera, config: SegmentationConfig) -> BuiltinSegmenter:
    """The built-in segmenter; ``config.first_masks`` says whether SAM 2 makes the masks of prompts.

    :class:`MissingBackend` says what to fetch or install where SAM 2 is asked for and not there.
    """
    if config.first_masks == "builtin" or (config.first_masks == "auto" and not _available()):
        return BuiltinSegmenter(camera, config)
    return _with_sam2(camera, config, None, config.first_masks == "sam2")


def sam2(camera: Camera, config: SegmentationConfig) -> BuiltinSegmenter:
    """The built-in segmenter, anchored by SAM 2; :class:`MissingBackend` says what to fetch or install."""
    return _with_sam2(camera, config, max(1, config.sam2_every), True)


def _with_sam2(camera: Camera, config: SegmentationConfig, every: int | None, at_once: bool) -> BuiltinSegmenter:
    """Beside the tracking the network leaves half of the cores alone, unless it is told otherwise."""
    from p2p_lib.segmenters.sam2 import Sam2Refiner, shared_network

    background = config.sam2_every == 0
    threads = config.sam2_threads or (max(1, (os.cpu_count() or 2) // 2) if background else 0)
    network = shared_network(threads, at_once)
    return BuiltinSegmenter(camera, config, Sam2Refiner(network, camera, config, every, background))


def _available() -> bool:
    """Whether the weights and the package that runs them are there; the files are read when they are needed."""
    if data_dir() is None or find_spec("onnxruntime") is None:
        return False
    from p2p_lib.datasets.checkpoints import are_there

    return are_there("sam2")
