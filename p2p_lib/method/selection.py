"""Which pose hypothesis to go on with (paper: "Multi-Hypothesis Pose Generation and Selection").

The paper takes the hypothesis whose dense points lie nearest to the surface (rule "surface"). Ours (rule "support")
keeps the one that most keypoints agree with, unless the surface prefers another one significantly: that one fits the
surface, and is nearer to it by more than a small margin and up to ``surface_sigmas`` standard errors of the mean
difference: the fewer, the more keypoints agree with it, too.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from p2p_lib.core.config import SelectionConfig
from p2p_lib.method.registration import Hypothesis

#: A smaller difference of the mean distances does not matter, however certain it is, m.
_MARGIN_M = 2e-4
#: The mean distance of a pose that fits is smaller; else the map is bent, or depth and colour are out of step, m.
_FITS_M = 0.004
#: However many keypoints agree with it, too, this share of the standard errors is asked for.
_LEAST = 0.5


def select(
    hypotheses: Sequence[Hypothesis],
    distance_m: np.ndarray | None,
    config: SelectionConfig,
    weight: np.ndarray | None = None,
) -> tuple[int | None, str]:
    """The row of the hypothesis to go on with, None without any, and why, by ``config.rule``.

    distance_m  (H, N) how far each masked depth point lies from the surface under each pose (absolute TSDF value in
                metres); None while there is no surface
    weight      (H,) factors of the support
    """
    if not hypotheses:
        return None, "no hypothesis: too few correspondences agree"
    if len(hypotheses) == 1:
        return 0, "the only hypothesis"
    support, scores = np.array([h.support for h in hypotheses]) * (1 if weight is None else weight), _scores(distance_m)
    best = _best(hypotheses, support)
    if distance_m is None or scores is None:
        return best, "most inliers; there is no surface to compare with"
    nearest = int(np.argmin(scores))
    if config.rule == "support":
        nearer = distance_m[best] - distance_m[nearest]
        fewer = max(1 - support[nearest] / max(support[best], 1e-9), _LEAST)
        chance = fewer * config.surface_sigmas * np.std(nearer) / np.sqrt(len(nearer))
        chance = chance if np.isfinite(nearer).all() else 0.0
        preferred = scores[best] - scores[nearest] > max(chance, _MARGIN_M) and scores[nearest] < _FITS_M
        if not preferred:
            return best, "most inliers; the surface does not prefer another one beyond chance"
    return nearest, f"nearest to the surface ({1e3 * scores[nearest]:.2f} mm)"


def _best(hypotheses: Sequence[Hypothesis], support: np.ndarray) -> int:
    """The hypothesis with most support (H,), then with the least mean residual."""
    residual_m = np.array([h.residual_m[h.inliers].mean() if h.support else np.inf for h in hypotheses])
    return int(np.lexsort((residual_m, -support))[0])


def _scores(distance_m: np.ndarray | None) -> np.ndarray | None:
    """(H,) mean distances, infinite where one is not finite; None where nothing can be compared."""
    if distance_m is None or not distance_m.size:
        return None
    finite = np.isfinite(distance_m).all(1)
    return np.where(finite, distance_m.mean(1), np.inf) if finite.any() else None
