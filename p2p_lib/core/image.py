"""Pixels and masks. An integer pixel is a pixel's centre, so an image of width w spans -0.5 to w - 0.5."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce

import cv2
import numpy as np

#: The direction of an outline is that from so many of its pixels before to so many behind.
_ALONG = 3


def in_image(uv_px: np.ndarray, shape: tuple[int, int], margin_px: float = 0.0) -> np.ndarray:
    """(...,) bool: which of the pixels (..., 2) an image of shape (H, W) holds; NaN is outside.

    margin_px  distance to the centres of the outermost pixels: 0 up to those centres, -0.5 up to the image's edge
    """
    u, v = uv_px[..., 0], uv_px[..., 1]
    in_u = (u >= margin_px) & (u <= shape[1] - 1 - margin_px)
    return in_u & (v >= margin_px) & (v <= shape[0] - 1 - margin_px)


def nearest_px(uv_px: np.ndarray, shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Columns u and rows v (...,) int of the nearest pixels that an image of shape (H, W) has; (0, 0) for NaN."""
    # fmax passes NaN over, where clip would keep it.
    px = np.minimum(np.fmax(np.rint(uv_px), 0), (shape[1] - 1, shape[0] - 1)).astype(int)
    return px[..., 0], px[..., 1]


def in_mask(uv_px: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """(...,) bool: which of the pixels (..., 2) have their nearest pixel in a mask (H, W); NaN is outside."""
    u, v = nearest_px(uv_px, mask.shape)
    return in_image(uv_px, mask.shape, -0.5) & mask[v, u]


def bounds(mask: np.ndarray, margin_px: int = 0) -> tuple[slice, slice]:
    """Rows and columns of a mask's (H, W) bounding box with a margin around it, cut to the image."""
    left, top, width, height = cv2.boundingRect(np.ascontiguousarray(mask, bool).view(np.uint8))
    spans = ((top, height, mask.shape[0]), (left, width, mask.shape[1]))
    rows, columns = (slice(max(at - margin_px, 0), min(at + size + margin_px, end)) for at, size, end in spans)
    return rows, columns


def ends_px(mask: np.ndarray) -> np.ndarray:
    """(2, 2) x, y of the first pixel of a mask's (H, W) bounding box, and of the first beyond it."""
    rows, columns = bounds(mask)
    return np.array([[columns.start, rows.start], [columns.stop, rows.stop]])


def outline_px(mask: np.ndarray, beside_px: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(N, 2) each: the pixels along the outline of a mask's (H, W) largest part, and what is beside, inside and out.

    beside_px  how far beside, across the outline. N is 0 for an empty mask.
    """
    cut = bounds(mask, 1)
    found, _ = cv2.findContours(mask[cut].astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    if not found:
        return (np.zeros((0, 2)),) * 3
    uv_px = max(found, key=len)[:, 0] + np.array([cut[1].start, cut[0].start])
    along = np.roll(uv_px, -_ALONG, 0) - np.roll(uv_px, _ALONG, 0)
    across = along[:, ::-1] * [1, -1] * beside_px / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1)
    u, v = nearest_px(uv_px + across, mask.shape)
    inwards = np.where(mask[v, u][:, None], across, -across)
    return uv_px, uv_px + inwards, uv_px - inwards


def shares(part: np.ndarray, holds: np.ndarray, fewest: int) -> np.ndarray:
    """(K,) of each part, whose number pixels have in ``part`` (N,) int, the share that holds (N,) bool.

    Parts of fewer pixels than ``fewest``, at least 1, are left out.
    """
    count = np.bincount(part)
    return (np.bincount(part, holds) / np.maximum(count, 1))[count >= fewest]


def mask_iou(one: np.ndarray, other: np.ndarray) -> float:
    """Intersection over union of two masks (H, W) bool; 0 where both are empty."""
    return float(np.count_nonzero(one & other) / max(int(np.count_nonzero(one | other)), 1))


def small_parts(mask: np.ndarray, fewest_px: float, connectivity: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) int, the number of each connected part of a mask (H, W) bool, 0 outside; and which have fewer pixels."""
    _, part, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=connectivity)
    small = stats[:, cv2.CC_STAT_AREA] < fewest_px
    small[0] = False
    return part, small


def either(masks: Iterable[np.ndarray | None]) -> np.ndarray:
    """(H, W) bool: what any of some masks holds; None holds nothing."""
    return reduce(np.logical_or, (mask for mask in masks if mask is not None))  # its ufunc would copy all of them first
