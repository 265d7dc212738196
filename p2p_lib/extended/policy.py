"""The default policy of an object: its motion proposes poses, too, gates judge, doubted frames stay out of the map.

The mechanisms of :mod:`~p2p_lib.extended.default` that :class:`OurPolicy` has are ``on`` or off by name.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import DOUBTED, Status
from p2p_lib.extended.agreement import scene_ratio
from p2p_lib.extended.confidence import Belief, may_slide
from p2p_lib.extended.contour import ContourFit, on_plane
from p2p_lib.extended.gates import FIXED_BY, SIGHTED, Judgement, PoseEvidence, judge
from p2p_lib.extended.graph import explained
from p2p_lib.extended.image_search import centred_on_cloud
from p2p_lib.extended.lifecycle import TELLING, Lifecycle, same_place
from p2p_lib.extended.model import OurKnown
from p2p_lib.extended.motion import motion_weight
from p2p_lib.extended.observation import OurObservation, cut_off, empty
from p2p_lib.extended.shape_search import ShapeSearch
from p2p_lib.method import registration
from p2p_lib.method.object_model import ObjectModel, Requests
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.policy import Admission, Candidate, Policy, Verdict
from p2p_lib.method.refinement import Refinement as Refinement  # the type of an inherited field
from p2p_lib.method.registration import Hypothesis

#: A pose that could not be told from other turns since a gap is compared with them again every so many frames.
_COMPARE_EVERY = 5
#: With depth steps along less of a mask's outline than this, depth does not tell where the object ends.
_CLEAR_OUTLINE = 0.3
#: A pose of less confidence makes no keyframe: the points that it places agree with it for ever after. A pose that the
#: surface alone determines well has more.
MAPPED = 0.1
#: The reason of a pose that is degraded although nothing contradicts it.
_UNCONSTRAINED = "rotation not constrained by shape or texture"
#: The reason of a pose of little confidence although nothing contradicts it.
_UNTOLD = "its turn is not told yet from others that look alike"
_HARDLY = "hardly any point of a sure pose agrees with it"
#: A keypoint that has agreed with so many poses has its whole vote.
_WHOLE_VOTE = 3


@dataclass(frozen=True, eq=False)
class Proposal(Candidate):
    """A hypothesis with what shape and colour say of it.

    sighting  share of the surface that shows under its pose; None: not looked for
    lead      how much more shows than under the best other turn, as a share; None: not compared
    """

    sighting: float | None = None
    lead: float | None = None

    @property
    def evidence(self) -> PoseEvidence:
        """What speaks for it."""
        assert self.refined is not None, "a pose is judged once it is refined"
        share = self.refined.inliers if self.refined.refined else None
        return PoseEvidence(self.hypothesis.support, share, self.sighting, self.lead)

    def agreement(self, keypoints: np.ndarray) -> float:
        """Of the keypoints seen (N,) bool, the share that agrees less the share that does not."""
        return float(np.where(self.hypothesis.inliers[keypoints], 1, -1).mean()) if keypoints.any() else 0.0


@dataclass(frozen=True, eq=False)
class BelievedAdmission(Admission):
    """What of a frame enters the model, and how far its pose is believed.

    T_cam_obj    (4, 4) the pose
    life         the state after it
    belief       what the pose rests on; None: its confidence is not computed
    most         upper bound of the confidence
    stray_sigma  (N, 2) noise in bearing and range by which stray points are kept out of the graph; None: all enter
    """

    T_cam_obj: np.ndarray = field(default_factory=lambda: np.eye(4))
    life: Lifecycle = field(default_factory=Lifecycle)
    belief: Belief | None = None
    most: float = 1.0
    stray_sigma: np.ndarray | None = None

    def rows(self, obs: Observation, model: ObjectModel) -> np.ndarray:
        """As in the paper, without stray points."""
        rows = super().rows(obs, model)
        if self.stray_sigma is None:
            return rows
        return rows & explained(model.map.p_obj, obs.p_cam, self.T_cam_obj, self.stray_sigma)

    def rated(self, model: ObjectModel) -> tuple[np.ndarray, float]:
        """Covariance (6, 6) and confidence; the error of the map as it is now is included."""
        return super().rated(model) if self.belief is None else self.belief.at(self.T_cam_obj, model, self.most)


class OurPolicy(Policy[OurObservation, OurKnown]):
    """The paper's answers with the mechanisms that are ``on``."""

    life: Lifecycle

    def __init__(
        self, observer: Observer, config: Config, rng: np.random.Generator, stopwatch: Stopwatch, on: Container[str]
    ):
        super().__init__(observer, config, rng, stopwatch, Lifecycle())
        self.on = on
        self.shape = ShapeSearch(self.observer, self.config, self.stopwatch, "shape_search" in on)
        self.frozen = False  # whether the map does not grow
        # The last pose, and where the object lies that had it, by the scene as seen last.
        self._lies: tuple[np.ndarray | None, np.ndarray | None] = (None, None)
        self.trusted: OurObservation | None = None  # the newest frame without a doubt; None if hidden since

    # -- propose -------------------------------------------------------------------------------

    def propose(self, obs: OurObservation, known: OurKnown) -> list[Hypothesis]:
        """Candidate poses from the visible keypoints and from priors: the last poses, a sighting."""
        cfg = self.config.registration
        with self.stopwatch("registration"):
            use, certain = self.correspondences(obs, known)
            priors = self._motion_priors(obs, known)
            if obs.sighting is not None:
                priors = {"sighting": obs.sighting.T_cam_obj, **priors}
            p_cam = np.where(use[:, None], obs.p_cam, np.nan)
            found = self.register(known, p_cam, priors)
            most = max((h.support for h in found), default=0)
            if priors and cfg.method != "svd" and most < cfg.contradicted * use.sum():
                # Most keypoints contradict the best pose: pending points may decide, or those that fit the surface.
                p_cam = np.where(certain[:, None], obs.p_cam, np.nan)
                found = self.register(known, p_cam, priors)
                found += self._along_surface(obs, known, p_cam, priors)
            return found or self._surface_only(known, priors)

    def min_keypoints(self, known: OurKnown) -> int:
        """While an object is followed, more: a fast turn leaves pending points where keypoints are few."""
        if "pending_points" in self.on and not known.life.unconfirmed:
            return self.config.keypoint_map.keyframe_min_points
        return super().min_keypoints(known)

    def _motion_priors(self, obs: OurObservation, known: OurKnown) -> dict[str, np.ndarray]:
        """Where the object is by its motion: name to T_cam_obj (4, 4)."""
        priors = known.life.motion_priors() if "motion_prior" in self.on else {}
        return priors or self._carried_on(obs, known)

    def carried(self, known: OurKnown, time_s: float) -> bool:
        """Whether its motion before a gap still says where the object is at this time."""
        motion = known.life.motion
        return "motion_over_gaps" in self.on and motion is not None and motion.holds(time_s)

    def _carried_on(self, obs: OurObservation, known: OurKnown) -> dict[str, np.ndarray]:
        """Where an absent object is if its motion went on, and that turn placed on its measured depth."""
        motion, time_s = known.life.motion, obs.frame.time_s
        if motion is None or not (self.carried(known, time_s) and len(obs.cloud) and self.shape.knows(known)):
            return {}
        T_cam_obj = motion.at(time_s)
        (on_depth,) = centred_on_cloud(T_cam_obj[None], obs.cloud, self.shape.sample(known.model))
        near = np.linalg.norm(on_depth[:3, 3] - T_cam_obj[:3, 3]) < motion.reach_m(time_s)
        return {"motion": T_cam_obj} | ({"motion, on its depth": on_depth} if near else {})

    def _along_surface(
        self, obs: OurObservation, known: OurKnown, p_cam: np.ndarray, priors: dict[str, np.ndarray]
    ) -> list[Hypothesis]:
        """The hypothesis that is refit from the pose that the surface alone leads to; or none."""
        start = self.refined(obs, known, list(priors.values())[-1])
        if not start.refined:
            return []
        cfg, sigma_m = self.config.registration, known.model.noise_m(p_cam)
        return registration.refit(start.T_cam_obj, "surface", known.map.p_obj, p_cam, cfg, sigma_m)

    def _surface_only(self, known: OurKnown, priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """Hypotheses without points, at the priors, for when too few points register: the surface may refine them."""
        no_inliers, no_residual = np.zeros(len(known.map), bool), np.full(len(known.map), np.inf)
        return [Hypothesis(T_cam_obj, no_inliers, no_residual, name) for name, T_cam_obj in priors.items()]

    # -- choose --------------------------------------------------------------------------------

    def refined(
        self, obs: OurObservation, known: OurKnown, T_cam_obj: np.ndarray, agrees: np.ndarray | None = None
    ) -> Refinement:
        """As in the paper; something flat that no points hold is held by where it ends, while it is followed."""
        found = super().refined(obs, known, T_cam_obj, agrees)
        held = known.life.unconfirmed or (agrees is not None and agrees.sum() >= FIXED_BY)
        fit = None if held else self._contour(obs, known, found)
        if fit is None:
            return found
        surface = known.model.surface
        assert surface is not None, "what is flat was refined on it"
        return fit.refined(found, obs.cloud, surface, self.config.refinement)

    def _contour(self, obs: OurObservation, known: OurKnown, refined: Refinement) -> ContourFit | None:
        """The contour that something flat is known by beside the one that is seen; None where there is none."""
        if not self._flat(refined) or known.life.contour is None:
            return None
        return ContourFit(known.life.contour, obs.contour_px, obs.frame, self.observer.camera)

    def _flat(self, refined: Refinement) -> bool:
        """Whether the contour has a say: where the surface leaves free to all sides where the object is."""
        return "contour" in self.on and may_slide(refined, self.config.refinement.min_eigenvalue, 2)

    def choose(self, obs: OurObservation, known: OurKnown, hypotheses: list[Hypothesis]) -> tuple[Proposal | None, str]:
        """The best of some hypotheses, refined, and why. The paper selects one and refines that; ours refines all."""
        candidates = [Proposal(hypothesis) for hypothesis in hypotheses]
        if self.config.selection.rule == "support":
            candidates = self._look_again(obs, known, [self.refine(obs, known, c) for c in candidates])
        best, reason = self._best(obs, known, candidates)
        if best is None:
            return None, reason
        return self._told_from_turns(obs, known, best if best.refined else self.refine(obs, known, best)), reason

    def _best(self, obs: OurObservation, known: OurKnown, candidates: list[Proposal]) -> tuple[Proposal | None, str]:
        """The candidate to go on with, and why."""
        few = max((c.hypothesis.support for c in candidates), default=0) < self.config.lifecycle.return_inliers
        if few and any((c.sighting or 0.0) > 0 for c in candidates):
            return max(candidates, key=lambda c: c.sighting or 0.0), "most of the surface shows"
        weight = np.ones(len(candidates))
        if "motion_weight" in self.on:
            poses, priors = [c.T_cam_obj for c in candidates], list(known.life.motion_priors().values())
            weight = motion_weight(poses, priors)
        if "votes" in self.on:
            weight = weight * self._votes(known, candidates)
        return self.select(obs, known, candidates, weight)

    def _votes(self, known: OurKnown, candidates: list[Proposal]) -> np.ndarray:
        """(H,) mean vote, up to 1, of the points that agree with each candidate: it grows with what they agreed with.

        New points on a reflection that stands still are many, and contradict those that have moved with the object.
        """
        vote = (1 + np.minimum(known.map.agreed, _WHOLE_VOTE)) / (1 + _WHOLE_VOTE)
        return np.array([vote[c.hypothesis.inliers].mean() if c.hypothesis.support else 0.0 for c in candidates])

    def _look_again(self, obs: OurObservation, known: OurKnown, candidates: list[Proposal]) -> list[Proposal]:
        """Candidates for a return, with how much of the surface shows in the image under each."""
        if not (known.life.unconfirmed and self.shape.knows(known)):
            return candidates
        found = self.shape.at(obs, known, [c.T_cam_obj for c in candidates])
        return [replace(c, sighting=None if s is None else s.share) for c, s in zip(candidates, found, strict=True)]

    def _told_from_turns(self, obs: OurObservation, known: OurKnown, best: Proposal) -> Proposal:
        """The pose of a return with its lead over the best other turn, or that turn if much more of the surface shows.

        Repeated now and then until the lead is telling. Where no other turn is known, the keypoints' agreement leads.
        """
        life = known.life
        due = life.unconfirmed or (life.doubted and not obs.frame.index % _COMPARE_EVERY)
        if not (due and self.shape.knows(known) and "turns" in self.on):
            return best
        own, other = self.shape.otherwise(obs, known, best.T_cam_obj)
        if own is None or other is None:
            return replace(best, lead=0.0 if own is None else best.agreement(known.keypoints(obs)))
        lead = (own.share - other.share) / max(own.share, other.share, 1e-6)
        if lead > -TELLING or other.share < SIGHTED or cut_off(self.observer, obs):
            return replace(best, lead=lead)
        (hypothesis,) = self._surface_only(known, {"other turn": other.T_cam_obj})
        turned = self.refine(obs, known, Proposal(hypothesis))
        return replace(turned, sighting=other.share, lead=0.0)

    # -- judge ---------------------------------------------------------------------------------

    def start(self, known: OurKnown, points: int) -> Verdict:
        """A map may begin with fewer points than registration needs, if the surface can track."""
        verdict = super().start(known, points)
        if verdict.accepted or known.model.surface is None or "motion_prior" not in self.on:
            return verdict
        return Verdict(True, Status.DEGRADED, verdict.reason)

    def judge(self, obs: OurObservation, known: OurKnown, best: Candidate) -> Judgement:
        """Whether the pose stands, by its evidence and by the consistency of depth and masks."""
        assert isinstance(best, Proposal) and best.refined is not None
        ratio = self._scene_ratio(obs) if "scale" in self.on else 1.0
        outline = self.outline(obs) if "outline" in self.on else 1.0
        carried = self.carried(known, obs.frame.time_s)
        slides = "sliding_gate" in self.on and may_slide(best.refined, self.config.refinement.min_eigenvalue)
        fit = self._contour(obs, known, best.refined)
        rests = self._rests(obs, known, best) if "rest" in self.on else None
        contour = 0.0 if fit is None else fit.share(best.T_cam_obj)
        consistent = replace(best.evidence, scene_ratio=ratio, outline=outline, still=obs.still, rests=rests)
        evidence = replace(consistent, carried=carried, slides=slides, contour=contour)
        return judge(known.life, evidence, self.on, self.config.lifecycle)

    def judge_other(self, obs: OurObservation, known: OurKnown, best: Proposal) -> Judgement:
        """The same in the other map, by the pose's own evidence alone."""
        return judge(known.life, replace(best.evidence, still=obs.still), self.on, self.config.lifecycle)

    def _rests(self, obs: OurObservation, known: OurKnown, best: Proposal) -> bool | None:
        """Whether an object that lay still is where the scene has it; None if unknown, or the place is seen empty."""
        place = known.life.scene_prior(obs.frame.T_world_cam).get("scene") if known.life.lay_still else None
        if place is None:
            return None
        near = same_place(place, best.T_cam_obj)
        return near or (None if empty(self.observer, obs.frame, place, known.map.p_obj) else False)

    def _scene_ratio(self, obs: OurObservation) -> float:
        """How far away the resting scene is measured, over what it was in the newest frame without a doubt."""
        before = self.trusted
        if obs.mask is None or before is None or before.mask is None:
            return 1.0
        return scene_ratio(obs.frame, obs.mask, before.frame, before.mask)

    def outline(self, obs: OurObservation) -> float:
        """Share of the mask's outline along depth steps, relative to that in the newest frame without a doubt."""
        then, now = None if self.trusted is None else self.trusted.outline_share, obs.outline_share
        return 1.0 if then is None or now is None or then < _CLEAR_OUTLINE else now / then

    # -- admit and request ---------------------------------------------------------------------

    def admit(self, obs: OurObservation, known: OurKnown, best: Candidate, verdict: Verdict) -> BelievedAdmission:
        """Nothing is learnt from a doubted pose, and one of little confidence makes no keyframe."""
        assert isinstance(best, Proposal) and isinstance(verdict, Judgement)
        belief = Belief.of(obs, best, known, self, "texture" in self.on) if "confidence" in self.on else None
        life = known.life.with_verdict(best.T_cam_obj, obs.frame.time_s, verdict, best.lead)
        most = DOUBTED if verdict.doubted or life.doubted else 1.0
        kept: dict[str, Any] = {"life": life, "T_cam_obj": best.T_cam_obj, "belief": belief, "most": most}
        kept |= {"learns": not verdict.doubted, "in_camera": "moving_points" in self.on}
        if "stray_points" in self.on and not verdict.joins:  # joined maps are only as well aligned as their poses
            sigma_m = self.observer.noise_m(obs.p_cam)
            bearing_rad = np.full_like(sigma_m, self.config.factor_graph.bearing_sigma_rad)
            kept["stray_sigma"] = np.stack([bearing_rad, sigma_m], -1)
        kept["keyframe"] = not self.frozen
        if belief is None:
            return BelievedAdmission(verdict, best.hypothesis.inliers, self.covariance(obs, known, best), **kept)
        # For the map an unconstrained turn does not count: it bends nothing.
        covariance, confidence = belief.at(best.T_cam_obj, known.model, most, constrained=True)
        kept["keyframe"] &= "sure_keyframes" not in self.on or (
            not life.confirming and belief.confidence_given_turn(covariance) >= MAPPED
        )
        if not verdict.doubted and not belief.constrained and verdict.status is Status.TRACKED:
            verdict = replace(verdict, status=Status.DEGRADED, reason=_UNCONSTRAINED)
        if confidence <= DOUBTED and not verdict.reason:
            verdict = replace(verdict, reason=_UNTOLD if life.doubted else _HARDLY)
        return BelievedAdmission(verdict, best.hypothesis.inliers, belief.of_frame, confidence, **kept)

    def request(self, obs: OurObservation, known: OurKnown, best: Candidate, admission: Admission) -> Requests:
        """Tracks of keypoints that contradict the pose are rejected, if the frame is learnt from and others agree.

        A pose that the surface alone has says nothing against points.
        """
        if "rejection" not in self.on or not admission.learns or best.hypothesis.support < FIXED_BY:
            return Requests()
        return Requests(reject=known.map.ids[known.keypoints(obs) & ~best.hypothesis.inliers])

    # -- the object's life ---------------------------------------------------------------------

    def begun(self, obs: OurObservation, T_cam_obj: np.ndarray, verdict: Verdict) -> Lifecycle:
        """As in the paper, with its place in the scene; the frame becomes the trusted one."""
        self.trusted = obs
        life = super().begun(obs, T_cam_obj, verdict)
        assert isinstance(life, Lifecycle)
        life = life.placed(obs.frame.T_world_cam)
        return self._outlined(life, obs, T_cam_obj) if "contour" in self.on else life

    def followed(
        self, obs: OurObservation, known: OurKnown, best: Candidate, admitted: Admission, confidence: float
    ) -> Lifecycle:
        """A frame that is learnt from updates its place in the scene and its motion, too."""
        assert isinstance(admitted, BelievedAdmission) and best.refined is not None
        life = admitted.life
        if not admitted.learns:
            return life
        certain = best.hypothesis.support >= self.config.lifecycle.return_inliers
        if (certain or life.contour is None) and self._flat(best.refined):
            life = self._outlined(life, obs, best.T_cam_obj)
        return life.placed(obs.frame.T_world_cam).moved(confidence)

    def _outlined(self, life: Lifecycle, obs: OurObservation, T_cam_obj: np.ndarray) -> Lifecycle:
        """The life with the contour that is seen under a pose, where that can be known."""
        p_cam = on_plane(obs.contour_px, obs.cloud, self.observer.camera)
        return life if p_cam is None else replace(life, contour=se3.transform(se3.inverse(T_cam_obj), p_cam))

    def expected(self, obs: OurObservation, known: OurKnown) -> np.ndarray | None:
        """Where it was left in the static scene, by the newest frame that located the camera; else as in the paper."""
        last = super().expected(obs, known)
        if known.life.lay_still and (prior := known.life.scene_prior(obs.frame.T_world_cam)):
            self._lies = last, prior["scene"]
        since, lies = self._lies
        return lies if since is last and since is not None else last

    def missed(self, obs: OurObservation, known: OurKnown, verdict: Verdict) -> Lifecycle:
        """After a frame in which the object was hidden, later ones are not compared with those before."""
        self.trusted = self.trusted if verdict.status is Status.LOST else None
        return known.life.without_pose(verdict.status, obs.mask_px, self.carried(known, obs.frame.time_s))
