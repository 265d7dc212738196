"""How far an object has turned, view by view, up to each of its keyframes.

A map is made view by view: each is registered to what the one beside it saw, so that small errors with one cause add
up. On a round body, whose shape does not determine its turn, the keypoints all drift a little as it rotates; no sum
over independent points shows that.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.method.keyframe_views import KeyframeViews


class AccumulatedViews(KeyframeViews):
    """Keyframe poses with the accumulated rotation up to each of them."""

    def __init__(self, *args: int):
        super().__init__(*args)
        self._accumulated_rad = np.zeros(0)

    def accumulated_rad(self, T_cam_obj: np.ndarray) -> float:
        """How far the object has turned since the first view, along the views that lead here; 0 before it."""
        turned, row = self.nearest(T_cam_obj)
        return turned + self._accumulated_rad[row] if len(self) else 0.0

    def some(self, most: int) -> np.ndarray:
        """(M, 4, 4) of the views, evenly chosen where there are more than ``most``."""
        return self.T_cam_obj[np.unique(np.linspace(0, len(self) - 1, min(len(self), most)).astype(int))]

    def add(self, T_cam_obj: np.ndarray) -> None:
        """One more view, as far along as it is from the nearest."""
        accumulated = self.accumulated_rad(T_cam_obj)
        super().add(T_cam_obj)
        self._accumulated_rad = np.append(self._accumulated_rad, accumulated)

    def remove(self, row: int) -> None:
        """Forget a view."""
        super().remove(row)
        self._accumulated_rad = np.delete(self._accumulated_rad, row)
