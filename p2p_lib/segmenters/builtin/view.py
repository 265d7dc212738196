"""One frame, as the segmenter's stages get it, and what they claim in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import Box

#: The probability (rows, columns) that pixels of a box belong to an object; None where nothing of it is found.
Claim = tuple[Box, np.ndarray] | None


@dataclass(frozen=True, eq=False)
class View:
    """The newest frame, the one before it (None at the start), their camera and the parameters."""

    frame: Frame
    previous: Frame | None
    camera: Camera
    config: SegmentationConfig

    @property
    def focal_px(self) -> np.ndarray:
        """(2,) focal lengths, fx and fy."""
        return np.array([self.camera.fx, self.camera.fy])
