"""Does what camera and masks say agree with itself: measures from values alone (not in the paper).

They know no truth. What follows for an object is in :data:`p2p_lib.extended.gates.DOUBTS`; depth and colour that are
not of one moment are left out in :mod:`p2p_lib.extended.frame_guard`.
"""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.image import bounds, in_image, nearest_px
from p2p_lib.core.types import SPARSE, Frame

#: Keypoints nearer to each other say little of the size, m; so many are needed.
_APART_M, _KEYPOINTS = 0.02, 8
#: What has changed by less is the same thing: each of red, green and blue, in grey levels.
_SAME_GREY = 12
#: So much of an image has to look the same before it tells of the scene.
_LOOKS_THE_SAME = 0.2
#: Where a mask ends, depth is compared so many pixels to either side of so many pixels at least; a step is larger, m.
_BESIDE_PX, _OUTLINE, _DEPTH_STEP_M = 4, 20, 0.02
#: The outline's direction is that from so many of its pixels before to so many behind.
_ALONG = 3


def size_ratio(p_obj: np.ndarray, p_cam: np.ndarray, noise_m: np.ndarray) -> tuple[float, float] | None:
    """How many times as large as in the map (N, 3) the object is measured (N, 3), with the standard deviation of that.

    A rigid object has one size. Depth that is scaled or offset changes it; a wrong pose or a few wrong points do not:
    the median over pairs of keypoints. ``noise_m`` (N,) is that of the points; None where too few keypoints are seen.
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
    """How many times as far as in a frame before what looks the same beside an object is measured: the median.

    1 where too little looks the same, as before a moving camera: nothing is said then.
    """
    now, now_m, then, then_m = (of.sparse[name] for of in (frame, before) for name in ("rgb", "depth_m"))
    same = (now_m > 0) & (then_m > 0) & ~(mask[SPARSE] | mask_before[SPARSE])
    same &= cv2.inRange(cv2.absdiff(now, then), (0,) * 3, (_SAME_GREY - 1,) * 3) > 0
    return float(np.median(now_m[same] / then_m[same])) if same.mean() > _LOOKS_THE_SAME else 1.0


def outline_share(frame: Frame, mask: np.ndarray, own: bool = False) -> float | None:
    """Share of a mask's (H, W) outline where the measured depth has a step, as it has where an object ends.

    Of the mask's largest part; None where too little is measured on both sides. At the image's border there is none.
    With ``own``, steps alone where the mask is the nearer side: elsewhere something else ends before it.
    """
    cut = bounds(mask, 1)
    found, _ = cv2.findContours(mask[cut].astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not found:
        return None
    uv_px = max(found, key=len)[:, 0] + np.array([cut[1].start, cut[0].start])
    along = np.roll(uv_px, -_ALONG, 0) - np.roll(uv_px, _ALONG, 0)
    across = along[:, ::-1] * [1, -1] * _BESIDE_PX / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1)
    sides = uv_px + across, uv_px - across
    inside = in_image(sides[0], mask.shape) & in_image(sides[1], mask.shape)
    z = [frame.depth_m[nearest_px(at, mask.shape)[::-1]] for at in sides]
    beyond_m = np.where(mask[nearest_px(sides[0], mask.shape)[::-1]], z[1] - z[0], z[0] - z[1])
    steps = (inside & ((beyond_m if own else np.abs(beyond_m)) > _DEPTH_STEP_M))[~inside | (z[0] > 0) & (z[1] > 0)]
    return float(steps.mean()) if len(steps) >= _OUTLINE else None
