"""Frame-to-map registration: from 3D correspondences to several candidate poses (paper: "Frame-to-Map Registration").

:func:`register` runs sequential RANSAC + SVD; the dense surface tells which of its hypotheses is right
(:mod:`p2p_lib.method.selection`). :func:`covariance` says how well the correspondences determine each direction of
the chosen pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from p2p_lib.core import robust, se3
from p2p_lib.core.config import RegistrationConfig
from p2p_lib.core.robust import fit_rigid_inertia

# Points count as collinear when noise of a third of the inlier threshold would turn them about their
# long axis by this or more.
_DETERMINED_RAD = 0.35
# What is known of a pose before any point is seen: keeps covariances finite.
_UNKNOWN_RAD, _UNKNOWN_M = np.pi, 1.0
#: An inlier's residual is at most this many standard deviations of the point's noise, where that is known.
_INLIER_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A candidate pose T^C_O with the correspondences that speak for it.

    T_cam_obj   (4, 4)
    inliers     (N,) bool, the consensus set; False for rows that were not finite
    residual_m  (N,) distance between p_cam and T_cam_obj p_obj; infinite for rows that were not finite
    origin      "ransac 1", "ransac 2", ..., "svd", or the name of the prior it was refit from
    """

    T_cam_obj: np.ndarray
    inliers: np.ndarray
    residual_m: np.ndarray
    origin: str

    @property
    def support(self) -> int:
        """The number of inliers."""
        return int(self.inliers.sum())


def register(
    p_obj: np.ndarray,
    p_cam: np.ndarray,
    config: RegistrationConfig,
    rng: np.random.Generator,
    *,
    sigma_m: np.ndarray | None = None,
    priors: Mapping[str, np.ndarray] | None = None,
) -> list[Hypothesis]:
    """The hypotheses that correspondences p_obj, p_cam (N, 3) support: RANSAC's in its order, then those of priors.

    ``config.method`` is "sequential_ransac", the paper's: the transformation with the most inliers, its consensus set
    removed, and again on the rest; or "svd", its ablation: one fit to all, outliers removed by the threshold, a second
    fit. Rows that are not finite are ignored. Too few points, or collinear ones without a prior: an empty list.

    sigma_m  (N,) noise of each p_cam: the threshold grows with it, and RANSAC's and priors' fits are weighted by it.
             None: one threshold for all
    priors   name to T_cam_obj (4, 4): poses that compete beside RANSAC's, refit on the points that agree with them
    """
    matches, usable = _Matches.of(p_obj, p_cam, sigma_m, config)
    if len(matches.p_obj) < max(3, config.min_inliers):
        return []
    if config.method == "svd":
        found = _svd_twice(matches, config)
    else:
        found = _sequential(matches, config, rng) + _from_priors(matches, priors or {}, config)
    distinct = _without_duplicates(found, matches, config)[: config.max_hypotheses]
    return [_in_all_rows(hypothesis, usable) for hypothesis in distinct]


def refit(
    T_cam_obj: np.ndarray,
    origin: str,
    p_obj: np.ndarray,
    p_cam: np.ndarray,
    config: RegistrationConfig,
    sigma_m: np.ndarray | None = None,
) -> list[Hypothesis]:
    """A given pose refit on the correspondences that agree with it: one hypothesis, or none."""
    matches, usable = _Matches.of(p_obj, p_cam, sigma_m, config)
    return [_in_all_rows(hypothesis, usable) for hypothesis in _from_priors(matches, {origin: T_cam_obj}, config)]


def covariance(hypothesis: Hypothesis, p_obj: np.ndarray, p_cam: np.ndarray, sigma_m: np.ndarray | float) -> np.ndarray:
    """(6, 6) covariance of the pose: right tangent of T_cam_obj, [rotation rad, translation m].

    The inverse of the information that the inliers carry when each p_cam (N, 3) has noise sigma_m
    (isotropic, per row or one for all), inflated when the residuals are larger than that noise
    explains. Finite and positive definite for any input: directions that the points leave free get
    the variance of not knowing (pi rad, 1 m).
    """
    p_obj, p_cam = np.asarray(p_obj, float), np.asarray(p_cam, float)
    sigma_m = np.broadcast_to(np.asarray(sigma_m, float), p_obj.shape[:1])
    rows = hypothesis.inliers & np.isfinite(p_obj).all(1) & np.isfinite(p_cam).all(1) & (sigma_m > 0)
    p, weight = p_obj[rows], 1 / sigma_m[rows] ** 2
    residual = p_cam[rows] - se3.transform(hypothesis.T_cam_obj, p)
    jacobian = np.concatenate([-se3.hat(p), np.broadcast_to(np.eye(3), (len(p), 3, 3))], -1)
    information = np.einsum("n,nki,nkj->ij", weight, jacobian, jacobian)
    degrees_of_freedom = 3 * len(p) - 6
    excess = np.sum(weight[:, None] * residual**2) / degrees_of_freedom if degrees_of_freedom > 0 else 1.0
    unknown = np.diag(np.repeat([_UNKNOWN_RAD**-2, _UNKNOWN_M**-2], 3))
    result = np.linalg.inv(information / max(excess, 1.0) + unknown)
    return (result + result.T) / 2


@dataclass(frozen=True, eq=False)
class _Matches:
    """The finite correspondences (N, 3), each with its inlier threshold (m) and its weight in fits."""

    p_obj: np.ndarray
    p_cam: np.ndarray
    limit_m: np.ndarray
    weight: np.ndarray

    @classmethod
    def of(cls, p_obj, p_cam, sigma_m, config: RegistrationConfig) -> tuple[_Matches, np.ndarray]:
        """The finite rows, and (N,) bool which ones they are."""
        p_obj, p_cam = np.asarray(p_obj, float).reshape(-1, 3), np.asarray(p_cam, float).reshape(-1, 3)
        usable = np.isfinite(p_obj).all(1) & np.isfinite(p_cam).all(1)
        if sigma_m is not None:
            usable &= np.isfinite(sigma_m) & (sigma_m > 0)
        p_obj, p_cam = p_obj[usable], p_cam[usable]
        limit, weight = np.full(len(p_obj), config.inlier_m), np.ones(len(p_obj))
        if sigma_m is not None and len(p_obj):
            sigma_m = sigma_m[usable]
            limit = np.maximum(config.inlier_m, _INLIER_SIGMAS * sigma_m)
            weight = (sigma_m.mean() / sigma_m) ** 2
        return cls(p_obj, p_cam, limit, weight), usable


def _determined(inertia_m2: np.ndarray | float, limit_m: float) -> bool:
    return bool(inertia_m2 > (limit_m / 3 / _DETERMINED_RAD) ** 2)


def _sequential(matches: _Matches, config: RegistrationConfig, rng: np.random.Generator) -> list[Hypothesis]:
    pool = np.ones(len(matches.p_obj), bool)
    found: list[Hypothesis] = []
    for _ in range(config.max_hypotheses):
        if pool.sum() < max(config.sample_size, config.min_inliers):
            break
        drawn = matches.p_obj[pool], matches.p_cam[pool], matches.limit_m[pool]
        T = robust.ransac(*drawn, config.sample_size, config.iterations, rng)
        refit = None if T is None else _refit(T, matches, pool, f"ransac {len(found) + 1}", config)
        if refit is None:
            break
        hypothesis, determined = refit
        pool &= ~hypothesis.inliers
        if determined:  # else collinear points, removed to uncover other hypotheses
            found.append(hypothesis)
    return found


def _refit(
    T: np.ndarray,
    matches: _Matches,
    pool: np.ndarray,
    origin: str,
    config: RegistrationConfig,
    R_prior: np.ndarray | None = None,
) -> tuple[Hypothesis, bool] | None:
    """The hypothesis refit on its inliers in ``pool`` (N,) bool, and whether they fix its turn; None with too few."""
    m = matches
    fit = robust.refit(T, m.p_obj, m.p_cam, m.limit_m, m.weight, config.min_inliers, pool, R_prior)
    if fit is None:
        return None
    hypothesis = Hypothesis(fit.T_a_b, fit.inliers, fit.residual_m, origin)
    return hypothesis, _determined(fit.inertia_m2, m.limit_m[fit.inliers].mean())


def _from_priors(matches: _Matches, priors: Mapping[str, np.ndarray], config: RegistrationConfig) -> list[Hypothesis]:
    everything = np.ones(len(matches.p_obj), bool)
    usable = {name: np.asarray(T, float) for name, T in priors.items() if np.isfinite(T).all()}
    refits = [_refit(T, matches, everything, name, config, T[:3, :3]) for name, T in usable.items()]
    return [refit[0] for refit in refits if refit is not None]


def _svd_twice(matches: _Matches, config: RegistrationConfig) -> list[Hypothesis]:
    T, _ = fit_rigid_inertia(matches.p_obj, matches.p_cam)
    kept = robust.residual_m(T, matches.p_obj, matches.p_cam) <= matches.limit_m
    if kept.sum() < config.min_inliers:
        return []
    T, inertia = fit_rigid_inertia(matches.p_obj[kept], matches.p_cam[kept])
    if not _determined(inertia, matches.limit_m.mean()):
        return []
    residual = robust.residual_m(T, matches.p_obj, matches.p_cam)
    return [Hypothesis(T, residual <= matches.limit_m, residual, "svd")]


def _without_duplicates(found: list[Hypothesis], matches: _Matches, config: RegistrationConfig) -> list[Hypothesis]:
    """Drops poses that put every point within a tenth of the threshold of where an earlier pose puts it."""
    if len(found) < 2:
        return found
    placed = se3.transform(np.stack([h.T_cam_obj for h in found]), matches.p_obj)
    apart = np.abs(placed[:, None] - placed[None]).max((2, 3)) > config.inlier_m / 10
    return [h for k, h in enumerate(found) if apart[k, :k].all()]


def _in_all_rows(hypothesis: Hypothesis, usable: np.ndarray) -> Hypothesis:
    """The hypothesis with its rows put back among those that were not finite."""
    inliers, residual = np.zeros(len(usable), bool), np.full(len(usable), np.inf)
    inliers[usable], residual[usable] = hypothesis.inliers, hypothesis.residual_m
    return Hypothesis(hypothesis.T_cam_obj, inliers, residual, hypothesis.origin)
