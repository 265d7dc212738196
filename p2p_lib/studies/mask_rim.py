"""Whether a mask keeps to its object: along its rim, depth must not fall off to what stands behind."""

from __future__ import annotations

import cv2
import numpy as np

#: The outermost pixels are left out: no silhouette is that exact, and sensors blur depth there.
INSET_PX = 2
#: The rim is compared with what the mask holds within this distance of it.
REACH_PX = 12
#: So much farther than that is background, plus a share of the range.
GAP_M, GAP_SHARE = 0.03, 0.02


def background_share(mask: np.ndarray, depth_m: np.ndarray) -> float:
    """The share of a mask's rim, where measured, that lies clearly behind the rest of the mask nearby; NaN without any.

    mask (H, W) bool, depth_m (H, W) metres, 0 = no measurement.
    """
    on_rim, behind = rim(mask, depth_m)
    return float(behind.sum() / on_rim.sum()) if on_rim.any() else float("nan")


def rim(mask: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) bool each: the measured pixels of a mask's rim, and those of them that lie on the background."""
    inner = cv2.erode(mask.astype(np.uint8), _disc(INSET_PX), borderValue=0)
    on_rim = (inner > 0) & (cv2.erode(inner, np.ones((3, 3), np.uint8), borderValue=0) == 0) & (depth_m > 0)
    own = np.where((inner > 0) & (depth_m > 0), depth_m, np.float32(1e3))
    behind_m = depth_m - cv2.erode(own, _disc(REACH_PX))
    return on_rim, on_rim & (behind_m > GAP_M + GAP_SHARE * depth_m)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)
