"""Two maps of one object that become one (not in the paper): how one's frame lies in the other's, and what both show.

A known object that comes back with a side never seen cannot be registered; a second map is begun, in an object frame of
its own. Once frames fit both maps, these frames say how the two object frames lie to each other.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.types import joined
from p2p_lib.method.observation import Observation
from p2p_lib.method.registration import Hypothesis

#: Two maps become one where so many frames, one after the other, say alike how they lie to each other: m, rad.
_FRAMES, _ALIKE_M, _ALIKE_RAD = 5, 0.01, np.radians(5)


@dataclass(frozen=True, eq=False)
class Relation:
    """Where a second map's frame lies in the first one's, by the newest frames that fit both and say so alike.

    T_obj_other  (K, 4, 4), one of each such frame
    """

    T_obj_other: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def with_frame(self, T_obj_other: np.ndarray, p_other: np.ndarray) -> Relation:
        """With one more frame's (4, 4); where it moves the second map's middle or turns it, it begins anew."""
        if len(self.T_obj_other):
            last, middle = self.T_obj_other[-1], p_other.mean(0, keepdims=True)
            moved_m = np.linalg.norm(se3.transform(T_obj_other, middle) - se3.transform(last, middle))
            if moved_m < _ALIKE_M and se3.angle_rad(se3.inverse(last) @ T_obj_other) < _ALIKE_RAD:
                return Relation(np.concatenate([self.T_obj_other, T_obj_other[None]]))
        return Relation(T_obj_other[None])

    @property
    def certain(self) -> bool:
        """Whether enough frames agree."""
        return len(self.T_obj_other) >= _FRAMES

    @property
    def mean(self) -> np.ndarray:
        """(4, 4) of all these frames."""
        first = self.T_obj_other[0]
        return first @ se3.exp(se3.log(se3.inverse(first) @ self.T_obj_other).mean(0))


def seen_together(own: Observation, other: Observation) -> Observation:
    """One frame's observation of a map that has taken in another: its points, then the other's."""
    p_cam = np.concatenate([own.p_cam, other.p_cam])
    return replace(own, tracks=joined([own.tracks, other.tracks]), p_cam=p_cam, aside=None)


def agreeing_together(own: Hypothesis, other: Hypothesis) -> Hypothesis:
    """A pose in the frame of the one map, with the points of both that agree."""
    inliers, residual_m = ([own.inliers, other.inliers], [own.residual_m, other.residual_m])
    return replace(own, inliers=np.concatenate(inliers), residual_m=np.concatenate(residual_m))
