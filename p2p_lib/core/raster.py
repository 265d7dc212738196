"""Pixels of ours, whose integers are centres, and coordinates in a network's raster, where 0 is the image's edge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import torch


def to_raster(uv_px: np.ndarray, shape: tuple[int, int], size: int) -> np.ndarray:
    """Pixels (N, 2) of an image of shape (H, W) to coordinates x, y in a raster of size x size."""
    return (np.asarray(uv_px, float) + 0.5) * (size / np.array(shape[::-1], float))


def from_raster(xy: np.ndarray, shape: tuple[int, int], size: int) -> np.ndarray:
    """The inverse of :func:`to_raster`."""
    return np.asarray(xy, float) * (np.array(shape[::-1], float) / size) - 0.5


def square(rgb: np.ndarray, size: int, device: str) -> torch.Tensor:
    """(1, 1, size, size, 3) float32 in [-1, 1]: the image scaled to a square raster, as the models were trained."""
    import torch

    image = torch.from_numpy(np.ascontiguousarray(rgb)).to(device).permute(2, 0, 1)[None].float()
    scaled = torch.nn.functional.interpolate(image, (size, size), mode="bilinear", align_corners=False)
    return scaled.div(127.5).sub(1).permute(0, 2, 3, 1)[None]
