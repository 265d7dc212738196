"""What an object has been through, as a value, and the gates that a pose has to pass to be believed.

:class:`Lifecycle` never changes: each frame makes the next one. :data:`GATES` is the list of reasons for which a pose
is refused; of a map that was put aside :mod:`~p2p_lib.method.object_tracker` asks more. The paper refuses none:
the gates are ours.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import LifecycleConfig
from p2p_lib.core.types import WITH_POSE, Status
from p2p_lib.method.motion import Motion

#: A return has to be confirmed for so many frames, and is marked as recovered meanwhile; for more without points.
CONFIRM_FRAMES, CONFIRM_SIGHTED_FRAMES = 5, 15
#: Shape and colour have found an object where this share of its surface shows.
SIGHTED, SIGHTED_STILL = 0.5, 0.3
#: A longer time between two frames is a pause, s, if it is so many times what it was before, too.
_PAUSE_S, _PAUSE = 0.25, 5
#: Another size is one that is off by this and so many standard deviations.
_SIZE, _SIZE_SIGMAS = 0.05, 3.0
#: A mask is doubted of whose outline less than this share lies where depth has steps, of what did before. One that
#: stays so for this many frames is taken for right.
OUTLINE, _LONGEST_DOUBT = 0.45, 60
#: A pose of less confidence makes no keyframe: what it places agrees with it for ever after. One that the surface
#: alone determines well has more.
MAPPED = 0.1
#: The motion so far is that of poses with more confidence.
_SURE = 0.5
#: Shape and colour tell a turn from all others by this lead, and leave no doubt by this one.
TELLING, CLEAR = 0.25, 0.5


@dataclass(frozen=True)
class Evidence:
    """What speaks for the pose of a frame.

    support        keypoints that agree with it
    surface_share  share of the depth points that lie on the surface under it; None where no surface was asked
    sighting       share of the surface that shows in the image where and as it should; None where nobody has looked
    lead           share of that which is more than where it is turned otherwise; None where nobody has compared
    size           times as large as its keypoint map it is measured, and the standard deviation; None: few are seen
    outline        what of its mask's outline lies where depth has steps, as a share of what did before any doubt
    still          whether the same image has come again and again
    carried        whether its motion before the gap still says where it is
    """

    support: int
    surface_share: float | None
    sighting: float | None = None
    lead: float | None = None
    size: tuple[float, float] | None = None
    outline: float = 1.0
    still: bool = False
    carried: bool = False


@dataclass(frozen=True)
class Verdict:
    """Whether a pose stands, with the status that it gives the object and the reason in words.

    doubted  whether what it rests on contradicts itself: a pose that nothing is learnt from
    proven   whether enough speaks for it to confirm a return: more than a surface that fits where the motion leads
    """

    accepted: bool
    status: Status
    reason: str = ""
    doubted: bool = False
    proven: bool = True


@dataclass(frozen=True, eq=False)
class Lifecycle:
    """The state of one object between two frames.

    status          of the newest frame
    T_cam_obj       newest pose, of whatever frame; None before the first
    seen_s          its time
    pace_s          time between the newest two frames that followed each other with poses; infinite before
    T_previous      pose of the frame before it; None after a gap
    T_left          newest pose before the absence; an unconfirmed return falls back to it
    confirming      frames for which a return still has to be confirmed
    T_world_obj     newest pose in the scene that many points agreed with, where the camera was known; None before
    motion          how it moves, by the sure poses; None before the first
    start_px        pixels of the newest mask, in a frame without a pose; None without a mask
    doubted         since a gap nothing has told its turn from others that look alike
    lost_frames     frames since the newest proven pose in which it was in view
    doubted_frames  newest frames in a row whose pose was doubted by one of :data:`DOUBTS`
    in_sight        it has had a mask in every frame since its newest pose, or since its motion still led to it
    """

    status: Status = Status.INITIALISING
    T_cam_obj: np.ndarray | None = None
    seen_s: float = float("nan")
    pace_s: float = float("inf")
    T_previous: np.ndarray | None = None
    T_left: np.ndarray | None = None
    confirming: int = 0
    T_world_obj: np.ndarray | None = None
    motion: Motion | None = None
    start_px: int | None = None
    doubted: bool = False
    lost_frames: int = 0
    doubted_frames: int = 0
    in_sight: bool = False

    @property
    def has_pose(self) -> bool:
        """Whether the newest frame has a pose."""
        return self.status in WITH_POSE

    @property
    def followed(self) -> bool:
        """Whether two frames that followed each other ever had poses: else the map may be of something else."""
        return self.pace_s < float("inf")

    @property
    def unconfirmed(self) -> bool:
        """Whether a pose would be a return, or one of the frames that confirm a return."""
        return not self.has_pose or self.confirming > 0

    @property
    def sought(self) -> bool:
        """Whether it is absent, or back by shape and colour alone."""
        return not self.has_pose or (self.confirming > 0 and self.status is Status.DEGRADED)

    def at(self, time_s: float) -> Lifecycle:
        """The state before a frame at this time: after a pause in the stream the object may be anywhere."""
        paused = self.has_pose and time_s - self.seen_s > max(_PAUSE_S, _PAUSE * self.pace_s)
        return replace(self, status=Status.LOST) if paused else self

    def motion_priors(self) -> dict[str, np.ndarray]:
        """Where the object is if it stays or moves on evenly: origin to T_cam_obj; empty after a gap."""
        if not self.has_pose or self.T_cam_obj is None:
            return {}
        priors = {"last pose": self.T_cam_obj}
        if self.T_previous is not None:
            priors["constant velocity"] = self.T_cam_obj @ se3.inverse(self.T_previous) @ self.T_cam_obj
        return priors

    def scene_prior(self, T_world_cam: np.ndarray | None) -> dict[str, np.ndarray]:
        """Where an absent object is if it has lain still: origin to T_cam_obj; empty where nobody knows."""
        if self.has_pose or T_world_cam is None or self.T_world_obj is None:
            return {}
        return {"scene": se3.orthonormalised(se3.inverse(T_world_cam) @ self.T_world_obj)}

    def in_frame(self, T_old_new: np.ndarray) -> Lifecycle:
        """The same in another object frame; T_old_new (4, 4) maps it to the one so far."""
        poses = {name: getattr(self, name) for name in ("T_cam_obj", "T_previous", "T_left", "T_world_obj")}
        motion = self.motion and self.motion.in_frame(T_old_new)
        return replace(self, motion=motion, **{n: None if T is None else T @ T_old_new for n, T in poses.items()})

    def placed(self, T_world_cam: np.ndarray | None) -> Lifecycle:
        """The state with the newest pose's place in the scene, once a return has been confirmed.

        A pose that few points agree with, as one of a sliver at the image's border, places nothing again.
        """
        if T_world_cam is None or self.confirming or (self.status is Status.DEGRADED and self.T_world_obj is not None):
            return self
        return replace(self, T_world_obj=T_world_cam @ self.T_cam_obj)

    def moved(self, confidence: float) -> Lifecycle:
        """The state with its motion, which goes on with the newest pose where that is sure."""
        if confidence <= _SURE:
            return self
        known = self.motion is not None and self.motion.time_s < self.seen_s
        go_on = self.motion.followed_by if known else Motion
        return replace(self, motion=go_on(self.T_cam_obj, self.seen_s))

    def corrected(self, T_cam_obj: np.ndarray) -> Lifecycle:
        """With the newest pose as the graph has it: what comes next starts from there."""
        lies = self.T_world_obj
        lies = None if lies is None else lies @ se3.inverse(self.T_cam_obj) @ T_cam_obj
        return replace(self, T_cam_obj=T_cam_obj, T_world_obj=lies)

    def moved_from_last(self, T_cam_obj: np.ndarray) -> tuple[float, float] | None:
        """Metres and degrees from the pose of the frame before to another (4, 4); None after a gap."""
        if not self.has_pose:
            return None
        moved_m = np.linalg.norm(T_cam_obj[:3, 3] - self.T_cam_obj[:3, 3])
        return float(moved_m), float(np.degrees(se3.angle_rad(se3.inverse(self.T_cam_obj) @ T_cam_obj)))

    def judge(self, evidence: Evidence, gates: tuple[str, ...], config: LifecycleConfig) -> Verdict:
        """The verdict on a pose: refused by the first of ``gates`` that refuses it, else accepted."""
        for name in gates:
            if reason := GATES[name](self, evidence, config):
                return Verdict(False, Status.LOST, reason)
        for name in gates and DOUBTS:
            if reason := DOUBTS[name](self, evidence):
                return Verdict(True, Status.DEGRADED, reason, doubted=True)
        if evidence.support < config.return_inliers:
            proven = not gates or evidence.sighting is None or _sighted(self, evidence)
            return Verdict(True, Status.DEGRADED, f"only {evidence.support} points agree", proven=proven)
        confirming = not self.has_pose or self.confirming > 1
        return Verdict(True, Status.RECOVERED if confirming else Status.TRACKED)

    def with_pose(self, T_cam_obj: np.ndarray, time_s: float, verdict: Verdict, lead: float | None = None) -> Lifecycle:
        """The state after a frame with an accepted pose, and the lead by which it was."""
        clear = verdict.status is not Status.DEGRADED or (lead is not None and lead >= CLEAR)
        longest = CONFIRM_FRAMES if clear else CONFIRM_SIGHTED_FRAMES
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
        """The state after a frame without a pose, where its motion leads or not; see :class:`Evidence`.

        A return that was not confirmed is taken back.
        """
        taken_back = {"T_cam_obj": self.T_left, "confirming": 0} if self.confirming else {}
        lost = status is Status.LOST
        in_sight = lost and (self.in_sight or carried)
        lost_frames = self.lost_frames + lost
        return replace(self, status=status, lost_frames=lost_frames, start_px=mask_px, in_sight=in_sight, **taken_back)


def _sighted(life: Lifecycle, evidence: Evidence) -> bool:
    return (evidence.sighting or 0.0) >= (SIGHTED_STILL if life.has_pose else SIGHTED)


def _few_points_on_return(life: Lifecycle, evidence: Evidence, config: LifecycleConfig) -> str:
    on_its_way = evidence.carried and (evidence.surface_share or 0.0) >= config.surface_only_share
    found = _sighted(life, evidence) or on_its_way
    few = life.unconfirmed and evidence.support < config.return_inliers and not found
    return f"only {evidence.support} points agree on a return" if few else ""


def _no_points_and_off_surface(life: Lifecycle, evidence: Evidence, config: LifecycleConfig) -> str:
    off = (evidence.surface_share or 0.0) < config.surface_only_share
    nothing = not evidence.support and off and not _sighted(life, evidence)
    return "too few points, and the surface does not fit either" if nothing else ""


def _mask_off_steps(life: Lifecycle, evidence: Evidence) -> str:
    off = evidence.outline < OUTLINE and life.doubted_frames < _LONGEST_DOUBT
    return "its mask does not end where its depth does any more" if off else ""


def _another_size(life: Lifecycle, evidence: Evidence) -> str:
    ratio, sigma = evidence.size or (1.0, 0.0)
    return f"its depth shows it {ratio:.2f} times as large as before" if off_size(ratio, sigma) else ""


def _same_image(life: Lifecycle, evidence: Evidence) -> str:
    return "the camera gives the same image again and again" if evidence.still else ""


def off_size(ratio: float, sigma: float = 0.0) -> bool:
    """Whether something is measured so many times as large as before that it is not the same."""
    return abs(ratio - 1) > _SIZE + _SIZE_SIGMAS * sigma


#: Every reason to doubt a pose that no gate refuses: what camera and masks say contradicts itself.
DOUBTS: dict[str, Callable[[Lifecycle, Evidence], str]] = {
    "size": _another_size,
    "outline": _mask_off_steps,
    "still": _same_image,
}

#: Every reason to refuse a pose, in the order in which they are asked: state, evidence and bounds to words, or "".
GATES: dict[str, Callable[[Lifecycle, Evidence, LifecycleConfig], str]] = {
    "return_inliers": _few_points_on_return,
    "surface_only": _no_points_and_off_surface,
}
