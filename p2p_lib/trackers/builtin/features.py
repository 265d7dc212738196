"""Corners and their descriptors on the surface, for guided and global re-detection.

The descriptor is of the family of SIFT: half-rectified gradients in eight directions, pooled in 4 x 4
cells turned to the corner's dominant direction. It is sampled on the surface's tangent plane, in
millimetres (as the viewpoint invariant patches of Wu et al., CVPR 2008), so that the depth image
removes scale and slant. All corners are described in one batch of matrix products.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from p2p_lib.core.compiled import compiled
from p2p_lib.core.image import bounds
from p2p_lib.trackers.builtin.image import sampled

_DIRECTIONS, _CELLS, _SAMPLES = 8, 4, 16
SIZE = _DIRECTIONS * _CELLS**2
_ANGLES = 2 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
_DIRECTION_VECTORS = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], 1).astype(np.float32)
_AXIS = np.arange(_SAMPLES) - (_SAMPLES - 1) / 2
_GRID = np.stack(np.meshgrid(_AXIS, _AXIS)).reshape(2, -1).astype(np.float32)
_RADIUS = _AXIS[-1]
#: Places that a landmark may match.
_PLACES = 2
#: Corners within this many pixels are one place.
_SAME_PX = 4.0
#: Room around a region in which gradients are computed.
_MARGIN_PX = 14
#: Half an image of 640 x 480.
_LARGE_PX = 150_000


def _pooling() -> tuple[np.ndarray, np.ndarray]:
    """Weights (S, 16) of the samples in each cell, bilinear under a wide Gaussian; and (S,) a narrower one."""
    cell = (np.arange(_CELLS) - (_CELLS - 1) / 2) * (_SAMPLES / _CELLS)
    near = np.maximum(1 - np.abs(_AXIS[:, None] - cell) / (cell[1] - cell[0]), 0)
    pool = (near[:, None, :, None] * near[None, :, None, :]).reshape(_SAMPLES**2, _CELLS**2)
    squared = (_GRID**2).sum(0)
    wide = np.exp(-0.5 * squared / _RADIUS**2)[:, None]
    return (pool * wide).astype(np.float32), np.exp(-0.5 * squared / (0.5 * _RADIUS) ** 2).astype(np.float32)


_POOL, _ROUND = _pooling()


def detect(gray: np.ndarray, region: np.ndarray | None, limit: int) -> np.ndarray:
    """The strongest corners (M, 2) of a uint8 image, at most ``limit``, inside ``region`` (H, W) bool if given.

    Regions of more than :data:`_LARGE_PX` pixels are searched at half the resolution, for speed.
    """
    if region is not None and not region.any():
        return np.zeros((0, 2), np.float32)
    cut = rows, columns = bounds(np.ones(gray.shape, bool) if region is None else region, _MARGIN_PX)
    step = 1 + (gray[cut].size > _LARGE_PX)
    # pyrDown keeps every other pixel where it is.
    level = cv2.pyrDown(gray[cut]) if step == 2 else gray[cut]
    inside = None if region is None else np.ascontiguousarray(region[cut][::step, ::step]).view(np.uint8)
    corners = cv2.goodFeaturesToTrack(level, limit, 0.005, 4 - step + 1, mask=inside, blockSize=7 - 2 * step)
    if corners is None:
        return np.zeros((0, 2), np.float32)
    return step * corners.reshape(-1, 2).astype(np.float32) + np.array([columns.start, rows.start], np.float32)


def describe(gray: np.ndarray, uv_px: np.ndarray, step_px: Sequence[np.ndarray]) -> np.ndarray:
    """Descriptors (M, scales, SIZE) float32, unit length, of the surroundings of uv_px in a uint8 image.

    step_px  (M, 2, 2) each: columns are the steps of the sampling grid on the surface, in pixels
    """
    if not len(uv_px):
        return np.zeros((0, len(step_px), SIZE), np.float32)
    x0, y0 = np.maximum(np.floor(uv_px.min(0)).astype(int) - 60, 0)
    x1, y1 = np.ceil(uv_px.max(0)).astype(int) + 61
    smooth = cv2.GaussianBlur(gray[y0:y1, x0:x1], (0, 0), 1.0)
    maps = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))]
    uv = (uv_px - [x0, y0]).astype(np.float32)
    return np.stack([_described(maps, uv, step.astype(np.float32)) for step in step_px], 1)


def _described(maps: list[np.ndarray], uv: np.ndarray, M: np.ndarray) -> np.ndarray:
    """(N, SIZE) at one scale, from the derivatives of the image."""
    gx, gy = _gradients(maps, uv, M)
    angle = _dominant(np.stack([along @ _ROUND for along in _rectified(gx, gy, _DIRECTION_VECTORS)], 1))
    c, s = np.cos(angle), np.sin(angle)
    gx, gy = _gradients(maps, uv, M @ np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2).astype(np.float32))
    raw = np.concatenate([along @ _POOL for along in _rectified(gx, gy, _DIRECTION_VECTORS)], 1)
    # The square root (Hellinger kernel) keeps strong edges from dominating.
    return np.sqrt(raw / np.maximum(raw.sum(1, keepdims=True), 1e-6))


@compiled("f4[:,::1], f4[:,::1], f4[:,::1]")
def _rectified(gx: np.ndarray, gy: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """(D, N, S) derivatives along directions (D, 2), 0 where negative: in one pass over each."""
    out = np.empty((len(directions), *gx.shape), gx.dtype)
    for d in range(len(directions)):
        c, s = directions[d]
        for n in range(gx.shape[0]):
            for p in range(gx.shape[1]):
                out[d, n, p] = max(c * gx[n, p] + s * gy[n, p], np.float32(0))
    return out


def _gradients(maps: list[np.ndarray], uv: np.ndarray, M: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, S) derivatives along the two steps of the grids at uv (N, 2)."""
    at = uv[:, :, None] + M @ _GRID
    gu, gv = (sampled(values, at) for values in maps)
    return M[:, 0, :1] * gu + M[:, 1, :1] * gv, M[:, 0, 1:] * gu + M[:, 1, 1:] * gv


def _dominant(histogram: np.ndarray) -> np.ndarray:
    """Direction (M,) of the peak of (M, 8) by the parabola through it and its neighbours."""
    rows, peak = np.arange(len(histogram)), histogram.argmax(1)
    left, right = histogram[rows, peak - 1], histogram[rows, (peak + 1) % _DIRECTIONS]
    bend = left + right - 2 * histogram[rows, peak]
    shift = np.where(bend < -1e-6, 0.5 * (left - right) / np.minimum(bend, -1e-6), 0)
    return 2 * np.pi * (peak + shift) / _DIRECTIONS


def match(wanted: np.ndarray, found: np.ndarray, uv_px: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of descriptors wanted (Q, SIZE) and of places found (M, SIZE) at uv_px (M, 2) that match.

    A wanted one may match its two nearest places, for two objects may look alike. Each counts if it is nearer than
    ``ratio`` times the next best place beyond those two.
    """
    from scipy.spatial.distance import cdist

    similarity = wanted @ found.T
    rows = np.arange(len(wanted))
    best: list[np.ndarray] = []
    similarities: list[np.ndarray] = []
    same = cdist(uv_px, uv_px, "chebyshev") <= _SAME_PX
    for place in range(_PLACES + 1):
        if place:
            np.copyto(similarity, -1, where=same[best[-1]])
        best.append(similarity.argmax(1))
        similarities.append(similarity[rows, best[-1]])
    distance = np.sqrt(np.maximum(2 - 2 * np.stack(similarities, 1), 0))
    which, rank = np.nonzero(distance[:, :_PLACES] < ratio * distance[:, _PLACES:])
    return which, np.stack(best, 1)[which, rank]


def mutual_match(wanted: np.ndarray, found: np.ndarray, ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows of descriptors wanted (Q, SIZE) and found (M, SIZE) that are each other's nearest.

    The nearest one of those wanted is nearer than ``ratio`` times the next.
    """
    similarity = wanted @ found.T
    rows, best = np.arange(len(wanted)), similarity.argmax(1)
    mutual = similarity.argmax(0)[best] == rows
    nearest = similarity[rows, best]
    similarity[rows, best] = -1
    gap, next_gap = (np.sqrt(np.maximum(2 - 2 * s, 0)) for s in (nearest, similarity.max(1)))
    good = mutual & (gap < ratio * next_gap)
    return rows[good], best[good]
