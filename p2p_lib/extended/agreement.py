"""Consistency of depth, colour and masks over time, measured without any truth (not in the paper).

What follows for an object is in :data:`p2p_lib.extended.gates.DOUBTS`; depth that is not of the moment of its colour
is handled in :mod:`p2p_lib.extended.frame_guard`.
"""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.image import in_image, nearest_px, outline_px
from p2p_lib.core.types import SPARSE, Frame

#: Pixels that changed by less in each of red, green and blue, in grey levels, look the same.
_SAME_GREY = 12
#: So many places have to tell whether the camera stands still, and at least this share of them that it does.
_TELLING, _STANDS = 30, 0.4
#: Depth is compared this many px to either side of the outline, at this many places at least; a step is larger, m.
_BESIDE_PX, _OUTLINE, _DEPTH_STEP_M = 4, 20, 0.02


def scene_ratio(frame: Frame, mask: np.ndarray, before: Frame, mask_before: np.ndarray) -> float:
    """Median ratio of depths, now over before, of pixels beside the object that look the same; 1 with a moving camera.

    A camera stands still where places that differ from those beside them look the same: of a plain wall all look
    the same from everywhere. Points that slide over an object, or follow wrong depth, change nothing of it.
    """
    now, now_m, then, then_m = (of.sparse[name] for of in (frame, before) for name in ("rgb", "depth_m"))
    beside = ~(mask[SPARSE] | mask_before[SPARSE])
    same, telling = beside & _alike(now, then), beside & _telling(now)
    if telling.sum() < _TELLING or same[telling].mean() < _STANDS:
        return 1.0
    same &= (now_m > 0) & (then_m > 0)
    return float(np.median(now_m[same] / then_m[same])) if same.sum() >= _TELLING else 1.0


def _telling(rgb: np.ndarray) -> np.ndarray:
    """(H, W) bool: where an image (H, W, 3) differs from what is beside: of a plain wall all looks the same."""
    around = np.ones((3, 3), np.uint8)
    return ~_alike(cv2.dilate(rgb, around), cv2.erode(rgb, around))


def _alike(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(H, W) bool: where two images (H, W, 3) look the same."""
    return cv2.inRange(cv2.absdiff(a, b), (0,) * 3, (_SAME_GREY - 1,) * 3) > 0


def outline_share(frame: Frame, mask: np.ndarray, own: bool = False) -> float | None:
    """Share of a mask's (H, W) outline where the measured depth has a step, as it has where an object ends.

    Of the longest contour; None where too little is measured on both sides. At the image's border there is no step.
    With ``own`` only steps with the mask on the nearer side count: at others something in front ends.
    """
    _, inner, outer = outline_px(mask, _BESIDE_PX)
    inside = in_image(inner, mask.shape) & in_image(outer, mask.shape)
    own_m, other_m = (frame.depth_m[nearest_px(at, mask.shape)[::-1]] for at in (inner, outer))
    beyond_m = other_m - own_m
    steps = (inside & ((beyond_m if own else np.abs(beyond_m)) > _DEPTH_STEP_M))[~inside | (own_m > 0) & (other_m > 0)]
    return float(steps.mean()) if len(steps) >= _OUTLINE else None
