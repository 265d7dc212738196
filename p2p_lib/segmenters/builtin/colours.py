"""The colours of an object: histograms, and the log-odds of a colour for the object against the rest."""

from __future__ import annotations

import numpy as np

_BINS = 16  # per channel
_COLOURS = _BINS**3
#: Added to all shares: colours seen on neither side, or hardly, are neutral.
_RARE = 2e-4
#: Bound of a colour's log-odds, nats: object and background share the colours of shadows and highlights.
_LOUDEST = 3.0

_BLUR = np.exp(-0.5 * ((np.arange(_BINS)[:, None] - np.arange(_BINS)) / 0.7) ** 2)
_BLUR /= _BLUR.sum(0)


def colour_codes(rgb: np.ndarray) -> np.ndarray:
    """The histogram bin (...,) int of every colour (..., 3) uint8."""
    q = (rgb >> 4).astype(np.int32)
    return (q[..., 0] * _BINS + q[..., 1]) * _BINS + q[..., 2]


def histogram(codes: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """(4096,) shares of the colours of some pixels, blurred a little; zeros without pixels.

    codes, weights  (N,) the pixels' colours by :func:`colour_codes`, and their weights; None: all the same
    """
    total = codes.size if weights is None else weights.sum()
    counts = np.bincount(codes, weights, _COLOURS).reshape(_BINS, _BINS, _BINS) / max(total, 1e-9)
    for _ in range(3):  # one axis at a time; tensordot moves the next one to the front
        counts = np.tensordot(counts, _BLUR, (0, 1))
    return counts.ravel()


def evidence(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(4096,) log of how much likelier each colour is by ``own`` than by ``other`` shares (4096,), bounded."""
    return np.clip(np.log((own + _RARE) / (other + _RARE)), -_LOUDEST, _LOUDEST)
