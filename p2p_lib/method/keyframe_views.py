"""The views that one object has been seen from: its keyframe poses (appendix, "Sampling Criteria")."""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3

#: At most so many views are remembered, which bounds memory and time on long videos.
MOST = 1000


class KeyframeViews:
    """Keyframe poses T_cam_obj (N, 4, 4) as registered; a view far from all of them asks for a keyframe."""

    def __init__(self, most: int = MOST):
        self._most = most
        self.T_cam_obj = np.zeros((0, 4, 4))

    def __len__(self) -> int:
        return len(self.T_cam_obj)

    def turned_rad(self, T_cam_obj: np.ndarray) -> float:
        """Angle to the nearest view; infinite before the first."""
        return self.nearest(T_cam_obj)[0]

    def add(self, T_cam_obj: np.ndarray) -> None:
        """Add a view; beyond the cap it replaces the most similar one."""
        if len(self) >= self._most:
            self.remove(self.nearest(T_cam_obj)[1])
        self.T_cam_obj = np.concatenate([self.T_cam_obj, T_cam_obj[None]])

    def remove(self, row: int) -> None:
        """Forget a view."""
        self.T_cam_obj = np.delete(self.T_cam_obj, row, 0)

    def nearest(self, T_cam_obj: np.ndarray) -> tuple[float, int]:
        """Angle (rad) to the nearest view, and its row; infinite and -1 without any."""
        if not len(self):
            return np.inf, -1
        turned = se3.angle_rad(se3.inverse(self.T_cam_obj) @ T_cam_obj)
        row = int(turned.argmin())
        return float(turned[row]), row
