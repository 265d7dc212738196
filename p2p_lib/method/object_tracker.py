"""One object's step: register, refine, select, judge, extend (paper: Fig. "Overview of the framework").

:class:`Point2Pose` tracks and segments for all objects; here one object's observation becomes its pose. Whatever it
wants of the shared tracker it returns as :class:`Requests`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.core.interfaces import Detector, Hint
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Frame, PoseEstimate, Status, Tracks
from p2p_lib.method import refinement, registration, selection
from p2p_lib.method.confidence import confidence
from p2p_lib.method.lifecycle import GATES, Evidence, Lifecycle, Verdict
from p2p_lib.method.object_model import NewPoints, ObjectModel, Requests
from p2p_lib.method.observability import drift_covariance
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.refinement import Keypoints, Refinement, surface_distance
from p2p_lib.method.registration import Hypothesis
from p2p_lib.method.sampling import choose, usable_region


@dataclass(frozen=True, eq=False)
class Proposal:
    """What an object makes of a frame before it decides: its hypotheses, and the tracks that it rejects."""

    observation: Observation
    hypotheses: list[Hypothesis] = field(default_factory=list)
    reject: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis with its pose refined on the surface."""

    hypothesis: Hypothesis
    refined: Refinement

    @property
    def evidence(self) -> Evidence:
        """What speaks for it."""
        share = self.refined.inliers if self.refined.refined else None
        return Evidence(self.hypothesis.support, share)


@dataclass(frozen=True, eq=False)
class ObjectStep:
    """One object's answer to a frame."""

    estimate: PoseEstimate
    requests: Requests = field(default_factory=Requests)


class ObjectTracker:
    """State and step of one object: what it has been through (``life``) and what is known of it (``model``)."""

    def __init__(
        self,
        name: str,
        camera: Camera,
        config: Config,
        detector: Detector,
        rng: np.random.Generator,
        stopwatch: Stopwatch,
    ):
        self.name, self.config, self.detector = name, config, detector
        self.observer = Observer(camera, config.depth, config.refinement.max_points if config.method.surface else 0)
        self.model = ObjectModel(config, self.observer, stopwatch)
        self.life = Lifecycle()
        self._gates = tuple(GATES) if config.method.gates == "all" else ()
        self._rng, self._stopwatch = rng, stopwatch

    # -- the step ------------------------------------------------------------------------------

    def propose(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> Proposal:
        """Observe and register: the hypotheses of this frame."""
        with self._stopwatch("observation"):
            obs = self.observer.observe(frame, mask, tracks.select(self.model.map.ids))
        if self.model.empty or self._hidden(mask):
            return Proposal(obs, reject=self._misplaced(obs))
        return Proposal(obs, self._register(obs), self._misplaced(obs))

    def redetected(self, proposal: Proposal, tracks: Tracks) -> Proposal:
        """The proposal once more, from tracks that guided re-detection has added to."""
        obs = self.observer.tracked(proposal.observation, tracks.select(self.model.map.ids))
        return replace(proposal, observation=obs, hypotheses=self._register(obs))

    def step(self, proposal: Proposal) -> ObjectStep:
        """Refine, select, judge and extend: the object's pose at this frame."""
        obs = proposal.observation
        if self.model.empty:
            return self._initialise(obs)
        if self._hidden(obs.mask):
            return self._without_pose(obs, Status.OCCLUDED, f"{int(obs.mask.sum())} mask pixels")
        best, reason = self._select(obs, proposal.hypotheses)
        if best is None:
            nothing = obs.mask is None and not obs.seen.any()
            return self._without_pose(obs, Status.OCCLUDED if nothing else Status.LOST, reason)
        verdict = self.life.judge(best.evidence, self._gates, self.config.lifecycle)
        if not verdict.accepted:
            return self._without_pose(obs, verdict.status, verdict.reason)
        return self._extend(obs, best, verdict)

    # -- register ------------------------------------------------------------------------------

    def _register(self, obs: Observation) -> list[Hypothesis]:
        """Candidate poses from the keypoints seen; with motion, from the last poses too."""
        cfg, with_motion = self.config.registration, self.config.method.motion
        with self._stopwatch("registration"):
            certain = obs.seen & (obs.tracks.uncertainty <= cfg.max_uncertainty)
            use = certain & self.model.map.promoted
            if use.sum() < cfg.min_promoted:
                use = certain
            priors = self.life.motion_priors() if with_motion else {}
            found = self._hypotheses(obs, use, priors)
            most = max((h.support for h in found), default=0)
            if priors and cfg.method != "svd" and most < cfg.contradicted * use.sum():
                found = self._hypotheses(obs, certain, priors) + self._along_surface(obs, certain, priors)
            return self._surface_only(self._without_jumps(found), priors) if with_motion else found

    def _hypotheses(self, obs: Observation, use: np.ndarray, priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """Hypotheses from the points ``use`` (N,) alone."""
        p_cam = np.where(use[:, None], obs.p_cam, np.nan)
        cfg, sigma_m = self.config.registration, self.model.noise_m(p_cam)
        return registration.register(self.model.map.p_obj, p_cam, cfg, self._rng, sigma_m=sigma_m, priors=priors)

    def _along_surface(self, obs: Observation, use: np.ndarray, priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """The hypothesis that grows from where the surface alone leads: most points may be wrong."""
        start = self._refine(obs, list(priors.values())[-1])
        if not start.refined:
            return []
        p_cam = np.where(use[:, None], obs.p_cam, np.nan)
        cfg, sigma_m = self.config.registration, self.model.noise_m(p_cam)
        return registration.refit(start.T_cam_obj, "surface", self.model.map.p_obj, p_cam, cfg, sigma_m)

    def _without_jumps(self, found: list[Hypothesis]) -> list[Hypothesis]:
        """Objects do not jump between frames: a hypothesis that does must have more support than any that does not.

        It also needs as many points as a return. A box whose faces look alike flips otherwise.
        """
        moved = self.life.moved_from_last(np.stack([h.T_cam_obj for h in found])) if found else None
        if moved is None:
            return found
        cfg, (moved_m, turned_deg) = self.config.lifecycle, moved
        jumps = (moved_m > cfg.max_jump_m) | (turned_deg > cfg.max_jump_deg)
        support = np.array([h.support for h in found])
        needed = max([cfg.return_inliers, *(support[~jumps] + 1)])
        return [h for h, jumped in zip(found, jumps, strict=True) if not jumped or h.support >= needed]

    def _surface_only(self, found: list[Hypothesis], priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """Where too few points register, the surface may track for a while, from where the object should be."""
        if found or self.life.surface_only >= self.config.lifecycle.surface_only_frames:
            return found
        n = len(self.model.map)
        no_inliers, no_residual = np.zeros(n, bool), np.full(n, np.inf)
        return [Hypothesis(T_cam_obj, no_inliers, no_residual, name) for name, T_cam_obj in priors.items()]

    # -- refine and select ---------------------------------------------------------------------

    def _refine(self, obs: Observation, T_cam_obj: np.ndarray, agrees: np.ndarray | None = None) -> Refinement:
        """The pose refined on the surface, with the keypoints that agree (N,) where the configuration says so."""
        cfg = self.config.refinement
        if cfg.residuals == "none" or not self.model.has_surface or not len(obs.cloud):
            return Refinement(T_cam_obj, reason="no surface")
        keypoints = None
        if agrees is not None:
            p_cam = obs.p_cam[agrees]
            keypoints = Keypoints(self.model.map.p_obj[agrees], p_cam, self.observer.noise_m(p_cam))
        return refinement.refine(T_cam_obj, obs.cloud, self.model.surface, cfg, keypoints=keypoints)

    def _select(self, obs: Observation, hypotheses: list[Hypothesis]) -> tuple[Candidate | None, str]:
        """The hypothesis to go on with, refined, and why it was chosen.

        The paper selects, then refines the selected one; ours refines all that compete first.
        """
        cfg = self.config.selection
        refine_first = cfg.rule == "support"
        if refine_first:
            hypotheses = selection.supported(hypotheses, cfg)
        refined: list[Refinement] = []
        if refine_first:
            with self._stopwatch("refinement"):
                refined = [self._refine(obs, h.T_cam_obj, h.inliers) for h in hypotheses]
        with self._stopwatch("selection"):
            T_cam_obj = [pose.T_cam_obj for pose in (refined or hypotheses)]
            weight = selection.motion_weight(T_cam_obj, list(self.life.motion_priors().values()), cfg)
            distance_m = self._surface_distances(obs, T_cam_obj)
            row, reason = selection.select(hypotheses, distance_m, cfg, weight if refine_first else None)
        if row is None:
            return None, reason
        if not refine_first:
            with self._stopwatch("refinement"):
                refined = {row: self._refine(obs, hypotheses[row].T_cam_obj, hypotheses[row].inliers)}
        return Candidate(hypotheses[row], refined[row]), reason

    def _surface_distances(self, obs: Observation, T_cam_obj: list[np.ndarray]) -> np.ndarray | None:
        """(H, M) how far each dense point lies from the surface under each pose; None where nothing is compared."""
        if len(T_cam_obj) < 2 or not self.model.has_surface or not len(obs.cloud):
            return None
        unseen = self.config.selection.unseen_share
        return refinement.surface_distances(self.model.surface, obs.cloud, np.stack(T_cam_obj), unseen)

    # -- extend --------------------------------------------------------------------------------

    def _extend(self, obs: Observation, best: Candidate, verdict: Verdict) -> ObjectStep:
        """Take an accepted frame into the model, with a keyframe where one is due."""
        T_cam_obj, agrees, model = best.refined.T_cam_obj, best.hypothesis.inliers, self.model
        life = self.life.with_pose(T_cam_obj, obs.frame.time_s, verdict, best.hypothesis.support, self.config.lifecycle)
        used = obs.seen & model.map.promoted
        # Counted before a keyframe changes the map's rows.
        support = (model.map.confidence[agrees].sum(), (agrees & used).sum() / max(used.sum(), 1))
        requests = Requests(reject=model.map.ids[used & ~agrees])
        covariance = self._covariance(obs, best)
        with self._stopwatch("map"):
            model.observe(obs, T_cam_obj, agrees, self._moved_little(T_cam_obj))
            keyframe = not life.confirming and model.keyframe_due(obs, T_cam_obj, agrees)
        model.settle_surface()
        if keyframe:
            good = obs.seen & (agrees | ~model.map.promoted)
            _, sure = self._certainty(T_cam_obj, best.refined, covariance, *support)
            T_cam_obj, asked = model.insert_keyframe(obs, T_cam_obj, self._sample(obs), good, covariance, sure)
            requests = replace(asked, reject=requests.reject)
        of_pose, sure = self._certainty(T_cam_obj, best.refined, covariance, *support)
        self.life = replace(life, T_cam_obj=T_cam_obj)
        step = self._estimate(obs, verdict, best.hypothesis.support, sure, of_pose, keyframe)
        return ObjectStep(step, requests)

    def _covariance(self, obs: Observation, best: Candidate) -> np.ndarray:
        """(6, 6) of the pose relative to the map, right tangent of T_cam_obj."""
        if best.refined.covariance is not None:
            return best.refined.covariance
        sigma_m = self.observer.noise_m(obs.p_cam)
        return registration.covariance(best.hypothesis, self.model.map.p_obj, obs.p_cam, sigma_m)

    def _certainty(
        self, T_cam_obj: np.ndarray, refined: Refinement, covariance: np.ndarray, agreeing: float, agreement: float
    ) -> tuple[np.ndarray, float]:
        """(6, 6) covariance and confidence of a pose, with what the map itself may be wrong by.

        covariance           (6, 6) of the pose relative to the map
        agreeing, agreement  keypoints that agree with it, by their confidence, and their share of those seen
        """
        cfg = self.config.factor_graph
        drift = drift_covariance(refined.free_rotations, self.model.views.accumulated_rad(T_cam_obj), cfg.drift_share)
        of_pose = cfg.covariance_scale * (covariance + self.model.covariance + drift)
        return of_pose, confidence(of_pose, agreeing, agreement)

    def _moved_little(self, T_cam_obj: np.ndarray) -> bool:
        """The appendix's "Pose Stability" check against the frame before."""
        moved = self.life.moved_from_last(T_cam_obj)
        cfg = self.config.keypoint_map
        return moved is not None and bool(moved[0] < cfg.stable_translation_m and moved[1] < cfg.stable_rotation_deg)

    def _sample(self, obs: Observation) -> NewPoints:
        """New points where the objective wants them."""
        with self._stopwatch("sampling"):
            cfg = self.config.sampling
            region = usable_region(obs.frame, obs.mask, cfg, self.config.depth.edge_m)
            candidates = self.detector.detect(obs.frame, region)
            p_cam = self.observer.lift(obs.frame, candidates.uv_px)
            liftable = np.isfinite(p_cam[:, 0])
            candidates, p_cam = candidates.select(liftable), p_cam[liftable]
            count = min(cfg.points, cfg.max_visible - int(obs.seen.sum()))
            chosen = choose(candidates, obs.tracks.uv_px[obs.seen], count, cfg)
            return NewPoints(candidates.uv_px[chosen], p_cam[chosen])

    # -- start, and frames without a pose ------------------------------------------------------

    def _initialise(self, obs: Observation) -> ObjectStep:
        """The first frame: fix the object frame and start the map with the first points."""
        cfg, before = self.config, self.life.start_px
        pixels = None if obs.mask is None else int(obs.mask.sum())
        self.life = replace(self.life, start_px=pixels)
        if pixels is None or pixels < cfg.lifecycle.min_mask_px:
            return self._without_pose(obs, Status.INITIALISING, "not seen yet")
        # Points on the first sliver of an object would all be at its rim.
        if self._gates and before is not None and pixels > cfg.lifecycle.start_growth * before:
            return self._without_pose(obs, Status.INITIALISING, "still coming into view")
        v, u = np.nonzero(self.observer.measured(obs))
        if len(v) < cfg.lifecycle.min_mask_px:
            return self._without_pose(obs, Status.INITIALISING, f"only {len(v)} mask pixels with depth")
        points = self._sample(obs)
        few = len(points) < cfg.registration.min_inliers
        if few and not (self.model.surface is not None and cfg.method.motion):
            return self._without_pose(obs, Status.INITIALISING, f"only {len(points)} points to start from")
        T_cam_obj = np.eye(4)
        if cfg.method.object_frame == "centroid":
            p_cam = self.observer.camera.unproject(np.stack([u, v], -1), obs.frame.depth_m[v, u])
            T_cam_obj[:3, 3] = np.median(p_cam, 0)
        T_cam_obj, requests = self.model.insert_keyframe(obs, T_cam_obj, points, np.zeros(0, bool))
        verdict = Verdict(True, Status.DEGRADED if few else Status.TRACKED, f"only {len(points)} points" * few)
        self.life = self.life.started(T_cam_obj, obs.frame.time_s, verdict)
        # The first pose defines the object frame: it is right by definition, whatever the points are worth.
        estimate = self._estimate(obs, verdict, len(self.model.map), 1.0, self.model.covariance, True)
        return ObjectStep(estimate, requests)

    def _hidden(self, mask: np.ndarray | None) -> bool:
        """Whether a mask says that nothing of the object is to be seen."""
        return mask is not None and mask.sum() < self.config.lifecycle.min_mask_px

    def _misplaced(self, obs: Observation) -> np.ndarray:
        """Ids of tracks found outside the mask of an object that is away: on a look-alike perhaps."""
        if self.model.empty or self.life.has_pose:
            return np.zeros(0, np.int64)
        return self.model.map.ids[obs.outside_mask()]

    def _estimate(
        self, obs: Observation, verdict: Verdict, support: int, sure: float, covariance: np.ndarray, keyframe: bool
    ) -> PoseEstimate:
        """The estimate of an accepted frame, whose pose ``life`` has already taken in."""
        return PoseEstimate(
            self.name,
            obs.frame.index,
            obs.frame.time_s,
            verdict.status,
            self.life.T_cam_obj,
            sure,
            covariance,
            reason=verdict.reason,
            visible_points=int(obs.seen.sum()),
            inliers=support,
            last_T_cam_obj=self.life.T_cam_obj,
            last_seen_s=self.life.seen_s,
            keyframe=keyframe,
        )

    def _without_pose(self, obs: Observation, status: Status, reason: str) -> ObjectStep:
        self.life = self.life.without_pose(status)
        estimate = PoseEstimate(
            self.name,
            obs.frame.index,
            obs.frame.time_s,
            status,
            reason=reason,
            visible_points=int(obs.seen.sum()),
            last_T_cam_obj=self.life.T_cam_obj,
            last_seen_s=self.life.seen_s,
        )
        return ObjectStep(estimate)

    # -- questions of the pipeline -------------------------------------------------------------

    @property
    def map(self):
        """The keypoint map."""
        return self.model.map

    def awaited(self, mask: np.ndarray | None) -> bool:
        """Whether the object was hidden or lost until now and its mask says that it is back."""
        return not self.model.empty and not self.life.has_pose and mask is not None and not self._hidden(mask)

    def expected_px(self, proposal: Proposal) -> np.ndarray | None:
        """(N, 2) where keypoints show under the best hypothesis, NaN where not: what guided re-detection looks for.

        None where there are enough points, or no pose to go by. A few points that agree say where all the others
        should show, which the tracker checks by their appearance: so an object is back in the frame of its return.
        """
        obs, cfg, away = proposal.observation, self.config.lifecycle, not self.life.has_pose
        if self.config.method.redetection == "none" or self.model.empty or obs.mask is None or self._hidden(obs.mask):
            return None
        if not away and (obs.seen & self.map.promoted).sum() >= cfg.redetect_below:
            return None
        hypotheses = proposal.hypotheses
        if away and not hypotheses:
            fewer = replace(self.config.registration, min_inliers=registration.MINIMAL)
            with self._stopwatch("registration"):
                sigma_m = self.model.noise_m(obs.p_cam)
                hypotheses = registration.register(self.map.p_obj, obs.p_cam, fewer, self._rng, sigma_m=sigma_m)
        if not hypotheses:
            return None
        T_cam_obj = max(hypotheses, key=lambda h: h.support).T_cam_obj
        expected = self.observer.expected_px(obs, T_cam_obj, self.map.p_obj, cfg.redetect_depth_m)
        expected[~self.map.promoted] = np.nan
        return expected

    def hint(self, frame: Frame, tracks: Tracks) -> tuple[Hint, np.ndarray]:
        """Where this object should be, by its tracks and its model, before the frame is segmented.

        Also the ids of tracks to reject: while the object is away, points that agree on no pose are somewhere else.
        """
        nothing = np.zeros(0, np.int64)
        if self.model.empty:
            return Hint(), nothing
        obs = self.observer.observe(frame, None, tracks.select(self.map.ids))
        best = max(self._register(obs), key=lambda h: h.support, default=None)
        if not self.life.has_pose:
            agrees = np.zeros(len(self.map), bool) if best is None else best.inliers
            nothing = self.map.ids[obs.tracks.visible & ~agrees]
        if best is None or (not self.life.has_pose and best.support < self.config.lifecycle.return_inliers):
            return Hint(), nothing
        distance_m = None
        if self.model.has_surface:
            corners = self.model.surface.corners_m()
            distance_m = surface_distance(
                self.model.surface, corners, frame.depth_m, self.observer.camera, best.T_cam_obj
            )
        return Hint(obs.tracks.uv_px[best.inliers], distance_m), nothing
