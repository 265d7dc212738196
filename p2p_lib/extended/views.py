"""How far an object has turned, view by view, up to each of its keyframes.

A map grows view by view, each registered to the one beside it, so that systematic errors add up. On a round body,
whose shape does not determine its turn, all keypoints drift a little as it rotates, which a covariance of independent
points does not show.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core.types import evenly
from p2p_lib.method.keyframe_views import MOST, KeyframeViews


class AccumulatedViews(KeyframeViews):
    """Keyframe poses with the accumulated rotation up to each of them."""

    def __init__(self, most: int = MOST):
        super().__init__(most)
        self._accumulated_rad = np.zeros(0)

    def accumulated_rad(self, T_cam_obj: np.ndarray) -> float:
        """Rotation (rad) of the object since the first view, along the views that lead here; 0 before it."""
        turned, row = self.nearest(T_cam_obj)
        return turned + self._accumulated_rad[row] if len(self) else 0.0

    def some(self, most: int) -> np.ndarray:
        """(M, 4, 4) of the views, evenly chosen where there are more than ``most``."""
        return evenly(self.T_cam_obj, most)

    def add(self, T_cam_obj: np.ndarray) -> None:
        """Add a view; its accumulated rotation is that of the nearest view plus the turn from it."""
        accumulated = self.accumulated_rad(T_cam_obj)
        super().add(T_cam_obj)
        self._accumulated_rad = np.append(self._accumulated_rad, accumulated)

    def remove(self, row: int) -> None:
        """Forget a view."""
        super().remove(row)
        self._accumulated_rad = np.delete(self._accumulated_rad, row)
