"""Whether a pose stands, and whether its frame is learnt from.

:data:`GATES` are the reasons to refuse a pose; :data:`DOUBTS` are the reasons to learn nothing from it, since depth or
masks contradict earlier ones; :data:`PROOFS` say what confirms a return on few points. Each is the mechanism of its
name. The paper refuses none.
"""

from __future__ import annotations

from collections.abc import Callable, Container
from dataclasses import dataclass

from p2p_lib.core.config import LifecycleConfig
from p2p_lib.core.types import Status
from p2p_lib.extended.lifecycle import Lifecycle
from p2p_lib.method.policy import Verdict

#: Shape and colour have found an object if this share of its surface shows; the second while it has a pose.
SIGHTED, SIGHTED_STILL = 0.5, 0.3
#: Depth of what rests is another if its ratio to that before is off 1 by more.
_RATIO = 0.05
#: A mask is doubted if less of its outline is along depth steps than this share of what was before. After so many
#: doubted frames in a row it is accepted.
OUTLINE, _LONGEST_DOUBT = 0.45, 60
#: So many points fix a pose, or so much of its contour.
FIXED_BY, _CONTOUR = 3, 0.7


@dataclass(frozen=True)
class PoseEvidence:
    """What speaks for the pose of a frame.

    support        keypoints that agree with it
    surface_share  share of the depth points that lie on the surface under it; None where no surface was asked
    sighting       share of the surface that shows in the image where and as it should; None: not looked for
    lead           how much more shows than under the best other turn, as a share; None: not compared
    scene_ratio    depth of the resting scene over that before any doubt
    outline        share of its mask's outline along depth steps, relative to that before any doubt
    still          whether the same image has come again and again
    carried        whether its motion before the gap still says where it is
    slides         whether the pose may move along the surface without leaving it, as that of something flat
    rests          whether an object that lay still is where the scene has it; None where nobody knows
    contour        share of its contour that shows where its mask ends; 0 where nobody has looked
    """

    support: int
    surface_share: float | None
    sighting: float | None = None
    lead: float | None = None
    scene_ratio: float = 1.0
    outline: float = 1.0
    still: bool = False
    carried: bool = False
    slides: bool = False
    rests: bool | None = None
    contour: float = 0.0


@dataclass(frozen=True)
class Judgement(Verdict):
    """Whether a pose stands, and what may be made of it.

    doubted  whether depth or mask contradict earlier ones: nothing is learnt from the pose
    proven   whether its evidence can confirm a return: more than a surface that fits where the motion leads
    joins    whether it joins two maps
    """

    doubted: bool = False
    proven: bool = True
    joins: bool = False


def judge(life: Lifecycle, evidence: PoseEvidence, on: Container[str], config: LifecycleConfig) -> Judgement:
    """The verdict on a pose: refused by the first gate ``on`` with a reason, else accepted, perhaps with a doubt."""
    for name, gate in GATES.items():
        if name in on and (reason := gate(life, evidence, config)):
            return Judgement(False, Status.LOST, reason)
    for name, contradiction in DOUBTS.items():
        if name in on and (reason := contradiction(life, evidence)):
            return Judgement(True, Status.DEGRADED, reason, doubted=True)
    if evidence.support < config.return_inliers:
        few = f"only {evidence.support} points agree with the pose, fewer than {config.return_inliers}"
        proven = all(proves(life, evidence) for name, proves in PROOFS.items() if name in on)
        return Judgement(True, Status.DEGRADED, few, proven=proven)
    return Judgement(True, Status.RECOVERED if life.returning else Status.TRACKED)


def _sighted(life: Lifecycle, evidence: PoseEvidence) -> bool:
    return (evidence.sighting or 0.0) >= (SIGHTED_STILL if life.has_pose else SIGHTED)


def _few_points_on_return(life: Lifecycle, evidence: PoseEvidence, config: LifecycleConfig) -> str:
    on_its_way = evidence.carried and (evidence.surface_share or 0.0) >= config.surface_only_share
    found = _sighted(life, evidence) or on_its_way
    few = life.unconfirmed and evidence.support < config.return_inliers and not found
    return f"only {evidence.support} points agree with the pose of a return" if few else ""


def _found_where_looked_for(life: Lifecycle, evidence: PoseEvidence) -> bool:
    return evidence.sighting is None or _sighted(life, evidence)


def _no_points_and_off_surface(life: Lifecycle, evidence: PoseEvidence, config: LifecycleConfig) -> str:
    off = (evidence.surface_share or 0.0) < config.surface_only_share
    nothing = not evidence.support and off and not _sighted(life, evidence)
    return "no points agree with the pose, and its surface does not fit the depth" if nothing else ""


def _few_points_on_flat(life: Lifecycle, evidence: PoseEvidence, config: LifecycleConfig) -> str:
    """What is flat lies on a table as well as on itself: its own points, or where it ends, have to say where."""
    points = evidence.support >= FIXED_BY or (evidence.sighting or 0.0) >= SIGHTED
    fixed = points or evidence.contour >= _CONTOUR
    free = evidence.slides and not fixed
    return f"only {evidence.support} points agree with the pose, and a flat surface does not fix it" if free else ""


def _few_points_elsewhere(life: Lifecycle, evidence: PoseEvidence, config: LifecycleConfig) -> str:
    """What lay still does not move while nobody sees it, unless its own points say so."""
    elsewhere = life.unconfirmed and evidence.support < config.return_inliers and evidence.rests is False
    return f"only {evidence.support} points agree with the pose, and the object rested elsewhere" if elsewhere else ""


def _mask_off_steps(life: Lifecycle, evidence: PoseEvidence) -> str:
    off = evidence.outline < OUTLINE and life.doubted_frames < _LONGEST_DOUBT
    return "the outline of the mask no longer follows depth edges" if off else ""


def _another_depth(life: Lifecycle, evidence: PoseEvidence) -> str:
    ratio = evidence.scene_ratio
    return f"depth shows what rests {ratio:.2f} times as far away as before" if abs(ratio - 1) > _RATIO else ""


def _same_image(life: Lifecycle, evidence: PoseEvidence) -> str:
    return "the camera repeats the same image" if evidence.still else ""


#: Every reason to doubt a pose that no gate refuses: state and evidence to words, or "".
DOUBTS: dict[str, Callable[[Lifecycle, PoseEvidence], str]] = {
    "scale": _another_depth,
    "outline": _mask_off_steps,
    "still": _same_image,
}

#: What a pose that few points agree with needs to confirm a return: state and evidence to whether it has it.
PROOFS: dict[str, Callable[[Lifecycle, PoseEvidence], bool]] = {"return_gate": _found_where_looked_for}

#: Every reason to refuse a pose, in this order: state, evidence and bounds to words, or "".
GATES: dict[str, Callable[[Lifecycle, PoseEvidence, LifecycleConfig], str]] = {
    "return_gate": _few_points_on_return,
    "surface_gate": _no_points_and_off_surface,
    "sliding_gate": _few_points_on_flat,
    "rest": _few_points_elsewhere,
}
