"""Other sources of candidates than the embedded corners, for comparison (appendix: "Keypoint Sampling Strategies")."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Frame

# Pixels that farthest-point sampling works on; more cost time and change nothing that matters.
_POOL = 4000
# ORB looks at a patch this large around a feature, so this much around the mask is looked at too.
_ORB_PATCH_PX = 31

#: Detector and settings of the appendix's comparison; ``detector only`` takes the best scores, wherever they are.
SAMPLING_VARIANTS: dict[str, tuple[str, dict[str, float]]] = {
    "proposed": ("superpoint", {}),
    "detector only": (
        "superpoint",
        {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0},
    ),
    "uniform": (
        "uniform",
        {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0},
    ),
    "farthest": (
        "farthest",
        {"sampling.score_weight": 1.0, "sampling.cluster_weight": 0.0, "sampling.r_min_px": 0.0},
    ),
}


class CornerDetector:
    """Embedded detector: SIFT blobs, which the embedded tracker can re-detect, and corners, which it follows best.

    The score is the feature's strength relative to the strongest of its kind, blobs above corners.
    """

    name = "corners"

    def __init__(self, config: SamplingConfig, rng: np.random.Generator | None = None):
        self._limit = config.candidates
        self._sift = cv2.SIFT_create(config.candidates, contrastThreshold=0.01, enable_precise_upscale=True)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Candidates in the mask, best first."""
        x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
        if not w:
            return Candidates(np.zeros((0, 2)), np.zeros(0))
        x0, y0 = max(0, x - 16), max(0, y - 16)
        crop = (slice(y0, y + h + 16), slice(x0, x + w + 16))
        gray = cv2.cvtColor(frame.rgb[crop], cv2.COLOR_RGB2GRAY)
        inside = np.ascontiguousarray(mask[crop]).astype(np.uint8)
        blobs = self._sift.detect(gray, inside)
        corners, quality = cv2.goodFeaturesToTrackWithQuality(gray, self._limit, 0.01, 3, inside, blockSize=5)[:2]
        uv, score = [np.zeros((0, 2))], [np.zeros(0)]
        if blobs:
            response = np.array([p.response for p in blobs])
            uv.append(cv2.KeyPoint.convert(blobs))
            score.append(0.5 + 0.5 * response / response.max())
        if corners is not None:
            uv.append(corners.reshape(-1, 2))
            score.append(0.5 * quality.ravel() / quality.max())
        uv_px, score = np.concatenate(uv) + np.array([x0, y0], float), np.concatenate(score).astype(float)
        order = np.argsort(-score, kind="stable")[: self._limit]
        return Candidates(uv_px[order], score[order])


class UniformDetector:
    """Pixels of the mask drawn at random, all of score 1: their order alone says which are taken."""

    name = "uniform"

    def __init__(self, config: SamplingConfig, rng: np.random.Generator | None = None):
        self._limit, self._rng = config.candidates, _generator(rng)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Random pixels of the mask."""
        uv_px = self._rng.permutation(_pixels(mask))[: self._limit]
        return Candidates(uv_px, np.ones(len(uv_px)))


class FarthestDetector:
    """Farthest-point sampling: each next pixel is the one farthest from those before, with a falling score."""

    name = "farthest"

    def __init__(self, config: SamplingConfig, rng: np.random.Generator | None = None):
        self._limit, self._rng = config.candidates, _generator(rng)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Pixels of the mask from the one nearest to its middle outwards."""
        pool = self._rng.permutation(_pixels(mask))[:_POOL]
        count = min(self._limit, len(pool))
        if not count:
            return Candidates(np.zeros((0, 2)), np.zeros(0))
        taken = np.zeros(count, int)
        taken[0] = np.square(pool - pool.mean(0)).sum(1).argmin()
        distance = np.square(pool - pool[taken[0]]).sum(1)
        for k in range(1, count):
            taken[k] = distance.argmax()
            distance = np.minimum(distance, np.square(pool - pool[taken[k]]).sum(1))
        return Candidates(pool[taken], 1 - np.arange(count) / count)


class OrbDetector:
    """ORB's corners (Rublee et al., ICCV 2011), scored relative to the strongest."""

    name = "orb"

    def __init__(self, config: SamplingConfig, rng: np.random.Generator | None = None):
        # The default threshold finds nothing on plain objects.
        self._orb = cv2.ORB_create(config.candidates, edgeThreshold=_ORB_PATCH_PX, fastThreshold=5)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Corners in the mask, best first."""
        x, y, w, h = cv2.boundingRect(mask.astype(np.uint8))
        points = ()
        if w:
            margin = _ORB_PATCH_PX + 1
            x0, y0 = max(0, x - margin), max(0, y - margin)
            crop = (slice(y0, y + h + margin), slice(x0, x + w + margin))
            gray = cv2.cvtColor(frame.rgb[crop], cv2.COLOR_RGB2GRAY)
            points = self._orb.detect(gray, np.ascontiguousarray(mask[crop]).astype(np.uint8))
        if not points:
            return Candidates(np.zeros((0, 2)), np.zeros(0))
        response = np.array([point.response for point in points])
        order = np.argsort(-response, kind="stable")
        uv_px = cv2.KeyPoint.convert(points).astype(float) + np.array([x0, y0])
        return Candidates(uv_px[order], np.clip(response[order] / max(response.max(), 1e-12), 0, 1))


def _pixels(mask: np.ndarray) -> np.ndarray:
    """(N, 2) u, v of a mask's pixels."""
    return np.argwhere(mask)[:, ::-1].astype(float)


def _generator(rng: np.random.Generator | None) -> np.random.Generator:
    return rng if rng is not None else np.random.default_rng(0)
