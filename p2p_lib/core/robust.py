"""Rigid motions between two sets of points, with and without wrong pairs among them.

All functions take pairs p_b, p_a (N, 3) of the same points in two frames and find T_a_b. :func:`fit_rigid` is least
squares; :func:`ransac` and :func:`consensus` find the motion that most pairs agree on, from random samples and from
pairs of equal length; :func:`refit` improves a motion on the pairs that agree with it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.compiled import compiled

# Weight (m^2) that holds a fit at its prior's rotation where the points say nothing (a line's roll).
# Points spread over a centimetre outweigh it a thousandfold.
_PRIOR_INERTIA_M2 = 1e-6
_REFITS = 5
# RANSAC draws at least so many samples, for one that fits tightly, and stops when the chance that none was free of
# outliers, with the best consensus for the truth, is below this.
_SAMPLES, _MISSED = 40, 1e-3
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
    p_b: np.ndarray, p_a: np.ndarray, weights: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """As :func:`fit_rigid`, and the inertia (...,) in m^2 of the points about their long axis."""
    p_b, p_a = np.asarray(p_b, float), np.asarray(p_a, float)
    w = np.ones(p_b.shape[:-1]) if weights is None else np.asarray(weights, float)
    several, (n, _) = p_b.shape[:-2], p_b.shape[-2:]
    p_a, w = np.broadcast_to(p_a, p_b.shape).copy(), np.broadcast_to(w, p_b.shape[:-1]).copy()
    arrays = p_b.reshape(-1, n, 3), p_a.reshape(-1, n, 3), w.reshape(-1, n)
    T, inertia_m2 = _fits(*map(np.ascontiguousarray, arrays))
    return T.reshape(*several, 4, 4), inertia_m2.reshape(several)


@compiled("f8[:,:,::1], f8[:,:,::1], f8[:,::1]")
def _fits(p_b: np.ndarray, p_a: np.ndarray, w: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    T, inertia_m2, nothing = np.zeros((len(p_b), 4, 4)), np.zeros(len(p_b)), np.zeros((3, 3))
    for n in range(len(p_b)):
        inertia_m2[n] = _fit(p_b[n], p_a[n], w[n], nothing, T[n])
    return T, inertia_m2


@compiled()
def _fit(p_b: np.ndarray, p_a: np.ndarray, w: np.ndarray, prior: np.ndarray, T: np.ndarray) -> float:
    """Into T (4, 4) the motion of one set; returns the inertia. ``prior`` (3, 3) is added to the cross-covariance."""
    mean_b, mean_a, H, total = np.zeros(3), np.zeros(3), prior.copy(), 1e-300
    for n in range(len(w)):
        total += w[n]
        for i in range(3):
            mean_b[i] += w[n] * p_b[n, i]
            mean_a[i] += w[n] * p_a[n, i]
    mean_b, mean_a = mean_b / total, mean_a / total
    for n in range(len(w)):
        for i in range(3):
            for j in range(3):
                H[i, j] += w[n] * (p_a[n, i] - mean_a[i]) * (p_b[n, j] - mean_b[j])
    U, s, Vt = np.linalg.svd(H)
    R = U @ Vt
    proper = 1.0 if _determinant(R) > 0 else -1.0
    for i in range(3):
        U[i, 2] *= proper
    R = U @ Vt
    at, T[3, 3] = mean_a - R @ mean_b, 1.0
    for i in range(3):  # that a slice may not fit takes as long to compile as all else
        T[i, 0], T[i, 1], T[i, 2], T[i, 3] = R[i, 0], R[i, 1], R[i, 2], at[i]
    return s[1] + proper * s[2]


@compiled()
def _determinant(M: np.ndarray) -> float:
    """Of a matrix (3, 3), without the half second in which that of LAPACK is compiled."""
    minors = M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1], M[1, 2] * M[2, 0] - M[1, 0] * M[2, 2]
    return M[0, 0] * minors[0] + M[0, 1] * minors[1] + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])


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

    Of those with equally many, the one that fits the tightest. Samples are drawn until a better consensus is unlikely
    to have been missed.
    """
    drawn = rng.random((iterations, sample_size))
    T, score = _ransac(*(np.ascontiguousarray(a, float) for a in (p_b, p_a, limit_m, drawn)))
    return T if score > 0 else None


@compiled("f8[:,::1], f8[:,::1], f8[::1], f8[:,::1]")
def _ransac(p_b: np.ndarray, p_a: np.ndarray, limit_m: np.ndarray, drawn: np.ndarray) -> tuple[np.ndarray, float]:
    """The best motion and its inliers, less a fraction of one for how loosely they fit; drawn (S, k) from 0 to 1."""
    count, size = len(p_b), drawn.shape[1]
    order, even, nothing = np.arange(count), np.ones(size), np.zeros((3, 3))
    T, best, best_score, missed = np.eye(4), np.eye(4), 0.0, 1.0
    for s in range(len(drawn)):
        for i in range(size):
            j = i + int(drawn[s, i] * (count - i))
            order[i], order[j] = order[j], order[i]
        sample = order[:size]
        if not _lengths_agree(p_b, p_a, limit_m, sample):
            continue
        _fit(p_b[sample], p_a[sample], even, nothing, T)
        score = 0.0
        for n in range(count):
            relative = _residual_m(T, p_b[n], p_a[n]) / limit_m[n]
            score += 1 - relative / (count + 1) if relative <= 1 else 0.0
        if score > best_score:
            best, best_score = T.copy(), score
            missed = 1 - (np.ceil(score) / count) ** size
        if s + 1 >= _SAMPLES and missed ** (s + 1) < _MISSED:
            break
    return best, best_score


@compiled()
def _residual_m(T: np.ndarray, p_b: np.ndarray, p_a: np.ndarray) -> float:
    squared = 0.0
    for i in range(3):
        squared += (T[i, 0] * p_b[0] + T[i, 1] * p_b[1] + T[i, 2] * p_b[2] + T[i, 3] - p_a[i]) ** 2
    return np.sqrt(squared)


@compiled()
def _lengths_agree(p_b: np.ndarray, p_a: np.ndarray, limit_m: np.ndarray, sample: np.ndarray) -> bool:
    """Whether a sample keeps the distances between successive points: no rigid motion fits it otherwise."""
    for i in range(len(sample)):
        m, n = sample[i - 1], sample[i]
        length_b, length_a = np.sqrt(((p_b[m] - p_b[n]) ** 2).sum()), np.sqrt(((p_a[m] - p_a[n]) ** 2).sum())
        if abs(length_b - length_a) > limit_m[m] + limit_m[n]:
            return False
    return True


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
    among    (N,) bool: pairs that may be inliers
    R_prior  (3, 3) the rotation to keep where the points leave it free
    """
    prior = np.zeros((3, 3)) if R_prior is None else _PRIOR_INERTIA_M2 * R_prior
    arrays = [*(np.ascontiguousarray(a, float) for a in (T_a_b, p_b, p_a, limit_m, weights)), min_inliers, among, prior]
    T, inliers, residual, inertia_m2 = _refit(*arrays)
    return RigidFit(T, inliers, residual, inertia_m2) if inliers.sum() >= min_inliers else None


@compiled("f8[:,::1], f8[:,::1], f8[:,::1], f8[::1], f8[::1], i8, b1[::1], f8[:,::1]")
def _refit(T_a_b, p_b, p_a, limit_m, weights, min_inliers, among, prior):
    T, residual, inertia_m2, w = T_a_b.copy(), np.empty(len(p_b)), 0.0, np.empty(len(p_b))
    inliers, fitted = np.zeros(len(p_b), np.bool_), np.zeros(len(p_b), np.bool_)
    for turn in range(_REFITS + 1):
        for n in range(len(p_b)):
            residual[n] = _residual_m(T, p_b[n], p_a[n])
            inliers[n] = among[n] and residual[n] <= limit_m[n]
            w[n] = weights[n] if inliers[n] else 0.0
        if turn == _REFITS or inliers.sum() < min_inliers or (turn > 0 and (inliers == fitted).all()):
            break
        fitted = inliers.copy()
        inertia_m2 = _fit(p_b, p_a, w, prior, T)
    return T, inliers, residual, inertia_m2


def consensus(
    p_b: np.ndarray, p_a: np.ndarray, inlier_m: float, source: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The T_a_b that most pairs agree on, and who does (N,) bool; deterministic, for few right among many wrong.

    source  (N,) what each pair is made of: several pairs of one source count once

    Two pairs go together if they are equally far apart in both frames. Triples are made of those that most others
    go together with, so that a few right pairs among many wrong ones suffice.
    """
    from scipy.spatial.distance import cdist

    no_inliers = np.eye(4), np.zeros(len(p_b), bool)
    if len(p_b) < 3:
        return no_inliers
    apart_b, apart_a = cdist(p_b, p_b), cdist(p_a, p_a)
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
