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
#: A camera stands still if so much more of the image looks the same than would by chance, of what could; by so many
#: places at least. By chance: as what was so many places beside it.
_STANDS, _TELLING, _ASIDE = 0.2, 30, 2
#: Depth is compared this many px to either side of the outline, at this many places at least; a step is larger, m.
_BESIDE_PX, _OUTLINE, _DEPTH_STEP_M = 4, 20, 0.02


def scene_ratio(frame: Frame, mask: np.ndarray, before: Frame, mask_before: np.ndarray) -> float:
    """Median ratio of depths, now over before, of pixels beside the object that look the same; 1 with a moving camera.

    Points that slide over an object, or follow wrong depth, change nothing of it.
    """
    now, now_m, then, then_m = (of.sparse[name] for of in (frame, before) for name in ("rgb", "depth_m"))
    beside = ~(mask[SPARSE] | mask_before[SPARSE])
    same = beside & _alike(now, then)
    if not _stands(now, then, same, beside):
        return 1.0
    same &= (now_m > 0) & (then_m > 0)
    return float(np.median(now_m[same] / then_m[same])) if same.sum() >= _TELLING else 1.0


def _stands(now: np.ndarray, then: np.ndarray, same: np.ndarray, beside: np.ndarray) -> bool:
    """Whether the camera stands still: what looks the ``same`` does so because it is (Cohen's kappa of two images).

    Of a wall, or a table's grain, much looks the same wherever the camera goes, and as much as what is beside it.
    """
    aside = (np.roll(then, step, axis) for step in (-_ASIDE, _ASIDE) for axis in (0, 1))
    by_chance = np.mean([np.count_nonzero(beside & _alike(now, other)) for other in aside])
    could = np.count_nonzero(beside) - by_chance
    return bool(could >= _TELLING and np.count_nonzero(same) - by_chance >= _STANDS * could)


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
