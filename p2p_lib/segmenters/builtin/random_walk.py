"""Cutting an image in two: a random walker with priors (Grady 2005) on a small RGB-D grid.

Every pixel is pulled towards object or background by its own evidence and tied to its neighbours, less
where colour and depth change between them. The answer is the probability that a walker who
starts at the pixel and prefers large edge weights ends at the object: the minimum of a quadratic energy.
"""

from __future__ import annotations

import numpy as np

#: Edge weight across the strongest contrast: no pixel is ever quite alone.
_LOOSE = 1e-4
#: Factor of the edge weight between a measured and an unmeasured pixel: depth is missing mostly beside silhouettes.
_INTO_THE_UNMEASURED = 0.05
#: Conjugate gradients end when the preconditioned residual falls below this, or after so many steps.
_SETTLED, _STEPS = 1e-6, 40


def edge_weights(colour: np.ndarray, depth_m: np.ndarray, step_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights in (0, 1] of neighbours along a row (H, W-1) and along a column (H-1, W).

    colour (H, W, C) float, its contrast is judged by the image's own mean; depth_m (H, W), 0 = not measured;
    step_m (H, W): a depth step of this size is an edge.
    """
    across = colour[:, 1:] - colour[:, :-1], colour[1:] - colour[:-1]
    contrast = [(d * d).sum(-1) for d in across]
    mean = np.concatenate([c.ravel() for c in contrast]).mean() if colour.size else 0.0
    pairs = (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])
    weights = []
    for (a, b), c in zip(pairs, contrast, strict=True):
        measured = (depth_m[a] > 0).astype(np.int8) + (depth_m[b] > 0)
        jump = np.where(measured == 2, (depth_m[a] - depth_m[b]) / np.maximum(step_m[a], step_m[b]), 0)
        w = np.exp(-c / (2 * mean + 1e-6) - np.minimum(jump * jump, 20))
        weights.append(np.maximum(np.where(measured == 1, _INTO_THE_UNMEASURED * w, w), _LOOSE).astype(np.float32))
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
    across, down = weights
    degree = strength.copy()
    degree[:, :-1] += across
    degree[:, 1:] += across
    degree[:-1] += down
    degree[1:] += down

    def apply(x: np.ndarray) -> np.ndarray:
        y = degree * x
        y[:, :-1] -= across * x[:, 1:]
        y[:, 1:] -= across * x[:, :-1]
        y[:-1] -= down * x[1:]
        y[1:] -= down * x[:-1]
        return y

    inverse = 1 / (degree + 1e-9)
    x = start.astype(np.float32)
    residual = strength * target - apply(x)
    step = scaled = inverse * residual
    size = float((residual * scaled).sum())
    for _ in range(steps):
        if size < _SETTLED:
            break
        image = apply(step)
        length = size / float((step * image).sum())
        x, residual = x + length * step, residual - length * image
        scaled = inverse * residual
        size, before = float((residual * scaled).sum()), size
        step = scaled + (size / before) * step
    return np.clip(x, 0, 1)
