"""The object-centric keypoint map (paper: section "Sampling Strategy", appendix "Point Promotion Strategy").

New points are pending until they have proved themselves over several frames in a row; promoted ones
are keypoints p_n in the object frame that frames are registered to. Where the main text (a score
within a time window) and the appendix (a streak of consecutive frames) differ, this follows the appendix.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.config import KeypointMapConfig

_HISTORY = 16  # observations kept of a pending point


class KeypointMap:
    """Keypoints of one object. Rows belong together; ``ids`` are the tracker's."""

    def __init__(self, config: KeypointMapConfig):
        self.config = config
        self.ids = np.zeros(0, np.int64)
        self.p_obj = np.zeros((0, 3))
        self.promoted = np.zeros(0, bool)
        self.trust = np.zeros(0)  # how likely the pose was right that placed each
        self._streak = np.zeros(0, np.int64)
        self._age = np.zeros(0, np.int64)
        self._agreed = np.zeros(0, np.int64)
        self._disagreed = np.zeros(0, np.int64)
        self._history = np.zeros((0, _HISTORY, 3))
        self._observations = np.zeros(0, np.int64)

    def __len__(self) -> int:
        return len(self.ids)

    def add(self, ids: np.ndarray, p_obj: np.ndarray, promoted: bool = False, trust: float = 1.0) -> None:
        """New points (N,) at p_obj (N, 3). The first frame's are promoted at once: they define the map.

        ``trust`` is the confidence of the pose that places them.
        """
        n = len(ids)
        zeros = np.zeros(n, np.int64)
        history = np.full((n, _HISTORY, 3), np.nan)
        history[:, 0] = p_obj
        self.ids = np.concatenate([self.ids, np.asarray(ids, np.int64)])
        self.p_obj = np.concatenate([self.p_obj, p_obj])
        self.promoted = np.concatenate([self.promoted, np.full(n, promoted)])
        self.trust = np.concatenate([self.trust, np.full(n, trust)])
        self._streak = np.concatenate([self._streak, zeros])
        self._age = np.concatenate([self._age, zeros])
        self._agreed = np.concatenate([self._agreed, zeros])
        self._disagreed = np.concatenate([self._disagreed, zeros])
        self._history = np.concatenate([self._history, history])
        self._observations = np.concatenate([self._observations, zeros + 1])

    def observe(self, p_obj: np.ndarray, uncertainty: np.ndarray, stable: bool) -> np.ndarray:
        """Take in one frame's observations of all points; returns the ids promoted by it.

        p_obj        (N, 3) in the object frame at the frame's pose; NaN where a point was not visible
                     in the mask with depth
        uncertainty  (N,) of the tracks
        stable       the pose moved little since the last frame ("Pose Stability")
        """
        cfg = self.config
        self._age += 1
        passed = stable & np.isfinite(p_obj[:, 0]) & (uncertainty < cfg.max_uncertainty) & ~self.promoted
        self._streak = np.where(passed, self._streak + 1, 0)
        at = np.flatnonzero(passed)
        self._history[at, self._observations[at] % _HISTORY] = p_obj[at]
        self._observations[at] += 1
        ready = np.flatnonzero(passed & (self._streak >= cfg.streak) & (self._observations >= cfg.min_observations))
        if not len(ready):
            return np.zeros(0, np.int64)
        centre = np.nanmedian(self._history[ready], 1)
        spread = np.nanmedian(np.linalg.norm(self._history[ready] - centre[:, None], axis=-1), 1)
        tight = spread < cfg.max_spread_m
        self.p_obj[ready[tight]] = centre[tight]
        self.promoted[ready[tight]] = True
        self._age[ready[tight]] = 0
        return self.ids[ready[tight]]

    def count(self, used: np.ndarray, agreed: np.ndarray) -> None:
        """Remember which points (N,) bool took part in a registration and which agreed with its pose."""
        self._agreed += used & agreed
        self._disagreed += used & ~agreed

    def move(self, ids: np.ndarray, p_obj: np.ndarray) -> None:
        """Set keypoints to p_obj (N, 3), as the factor graph found them. Unknown ids are passed over."""
        known, order = np.isin(ids, self.ids), np.argsort(self.ids)
        at = order[np.searchsorted(self.ids, ids[known], sorter=order)]
        self.p_obj[at] = p_obj[known]

    def retire(self) -> np.ndarray:
        """Remove pending points past their time, keypoints that mostly disagree, and keypoints beyond the cap.

        Those that agreed in the smallest share of the frames since their promotion go first: a cap on the
        count alone would close the map of an object that turns to new points. The pending are bounded by
        their time. Returns the ids removed, for the tracker to drop.
        """
        cfg = self.config
        stale = ~self.promoted & (self._age > cfg.pending_ttl)
        seen = self._agreed + self._disagreed
        wrong = self.promoted & (seen >= 10) & (self._agreed < 0.3 * seen)
        gone = stale | wrong
        kept = np.flatnonzero(self.promoted & ~gone)
        worth = (self._agreed[kept] + 1) / (self._age[kept] + 1)
        gone[kept[np.argsort(worth, kind="stable")[: max(len(kept) - cfg.max_points, 0)]]] = True
        removed = self.ids[gone]
        for name, value in list(vars(self).items()):
            if isinstance(value, np.ndarray):
                setattr(self, name, value[~gone])
        return removed
