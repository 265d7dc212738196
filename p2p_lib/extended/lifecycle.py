"""The state of an object between frames, which gates, search and second map go by.

:class:`Lifecycle` is immutable: each frame makes a new one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.types import Status
from p2p_lib.extended.motion import Motion
from p2p_lib.method.object_model import CONFIRM_FRAMES, CONFIRM_LONGER, Life

if TYPE_CHECKING:
    from p2p_lib.extended.gates import Judgement

#: A time between two frames is a pause if it is longer than this, s, and than so many times the one before.
_PAUSE_S, _PAUSE = 0.25, 5
#: The motion so far is that of poses with more confidence than this.
_CONFIDENT = 0.5
#: Seen so often in a row at one place in the scene, an object lies still. One place extends this far, m: the error of
#: cameras located by the scene.
_RESTED, _NEAR_M = 3, 0.08
#: With the first lead shape and colour tell a turn from all others, with the second beyond doubt.
TELLING, CLEAR = 0.25, 0.5


@dataclass(frozen=True, eq=False)
class Lifecycle(Life):
    """The state of one object between two frames.

    In addition to the paper's, of which ``confirming`` counts the frames that still have to confirm a return:

    pace_s          time between the newest two frames that followed each other with poses; infinite before
    T_previous      pose of the frame before it; None after a gap
    T_left          newest pose before the absence; an unconfirmed return falls back to it
    T_world_obj     newest pose in the scene that many points agreed with, where the camera was known; None before
    rested          how often in a row it was seen at T_world_obj again
    motion          how it moves, by the confident poses; None before the first
    start_px        pixels of the newest mask, in a frame without a pose; None without a mask
    doubted         whether, since a gap, its turn has not been told from others that look alike
    lost_frames     frames in view since the newest proven pose
    doubted_frames  newest frames in a row whose pose was doubted by one of :data:`~p2p_lib.extended.gates.DOUBTS`
    seen_m2         the most that a keyframe showed of it, across the line of sight
    contour         (K, 3) where something flat ends, as it was seen under a sure pose; None before
    in_sight        it has had a mask in every frame since its newest pose, or since its motion still led to it
    """

    pace_s: float = float("inf")
    T_previous: np.ndarray | None = None
    T_left: np.ndarray | None = None
    T_world_obj: np.ndarray | None = None
    rested: int = 0
    motion: Motion | None = None
    start_px: int | None = None
    doubted: bool = False
    lost_frames: int = 0
    doubted_frames: int = 0
    in_sight: bool = False
    seen_m2: float = 0.0
    contour: np.ndarray | None = None

    @property
    def followed(self) -> bool:
        """Whether two consecutive frames ever had poses: else the map may be of something else."""
        return self.pace_s < float("inf")

    @property
    def unconfirmed(self) -> bool:
        """Whether a pose would be a return, or one of the frames that confirm a return."""
        return not self.has_pose or self.confirming > 0

    def at(self, time_s: float) -> Lifecycle:
        """The state before a frame at this time: after a pause in the stream the object may be anywhere."""
        paused = self.has_pose and time_s - self.seen_s > max(_PAUSE_S, _PAUSE * self.pace_s)
        return replace(self, status=Status.LOST) if paused else self

    def motion_priors(self) -> dict[str, np.ndarray]:
        """T_cam_obj if the object stays, or moves on evenly, by name; empty after a gap."""
        if not self.has_pose or self.T_cam_obj is None:
            return {}
        priors = {"last pose": self.T_cam_obj}
        if self.T_previous is not None:
            priors["constant velocity"] = self.T_cam_obj @ se3.inverse(self.T_previous) @ self.T_cam_obj
        return priors

    def scene_prior(self, T_world_cam: np.ndarray | None) -> dict[str, np.ndarray]:
        """T_cam_obj of a sought object if it has lain still, by name; empty where unknown."""
        if T_world_cam is None or self.T_world_obj is None or (self.has_pose and not self.sought):
            return {}
        return {"scene": se3.orthonormalised(se3.inverse(T_world_cam) @ self.T_world_obj)}

    def in_frame(self, T_old_new: np.ndarray) -> Lifecycle:
        """The same in a new object frame, which T_old_new (4, 4) maps to the present one."""
        poses: dict[str, np.ndarray | None] = {
            name: getattr(self, name) for name in ("T_cam_obj", "T_previous", "T_left", "T_world_obj")
        }
        motion = self.motion and self.motion.in_frame(T_old_new)
        contour = None if self.contour is None else se3.transform(se3.inverse(T_old_new), self.contour)
        moved: dict[str, Any] = {n: None if T is None else T @ T_old_new for n, T in poses.items()}
        return replace(self, motion=motion, contour=contour, **moved)

    def placed(self, T_world_cam: np.ndarray | None) -> Lifecycle:
        """The state with the newest pose's place in the scene, once a return has been confirmed.

        A degraded pose, as of a sliver at the image's border, does not replace a known place.
        """
        if T_world_cam is None or self.T_cam_obj is None or self.confirming:
            return self
        if self.status is Status.DEGRADED and self.T_world_obj is not None:
            return self
        T_world_obj = T_world_cam @ self.T_cam_obj
        again = self.T_world_obj is not None and same_place(self.T_world_obj, T_world_obj)
        return replace(self, T_world_obj=T_world_obj, rested=self.rested + 1 if again else 0)

    @property
    def lay_still(self) -> bool:
        """Whether it was at rest in the scene when it was seen last."""
        return self.rested >= _RESTED

    def moved(self, confidence: float) -> Lifecycle:
        """The state with its motion updated by the newest pose, if that is confident."""
        if confidence <= _CONFIDENT or self.T_cam_obj is None:
            return self
        before = self.motion
        go_on = before.followed_by if before is not None and before.time_s < self.seen_s else Motion
        return replace(self, motion=go_on(self.T_cam_obj, self.seen_s))

    def corrected(self, T_cam_obj: np.ndarray) -> Lifecycle:
        """With the newest pose replaced by the graph's, from which the next frame starts."""
        lies = self.T_world_obj
        lies = None if lies is None or self.T_cam_obj is None else lies @ se3.inverse(self.T_cam_obj) @ T_cam_obj
        return replace(self, T_cam_obj=T_cam_obj, T_world_obj=lies)

    def with_verdict(
        self,
        T_cam_obj: np.ndarray,
        time_s: float,
        verdict: Judgement,
        lead: float | None = None,
    ) -> Lifecycle:
        """The state after a frame with an accepted pose, and its lead over other turns."""
        clear = verdict.status is not Status.DEGRADED or (lead is not None and lead >= CLEAR)
        longest = CONFIRM_FRAMES if clear else CONFIRM_LONGER
        return replace(
            self,
            status=verdict.status,
            T_cam_obj=T_cam_obj,
            seen_s=time_s,
            pace_s=time_s - self.seen_s if self.has_pose else self.pace_s,
            lost_frames=0 if verdict.proven else self.lost_frames + 1,
            start_px=None,
            in_sight=True,
            doubted_frames=self.doubted_frames + 1 if verdict.doubted else 0,
            doubted=self.doubted if lead is None else lead < TELLING,
            T_previous=self.T_cam_obj if self.has_pose else None,
            T_left=self.T_left if self.has_pose else self.T_cam_obj,
            confirming=min(max(self.confirming - verdict.proven, 0), longest) if self.has_pose else longest,
        )

    def without_pose(self, status: Status, mask_px: int | None = None, carried: bool = False) -> Lifecycle:
        """The state after a frame without a pose; ``carried``: its motion still leads to it.

        A return that was not confirmed is taken back.
        """
        taken_back: dict[str, Any] = {"T_cam_obj": self.T_left, "confirming": 0} if self.confirming else {}
        lost = status is Status.LOST
        in_sight = lost and (self.in_sight or carried)
        lost_frames = self.lost_frames + lost
        return replace(
            self,
            status=status,
            lost_frames=lost_frames,
            start_px=mask_px,
            in_sight=in_sight,
            **taken_back,
        )


def same_place(T: np.ndarray, other: np.ndarray) -> bool:
    """Whether an object lies where it lay, turned or not: by two of its poses (4, 4) in one frame."""
    return bool(np.linalg.norm(T[:3, 3] - other[:3, 3]) < _NEAR_M)
