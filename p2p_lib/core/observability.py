"""Which motions of a pose the shape determines, and which it leaves free.

A plane leaves three directions free and a tin one. Whether it does is told by the eigenvalues of the normal
equations, but the normals of noisy depth scatter, and that scatter looks like shape. The products of two neighbours'
Jacobians, whose noise is independent, hold the shape without it.
"""

from __future__ import annotations

import numpy as np

#: The noise of the surface is independent this many voxels apart.
PAIR_VOXELS = 3.0
#: An eigenvalue must exceed this many standard deviations of what gradient noise alone makes of it.
_CLEAR_OF_NOISE = 3.0
#: Fewer pairs than this tell nothing.
_MIN_PAIRS = 10
#: A unit tangent about the cloud's centre rotates, rather than shifts, if this much of it is rotation.
_MOSTLY = 0.5


def eigen(J: np.ndarray, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (6,) ascending and eigenvectors (6, 6), columns, of the mean of J^T J without gradient noise.

    J      (N, 6) derivatives of the points' distances by the pose
    pairs  (2, P) rows of neighbours with independent noise

    The eigenvalues are relative to those of the squared gradient; one that is not clear of noise is 0.
    """
    H = J.T @ J / len(J)
    scale = max(np.trace(H[3:, 3:]), 1e-12)
    count = pairs.shape[1]
    if count < max(_MIN_PAIRS, len(J) // 4):
        value, vector = np.linalg.eigh(H)  # the points lie too far apart for pairs
        return value / scale, vector
    S = J.take(pairs[0], 0).T @ J.take(pairs[1], 0) / count  # take: an index of rows alone is a third as fast
    value, vector = np.linalg.eigh((S + S.T) / 2)
    gradient_noise = np.einsum("ik,ij,jk->k", vector, H, vector) - value
    clear = value > _CLEAR_OF_NOISE * np.abs(gradient_noise) / np.sqrt(count)
    return np.where(clear, np.maximum(value, 0.0), 0.0) / scale, vector


def neighbours(p_cam: np.ndarray, distance_m: float) -> np.ndarray:
    """(2, P) rows of points about ``distance_m`` apart, each point with one to its right and one below it."""
    pairs = []
    for along, across in ((0, 1), (1, 0)):
        strip = np.floor(p_cam[:, across] / (distance_m / 2))
        # Within a strip the keys run along it; strips lie farther apart than any pair.
        key = strip * (np.ptp(p_cam[:, along]) + 4 * distance_m) + p_cam[:, along]
        order = np.argsort(key, kind="stable")
        nearest = np.searchsorted(key[order], key + distance_m)
        first = np.flatnonzero(nearest < len(key))
        pairs.append(np.stack([first, order[nearest[first]]]))
    first, second = found = np.concatenate(pairs, 1)
    apart = np.linalg.norm(p_cam.take(first, 0) - p_cam.take(second, 0), axis=-1)
    near = (apart > distance_m / 2) & (apart < 2 * distance_m)
    return found[:, near]


def rotations_in(tangents: np.ndarray) -> np.ndarray:
    """(6, T) the rotations in the span of orthonormal tangents (6, K), each with a unit of rotation."""
    if not tangents.size:
        return np.zeros((6, 0))
    _, size, mix = np.linalg.svd(tangents[:3])
    size, mix = size[size > _MOSTLY], mix[: len(size)][size > _MOSTLY]
    return tangents @ mix.T / size
