"""Rigid motions between two sets of points, with and without wrong pairs among them.

All functions take pairs p_b, p_a (N, 3) of the same points in two frames and find T_a_b. :func:`fit_rigid` is least
squares; :func:`ransac` and :func:`consensus` find the motion that most pairs agree on, from random samples and from
pairs of equal length; :func:`refit` improves a motion on the pairs that agree with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3

# Weight (m^2) that holds a fit at its prior's rotation where the points say nothing (a line's roll).
# Points spread over a centimetre outweigh it a thousandfold.
_PRIOR_INERTIA_M2 = 1e-6
_REFITS = 5
# RANSAC draws this many samples at once, and stops when the chance that no sample so far was free of
# outliers, taking the best consensus for the truth, is below this.
_BATCH, _MISSED = 100, 1e-3
# Triples of pairs that the deterministic consensus starts from.
_TRIPLES = 100


def fit_rigid(p_b: np.ndarray, p_a: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """The T_a_b (..., 4, 4) that minimises sum of w |p_a - T p_b|^2 (paper: eq. corres_svd).

    p_b, p_a (..., N, 3) finite, weights (..., N) at least 0. Always a proper rotation: never a
    reflection. Where the points leave directions free (collinear, coincident, fewer than three) the
    rotation is one of the many that fit.
    """
    return fit_rigid_inertia(p_b, p_a, weights)[0]


def fit_rigid_inertia(
    p_b: np.ndarray, p_a: np.ndarray, weights: np.ndarray | None = None, R_prior: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`fit_rigid`, and the inertia (...,) in m^2 of the points about their long axis.

    R_prior  (3, 3) the rotation to keep where the points leave it free
    """
    p_b, p_a = np.asarray(p_b, float), np.asarray(p_a, float)
    w = np.ones(p_b.shape[:-1]) if weights is None else np.asarray(weights, float)
    total = np.maximum(w.sum(-1), np.finfo(float).tiny)[..., None]
    mean_b = np.einsum("...n,...ni->...i", w, p_b) / total
    mean_a = np.einsum("...n,...ni->...i", w, p_a) / total
    centred = (p_a - mean_a[..., None, :]) * w[..., None]
    H = np.swapaxes(centred, -1, -2) @ (p_b - mean_b[..., None, :])
    if R_prior is not None:
        H = H + _PRIOR_INERTIA_M2 * R_prior
    U, s, Vt = np.linalg.svd(H)
    proper = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    U[..., 2] *= proper[..., None]
    R = U @ Vt
    t = mean_a - np.einsum("...ij,...j->...i", R, mean_b)
    return se3.from_rt(R, t), s[..., 1] + proper * s[..., 2]


def residual_m(T_a_b: np.ndarray, p_b: np.ndarray, p_a: np.ndarray) -> np.ndarray:
    """(..., N) distances between p_a and T_a_b p_b, of transformations (..., 4, 4)."""
    error = se3.transform(T_a_b, p_b) - p_a
    return np.sqrt(np.einsum("...i,...i->...", error, error))


def ransac(
    p_b: np.ndarray,
    p_a: np.ndarray,
    limit_m: np.ndarray,
    sample_size: int,
    iterations: int,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """The T_a_b with the most inliers, residual at most limit_m (N,); None without any.

    Samples come in batches until a better consensus is unlikely to have been missed.
    """
    best, best_score, missed = None, -np.inf, 1.0
    for drawn in range(0, iterations, _BATCH):
        size = min(_BATCH, iterations - drawn)
        T, score = _best_of_batch(p_b, p_a, limit_m, sample_size, size, rng)
        if score > best_score:
            best, best_score = T, score
            missed = 1 - (np.ceil(score) / len(p_b)) ** sample_size
        if missed ** (drawn + size) < _MISSED:
            break
    return best


def _best_of_batch(
    p_b: np.ndarray, p_a: np.ndarray, limit_m: np.ndarray, sample_size: int, size: int, rng: np.random.Generator
) -> tuple[np.ndarray | None, float]:
    """The best pose of ``size`` samples and its inliers, less a fraction of one for how loosely they fit."""
    order = rng.random((size, len(p_b)), np.float32)
    sample = np.argpartition(order, sample_size - 1, axis=1)[:, :sample_size]
    sample = sample[_lengths_agree(p_b[sample], p_a[sample], limit_m[sample])]
    if not len(sample):
        return None, -np.inf
    T = fit_rigid(p_b[sample], p_a[sample])
    relative = residual_m(T, p_b, p_a) / limit_m
    agrees = relative <= 1
    score = agrees.sum(1) - np.sum(np.where(agrees, relative, 0), 1) / (len(p_b) + 1)
    best = np.argmax(score)
    return T[best], float(score[best])


def _lengths_agree(p_b: np.ndarray, p_a: np.ndarray, limit_m: np.ndarray) -> np.ndarray:
    """Which samples (S, k, 3) keep the distances between successive points: no rigid motion fits the others."""
    length_b, length_a = (np.linalg.norm(p - np.roll(p, 1, axis=1), axis=-1) for p in (p_b, p_a))
    return (np.abs(length_b - length_a) <= limit_m + np.roll(limit_m, 1, axis=1)).all(1)


@dataclass(frozen=True, eq=False)
class RigidFit:
    """A motion and the pairs that agree with it.

    T_a_b       (4, 4)
    inliers     (N,) bool
    residual_m  (N,) of all pairs
    inertia_m2  of the inliers about their long axis: small where they do not determine the rotation
    """

    T_a_b: np.ndarray
    inliers: np.ndarray
    residual_m: np.ndarray
    inertia_m2: float


def refit(
    T_a_b: np.ndarray,
    p_b: np.ndarray,
    p_a: np.ndarray,
    limit_m: np.ndarray,
    weights: np.ndarray,
    min_inliers: int,
    among: np.ndarray,
    R_prior: np.ndarray | None = None,
) -> RigidFit | None:
    """Refits on the inliers, weights (N,), until they stay the same; None if fewer than min_inliers remain.

    Fitting and choosing inliers in turn lowers the truncated cost, sum of w min(r, limit)^2, at each step.
    among  (N,) bool: pairs that may be inliers
    """
    inliers = among & (residual_m(T_a_b, p_b, p_a) <= limit_m)
    for _ in range(_REFITS):
        if inliers.sum() < min_inliers:
            return None
        fitted = inliers
        T_a_b, inertia_m2 = fit_rigid_inertia(p_b[fitted], p_a[fitted], weights[fitted], R_prior)
        residual = residual_m(T_a_b, p_b, p_a)
        inliers = among & (residual <= limit_m)
        if np.array_equal(inliers, fitted):
            break
    return RigidFit(T_a_b, inliers, residual, float(inertia_m2)) if inliers.sum() >= min_inliers else None


def consensus(
    p_b: np.ndarray, p_a: np.ndarray, inlier_m: float, source: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The T_a_b that most pairs agree on, and who does (N,) bool; deterministic, for few right among many wrong.

    source  (N,) what each pair is made of: several pairs of one source count once

    Two pairs go together if they are equally far apart in both frames. Triples are made of those that most others
    go together with, so that a few right pairs among many wrong ones suffice.
    """
    no_inliers = np.eye(4), np.zeros(len(p_b), bool)
    if len(p_b) < 3:
        return no_inliers
    apart_b, apart_a = (np.linalg.norm(p[:, None] - p[None], axis=-1) for p in (p_b, p_a))
    together = (np.abs(apart_b - apart_a) < inlier_m) & (np.minimum(apart_b, apart_a) > 2 * inlier_m)
    C = together.astype(np.float32)
    votes = C @ C * C
    i, j = np.unravel_index(np.argsort(-np.triu(votes), axis=None, kind="stable")[:_TRIPLES], votes.shape)
    k = np.where(together[i] & together[j], votes[i] + votes[j], -1).argmax(1)
    sample = np.stack([i, j, k], 1)[votes[i, j] > 0]
    if not len(sample):
        return no_inliers
    weight = np.ones(len(p_b)) if source is None else 1 / np.bincount(source, minlength=source.max() + 1)[source]
    T = fit_rigid(p_b[sample], p_a[sample])
    for _ in range(2):
        inliers = residual_m(T, p_b, p_a) < inlier_m
        best = inliers[(inliers @ weight).argmax()]
        if best.sum() < 3:
            return no_inliers
        T = fit_rigid(p_b[best], p_a[best])[None]
    return T[0], best
