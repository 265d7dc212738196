"""The object-centric keypoint map (section "Sampling Strategy and Keypoints Map", appendix "Point Promotion Strategy").

New points are pending until they have proved themselves over several frames in a row; promoted ones
are keypoints p_n in the object frame that frames are registered to. Where the main text (a score
within a time window) and the appendix (a streak of consecutive frames) differ, this follows the appendix.

Ours beyond the paper: a point may be required to move with the object. A reflection on a slowly turning object stands
still before the camera, yet scatters little enough in the object frame to be promoted.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import KeypointMapConfig

_HISTORY = 16  # observations kept of a pending point
#: Under a cap a keypoint is retired when, of at least so many registrations, it agreed with less than this share.
_RETIRE_AFTER, _RETIRE_SHARE = 10, 0.3


class KeypointMap:
    """Keypoints of one object; rows belong together.

    keys        (N,) int64, the map's own names of the points, never used twice
    ids         (N,) int64, the tracker's; -1 until it has been asked to follow the point
    p_obj       (N, 3) object frame, metres
    promoted    (N,) bool
    confidence  (N,) of the pose that placed each
    age         (N,) int64, frames since it was added, of a keypoint since it was promoted
    agreed      (N,) how many registrations each keypoint took part in and agreed with; 0 for pending points
    """

    def __init__(self, config: KeypointMapConfig):
        self.config = config
        self.keys, self.ids = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self.p_obj = np.zeros((0, 3))
        self.promoted = np.zeros(0, bool)
        self.confidence = np.zeros(0)
        self._streak, self.age = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self.agreed, self._disagreed = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._in_object, self._in_camera = np.zeros((0, _HISTORY, 3)), np.zeros((0, _HISTORY, 3))
        self._observations = np.zeros(0, np.int64)

    def __len__(self) -> int:
        return len(self.keys)

    def add(
        self,
        keys: np.ndarray,
        p_obj: np.ndarray,
        promoted: bool = False,
        confidence: float = 1.0,
        p_cam: np.ndarray | None = None,
    ) -> None:
        """Add points at p_obj (N, 3), with keys (N,) larger than all before.

        The first frame's define the map and are ``promoted`` at once. ``confidence`` is that of the pose that places
        them, ``p_cam`` (N, 3) are their positions in the camera frame. Their ids are unknown until :meth:`assign`.
        """
        n = len(keys)
        histories = np.full((2, n, _HISTORY, 3), np.nan)
        histories[0, :, 0] = p_obj
        if p_cam is not None:
            histories[1, :, 0] = p_cam
        new = {
            "keys": np.asarray(keys, np.int64),
            "ids": np.full(n, -1),
            "p_obj": p_obj,
            "promoted": np.full(n, promoted),
            "confidence": np.full(n, float(confidence)),
            "_in_object": histories[0],
            "_in_camera": histories[1],
            "_observations": np.ones(n, np.int64),
        }
        nothing = np.zeros(n, np.int64)
        for name in self._columns():
            setattr(self, name, np.concatenate([getattr(self, name), new.get(name, nothing)]))

    def join(self, other: KeypointMap, T_obj_other: np.ndarray, shift: int) -> None:
        """Append another map's points, moved into this frame by T_obj_other (4, 4), their keys raised by ``shift``."""
        moved = {"keys": other.keys + shift, "p_obj": se3.transform(T_obj_other, other.p_obj)}
        moved["_in_object"] = se3.transform(T_obj_other, other._in_object)
        for name in self._columns():
            more = moved.get(name, getattr(other, name))
            setattr(self, name, np.concatenate([getattr(self, name), more]))

    def assign(self, keys: np.ndarray, ids: np.ndarray) -> np.ndarray:
        """Set the tracker's ids of points by key; returns the ids of points that are gone already."""
        there = np.isin(keys, self.keys)
        self.ids[np.searchsorted(self.keys, keys[there])] = ids[there]
        return ids[~there]

    def observe(
        self, p_obj: np.ndarray, uncertainty: np.ndarray, stable: bool, p_cam: np.ndarray | None = None
    ) -> np.ndarray:
        """Take in one frame's observations of all points; returns the keys promoted by it.

        p_obj        (N, 3) in the object frame at the frame's pose; NaN where a point was not visible
                     in the mask with depth
        uncertainty  (N,) of the tracks
        stable       the pose moved little since the last frame ("Pose Stability")
        p_cam        (N, 3) in the camera frame: a point that scatters less there than in the object frame is not
                     promoted. None: this is not tested
        """
        cfg = self.config
        self.age += 1
        passed = stable & np.isfinite(p_obj[:, 0]) & (uncertainty < cfg.max_uncertainty) & ~self.promoted
        self._streak = np.where(passed, self._streak + 1, 0)
        at = np.flatnonzero(passed)
        self._in_object[at, self._observations[at] % _HISTORY] = p_obj[at]
        if p_cam is not None:
            self._in_camera[at, self._observations[at] % _HISTORY] = p_cam[at]
        self._observations[at] += 1
        ready = np.flatnonzero(passed & (self._streak >= cfg.streak))
        if not len(ready):
            return np.zeros(0, np.int64)
        centre, scatter_m = _scatter(self._in_object[ready])
        tight = scatter_m < cfg.max_scatter_m
        if p_cam is not None:  # noise is the same in both, so even small scatters can be compared
            tight &= scatter_m < _scatter(self._in_camera[ready])[1]
        rows = ready[tight]
        self.p_obj[rows], self.promoted[rows], self.age[rows] = centre[tight], True, 0
        return self.keys[rows]

    def count(self, used: np.ndarray, agreed: np.ndarray) -> None:
        """Remember which points (N,) bool took part in a registration and which agreed with its pose."""
        self.agreed += used & agreed
        self._disagreed += used & ~agreed

    def move(self, keys: np.ndarray, p_obj: np.ndarray) -> None:
        """Set keypoints to p_obj (N, 3), as the factor graph found them. Unknown keys are passed over."""
        known = np.isin(keys, self.keys)
        self.p_obj[np.searchsorted(self.keys, keys[known])] = p_obj[known]

    def retire(self) -> tuple[np.ndarray, np.ndarray]:
        """Remove pending points past their time; under a cap, keypoints that mostly disagree or are too many.

        Of too many, those that agreed in the smallest share of the frames since their promotion go: refusing new
        ones instead would close the map to sides that come into view. The cap leaves out pending points, whose time
        bounds them. Returns the keys removed, and the tracker's ids of those that have one.
        """
        cfg = self.config
        stale = ~self.promoted & (self.age > cfg.pending_ttl)
        seen = self.agreed + self._disagreed
        wrong = self.promoted & (seen >= _RETIRE_AFTER) & (self.agreed < _RETIRE_SHARE * seen)
        most = cfg.max_points or len(self)
        gone = stale | (wrong & (cfg.max_points > 0))
        kept = np.flatnonzero(self.promoted & ~gone)
        usefulness = (self.agreed[kept] + 1) / (self.age[kept] + 1)
        gone[kept[np.argsort(usefulness, kind="stable")[: max(len(kept) - most, 0)]]] = True
        removed, ids = self.keys[gone], self.ids[gone]
        for name in self._columns():
            setattr(self, name, getattr(self, name)[~gone])
        return removed, ids[ids >= 0]

    def _columns(self) -> list[str]:
        return [name for name, value in vars(self).items() if isinstance(value, np.ndarray)]


def _scatter(history_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median (N, 3) of observations (N, K, 3), NaN where there are fewer, and median distance from it (N,)."""
    centre = np.nanmedian(history_m, 1)
    return centre, np.nanmedian(np.linalg.norm(history_m - centre[:, None], axis=-1), 1)
