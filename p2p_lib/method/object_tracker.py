"""One object's step: observe, register, refine, select, judge, extend (paper: Fig. "Overview of the framework").

:class:`p2p_lib.method.pipeline.Point2Pose` tracks and segments for all objects; here one object's share of a frame
becomes its pose. Whatever the object wants of the shared tracker it returns as
:class:`p2p_lib.method.object_model.Requests`.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.core.interfaces import Detector
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import DOUBTED, OUT_OF_VIEW, Frame, PoseEstimate, Status, Tracks
from p2p_lib.method.agreement import scene_ratio, size_ratio
from p2p_lib.method.confidence import Belief
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.lifecycle import GATES, MAPPED, OUTLINE, Lifecycle, Verdict, off_size
from p2p_lib.method.object_model import NO_IDS, Known, ObjectModel, Requests
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.outlook import Outlook, hidden
from p2p_lib.method.pose_finder import Candidate, PoseFinder
from p2p_lib.method.sampling import choose, usable_region
from p2p_lib.method.two_maps import Relation, agreeing_together, seen_together
from p2p_lib.recovery.search import Sighting

#: An object whose mask grows by more than this factor from frame to frame is still coming into view.
_GROWTH = 1.1
#: A map is founded anew where an object has been lost for so many frames and shows more than this of what it knows.
_PATIENCE, _OUTGROWN = 5, 1.5
#: Where depth has steps at less of a mask's outline than this, it does not tell where the object ends.
_SOME = 0.3
#: A known object that has been lost for so many frames and shows this share of the most that was ever seen of it is
#: turned to a side that nobody knows: a second map is begun.
_STAYS_LOST, _IN_PLAIN_VIEW = 12, 0.4
#: Why a pose is degraded that nothing contradicts.
_UNTOLD = "its shape leaves a turn free, and too little texture tells it"


@dataclass(frozen=True, eq=False)
class ObjectStep:
    """One object's answer to a frame."""

    estimate: PoseEstimate
    requests: Requests = field(default_factory=Requests)


class ObjectTracker:
    """State and step of one object: what is ``known`` of it, and what was put ``aside`` since it shows another side."""

    def __init__(
        self,
        name: str,
        camera: Camera,
        config: Config,
        detector: Detector,
        rng: np.random.Generator,
        stopwatch: Stopwatch,
        beside: Executor,
    ):
        self.name, self.config, self.detector = name, config, detector
        self.observer = Observer(camera, config.depth, config.refinement.max_points if config.method.surface else 0)
        self._new_model = partial(ObjectModel, config, self.observer, stopwatch, beside)
        self.finder = PoseFinder(self.observer, config, rng, stopwatch)
        self.known = Known(self._new_model())
        self.aside: Known | None = None  # a second map, which is asked whether it knows the object again
        self._trusted: Observation | None = None  # the newest without a doubt; None once it was hidden since
        self._relation = Relation()  # of the map aside to this one
        self._gates = tuple(GATES) if config.method.gates == "all" else ()
        self._stopwatch = stopwatch

    @property
    def model(self) -> ObjectModel:
        """The map in which the object is followed."""
        return self.known.model

    @property
    def map(self) -> KeypointMap:
        """Its keypoints."""
        return self.known.map

    @property
    def life(self) -> Lifecycle:
        """What the object has been through in it."""
        return self.known.life

    @life.setter
    def life(self, life: Lifecycle) -> None:
        self.known = replace(self.known, life=life)

    @property
    def ids(self) -> np.ndarray:
        """The tracker's ids of all points, those of the map aside too."""
        return self.map.ids if self.aside is None else np.concatenate([self.map.ids, self.aside.map.ids])

    @property
    def outlook(self) -> Outlook:
        """Where it should show."""
        return Outlook(self.known, self.observer, self.finder, self.config, self.aside)

    def known_as(self, map_id: int) -> Known | None:
        """What is known in the map of this number; None where it has been given up."""
        return next((known for known in (self.known, self.aside) if known and known.map_id == map_id), None)

    # -- the step ------------------------------------------------------------------------------

    def adopt(self) -> None:
        """Take in what was found beside since the frame before; before anything else in a frame."""
        T_cam_obj = self.model.adopt()  # nothing is ever found for the map aside: it was put there after this
        if T_cam_obj is not None:
            self.life = self.life.corrected(T_cam_obj)

    def observe(
        self,
        frame: Frame,
        mask: np.ndarray | None,
        tracks: Tracks,
        sighting: Sighting | None = None,
        given: bool = True,
        still: bool = False,
    ) -> Observation:
        """The object's share of a frame; mask (H, W) bool, None where it is not known, and everybody's tracks."""
        with self._stopwatch("observation"):
            obs = self.observer.observe(frame, mask, tracks.select(self.map.ids))
            return self._with_aside(replace(obs, sighting=sighting, given=given, still=still), tracks)

    def seen_anew(self, obs: Observation, tracks: Tracks) -> Observation:
        """The observation again, with tracks that have been added to."""
        return self._with_aside(self.observer.with_tracks(obs, tracks.select(self.map.ids)), tracks)

    def _with_aside(self, obs: Observation, tracks: Tracks) -> Observation:
        if self.aside is None:
            return obs
        same = replace(obs, sighting=None, aside=None)
        return replace(obs, aside=self.observer.with_tracks(same, tracks.select(self.aside.map.ids)))

    def step(self, obs: Observation) -> ObjectStep:
        """The object's pose at a frame."""
        if self.model.empty:
            return self._initialise(obs)
        if hidden(obs.mask_px, self.config):
            return self._without_pose(obs, Status.OCCLUDED, f"{obs.mask_px} mask pixels")
        self.life = self.life.at(obs.frame.time_s)
        found = self.finder.register(obs, self.known)
        best, reason = self.finder.refine_and_select(obs, self.known, found)
        verdict = self._judge(obs, best, reason)
        by_aside = self._by_aside(obs, best, verdict)
        if by_aside is not None:
            return by_aside
        if best is None or not verdict.accepted:
            if self._outgrown(obs) or self._turned_over(obs):
                return self._initialise(obs)
            return self._without_pose(obs, verdict.status, verdict.reason)
        return self._accepted(obs, best, verdict)

    # -- judge ---------------------------------------------------------------------------------

    def _judge(self, obs: Observation, best: Candidate | None, reason: str) -> Verdict:
        """Whether the pose stands, by what speaks for it and by whether camera and masks agree with themselves."""
        if best is None:
            nothing = obs.mask is None and not obs.seen.any()
            return Verdict(False, Status.OCCLUDED if nothing else Status.LOST, reason)
        size, outline = self._size(obs, best), self._outline(obs)
        carried = self.known.carried(obs.frame.time_s)
        evidence = replace(best.evidence, size=size, outline=outline, still=obs.still, carried=carried)
        return self.life.judge(evidence, self._gates, self.config.lifecycle)

    def _before(self, obs: Observation) -> Observation | None:
        """The newest frame in which nothing was doubted, where its mask and this one's can be compared."""
        before = self._trusted
        return None if obs.mask is None or before is None or before.mask is None else before

    def _size(self, obs: Observation, best: Candidate) -> tuple[float, float] | None:
        """How large it is measured, where the scene beside it is measured otherwise than before, too; else None.

        Points that slide over an object change its size alone.
        """
        before = self._before(obs)
        if before is None or not off_size(scene_ratio(obs.frame, obs.mask, before.frame, before.mask)):
            return None
        keypoints = self.known.keypoints(obs)
        agreeing = keypoints & best.hypothesis.inliers
        sized = agreeing if 2 * agreeing.sum() > keypoints.sum() else keypoints
        p_cam = obs.p_cam[sized]
        return size_ratio(self.map.p_obj[sized], p_cam, self.observer.noise_m(p_cam))

    def _outline(self, obs: Observation) -> float:
        """What of the mask's outline lies where depth has steps, as a share of what did before any doubt."""
        before = self._before(obs)
        then, now = None if before is None else before.outline_share, obs.outline_share
        return 1.0 if then is None or now is None or then < _SOME else now / then

    # -- extend --------------------------------------------------------------------------------

    def _accepted(self, obs: Observation, best: Candidate, verdict: Verdict) -> ObjectStep:
        """A frame whose pose stands."""
        if not verdict.doubted:
            self._trusted = obs
        return self._extend(obs, best, verdict)

    def _extend(self, obs: Observation, best: Candidate, verdict: Verdict, due: bool = False) -> ObjectStep:
        """Take an accepted frame into the model, with a keyframe where one is due."""
        if verdict.doubted:
            return self._doubted(obs, best, verdict)
        T_cam_obj, agrees, model = best.T_cam_obj, best.hypothesis.inliers, self.model
        life = self.life.with_pose(T_cam_obj, obs.frame.time_s, verdict, best.lead)
        requests = Requests(reject=self.map.ids[self.known.keypoints(obs) & ~agrees])
        belief, most = self._belief(obs, best), DOUBTED if life.doubted else 1.0
        covariance, mapped = belief.at(T_cam_obj, model, most, told=True)  # a turn that nothing tells bends no map
        with self._stopwatch("map"):
            model.observe(obs, T_cam_obj, agrees, self.life.moved_from_last(T_cam_obj))
            trusted = not self._gates or (not life.confirming and belief.given_turn(covariance) >= MAPPED)
            keyframe = due or (trusted and model.keyframe_due(obs, T_cam_obj, agrees))
        model.settle_surface()
        if keyframe:
            good = obs.seen & (agrees | ~self.map.promoted)
            if self._gates and not due:  # two maps that become one lie to each other as well as poses tell
                good &= model.explained(obs, T_cam_obj)
            asked = model.insert_keyframe(obs, T_cam_obj, *self._sample(obs), good, belief.of_frame, mapped)
            requests = replace(asked, reject=requests.reject)
        changed = keyframe or not belief.told
        covariance, sure = belief.at(T_cam_obj, model, most) if changed else (covariance, mapped)
        self.life = life.placed(obs.frame.T_world_cam).moved(sure)
        if not belief.told and verdict.status is Status.TRACKED:
            verdict = replace(verdict, status=Status.DEGRADED, reason=_UNTOLD)
        estimate = self._estimate(
            obs, verdict, confidence=sure, covariance=covariance, inliers=best.hypothesis.support, keyframe=keyframe
        )
        return ObjectStep(estimate, requests)

    def _doubted(self, obs: Observation, best: Candidate, verdict: Verdict) -> ObjectStep:
        """A pose from what contradicts itself: neither map nor surface learns from it, and no track is rejected."""
        self.life = self.life.with_pose(best.T_cam_obj, obs.frame.time_s, verdict, best.lead)
        self.model.settle_surface()
        covariance, sure = self._belief(obs, best).at(best.T_cam_obj, self.model, DOUBTED)
        support = best.hypothesis.support
        return ObjectStep(self._estimate(obs, verdict, confidence=sure, covariance=covariance, inliers=support))

    def _belief(self, obs: Observation, best: Candidate) -> Belief:
        return Belief.of(obs, best, self.known, self.observer, self.config)

    def _sample(self, obs: Observation) -> tuple[np.ndarray, np.ndarray]:
        """New points where the objective wants them: uv_px (M, 2) and p_cam (M, 3)."""
        with self._stopwatch("sampling"):
            cfg = self.config.sampling
            region = usable_region(obs.frame, obs.mask, self.config.depth.edge_m)
            candidates = self.detector.detect(obs.frame, region)
            p_cam = self.observer.lift(obs.frame, candidates.uv_px)
            liftable = np.isfinite(p_cam[:, 0])
            candidates, p_cam = candidates.select(liftable), p_cam[liftable]
            count = min(cfg.points, cfg.max_visible - int(obs.seen.sum()))
            chosen = choose(candidates, obs.tracks.uv_px[obs.seen], count, cfg)
            return candidates.uv_px[chosen], p_cam[chosen]

    # -- start, and frames without a pose ------------------------------------------------------

    def _initialise(self, obs: Observation) -> ObjectStep:
        """The first frame of a map: fix the object frame and start with the first points.

        What was known is put aside, for points enough to go on with; or let go where it was known from a sliver alone.
        """
        cfg, before = self.config, self.life.start_px
        without = Status.INITIALISING if self.model.empty else Status.LOST
        if obs.mask_px is None or hidden(obs.mask_px, self.config):
            return self._without_pose(obs, without, "not seen yet")
        # Points on the first sliver of an object would all be at its rim, and what is known may be about to return.
        if self._gates and before is not None and obs.mask_px > _GROWTH * before:
            return self._without_pose(obs, without, "still coming into view")
        v, u = np.nonzero(self.observer.measured(obs))
        if len(v) < cfg.lifecycle.min_mask_px:
            return self._without_pose(obs, without, f"only {len(v)} mask pixels with depth")
        uv_px, p_cam = self._sample(obs)
        few, aside = len(p_cam) < cfg.registration.min_inliers, not (self.model.empty or self._outgrown(obs))
        if few and (aside or self.model.surface is None or not cfg.method.motion):
            return self._without_pose(obs, without, f"only {len(p_cam)} points to start from")
        T_cam_obj = np.eye(4)
        if cfg.method.object_frame == "centroid":
            seen = self.observer.camera.unproject(np.stack([u, v], -1), obs.frame.depth_m[v, u])
            T_cam_obj[:3, 3] = np.median(seen, 0)
        verdict, forgotten = Verdict(True, Status.TRACKED), NO_IDS
        if not self.model.empty:
            gone = self.aside if aside else self.known
            forgotten = NO_IDS if gone is None else gone.map.ids[gone.map.ids >= 0]
            if aside:
                self.aside = self.known.lost()
            self.known, self._relation = Known(self._new_model(), self.life, self.known.map_id + 1), Relation()
            verdict = Verdict(True, Status.RECOVERED, "a new map: the old one stays lost")
        if few:
            verdict = Verdict(True, Status.DEGRADED, f"only {len(p_cam)} points")
        requests = self.model.insert_keyframe(obs, T_cam_obj, uv_px, p_cam, np.zeros(0, bool))
        self.model.adopt()
        self.life = Lifecycle(verdict.status, T_cam_obj, obs.frame.time_s).placed(obs.frame.T_world_cam)
        self._trusted = obs
        # The first pose defines the object frame: it is right by definition, whatever the points are worth.
        covariance, inliers = self.model.covariance, len(self.map)
        estimate = self._estimate(obs, verdict, confidence=1.0, covariance=covariance, inliers=inliers, keyframe=True)
        return ObjectStep(estimate, replace(requests, drop=forgotten))

    def _outgrown(self, obs: Observation) -> bool:
        """Whether an object that stays lost shows much more than its map was ever founded on, or never was followed."""
        if not self._gates or self.life.lost_frames < _PATIENCE or obs.mask is None:
            return False
        more = self.observer.area_m2(obs) > _OUTGROWN * self.model.seen_m2
        return not self.life.followed or (more and self._outline(obs) >= OUTLINE)

    def _turned_over(self, obs: Observation) -> bool:
        """Whether a known object stays lost in plain view: it shows a side that nobody knows.

        Its mask is given, or it has been in sight since: what the segmenter takes later for an object that was hidden,
        and that agrees with nothing known of it, may be anything.
        """
        room = self.aside is None or self.aside.first_view_alone
        known = self._gates and room and self.life.lost_frames >= _STAYS_LOST
        of_it = obs.given or self.life.in_sight
        if not known or obs.mask is None or not of_it or self.observer.cut_off(obs):
            return False
        plain = self.observer.area_m2(obs) >= _IN_PLAIN_VIEW * self.model.seen_m2
        return plain and self._outline(obs) >= OUTLINE

    # -- two maps ------------------------------------------------------------------------------

    def _by_aside(self, obs: Observation, best: Candidate | None, verdict: Verdict) -> ObjectStep | None:
        """The step by the map that was put aside, where it alone knows the object, or the two become one; else None."""
        known = None if self.aside is None or obs.aside is None else self._known_again(obs.aside, self.aside)
        if known is None:
            return None
        if not verdict.accepted:
            return self._accepted(self._exchanged(obs), *known)
        if verdict.doubted:
            return None
        T_obj_aside = se3.inverse(best.T_cam_obj) @ known[0].T_cam_obj
        self._relation = self._relation.with_frame(T_obj_aside, self.aside.map.p_obj)
        return self._joined(obs, best, known[0]) if self._relation.certain else None

    def _known_again(self, obs: Observation, aside: Known) -> tuple[Candidate, Verdict] | None:
        """The pose by what was put aside, where points and surface say that it is this object; else None."""
        cfg = self.config.lifecycle
        found = [h for h in self.finder.register(obs, aside) if h.support >= cfg.return_inliers]
        best = self.finder.refine_and_select(obs, aside, found)[0] if found else None
        if best is None or best.agreement(aside.keypoints(obs)) < 0:
            return None
        verdict = aside.life.judge(replace(best.evidence, still=obs.still), self._gates, cfg)
        share = best.evidence.surface_share
        fits = verdict.accepted and (share is None or share >= cfg.surface_only_share)
        return (best, verdict) if fits else None

    def _exchanged(self, obs: Observation) -> Observation:
        """Go on in the map that was put aside, with its observation; this one is put aside instead."""
        self.known, self.aside, self._relation = self.aside, self.known.lost(), Relation()
        return replace(obs.aside, aside=replace(obs, aside=None))

    def _joined(self, obs: Observation, best: Candidate, known: Candidate) -> ObjectStep:
        """Two maps that fit this frame become one, in the frame of the older; a keyframe ties what both have seen."""
        T_obj_aside = self._relation.mean
        if self.aside.map_id < self.known.map_id:
            life = self.life.in_frame(T_obj_aside)
            obs, best, known = self._exchanged(obs), known, best
            self.life, T_obj_aside = life, se3.inverse(T_obj_aside)
        gone, self.aside, self._relation = self.aside, None, Relation()
        self.model.join(gone.model, T_obj_aside)
        both = replace(best, hypothesis=agreeing_together(best.hypothesis, known.hypothesis))
        verdict = Verdict(True, Status.RECOVERED, f"maps {self.known.map_id} and {gone.map_id} are one")
        step = self._extend(seen_together(obs, obs.aside), both, verdict, due=True)
        return replace(step, estimate=replace(step.estimate, joined=(gone.map_id, T_obj_aside)))

    def _without_pose(self, obs: Observation, status: Status, reason: str) -> ObjectStep:
        self.life = self.life.without_pose(status, obs.mask_px, self.known.carried(obs.frame.time_s))
        self._trusted = self._trusted if status is Status.LOST else None
        reason = f"{OUT_OF_VIEW}: {reason}" if status is Status.OCCLUDED and self.outlook.out_of_view else reason
        return ObjectStep(self._estimate(obs, Verdict(False, status, reason)))

    def _estimate(self, obs: Observation, verdict: Verdict, **pose: Any) -> PoseEstimate:
        """The estimate of a frame that ``life`` has already taken in; what it says of a ``pose`` where there is one."""
        life = self.life
        return PoseEstimate(
            self.name,
            obs.frame.index,
            obs.frame.time_s,
            verdict.status,
            life.T_cam_obj if life.has_pose else None,
            reason=verdict.reason,
            visible_points=int(obs.seen.sum()),
            last_T_cam_obj=life.T_cam_obj,
            last_seen_s=life.seen_s,
            map_id=self.known.map_id,
            **pose,
        )
