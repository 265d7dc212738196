"""How one object moves: a prior that outlives a gap (not in the paper)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from p2p_lib.core import se3

#: The newest velocity counts by this share in what it was, which smooths the noise of poses.
_NEWEST = 0.1
#: What it has been for so long says where the object is, s.
_CARRIED_S = 1.5
#: What it leaves open grows by this, m/s.
_OPEN_M_S = 0.2
#: This turn, or this move, off the motion so far halves the support of a hypothesis.
MOTION_DEG, MOTION_M = 5.0, 0.02


@dataclass(frozen=True, eq=False)
class Motion:
    """What the sure poses of an object say of its motion; a value that each of them makes anew.

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
        """How far from where it would be the object may be."""
        return _OPEN_M_S * (time_s - self.time_s)

    def at(self, time_s: float) -> np.ndarray:
        """(4, 4) T_cam_obj if it has gone on as it did."""
        turn, moved_m = np.split(self.velocity * (time_s - self.time_s), 2)
        return se3.from_rt(cv2.Rodrigues(turn)[0] @ self.T_cam_obj[:3, :3], self.T_cam_obj[:3, 3] + moved_m)

    def in_frame(self, T_old_new: np.ndarray) -> Motion:
        """The same of another object frame; T_old_new (4, 4) maps it to the one so far."""
        return Motion(self.T_cam_obj @ T_old_new, self.time_s, self.velocity)


def motion_weight(T_cam_obj: Sequence[np.ndarray], priors: Sequence[np.ndarray]) -> np.ndarray | None:
    """(H,) by how much the support of poses counts less for being off the nearest of the priors; None without priors.

    1 on a prior, 1/2 at ``MOTION_DEG`` or ``MOTION_M`` from it: heavy tails, because objects may be pushed at any time.
    """
    if not len(priors) or not len(T_cam_obj):
        return None
    off = se3.inverse(np.stack(priors))[:, None] @ np.stack(T_cam_obj)[None]
    turned = np.degrees(se3.angle_rad(off)) / MOTION_DEG
    moved = np.linalg.norm(np.stack(priors)[:, None, :3, 3] - np.stack(T_cam_obj)[None, :, :3, 3], axis=-1)
    return 1 / (1 + (turned**2 + (moved / MOTION_M) ** 2).min(0))
