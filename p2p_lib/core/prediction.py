"""Where an object will be: its velocity, and its pose at a time to come, with how sure that is (not in the paper).

A Kalman filter of constant velocity on SE(3), beside the tracker: nothing of the method depends on it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from numbers import Real

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import DOUBTED, PoseEstimate

#: What is held in a hand accelerates like white noise of this density: rad^2/s^3 about an axis, m^2/s^3 along it.
_TURNS, _MOVES = 2.0, 0.3
#: Standard deviations of a pose that has no covariance, rad and m, and of a velocity that nobody knows, rad/s and m/s.
_POSE, _AT_FIRST = (0.05, 0.01), (2.0, 0.5)
#: After a longer time without a sure pose the velocity is unknown again, s.
_FORGOTTEN_S = 1.0


@dataclass(frozen=True, eq=False)
class Prediction:
    """An object's pose at a time to come, or at that of its newest sure pose.

    T_cam_obj    (4, 4) in the camera as it stands at the newest frame, of those with T_world_cam where some have one
    covariance   (6, 6) of the pose, right tangent: [rotation rad, translation m]
    velocity     (6,) in the object frame: [turn rad/s, move m/s]; ``T_cam_obj[:3, :3] @ velocity[3:]`` is the move in
                 the camera frame. Against the world where frames bring T_world_cam, else against the camera
    T_world_obj  (4, 4) where frames bring T_world_cam, else None
    """

    object: str
    time_s: float
    T_cam_obj: np.ndarray
    covariance: np.ndarray
    velocity: np.ndarray
    T_world_obj: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class Moving:
    """A pose T (4, 4) with its velocity (6,) at a time, and the covariance (12, 12) of both, right tangent."""

    T: np.ndarray
    velocity: np.ndarray
    covariance: np.ndarray
    time_s: float
    map_id: int = 0
    in_world: bool = False

    @classmethod
    def begun(cls, T: np.ndarray, noise: np.ndarray, time_s: float, map_id: int, in_world: bool) -> Moving:
        """At rest as far as anybody knows; noise (6, 6) of the pose."""
        covariance = np.diag(np.repeat([0, 0, *_AT_FIRST], 3) ** 2)
        covariance[:6, :6] = noise
        return cls(T, np.zeros(6), covariance, time_s, map_id, in_world)

    def at(self, time_s: float) -> Moving:
        """Moved on to a later time."""
        dt, both = time_s - self.time_s, np.eye(12)
        step = se3.exp(self.velocity * dt)
        both[:6, :6], both[:6, 6:] = se3.adjoint(se3.inverse(step)), dt * np.eye(6)
        grown = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.diag(np.repeat([_TURNS, _MOVES], 3)))
        return replace(self, T=self.T @ step, covariance=both @ self.covariance @ both.T + grown, time_s=time_s)

    def with_pose(self, T: np.ndarray, noise: np.ndarray) -> Moving:
        """With a pose that was measured at this time; noise (6, 6)."""
        gain = np.linalg.solve(self.covariance[:6, :6] + noise, self.covariance[:6]).T
        right = gain @ se3.log(se3.inverse(self.T) @ T)
        covariance = self.covariance - gain @ self.covariance[:6]
        covariance = (covariance + covariance.T) / 2
        moved = se3.orthonormalised(self.T @ se3.exp(right[:6]))
        return replace(self, T=moved, velocity=self.velocity + right[6:], covariance=covariance)


class Predictor:
    """Keeps the motion of every object up with the estimates."""

    def __init__(self) -> None:
        # Object to its motion and T_world_cam: one value, so that who asks from another thread gets both of one frame.
        self._known: dict[str, tuple[Moving, np.ndarray | None]] = {}

    def add(self, estimate: PoseEstimate, T_world_cam: np.ndarray | None) -> None:
        """Take in an estimate of the newest frame; T_world_cam (4, 4) as the frame brought it.

        A frame without one, as where a transform came too late, says nothing of a motion in the world, which goes on.
        """
        name = estimate.object
        known, _ = self._known.get(name, (None, None))
        if known is not None and known.in_world and T_world_cam is None:
            if estimate.time_s - known.time_s <= _FORGOTTEN_S:
                return
        if estimate.T_cam_obj is None or estimate.confidence <= DOUBTED:
            if known is not None:
                self._known[name] = known, T_world_cam
            return
        in_world = T_world_cam is not None
        T = estimate.T_cam_obj if T_world_cam is None else T_world_cam @ estimate.T_cam_obj
        noise = np.diag(np.repeat(_POSE, 3) ** 2) if estimate.covariance is None else estimate.covariance
        same = known is not None and (known.map_id, known.in_world) == (estimate.map_id, in_world)
        if known is None or not same or not 0 < estimate.time_s - known.time_s <= _FORGOTTEN_S:
            moving = Moving.begun(T, noise, estimate.time_s, estimate.map_id, in_world)
        else:
            moving = known.at(estimate.time_s).with_pose(T, noise)
        self._known[name] = moving, T_world_cam

    def forget(self, name: str) -> None:
        """The object is gone."""
        self._known.pop(name, None)

    def predict(self, name: str, time_s: float) -> Prediction | None:
        """The pose at a time, at or after that of the newest sure pose; None where there never was one."""
        if isinstance(time_s, bool) or not isinstance(time_s, Real):
            raise BadInput("predict time_s", repr(time_s), "a time in seconds")
        known, T_world_cam = self._known.get(name, (None, None))
        if known is None or (known.in_world and T_world_cam is None):
            return None
        if not known.time_s <= time_s < np.inf:
            raise BadInput("predict time_s", time_s, f"a time from that of the newest sure pose on, {known.time_s:g} s")
        then = known.at(time_s)
        T_cam_obj = se3.inverse(T_world_cam) @ then.T if known.in_world and T_world_cam is not None else then.T
        rest = then.covariance[:6, :6], then.velocity, then.T if known.in_world else None
        return Prediction(name, time_s, T_cam_obj, *rest)
