"""Appearance of points: patches that are found again with subpixel accuracy under an affine change of view.

A patch is aligned by the inverse compositional algorithm (Baker and Matthews, "Lucas-Kanade 20 years
on", IJCV 2004) with a window weight and invariance to gain, offset and slope of the light; all points
in one batch. The pseudo-inverse of its steepest descent images is computed once, when the patch is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from p2p_lib.core.compiled import compiled
from p2p_lib.core.types import Rows, joined
from p2p_lib.trackers.builtin.image import sampled

#: Half a patch's side in pixels, and the standard deviation of the window's weight.
RADIUS, WINDOW_PX = 7, 5.0
_SIDE = 2 * RADIUS + 1
_Y, _X = (a.ravel().astype(np.float32) for a in np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1])
_WEIGHT = np.exp(-0.5 * (_X**2 + _Y**2) / WINDOW_PX**2).astype(np.float32)
_SQUARE = _WEIGHT / _WEIGHT.sum()
_ROOT = np.sqrt(_SQUARE)
# Shading of a round object stays in place in the image while its texture moves: patches are invariant to slopes.
_RAMPS = np.stack([_X, _Y]) * _ROOT
_RAMPS /= np.linalg.norm(_RAMPS, axis=1, keepdims=True)
#: Effective number of independent samples in a patch: neighbouring pixels share their noise.
_SAMPLES = 10.0
#: A step (px, and of the affine part) that is smaller ends an alignment.
_SETTLED = 0.005
#: Ratio of areas beyond which an alignment has diverged.
_MAX_AREA_CHANGE = 5.0
#: Damping of an affine and of a translational step, in units of the normalised patch.
_DAMP = np.diag(np.array([1e-4] * 2 + [0.05] * 4, np.float32))


@dataclass(eq=False)
class Patches(Rows):
    """N patches, ready to be searched for.

    pixels    (N, P) weighted, without mean and slope, of unit length
    solver    (N, 6, P) takes a difference of pixels to the step [translation px, affine]
    unit_cov  (N, 2, 2) covariance of the translation per unit of the residual's variance, px^2
    contrast  (N,) standard deviation of the grey values
    """

    pixels: np.ndarray
    solver: np.ndarray
    unit_cov: np.ndarray
    contrast: np.ndarray

    def __setitem__(self, rows: np.ndarray, other: Patches) -> None:
        for f in fields(self):
            getattr(self, f.name)[rows] = getattr(other, f.name)

    @classmethod
    def empty(cls, count: int) -> Patches:
        """Zeros for so many patches."""
        p = _SIDE**2
        return cls(*(np.zeros((count, *tail), np.float32) for tail in ((p,), (6, p), (2, 2), ())))


class Templates:
    """What points look like, at full and at half resolution: a row for each time that a point was looked at.

    Room grows by doubling, and rows that are let go are used again: points come and go at every keyframe, and to copy
    what all of them look like would take longer than to track them.
    """

    def __init__(self) -> None:
        self.fine, self.coarse = Patches.empty(0), Patches.empty(0)
        self._free = np.zeros(0, np.int64)

    def new(self, count: int) -> np.ndarray:
        """(count,) rows that nobody uses."""
        short = count - len(self._free)
        if short > 0:
            size = len(self.fine)
            more = Patches.empty(max(short, size))
            self.fine, self.coarse = joined([self.fine, more]), joined([self.coarse, more])
            self._free = np.concatenate([self._free, np.arange(size, len(self.fine))])
        rows, self._free = self._free[:count], self._free[count:]
        return rows

    def let_go(self, rows: np.ndarray) -> None:
        """Nobody uses these rows any more."""
        self._free = np.concatenate([rows, self._free])


def take(image: np.ndarray, uv_px: np.ndarray) -> Patches:
    """The patches at uv_px (N, 2) of a float32 grey image."""
    n, side = len(uv_px), _SIDE + 2
    y, x = (a.ravel().astype(np.float32) for a in np.mgrid[:side, :side] - float(RADIUS + 1))
    raw = sampled(image, uv_px.astype(np.float32)[:, :, None] + np.stack([x, y])).reshape(n, side, side)
    gx = 0.5 * (raw[:, 1:-1, 2:] - raw[:, 1:-1, :-2]).reshape(n, _SIDE**2)
    gy = 0.5 * (raw[:, 2:, 1:-1] - raw[:, :-2, 1:-1]).reshape(n, _SIDE**2)
    grey = raw[:, 1:-1, 1:-1].reshape(n, _SIDE**2)
    centred = (grey - (grey @ _SQUARE)[:, None]) * _ROOT
    centred -= (centred @ _RAMPS.T) @ _RAMPS
    norm = np.sqrt(np.maximum(np.einsum("np,np->n", centred, centred), 1.0))
    pixels = centred / norm[:, None]
    J = np.stack([gx, gy, gx * _X, gx * _Y, gy * _X, gy * _Y], 1) * (_ROOT / norm[:, None, None])
    # What a change of offset, slope or gain explains is not evidence of motion.
    J -= (J @ _ROOT)[..., None] * _ROOT
    J -= (J @ _RAMPS.T) @ _RAMPS
    J -= (J @ pixels[..., None]) * pixels[:, None]
    H = J @ J.transpose(0, 2, 1)
    inverse = np.linalg.inv(H + _DAMP)
    return Patches(pixels, inverse @ J, inverse[:, :2, :2], norm)


@dataclass(eq=False)
class Alignment:
    """Where patches were found.

    uv_px           (N, 2), A (N, 2, 2): the patch's offset x lies at uv + A x
    ncc             (N,) weighted normalised cross correlation, -1 to 1; -1 where the alignment diverged
    cov_px2         (N, 2, 2) covariance of uv_px: long along an edge
    contrast_ratio  (N,) of the image to the patch
    """

    uv_px: np.ndarray
    A: np.ndarray
    ncc: np.ndarray
    cov_px2: np.ndarray
    contrast_ratio: np.ndarray


def align(
    image: np.ndarray, patches: Patches, rows: np.ndarray, uv_px: np.ndarray, A: np.ndarray, iterations: int = 4
) -> Alignment:
    """Find the patches at rows (N,) near uv_px (N, 2), seen under about A (N, 2, 2), in a float32 grey image.

    All patches are handed over: they are too large to be copied for it.
    """
    uv, A = uv_px.astype(np.float32), A.astype(np.float32)
    height, width = image.shape
    start, identity = uv.copy(), np.eye(2, dtype=np.float32)
    ncc, contrast = _aligned(image, patches.pixels, patches.solver, rows, uv, A, iterations)
    inside = (uv >= 0).all(1) & (uv[:, 0] <= width - 1) & (uv[:, 1] <= height - 1)
    area = np.abs(A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0])
    found = inside & np.isfinite(A).all((1, 2)) & (area > 1 / _MAX_AREA_CHANGE) & (area < _MAX_AREA_CHANGE)
    uv, A = np.where(found[:, None], uv, start), np.where(found[:, None, None], A, identity)
    ncc = np.where(found, ncc, -1.0)
    variance = 2 * np.maximum(1 - ncc, 0.01) / _SAMPLES
    cov = A @ (variance[:, None, None] * patches.unit_cov[rows]) @ A.transpose(0, 2, 1)
    return Alignment(uv, A, ncc, cov, contrast / patches.contrast[rows])


@compiled("f4[:,::1], f4[:,::1], f4[:,:,::1], i8[::1], f4[:,::1], f4[:,:,::1], i8")
def _aligned(image, pixels, solver, rows, uv, A, iterations):
    """Moves uv (N, 2) and A (N, 2, 2) to where the patches at ``rows`` are; correlation and contrast (N,) there."""
    right, bottom, one = np.float32(image.shape[1] - 1), np.float32(image.shape[0] - 1), np.float32(1)
    last_i, last_j, next_px = image.shape[1] - 2, image.shape[0] - 2, np.uint32(1)
    ncc, contrast, seen, step = np.zeros(len(uv)), np.zeros(len(uv)), np.zeros(pixels.shape[1], np.float32), np.ones(6)
    for n in range(len(uv)):
        step[:] = 1.0
        for turn in range(iterations + 1):
            mean, slope_x, slope_y, squared = 0.0, 0.0, 0.0, 0.0
            (m00, m01), (m10, m11), (u, v) = A[n, 0], A[n, 1], uv[n]
            for p in range(len(seen)):
                # The border is repeated; NaN lands on it as well.
                x = min(max(np.float32(0), u + m00 * _X[p] + m01 * _Y[p]), right)
                y = min(max(np.float32(0), v + m10 * _X[p] + m11 * _Y[p]), bottom)
                # Unsigned, for a look whether indices count from the end takes as long as the pixel.
                i, j = np.uint32(min(np.int32(x), last_i)), np.uint32(min(np.int32(y), last_j))
                a, b = x - np.float32(i), y - np.float32(j)
                upper = image[j, i] * (one - a) + image[j, i + next_px] * a
                lower = image[j + next_px, i] * (one - a) + image[j + next_px, i + next_px] * a
                seen[p] = upper * (one - b) + lower * b
            for p in range(len(seen)):  # a loop of its own: the one above is done for several pixels at once
                mean += seen[p] * _SQUARE[p]
            mean = np.float32(mean)  # type: ignore[assignment]  # compiled
            for p in range(len(seen)):
                seen[p] = (seen[p] - mean) * _ROOT[p]
                slope_x += seen[p] * _RAMPS[0, p]
                slope_y += seen[p] * _RAMPS[1, p]
            slope_x, slope_y = np.float32(slope_x), np.float32(slope_y)  # type: ignore[assignment]  # compiled
            for p in range(len(seen)):
                seen[p] -= slope_x * _RAMPS[0, p] + slope_y * _RAMPS[1, p]
                squared += seen[p] * seen[p]
            contrast[n] = np.sqrt(max(squared, 1.0))
            seen *= np.float32(1 / contrast[n])
            if turn == iterations or np.abs(step).max() < _SETTLED:
                ncc[n] = np.dot(seen, pixels[rows[n]])
                break
            found = np.dot(solver[rows[n]], seen - pixels[rows[n]])
            for k in range(6):
                step[k] = found[k]
            # The linearisation holds for a few pixels and a few tenths of scale.
            most = min(1.0, 3.0 / max(np.sqrt(step[0] ** 2 + step[1] ** 2), 1e-6))
            step[0], step[1] = step[0] * most, step[1] * most
            for k in range(2, 6):
                step[k] = min(max(step[k], -0.25), 0.25)
            # A times the inverse of identity + D.
            d00, d01, d10, d11 = 1 + step[2], step[3], step[4], 1 + step[5]
            area = d00 * d11 - d01 * d10
            for row in range(2):
                e, f = A[n, row]
                A[n, row, 0], A[n, row, 1] = (e * d11 - f * d10) / area, (f * d00 - e * d01) / area
                uv[n, row] -= A[n, row, 0] * step[0] + A[n, row, 1] * step[1]
    return ncc, contrast
