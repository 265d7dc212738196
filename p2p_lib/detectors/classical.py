"""Sources of candidates without weights: the default, and those of the appendix "Keypoint Sampling Strategies"."""

from __future__ import annotations

import cv2
import numpy as np

from p2p_lib.core.config import SamplingConfig
from p2p_lib.core.image import bounds
from p2p_lib.core.interfaces import Candidates
from p2p_lib.core.types import Frame

# Pixels that farthest-point sampling works on; more cost time and change nothing that matters.
_POOL = 4000
# ORB looks at a patch this large around a feature, so this much around the mask is looked at too.
_ORB_PATCH_PX = 31
# The same for blobs and corners.
_CORNER_PATCH_PX = 16
NO_CANDIDATES = Candidates(np.zeros((0, 2)), np.zeros(0))


class CornerDetector:
    """Built-in detector: SIFT blobs, which the built-in tracker can re-detect, and corners, which it follows best.

    The score is the feature's strength relative to the strongest of its kind, blobs above corners.
    """

    name = "corners"

    def __init__(self, config: SamplingConfig, rng: np.random.Generator | None = None):
        self._limit = config.candidates
        self._sift = cv2.SIFT.create(config.candidates, contrastThreshold=0.01, enable_precise_upscale=True)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Candidates in the mask, best first."""
        if not mask.any():
            return NO_CANDIDATES
        gray, inside, corner_px = _cropped(frame, mask, _CORNER_PATCH_PX)
        blobs = self._sift.detect(gray, inside)
        corners, quality = cv2.goodFeaturesToTrackWithQuality(gray, self._limit, 0.01, 3, inside, blockSize=5)[:2]
        uv: list[np.ndarray] = [np.zeros((0, 2))]
        scores: list[np.ndarray] = [np.zeros(0)]
        if blobs:
            response = np.array([p.response for p in blobs])
            uv.append(np.asarray(cv2.KeyPoint.convert(blobs)))
            scores.append(0.5 + 0.5 * response / response.max())
        if corners is not None:
            uv.append(corners.reshape(-1, 2))
            scores.append(0.5 * quality.ravel() / quality.max())
        uv_px, score = np.concatenate(uv) + corner_px, np.concatenate(scores).astype(float)
        order = np.argsort(-score, kind="stable")[: self._limit]
        return Candidates(uv_px[order], score[order])


class UniformDetector:
    """Pixels of the mask drawn at random, all of score 1: their order alone says which are taken."""

    name = "uniform"

    def __init__(self, config: SamplingConfig, rng: np.random.Generator | None = None):
        self._limit, self._rng = config.candidates, rng or np.random.default_rng(0)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Random pixels of the mask."""
        uv_px = self._drawn(mask, self._limit)
        return Candidates(uv_px, np.ones(len(uv_px)))

    def _drawn(self, mask: np.ndarray, limit: int) -> np.ndarray:
        """(N, 2) u, v of pixels of the mask in random order, at most ``limit``."""
        return self._rng.permutation(np.argwhere(mask)[:, ::-1].astype(float))[:limit]


class FarthestDetector(UniformDetector):
    """Farthest-point sampling: each next pixel is the one farthest from those before, with a falling score."""

    name = "farthest"

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Pixels of the mask from the one nearest to its middle outwards."""
        pool = self._drawn(mask, _POOL)
        count = min(self._limit, len(pool))
        if not count:
            return NO_CANDIDATES
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
        self._orb = cv2.ORB.create(config.candidates, edgeThreshold=_ORB_PATCH_PX, fastThreshold=5)

    def detect(self, frame: Frame, mask: np.ndarray) -> Candidates:
        """Corners in the mask, best first."""
        gray, inside, corner_px = _cropped(frame, mask, _ORB_PATCH_PX + 1)
        points = self._orb.detect(gray, inside) if mask.any() else ()
        if not points:
            return NO_CANDIDATES
        response = np.array([point.response for point in points])
        order = np.argsort(-response, kind="stable")
        uv_px = np.asarray(cv2.KeyPoint.convert(points), float) + corner_px
        return Candidates(uv_px[order], np.clip(response[order] / max(response.max(), 1e-12), 0, 1))


def _cropped(frame: Frame, mask: np.ndarray, margin_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Brightness and mask (h, w) uint8 around the mask, and the pixel (2,) of their upper left corner."""
    rows, columns = bounds(mask, margin_px)
    gray = cv2.cvtColor(frame.rgb[rows, columns], cv2.COLOR_RGB2GRAY)
    return gray, mask[rows, columns].astype(np.uint8), np.array([columns.start, rows.start], float)
