"""Poses over time, as a motion-capture system or a tag detector gives them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput

# A longer gap is not bridged: at 0.3 m/s a hand has moved 3 cm by then.
MAX_GAP_S = 0.1


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """One body's poses on one clock.

    times_s  (M,) seconds, increasing
    T        (M, 4, 4) poses; NaN where the body was not seen
    """

    times_s: np.ndarray
    T: np.ndarray

    def __post_init__(self) -> None:
        if self.T.shape != (len(self.times_s), 4, 4) or np.ndim(self.times_s) != 1:
            raise BadInput("pose track", f"times {self.times_s.shape}, poses {self.T.shape}", "(M,) and (M, 4, 4)")
        if not np.isfinite(self.times_s).all() or (np.diff(self.times_s) <= 0).any():
            raise BadInput("pose track", "times that do not increase", "finite seconds, one after the other")

    @property
    def seen(self) -> PoseTrack:
        """The samples at which the body was seen."""
        keep = np.isfinite(self.T).all((1, 2))
        return PoseTrack(self.times_s[keep], self.T[keep])

    def at(self, times_s: np.ndarray, max_gap_s: float = MAX_GAP_S) -> np.ndarray:
        """(K, 4, 4) poses at these times, between the two nearest samples with constant twist.

        NaN outside of the track and where the samples around are further apart than ``max_gap_s``.
        """
        seen, times_s = self.seen, np.asarray(times_s, float)
        T = np.full((len(times_s), 4, 4), np.nan)
        if len(seen.times_s) < 2:
            return T
        after = np.clip(np.searchsorted(seen.times_s, times_s, side="right"), 1, len(seen.times_s) - 1)
        begin, end = seen.times_s[after - 1], seen.times_s[after]
        share = (times_s - begin) / (end - begin)
        good = (share >= 0) & (share <= 1) & (end - begin <= max_gap_s)
        T[good] = se3.interpolate(seen.T[after[good] - 1], seen.T[after[good]], share[good])
        return T
