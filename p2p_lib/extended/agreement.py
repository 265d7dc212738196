"""Consistency of depth, colour and masks over time, measured without any truth (not in the paper).

What follows for an object is in :data:`p2p_lib.extended.gates.DOUBTS`; depth that is not of the moment of its colour
is handled in :mod:`p2p_lib.extended.frame_guard`.
"""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.image import in_image, nearest_px, outline_px
from p2p_lib.core.types import SPARSE, Frame

#: Keypoints nearer to each other say little of the size, m; so many are needed.
_APART_M, _KEYPOINTS = 0.02, 8
#: Pixels that changed by less in each of red, green and blue, in grey levels, look the same.
_SAME_GREY = 12
#: At least this share of an image has to look the same.
_LOOKS_THE_SAME = 0.2
#: Depth is compared this many px to either side of the outline, at this many places at least; a step is larger, m.
_BESIDE_PX, _OUTLINE, _DEPTH_STEP_M = 4, 20, 0.02


def size_ratio(p_obj: np.ndarray, p_cam: np.ndarray, noise_m: np.ndarray) -> tuple[float, float] | None:
    """Measured size of the object, p_cam (N, 3), over that in its map, p_obj (N, 3), and the standard deviation.

    Scaled or offset depth changes the size; a wrong pose or a few wrong points do not: it is the median over pairs of
    keypoints. ``noise_m`` (N,) is that of the points; None where too few keypoints are seen.
    """
    from scipy.spatial.distance import pdist

    if len(p_obj) < _KEYPOINTS:
        return None
    known_m, measured_m = pdist(p_obj), pdist(p_cam)
    apart = known_m > _APART_M
    if apart.sum() < _KEYPOINTS:
        return None
    sigma = np.sqrt(2 / len(p_obj)) * np.median(noise_m) / np.median(known_m[apart])
    return float(np.median(measured_m[apart] / known_m[apart])), float(sigma)


def scene_ratio(frame: Frame, mask: np.ndarray, before: Frame, mask_before: np.ndarray) -> float:
    """Median ratio of depths, now over before, of pixels beside the object that look the same.

    1 where too few look the same, as with a moving camera.
    """
    now, now_m, then, then_m = (of.sparse[name] for of in (frame, before) for name in ("rgb", "depth_m"))
    same = (now_m > 0) & (then_m > 0) & ~(mask[SPARSE] | mask_before[SPARSE])
    same &= cv2.inRange(cv2.absdiff(now, then), (0,) * 3, (_SAME_GREY - 1,) * 3) > 0
    return float(np.median(now_m[same] / then_m[same])) if same.mean() > _LOOKS_THE_SAME else 1.0


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
