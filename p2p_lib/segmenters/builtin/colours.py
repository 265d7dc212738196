"""What colours an object has: histograms, and how much more a colour speaks for the object than for the rest."""

from __future__ import annotations

import numpy as np

_BINS = 16  # per channel
_COLOURS = _BINS**3
#: A share of pixels so small says nothing: colours seen on neither side have no opinion.
_RARE = 2e-4
#: No colour speaks louder than this, in nats: shadows and highlights repeat each other's colours.
_LOUDEST = 3.0

_BLUR = np.exp(-0.5 * ((np.arange(_BINS)[:, None] - np.arange(_BINS)) / 0.7) ** 2)
_BLUR /= _BLUR.sum(0)


def colour_codes(rgb: np.ndarray) -> np.ndarray:
    """The bin (...,) int of every colour of (..., 3) uint8."""
    q = (rgb >> 4).astype(np.int32)
    return (q[..., 0] * _BINS + q[..., 1]) * _BINS + q[..., 2]


def histogram(codes: np.ndarray, weights: np.ndarray | None = None) -> np.ndarray:
    """(4096,) shares of the colours of some pixels, each bled a little into its neighbours; zeros for none.

    codes, weights  (N,) the pixels' colours, and how much each pixel counts; all alike where that is None
    """
    total = codes.size if weights is None else weights.sum()
    counts = np.bincount(codes, weights, _COLOURS).reshape(_BINS, _BINS, _BINS) / max(total, 1e-9)
    for _ in range(3):  # along one axis at a time; each turn brings the next one to the front
        counts = np.tensordot(counts, _BLUR, (0, 1))
    return counts.ravel()


def evidence(own: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(4096,) log of how much likelier each colour is among ``own`` than among ``other`` shares, bounded."""
    return np.clip(np.log((own + _RARE) / (other + _RARE)), -_LOUDEST, _LOUDEST)
