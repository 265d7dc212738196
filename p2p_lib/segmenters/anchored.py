"""The built-in segmenter by itself, with SAM 2 for what prompts say, or anchored by SAM 2 all along."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.paths import data_dir
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter


def builtin(camera: Camera, config: SegmentationConfig, rng: np.random.Generator) -> BuiltinSegmenter:
    """The built-in segmenter; ``config.first_masks`` says whether SAM 2 makes the masks of prompts.

    :class:`MissingBackend` says what to fetch or install where SAM 2 is asked for and not there.
    """
    if config.first_masks == "builtin" or (config.first_masks == "auto" and not _available()):
        return BuiltinSegmenter(camera, config, rng)
    from p2p_lib.segmenters.sam2 import Sam2Refiner, shared_network

    network = shared_network(config.sam2_threads, at_once=config.first_masks == "sam2")
    return BuiltinSegmenter(camera, config, rng, Sam2Refiner(network, camera))


def sam2(camera: Camera, config: SegmentationConfig, rng: np.random.Generator) -> BuiltinSegmenter:
    """The built-in segmenter, anchored by SAM 2; :class:`MissingBackend` says what to fetch or install."""
    from p2p_lib.segmenters.sam2 import Sam2Refiner, shared_network

    network = shared_network(config.sam2_threads, at_once=True)
    return BuiltinSegmenter(camera, config, rng, Sam2Refiner(network, camera, config.sam2_every))


def _available() -> bool:
    """Whether the weights and the package that runs them are there; the files are read when they are needed."""
    if data_dir() is None or find_spec("onnxruntime") is None:
        return False
    from p2p_lib.datasets.checkpoints import are_there

    return are_there("sam2")
