"""From where one object has been seen: the poses of its keyframes, and how long the way to each of them was.

A new view asks for a keyframe (appendix, "Sampling Criteria"). And a map is made view by view: each is registered to
what the one beside it saw, so that small errors with one cause add up along the way. On a round body, whose shape does
not hold its turn, the points all slide a little as they go round; no sum over independent points knows of that.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3


class Views:
    """Keyframe poses T_cam_obj (N, 4, 4) as registered, at most ``most``; the most alike go first."""

    def __init__(self, most: int):
        self._most = most
        self.T_cam_obj = np.zeros((0, 4, 4))
        self._way_rad = np.zeros(0)

    def __len__(self) -> int:
        return len(self.T_cam_obj)

    def turned_rad(self, T_cam_obj: np.ndarray) -> float:
        """The turn to the nearest of the views; infinite before the first."""
        return self._nearest(T_cam_obj)[0]

    def way_rad(self, T_cam_obj: np.ndarray) -> float:
        """How far the object has turned since the first view, by way of the views that lead here; 0 before it."""
        turned, row = self._nearest(T_cam_obj)
        return turned + self._way_rad[row] if len(self) else 0.0

    def add(self, T_cam_obj: np.ndarray) -> None:
        """One more view; beyond the cap it takes the place of the one that it is most like."""
        way = self.way_rad(T_cam_obj)
        if len(self) >= self._most:
            gone = self._nearest(T_cam_obj)[1]
            self.T_cam_obj, self._way_rad = np.delete(self.T_cam_obj, gone, 0), np.delete(self._way_rad, gone)
        self.T_cam_obj = np.concatenate([self.T_cam_obj, T_cam_obj[None]])
        self._way_rad = np.append(self._way_rad, way)

    def _nearest(self, T_cam_obj: np.ndarray) -> tuple[float, int]:
        if not len(self):
            return np.inf, -1
        turned = se3.angle_rad(se3.inverse(self.T_cam_obj) @ T_cam_obj)
        row = int(turned.argmin())
        return float(turned[row]), row


def slide_covariance(free_turns: np.ndarray, way_rad: float, share: float) -> np.ndarray:
    """(6, 6) by how much points may have slid around on the way: ``share`` of it along each of the turns.

    free_turns  (K, 6) tangents of one radian each that the shape leaves free, right tangent of T_cam_obj
    """
    return (share * way_rad) ** 2 * free_turns.T @ free_turns
