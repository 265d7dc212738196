"""Images on surfaces: prefiltered to every size, and looked up in between."""

from __future__ import annotations

import cv2
import numpy as np


def mipmap(image: np.ndarray) -> list[np.ndarray]:
    """An image (H, W, 3), each next level averaged to half the size, down to one texel: (h, w, 3) float32."""
    levels: list[np.ndarray] = [image.astype(np.float32)]
    while max(levels[-1].shape[:2]) > 1:
        h, w = levels[-1].shape[:2]
        levels.append(cv2.resize(levels[-1], (max(1, w // 2), max(1, h // 2)), interpolation=cv2.INTER_AREA))
    return levels


def lookup(levels: list[np.ndarray], uv: np.ndarray, texels_per_px: np.ndarray) -> np.ndarray:
    """Trilinear lookup at uv (N, 2) where a pixel covers so many texels (N,); (N, 3) float32."""
    level = np.clip(np.log2(np.maximum(texels_per_px, 1e-6)), 0, len(levels) - 1)
    colour = np.zeros((len(uv), 3), np.float32)
    for k in range(int(level.min()), int(np.ceil(level.max())) + 1):
        near = np.flatnonzero(np.abs(level - k) < 1)
        if not len(near):
            continue
        h, w = levels[k].shape[:2]
        # cv2.remap works on images with sides below 32768: fold the list into rows.
        at = np.zeros((2, -(-len(near) // 1024) * 1024), np.float32)
        at[:, : len(near)] = uv[near, 0] * w - 0.5, (1 - uv[near, 1]) * h - 0.5
        x, y = at.reshape(2, -1, 1024)
        found = cv2.remap(levels[k], x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        weight = (1 - np.abs(level[near] - k)).astype(np.float32)
        colour[near] += weight[:, None] * found.reshape(-1, 3)[: len(near)]
    return colour
