"""Pixels and masks. An integer pixel is a pixel's centre, so an image of width w spans -0.5 to w - 0.5."""

from __future__ import annotations

from collections.abc import Iterable
from functools import reduce

import cv2
import numpy as np


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


def either(masks: Iterable[np.ndarray | None]) -> np.ndarray:
    """(H, W) bool: what any of some masks holds; None holds nothing."""
    return reduce(np.logical_or, (mask for mask in masks if mask is not None))  # its ufunc would copy all of them first
