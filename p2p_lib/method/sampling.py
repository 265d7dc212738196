"""Where to put new points (paper: section "Sampling Strategy and Keypoints Map").

Candidates come from a detector with a score in [0, 1]; the greedy objective
J_k = lambda s_k + (1 - lambda) min(d_k / r_ideal, 1) - beta rho(d_k) picks among them, where d_k is
the distance to all points chosen so far and to those stored and visible.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.depth import of_one_surface
from p2p_lib.core.image import bounds
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Frame

#: Points keep this distance to the mask's border (the release's).
_EDGE_MARGIN_PX = 2


@dataclass(frozen=True, eq=False)
class Terms:
    """The three terms of J with their weights and signs, each of the shape of the scores; their sum is J.

    trackability  lambda s, 0 or more
    spread        (1 - lambda) min(d / r_ideal, 1), 0 or more
    crowding      -beta rho(d), 0 or less
    """

    trackability: np.ndarray
    spread: np.ndarray
    crowding: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """J."""
        return self.trackability + self.spread + self.crowding


def terms(score: np.ndarray, d_px: np.ndarray, config: SamplingConfig) -> Terms:
    """The terms of J for scores at distances d_px from the nearest point chosen or stored."""
    lam = config.score_weight
    spread = np.minimum(d_px / config.r_ideal_px, 1)
    crowding = np.maximum(0, (config.r_min_px - d_px) / config.r_min_px) if config.r_min_px > 0 else 0.0 * spread
    return Terms(lam * score, (1 - lam) * spread, -config.cluster_weight * crowding)


def choose(candidates: Candidates, stored_px: np.ndarray, count: int, config: SamplingConfig) -> np.ndarray:
    """Indices of up to ``count`` candidates in the order taken, greedily maximising J.

    ``stored_px`` (M, 2) are the map's points visible in this frame.
    """
    n = len(candidates.score)
    if not n:
        return np.zeros(0, int)
    d = distance_px(candidates.uv_px, stored_px)
    chosen: list[int] = []
    free = np.ones(n, bool)
    for _ in range(min(count, n)):
        J = np.where(free, terms(candidates.score, d, config).total, -np.inf)
        best = int(J.argmax())
        # The paper does not say when to stop short of K points: here, once the best candidate left is worth nothing.
        if J[best] <= 0:
            break
        chosen.append(best)
        free[best] = False
        d = np.minimum(d, np.linalg.norm(candidates.uv_px - candidates.uv_px[best], axis=1))
    return np.array(chosen, int)


def distance_px(uv_px: np.ndarray, others_px: np.ndarray) -> np.ndarray:
    """d_k of the objective: distance (N,) from pixels (N, 2) to the nearest of others (M, 2); infinite without any."""
    from scipy.spatial.distance import cdist

    if not len(others_px):
        return np.full(len(uv_px), np.inf)
    return cdist(uv_px, others_px).min(1)


def usable_region(frame: Frame, mask: np.ndarray, edge_m: float, narrow: bool = True) -> np.ndarray:
    """(H, W) bool: where points can be lifted, by :func:`~p2p_lib.core.depth.of_one_surface`."""
    cut, region = bounds(mask, 1), np.zeros(mask.shape, bool)
    if mask.any():
        region[cut] = of_one_surface(frame.depth_m[cut], mask[cut], _EDGE_MARGIN_PX, edge_m, narrow)
    return region
