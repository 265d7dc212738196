"""Segmentation by a random walker with priors (Grady 2005) on a small RGB-D grid.

Every pixel is pulled towards object or background by its own evidence and tied to its neighbours, less
where colour or depth change between them. The answer is the probability that a walker who starts at the
pixel, and prefers large edge weights, ends at the object: the minimum of a quadratic energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

#: Least edge weight, across the strongest contrast: no pixel is cut off completely.
_LOOSE = 1e-4
#: Factor of edge weights between measured and unmeasured pixels: depth is missing mostly along silhouettes.
_INTO_THE_UNMEASURED = 0.05
#: Conjugate gradients end when the residual is below this, in root mean square, or after so many steps.
_SETTLED, _STEPS = 3e-4, 40
#: Least differences in the reweighting of :func:`sharpen`, one for each of its walks.
_LEAST_DIFFERENCE = (0.5, 0.25)


def edge_weights(colour: np.ndarray, depth_m: np.ndarray, step_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights in (0, 1] of neighbours along a row (H, W-1) and along a column (H-1, W).

    colour (H, W, C) float, its contrast taken relative to the image's mean contrast; depth_m (H, W), 0 = not
    measured; step_m (H, W): a depth step of this size is an edge.
    """
    across = colour[:, 1:] - colour[:, :-1], colour[1:] - colour[:-1]
    contrast = [np.einsum("ijk,ijk->ij", d, d) for d in across]
    mean = sum(c.sum() for c in contrast) / max(sum(c.size for c in contrast), 1)
    pairs: Sequence[tuple[Any, Any]] = (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])
    measured, weights = depth_m > 0, []
    for (a, b), c in zip(pairs, contrast, strict=True):
        jump = np.where(measured[a] & measured[b], (depth_m[a] - depth_m[b]) / np.maximum(step_m[a], step_m[b]), 0)
        w = np.exp(-c / (2 * mean + 1e-6) - np.minimum(jump * jump, 20))
        weights.append(np.maximum(np.where(measured[a] ^ measured[b], _INTO_THE_UNMEASURED * w, w), _LOOSE))
    return weights[0], weights[1]


def walk(
    target: np.ndarray,
    strength: np.ndarray,
    weights: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    steps: int = _STEPS,
) -> np.ndarray:
    """(H, W) float32 in [0, 1]: the x that minimises sum strength (x - target)^2 + sum weights (x_i - x_j)^2.

    target, strength (H, W) float32, the latter at least 0; ``start`` is where the conjugate gradients begin.
    """
    from scipy.sparse import diags_array
    from scipy.sparse.linalg import cg

    columns = target.shape[1]
    right, below = np.pad(weights[0], ((0, 0), (0, 1))).ravel()[:-1], weights[1].ravel()
    degree = strength.ravel() + np.float32(1e-9)
    degree[:-1] += right
    degree[1:] += right
    degree[:-columns] += below
    degree[columns:] += below
    # Scaled to a unit diagonal, which spares a preconditioner.
    scale = 1 / np.sqrt(degree)
    right, below = right * scale[:-1] * scale[1:], below * (scale[:-columns] * scale[columns:])
    system = diags_array([np.ones_like(degree), -right, -right, -below, -below], offsets=[0, 1, -1, columns, -columns])
    evidence, first = (strength * target).ravel() * scale, start.ravel().astype(np.float32) / scale
    x, _ = cg(system, evidence, first, rtol=0, atol=_SETTLED * np.sqrt(degree.size), maxiter=steps)
    x *= scale
    return np.clip(x.reshape(target.shape), 0, 1)


def sharpen(
    target: np.ndarray, strength: np.ndarray, weights: tuple[np.ndarray, np.ndarray], start: np.ndarray
) -> np.ndarray:
    """(H, W) float32 in [0, 1]: a walk with absolute differences instead of squared ones, which shortens the outline.

    Approximates the x that minimises sum strength |x - target| + sum weights |x_i - x_j|, a minimum cut, by iteratively
    reweighted least squares: two walks, each from the one before.
    """
    x, (right, below) = start, weights
    for least in _LEAST_DIFFERENCE:
        across = np.abs(x[:, 1:] - x[:, :-1]), np.abs(x[1:] - x[:-1])
        again = right / np.maximum(across[0], least), below / np.maximum(across[1], least)
        x = walk(target, strength / np.maximum(np.abs(x - target), least), again, x)
    return x
