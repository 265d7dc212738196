"""Around an object: two trackers of it behind the face of one, while it shows a side that nobody knows.

A known object that comes back with a side never seen cannot be registered; a second map is begun, in an object frame of
its own. Once frames fit both maps, these frames say how the two object frames lie to each other, and the maps become
one.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.image import in_mask
from p2p_lib.core.types import Frame, Status, Tracks, joined
from p2p_lib.extended.gates import OUTLINE, Judgement
from p2p_lib.extended.image_search import Sighting
from p2p_lib.extended.lifecycle import Lifecycle
from p2p_lib.extended.model import JoinableModel, OurKnown
from p2p_lib.extended.observation import OurObservation, area_m2, cut_off, with_tracks
from p2p_lib.extended.outlook import Outlook
from p2p_lib.extended.policy import OurPolicy, Proposal
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.object_model import NO_IDS, Known
from p2p_lib.method.object_tracker import ObjectStep, ObjectTracker
from p2p_lib.method.policy import Candidate, Verdict
from p2p_lib.method.registration import Hypothesis

#: Two maps become one where so many frames, one after the other, agree on the transformation between them: m, rad.
_FRAMES, _ALIKE_M, _ALIKE_RAD = 5, 0.01, np.radians(5)
#: An object whose mask grows by more than this factor from frame to frame is still coming into view.
_GROWTH = 1.1
#: A map is founded anew where an object has been lost for so many frames and shows more than this of what it knows.
_PATIENCE, _OUTGROWN = 5, 1.5
#: A known object that has been lost for so many frames and shows this share of the most that was ever seen of it is
#: turned to a side that nobody knows: a second map is begun.
_STAYS_LOST, _IN_PLAIN_VIEW = 12, 0.4
_STILL_GROWING = "still coming into view"
_STAYED_LOST, _CORRECTED = "the object stayed lost in the old", "by the correction the old was of something else"


@dataclass(frozen=True, eq=False)
class Relation:
    """Where the other map's object frame lies in this one's, by the newest frames that fit both maps and agree.

    T_obj_other  (K, 4, 4), one of each such frame
    """

    T_obj_other: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)))

    def with_frame(self, T_obj_other: np.ndarray, p_other: np.ndarray) -> Relation:
        """With one more frame's (4, 4); one that disagrees with the last, at the points p_other, starts anew."""
        if len(self.T_obj_other):
            last, centre = self.T_obj_other[-1], p_other.mean(0, keepdims=True)
            moved_m = np.linalg.norm(se3.transform(T_obj_other, centre) - se3.transform(last, centre))
            if moved_m < _ALIKE_M and se3.angle_rad(se3.inverse(last) @ T_obj_other) < _ALIKE_RAD:
                return replace(self, T_obj_other=np.concatenate([self.T_obj_other, T_obj_other[None]]))
        return replace(self, T_obj_other=T_obj_other[None])

    @property
    def certain(self) -> bool:
        """Whether enough frames agree."""
        return len(self.T_obj_other) >= _FRAMES

    @property
    def mean(self) -> np.ndarray:
        """(4, 4) of all these frames."""
        first = self.T_obj_other[0]
        return first @ se3.exp(se3.log(se3.inverse(first) @ self.T_obj_other).mean(0))


def seen_together(own: OurObservation, other: OurObservation) -> OurObservation:
    """The observation of a map that has taken in another: its own points, then the other's."""
    p_cam = np.concatenate([own.p_cam, other.p_cam])
    return replace(own, tracks=joined([own.tracks, other.tracks]), p_cam=p_cam, other=None)


def agreeing_together(own: Hypothesis, other: Hypothesis) -> Hypothesis:
    """The hypothesis ``own`` with the agreeing points of both maps."""
    inliers, residual_m = ([own.inliers, other.inliers], [own.residual_m, other.residual_m])
    return replace(own, inliers=np.concatenate(inliers), residual_m=np.concatenate(residual_m))


class OurTracker(ObjectTracker):
    """The paper's step of one object, with our policy, model and life."""

    policy: OurPolicy
    known: OurKnown
    new_model: Callable[[], JoinableModel]


class TwoMaps:
    """One object: ``own`` follows it, ``other`` is asked whether it knows the object again.

    It takes the place of the :class:`~p2p_lib.method.object_tracker.ObjectTracker` that it is made from.
    """

    def __init__(self, own: OurTracker):
        self.own = own
        self.other: OurTracker | None = None
        self.policy = own.policy
        self.observer, self.config, self.name = own.observer, own.config, own.name
        self._on = self.policy.on
        self._relation = Relation()  # of the other map to this one
        self.next_map = own.known.map_id + 1  # which no map has had yet

    @property
    def known(self) -> OurKnown:
        """The map in which the object is followed, and its life in it."""
        return self.own.known

    @property
    def model(self) -> JoinableModel:
        """Its keypoint map, surface and graph."""
        return self.own.known.model

    @property
    def map(self) -> KeypointMap:
        """Its keypoints."""
        return self.own.map

    @property
    def life(self) -> Lifecycle:
        """The object's state in this map."""
        return self.own.known.life

    @life.setter
    def life(self, life: Lifecycle) -> None:
        self.own.life = life

    @property
    def ids(self) -> np.ndarray:
        """The tracker's ids of all points, those of the other map too."""
        return self.map.ids if self.other is None else np.concatenate([self.map.ids, self.other.map.ids])

    @property
    def outlook(self) -> Outlook:
        """Answers where the object should show."""
        return Outlook(self.known, self.policy, None if self.other is None else self.other.known)

    def known_as(self, map_id: int) -> Known | None:
        """What is known in the map of this number; None where it has been given up."""
        maps = (self.own, self.other)
        return next((known for tracker in maps if tracker and (known := tracker.known_as(map_id))), None)

    def adopt(self) -> None:
        """As in the paper. The other map needs none: its last solution was adopted before it became the other."""
        self.own.adopt()

    def awaited(self, mask: np.ndarray | None) -> bool:
        """Whether the object had no pose in the frame before and its mask says that it is back."""
        return self.own.awaited(mask)

    # -- observe -------------------------------------------------------------------------------

    def observe(
        self,
        frame: Frame,
        mask: np.ndarray | None,
        tracks: Tracks,
        sighting: Sighting | None = None,
        given: bool = True,
        told: bool = False,
    ) -> OurObservation:
        """What a frame shows of the object, by its mask (H, W) bool, None where unknown, and all objects' tracks."""
        obs = self.own.observe(frame, mask, tracks)
        ours = OurObservation(obs.frame, obs.mask, obs.tracks, obs.p_cam, obs.cloud, sighting, given, told)
        return self._with_other(ours, tracks)

    def seen_anew(self, obs: OurObservation, tracks: Tracks) -> OurObservation:
        """The observation again, with all objects' newest tracks."""
        return self._with_other(with_tracks(self.observer, obs, tracks.select(self.map.ids)), tracks)

    def _with_other(self, obs: OurObservation, tracks: Tracks) -> OurObservation:
        if self.other is None:
            return obs
        same = replace(obs, sighting=None, other=None)
        return replace(obs, other=with_tracks(self.observer, same, tracks.select(self.other.map.ids)))

    # -- the step ------------------------------------------------------------------------------

    def step(self, obs: OurObservation) -> ObjectStep:
        """The object's pose at a frame, by the map that knows it."""
        step = self._step(obs)
        if step.estimate.keyframe:
            self.life = replace(self.life, seen_m2=max(self.life.seen_m2, area_m2(self.observer, obs)))
        return step

    def _step(self, obs: OurObservation) -> ObjectStep:
        own = self.own
        if own.policy.hidden(obs) or (own.model.empty and not self._still_growing(obs)):
            return own.step(obs)
        if own.model.empty:
            return own.absent(obs, Verdict(False, Status.INITIALISING, _STILL_GROWING))
        self.life = self.life.at(obs.frame.time_s)
        if obs.told and self._contradicted(obs):
            return self._begin_anew(obs, _CORRECTED)
        best, verdict = own.find(obs)
        by_other = self._by_other(obs, best, verdict)
        if by_other is not None:
            return by_other
        if best is not None and verdict.accepted:
            return self._accept(obs, best, verdict)
        if (outgrown := self._outgrown(obs)) or self._turned_over(obs):
            return self._begin_anew(obs, _STAYED_LOST, keep=not outgrown)
        return own.absent(obs, verdict)

    def _accept(self, obs: OurObservation, best: Candidate, verdict: Verdict) -> ObjectStep:
        assert isinstance(verdict, Judgement)
        if not verdict.doubted:
            self.policy.trusted = obs
        return self.own.accept(obs, best, verdict)

    # -- a new map -----------------------------------------------------------------------------

    def _still_growing(self, obs: OurObservation) -> bool:
        """Whether the object is still coming into view.

        Points on its first sliver would all be at its rim; or a side that its map knows may be about to return.
        """
        before, now = self.life.start_px, obs.mask_px
        return "growing" in self._on and now is not None and before is not None and now > _GROWTH * before

    def _outgrown(self, obs: OurObservation) -> bool:
        """Whether a lost object shows much more than its keyframes ever did, or was never followed."""
        if "outgrown" not in self._on or self.life.lost_frames < _PATIENCE or obs.mask is None:
            return False
        more = area_m2(self.observer, obs) > _OUTGROWN * self.life.seen_m2
        return not self.life.followed or (more and self.policy.outline(obs) >= OUTLINE)

    def _turned_over(self, obs: OurObservation) -> bool:
        """Whether a known object stays lost in plain view: it shows a side that its map does not have.

        Its mask must be given, or it must have been in sight since: what the segmenter takes for an object that was
        hidden, and that agrees with nothing known of it, may be something else.
        """
        room = self.other is None or _first_view_alone(self.other.known)
        known = "second_map" in self._on and room and self.life.lost_frames >= _STAYS_LOST
        of_it = obs.given or self.life.in_sight
        if not known or obs.mask is None or not of_it or cut_off(self.observer, obs):
            return False
        plain = area_m2(self.observer, obs) >= _IN_PLAIN_VIEW * self.life.seen_m2
        return plain and self.policy.outline(obs) >= OUTLINE

    def _contradicted(self, obs: OurObservation) -> bool:
        """Whether most points that the tracker sees lie outside a mask that the user corrected: the map is of them."""
        seen = obs.tracks.uv_px[obs.tracks.visible]
        return obs.mask is not None and bool(2 * np.count_nonzero(in_mask(seen, obs.mask)) < len(seen))

    def _begin_anew(self, obs: OurObservation, why: str, keep: bool = True) -> ObjectStep:
        """Begin a new map; with ``keep`` the one so far becomes the other one, else it is dropped."""
        if self._still_growing(obs):
            return self.own.absent(obs, Verdict(False, Status.LOST, _STILL_GROWING))
        own, new = self.own, copy(self.own)
        new.known = Known(new.new_model(), self.policy.life, self.next_map)
        step, trusted = new.begin(obs), self.policy.trusted
        if (keep and step.estimate.status is Status.DEGRADED) or step.estimate.T_cam_obj is None:
            self.policy.trusted = trusted
            return own.absent(obs, Verdict(False, Status.LOST, step.estimate.reason))
        self.next_map += 1
        gone = self.other if keep else own
        if keep:
            self.other = _lost(own)
        self.own, self._relation = new, Relation()
        if step.estimate.status is not Status.DEGRADED:
            new.life = replace(new.life, status=Status.RECOVERED)
            again = replace(step.estimate, status=Status.RECOVERED, reason=f"new map: {why}")
            step = replace(step, estimate=again)
        forgotten = NO_IDS if gone is None else gone.map.ids[gone.map.ids >= 0]
        return replace(step, requests=replace(step.requests, drop=forgotten))

    # -- two maps ------------------------------------------------------------------------------

    def _by_other(self, obs: OurObservation, best: Candidate | None, verdict: Verdict) -> ObjectStep | None:
        """The step by the other map, if it alone finds the object, or by the joined maps; else None."""
        other = self.other
        known = None if other is None or obs.other is None else self._known_again(obs.other, other.known)
        if known is None:
            return None
        if best is None or not verdict.accepted:
            return self._accept(self._exchanged(obs), *known)
        assert other is not None and isinstance(verdict, Judgement)
        if verdict.doubted:
            return None
        T_obj_other = se3.inverse(best.T_cam_obj) @ known[0].T_cam_obj
        self._relation = self._relation.with_frame(T_obj_other, other.map.p_obj)
        return self._joined(obs, best, known[0]) if self._relation.certain else None

    def _known_again(self, obs: OurObservation, other: OurKnown) -> tuple[Proposal, Judgement] | None:
        """The pose by the other map, where points and surface say that it is this object; else None."""
        cfg = self.config.lifecycle
        found = [h for h in self.policy.propose(obs, other) if h.support >= cfg.return_inliers]
        best = self.policy.choose(obs, other, found)[0] if found else None
        if best is None or best.agreement(other.keypoints(obs)) < 0:
            return None
        verdict = self.policy.judge_other(obs, other, best)
        share = best.evidence.surface_share
        fits = verdict.accepted and (share is None or share >= cfg.surface_only_share)
        return (best, verdict) if fits else None

    def _exchanged(self, obs: OurObservation) -> OurObservation:
        """Exchange the two maps; returns the observation of the one to go on in."""
        assert self.other is not None and obs.other is not None
        self.own, self.other, self._relation = self.other, _lost(self.own), Relation()
        return replace(obs.other, other=replace(obs, other=None))

    def _joined(self, obs: OurObservation, best: Candidate, known: Candidate) -> ObjectStep:
        """Join two maps that fit this frame, in the frame of the older; a keyframe ties the points of both."""
        assert self.other is not None
        T_obj_other = self._relation.mean
        if self.other.known.map_id < self.known.map_id:
            life = self.life.in_frame(T_obj_other)
            obs, best, known = self._exchanged(obs), known, best
            self.life, T_obj_other = replace(life, seen_m2=self.life.seen_m2), se3.inverse(T_obj_other)
        gone, self.other, self._relation = self.other.known, None, Relation()
        self.model.join(gone.model, T_obj_other)
        self.life = replace(self.life, seen_m2=max(self.life.seen_m2, gone.life.seen_m2))
        both = replace(best, hypothesis=agreeing_together(best.hypothesis, known.hypothesis))
        maps = f"maps {self.known.map_id} and {gone.map_id} were joined"
        verdict = Judgement(True, Status.RECOVERED, maps, joins=True)
        assert obs.other is not None
        step = self.own.accept(seen_together(obs, obs.other), both, verdict, due=True)
        return replace(step, estimate=replace(step.estimate, joined=(gone.map_id, T_obj_other)))


def _lost(tracker: OurTracker) -> OurTracker:
    """The tracker after a frame in which the object was not found by it."""
    tracker.life = tracker.known.life.without_pose(Status.LOST)
    return tracker


def _first_view_alone(known: OurKnown) -> bool:
    """Whether an object is known from the view that it began with, and never was sure of another pose."""
    return known.life.motion is None and len(known.model.views) == 1
