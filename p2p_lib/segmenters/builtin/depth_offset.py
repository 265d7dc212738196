"""The offset of depth against colour in pixels: in a camera that turns fast the two are of different moments."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import Box, depth_step_m

#: Offsets tried, px to each side; a best one at the end of the range is rejected.
_RANGE_PX = 10
#: With fewer pixels on the near side of depth steps there is no answer.
_MIN_EDGE_PX = 150
#: An offset must raise the mean brightness gradient on depth edges by this, in standard deviations; one of length
#: _RANGE_PX has to make up for a loss of _NEAR_ZERO.
_MIN_GAIN, _NEAR_ZERO = 0.2, 0.3
#: Gradients count up to this, in grey levels: one strong edge does not outvote the others.
_STRONGEST = 80.0
#: Standard deviations of the blurs of the gradient, and of its surroundings, px.
_BLUR_PX, _AROUND_PX = 1.5, 12.0


def depth_offset_px(frame: Frame, box: Box) -> tuple[int, int]:
    """(x, y) px by which depth has to move so that its steps in a box lie on edges of brightness; (0, 0) in doubt."""
    z = frame.depth_m[box.slices]
    around = np.ones((3, 3), np.uint8)
    near_side = (cv2.dilate(z, around) - z > 2 * depth_step_m(z)) & (cv2.erode(z, around) > 0)
    count, reach = np.count_nonzero(near_side), _RANGE_PX
    if count < _MIN_EDGE_PX:
        return 0, 0
    edges = np.pad(_gradient(frame.rgb[box.slices]), reach)
    score = cv2.matchTemplate(edges, near_side.astype(np.float32), cv2.TM_CCORR) / (count * edges.std())
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    score -= _NEAR_ZERO * (x**2 + y**2) / reach**2
    dy, dx = (int(at) - reach for at in np.unravel_index(score.argmax(), score.shape))
    doubtful = max(abs(dx), abs(dy)) == reach or score.max() - score[reach, reach] < _MIN_GAIN
    return (0, 0) if doubtful else (dx, dy)


def with_depth_moved(frame: Frame, offset_px: tuple[int, int]) -> Frame:
    """A frame with its depth moved by (x, y) pixels; what moves in from outside the image is unmeasured."""
    if offset_px == (0, 0):
        return frame
    moved = np.array([[1, 0, offset_px[0]], [0, 1, offset_px[1]]], np.float32)
    depth_m = cv2.warpAffine(frame.depth_m, moved, frame.shape[::-1], flags=cv2.INTER_NEAREST)
    return replace(frame, depth_m=depth_m)


def _gradient(rgb: np.ndarray) -> np.ndarray:
    """(h, w) float32 gradient of brightness, above that of its surroundings."""
    gray = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
    size = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    size = cv2.GaussianBlur(np.minimum(size, _STRONGEST), (0, 0), _BLUR_PX)
    return size - cv2.GaussianBlur(size, (0, 0), _AROUND_PX)
