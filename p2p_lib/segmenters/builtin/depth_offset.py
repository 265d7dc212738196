"""By how many pixels depth lies beside colour: a camera that turns fast takes the two at different moments."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import Box, depth_step_m

#: Offsets that are tried, px to each side; one at the end of the range is none.
_RANGE_PX = 10
#: Fewer pixels on the near side of depth steps tell nothing.
_MIN_EDGE_PX = 150
#: An offset must raise the mean colour gradient on depth edges by this, in its standard deviations; the farthest one
#: loses as much as _NEAR_ZERO for its length.
_MIN_GAIN, _NEAR_ZERO = 0.2, 0.3
#: Gradients count up to this, in grey levels: one strong edge does not outvote the others.
_STRONGEST = 80.0
#: Standard deviations that blur a gradient and that its surroundings are taken of, px.
_BLUR_PX, _AROUND_PX = 1.5, 12.0


def depth_offset_px(frame: Frame, box: Box) -> tuple[int, int]:
    """(x, y) by which depth has to move so that its steps in a box lie on edges of colour; (0, 0) in doubt."""
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
    """A frame with its depth moved by (x, y) pixels; what comes in from outside is unmeasured."""
    if offset_px == (0, 0):
        return frame
    moved = np.float32([[1, 0, offset_px[0]], [0, 1, offset_px[1]]])
    depth_m = cv2.warpAffine(frame.depth_m, moved, frame.shape[::-1], flags=cv2.INTER_NEAREST)
    return replace(frame, depth_m=depth_m)


def _gradient(rgb: np.ndarray) -> np.ndarray:
    """(h, w) float32 gradient of brightness, above that of its surroundings."""
    gray = cv2.GaussianBlur(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), (0, 0), 1.0).astype(np.float32)
    size = np.hypot(cv2.Sobel(gray, cv2.CV_32F, 1, 0), cv2.Sobel(gray, cv2.CV_32F, 0, 1))
    size = cv2.GaussianBlur(np.minimum(size, _STRONGEST), (0, 0), _BLUR_PX)
    return size - cv2.GaussianBlur(size, (0, 0), _AROUND_PX)
