"""Steps of depth and edges of brightness: where an object ends both have one, if they are of one moment and place."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.depth import depth_noise_m

#: Depth changes by this much from pixel to pixel on surfaces seen at a slant.
_SLANT_M = 0.004
#: Gradients count up to this, in grey levels: one strong edge does not outvote the others.
_STRONGEST = 80.0
#: Standard deviations of the blurs of the gradient, and of its surroundings, px.
_BLUR_PX, _AROUND_PX = 1.5, 12.0


def depth_step_m(depth_m: np.ndarray) -> np.ndarray:
    """(...,) the change of depth (...,) beyond which it is an edge, not noise or slant."""
    return 3 * depth_noise_m(depth_m) + _SLANT_M


def near_sides(depth_m: np.ndarray) -> np.ndarray:
    """(H, W) bool: the measured pixels on the near side of a step of depth (H, W)."""
    around = np.ones((3, 3), np.uint8)
    return (cv2.dilate(depth_m, around) - depth_m > 2 * depth_step_m(depth_m)) & (cv2.erode(depth_m, around) > 0)


def brightness_edges(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32 gradient of the brightness of colour (H, W, 3), above that of its surroundings."""
    gray = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
    size = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    size = cv2.GaussianBlur(np.minimum(size, _STRONGEST), (0, 0), _BLUR_PX)
    return size - cv2.GaussianBlur(size, (0, 0), _AROUND_PX)
