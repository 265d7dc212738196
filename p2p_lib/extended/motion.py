"""How one object moves: a prior that lasts through gaps (not in the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from p2p_lib.core import se3

#: Weight of the newest velocity in the running mean, which smooths the noise of poses.
_NEWEST = 0.1
#: The velocity says where an object is for so long after its last confident pose, s.
_CARRIED_S = 1.5
#: The uncertainty of that place grows by this, m/s.
_OPEN_M_S = 0.2
#: This turn, or this move, off the motion so far halves the support of a hypothesis.
MOTION_DEG, MOTION_M = 5.0, 0.02


@dataclass(frozen=True, eq=False)
class Motion:
    """The motion of an object by its confident poses; immutable: each pose makes a new one.

    T_cam_obj  (4, 4) the newest of them
    time_s     its time
    velocity   (6,) in the camera frame: of the turn, rad/s, and of the origin, m/s; at rest until another pose follows
    """

    T_cam_obj: np.ndarray
    time_s: float
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(6))

    def followed_by(self, T_cam_obj: np.ndarray, time_s: float) -> Motion:
        """With a later pose."""
        turn = cv2.Rodrigues(T_cam_obj[:3, :3] @ self.T_cam_obj[:3, :3].T)[0].ravel()
        newest = np.concatenate([turn, T_cam_obj[:3, 3] - self.T_cam_obj[:3, 3]]) / (time_s - self.time_s)
        return Motion(T_cam_obj, time_s, self.velocity + _NEWEST * (newest - self.velocity))

    def holds(self, time_s: float) -> bool:
        """Whether it still says where the object is."""
        return time_s - self.time_s <= _CARRIED_S

    def reach_m(self, time_s: float) -> float:
        """How far the object may be from the predicted place, m."""
        return _OPEN_M_S * (time_s - self.time_s)

    def at(self, time_s: float) -> np.ndarray:
        """(4, 4) T_cam_obj if the motion has gone on."""
        turn, moved_m = np.split(self.velocity * (time_s - self.time_s), 2)
        return se3.from_rt(cv2.Rodrigues(turn)[0] @ self.T_cam_obj[:3, :3], self.T_cam_obj[:3, 3] + moved_m)

    def in_frame(self, T_old_new: np.ndarray) -> Motion:
        """The same in a new object frame, which T_old_new (4, 4) maps to the present one."""
        return Motion(self.T_cam_obj @ T_old_new, self.time_s, self.velocity)


def motion_weight(T_cam_obj: Sequence[np.ndarray], priors: Sequence[np.ndarray]) -> np.ndarray:
    """(H,) factors of poses' support by their distance from the nearest of the priors; 1 without priors.

    1 on a prior, 1/2 at ``MOTION_DEG`` or ``MOTION_M`` from it: heavy tails, because objects may be pushed at any time.
    """
    if not len(priors) or not len(T_cam_obj):
        return np.ones(len(T_cam_obj))
    off = se3.inverse(np.stack(priors))[:, None] @ np.stack(T_cam_obj)[None]
    turned = np.degrees(se3.angle_rad(off)) / MOTION_DEG
    moved = np.linalg.norm(np.stack(priors)[:, None, :3, 3] - np.stack(T_cam_obj)[None, :, :3, 3], axis=-1)
    return 1 / (1 + (turned**2 + (moved / MOTION_M) ** 2).min(0))
