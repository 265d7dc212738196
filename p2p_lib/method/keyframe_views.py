"""From where one object has been seen: the poses of its keyframes, and the accumulated rotation up to each of them.

A new view asks for a keyframe (appendix, "Sampling Criteria"). And a map is made view by view: each is registered to
what the one beside it saw, so that small errors with one cause add up. On a round body, whose shape does not determine
its turn, the keypoints all drift a little as it rotates; no sum over independent points shows that.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3

#: Views remembered; beyond it a new one takes the place of the most similar. Bounds memory and time on long videos.
_MOST = 1000


class KeyframeViews:
    """Keyframe poses T_cam_obj (N, 4, 4) as registered."""

    def __init__(self, most: int = _MOST):
        self._most = most
        self.T_cam_obj = np.zeros((0, 4, 4))
        self._accumulated_rad = np.zeros(0)

    def __len__(self) -> int:
        return len(self.T_cam_obj)

    def turned_rad(self, T_cam_obj: np.ndarray) -> float:
        """The turn to the nearest of the views; infinite before the first."""
        return self._nearest(T_cam_obj)[0]

    def accumulated_rad(self, T_cam_obj: np.ndarray) -> float:
        """How far the object has turned since the first view, along the views that lead here; 0 before it."""
        turned, row = self._nearest(T_cam_obj)
        return turned + self._accumulated_rad[row] if len(self) else 0.0

    def some(self, most: int) -> np.ndarray:
        """(M, 4, 4) of the views, evenly chosen where there are more than ``most``."""
        return self.T_cam_obj[np.unique(np.linspace(0, len(self) - 1, min(len(self), most)).astype(int))]

    def add(self, T_cam_obj: np.ndarray) -> None:
        """One more view; beyond the cap it replaces the one that it is most like."""
        accumulated = self.accumulated_rad(T_cam_obj)
        if len(self) >= self._most:
            row = self._nearest(T_cam_obj)[1]
            self.T_cam_obj = np.delete(self.T_cam_obj, row, 0)
            self._accumulated_rad = np.delete(self._accumulated_rad, row)
        self.T_cam_obj = np.concatenate([self.T_cam_obj, T_cam_obj[None]])
        self._accumulated_rad = np.append(self._accumulated_rad, accumulated)

    def _nearest(self, T_cam_obj: np.ndarray) -> tuple[float, int]:
        if not len(self):
            return np.inf, -1
        turned = se3.angle_rad(se3.inverse(self.T_cam_obj) @ T_cam_obj)
        row = int(turned.argmin())
        return float(turned[row]), row
