"""The offset of depth against colour in pixels: in a camera that turns fast the two are of different moments."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core.depth_edges import brightness_edges, near_sides
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import Box

#: Offsets tried, px to each side; a best one at the end of the range is rejected.
_RANGE_PX = 10
#: With fewer pixels on the near side of depth steps there is no answer.
_MIN_EDGE_PX = 150
#: An offset must raise the mean brightness gradient on depth edges by this, in standard deviations; one of length
#: _RANGE_PX has to make up for a loss of _NEAR_ZERO.
_MIN_GAIN, _NEAR_ZERO = 0.2, 0.3


def depth_offset_px(frame: Frame, box: Box) -> tuple[int, int]:
    """(x, y) px by which depth has to move so that its steps in a box lie on edges of brightness; (0, 0) in doubt."""
    near_side = near_sides(frame.depth_m[box.slices])
    count, reach = np.count_nonzero(near_side), _RANGE_PX
    if count < _MIN_EDGE_PX:
        return 0, 0
    edges = np.pad(brightness_edges(frame.rgb[box.slices]), reach)
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
