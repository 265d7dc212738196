"""What an object's step leaves open, and the paper's answers: propose, choose, judge, admit, request.

:class:`~p2p_lib.method.object_tracker.ObjectTracker` asks these questions in its step. The paper takes the hypothesis
that lies nearest to the surface, accepts every pose that it finds, and learns from every frame with a pose (section
"Frame-to-Map Registration for Pose Estimation", appendix "Sampling Criteria").
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np

from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import Status
from p2p_lib.method import refinement, registration, selection
from p2p_lib.method.object_model import Known, Life, ObjectModel, Requests
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.refinement import Keypoints, Refinement
from p2p_lib.method.registration import Hypothesis


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis, and its refinement on the surface once there is one."""

    hypothesis: Hypothesis
    refined: Refinement | None = None

    @property
    def T_cam_obj(self) -> np.ndarray:
        """(4, 4) the refined pose, else the hypothesis's."""
        return (self.refined or self.hypothesis).T_cam_obj


@dataclass(frozen=True)
class Verdict:
    """Whether a pose stands, with the status that it gives the object and the reason in words."""

    accepted: bool
    status: Status
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Admission:
    """What of a frame with a pose enters the model.

    agrees      (N,) bool: keypoints whose observations agree with the pose
    covariance  (6, 6) of the pose, right tangent of T_cam_obj, [rotation rad, translation m]
    confidence  of the pose, in [0, 1]; the paper has none, so its poses have 1
    learns      whether the keypoint map takes the frame in
    keyframe    whether it may become a keyframe
    in_camera   whether a point must move with the object to become a keypoint
    """

    verdict: Verdict
    agrees: np.ndarray
    covariance: np.ndarray
    confidence: float = 1.0
    learns: bool = True
    keyframe: bool = True
    in_camera: bool = False

    def rows(self, obs: Observation, model: ObjectModel) -> np.ndarray:
        """(N,) bool: points whose observations enter the graph at a keyframe: those that agree, and the pending."""
        return obs.seen & (self.agrees | ~model.map.promoted)

    def rated(self, model: ObjectModel) -> tuple[np.ndarray, float]:
        """Covariance (6, 6) and confidence to report: the newest keyframe's covariance, by the graph, is added."""
        return self.covariance + model.covariance, self.confidence


ObsT = TypeVar("ObsT", bound=Observation)
KnownT = TypeVar("KnownT", bound="Known[ObjectModel, Life]")
CandidateT = TypeVar("CandidateT", bound=Candidate)


@dataclass(eq=False)
class Policy(Generic[ObsT, KnownT]):
    """The paper's answers for one object; ``known`` is its model and its life so far."""

    observer: Observer
    config: Config
    rng: np.random.Generator
    stopwatch: Stopwatch
    life: Life = field(default_factory=Life)  # before the object has been seen

    # -- propose -------------------------------------------------------------------------------

    def propose(self, obs: ObsT, known: KnownT) -> list[Hypothesis]:
        """Candidate poses from the visible keypoints."""
        with self.stopwatch("registration"):
            use, _ = self.correspondences(obs, known)
            return self.register(known, np.where(use[:, None], obs.p_cam, np.nan))

    def hidden(self, obs: ObsT) -> bool:
        """Whether the mask says that nothing of the object is to be seen."""
        return obs.mask_px is not None and obs.mask_px < self.config.lifecycle.min_mask_px

    def correspondences(self, obs: ObsT, known: KnownT) -> tuple[np.ndarray, np.ndarray]:
        """(N,) bool each: the points to register, and all that are certain enough for it."""
        certain = obs.seen & (obs.tracks.uncertainty <= self.config.registration.max_uncertainty)
        use = certain & known.map.promoted
        return (use if use.sum() >= self.min_keypoints(known) else certain), certain

    def min_keypoints(self, known: KnownT) -> int:
        """With fewer visible keypoints than this, pending points help to register (the release's number)."""
        return 12

    def register(
        self, known: KnownT, p_cam: np.ndarray, priors: dict[str, np.ndarray] | None = None
    ) -> list[Hypothesis]:
        """Hypotheses from the map's points as measured, p_cam (N, 3); rows of NaN are ignored."""
        cfg, sigma_m = self.config.registration, known.model.noise_m(p_cam)
        return registration.register(known.map.p_obj, p_cam, cfg, self.rng, sigma_m=sigma_m, priors=priors)

    # -- choose --------------------------------------------------------------------------------

    def choose(self, obs: ObsT, known: KnownT, hypotheses: list[Hypothesis]) -> tuple[Candidate | None, str]:
        """One of the hypotheses, refined on the surface, and the reason for the choice."""
        best, reason = self.select(obs, known, [Candidate(hypothesis) for hypothesis in hypotheses])
        return (None if best is None else self.refine(obs, known, best)), reason

    def select(
        self, obs: ObsT, known: KnownT, candidates: list[CandidateT], weight: np.ndarray | None = None
    ) -> tuple[CandidateT | None, str]:
        """The candidate to go on with, and why; ``weight`` (H,) factors of their support."""
        with self.stopwatch("selection"):
            poses, distance_m = [c.T_cam_obj for c in candidates], None
            if len(poses) > 1 and len(obs.cloud) and (surface := known.model.seen_surface) is not None:
                distance_m = refinement.surface_distances(surface, obs.cloud, np.stack(poses))
            hypotheses = [c.hypothesis for c in candidates]
            row, reason = selection.select(hypotheses, distance_m, self.config.selection, weight)
            return (None if row is None else candidates[row]), reason

    def refine(self, obs: ObsT, known: KnownT, candidate: CandidateT) -> CandidateT:
        """The candidate with its refined pose."""
        with self.stopwatch("refinement"):
            refined = self.refined(obs, known, candidate.T_cam_obj, candidate.hypothesis.inliers)
            return replace(candidate, refined=refined)

    def refined(self, obs: ObsT, known: KnownT, T_cam_obj: np.ndarray, agrees: np.ndarray | None = None) -> Refinement:
        """The pose refined on the surface, with the keypoints ``agrees`` (N,) bool where the configuration says so."""
        cfg, keypoints = self.config.refinement, None
        if cfg.residuals == "none" or not len(obs.cloud) or (surface := known.model.seen_surface) is None:
            return Refinement(T_cam_obj, reason="no surface")
        if agrees is not None and cfg.residuals == "surface_and_keypoints":
            p_cam = obs.p_cam[agrees]
            keypoints = Keypoints(known.map.p_obj[agrees], p_cam, self.observer.noise_m(p_cam))
        return refinement.refine(T_cam_obj, obs.cloud, surface, cfg, keypoints=keypoints)

    # -- judge, admit, request -----------------------------------------------------------------

    def start(self, known: KnownT, points: int) -> Verdict:
        """Whether a map may begin with this number of ``points``."""
        enough = points >= self.config.registration.min_inliers
        return Verdict(enough, Status.TRACKED, "" if enough else f"only {points} points to start a map")

    def judge(self, obs: ObsT, known: KnownT, best: Candidate) -> Verdict:
        """Every pose stands; few points degrade it."""
        support, enough = best.hypothesis.support, self.config.lifecycle.return_inliers
        if support < enough:
            return Verdict(True, Status.DEGRADED, f"only {support} points agree with the pose, fewer than {enough}")
        return Verdict(True, Status.RECOVERED if known.life.returning else Status.TRACKED)

    def admit(self, obs: ObsT, known: KnownT, best: Candidate, verdict: Verdict) -> Admission:
        """Every frame with a pose is learnt from."""
        return Admission(verdict, best.hypothesis.inliers, self.covariance(obs, known, best))

    def covariance(self, obs: ObsT, known: KnownT, best: Candidate) -> np.ndarray:
        """(6, 6) of the pose relative to the map: from the refinement, else from the keypoints alone."""
        if best.refined is not None and best.refined.covariance is not None:
            return best.refined.covariance
        noise_m = self.observer.noise_m(obs.p_cam)
        return registration.covariance(best.hypothesis, known.map.p_obj, obs.p_cam, noise_m)

    def request(self, obs: ObsT, known: KnownT, best: Candidate, admission: Admission) -> Requests:
        """No track is rejected."""
        return Requests()

    # -- the object's life ---------------------------------------------------------------------

    def begun(self, obs: ObsT, T_cam_obj: np.ndarray, verdict: Verdict) -> Life:
        """The life of a map after its first frame."""
        return replace(self.life, status=verdict.status, T_cam_obj=T_cam_obj, seen_s=obs.frame.time_s)

    def followed(self, obs: ObsT, known: KnownT, best: Candidate, admitted: Admission, confidence: float) -> Life:
        """The life after a frame with a pose that is reported with this confidence."""
        return known.life.with_pose(best.T_cam_obj, obs.frame.time_s, admitted.verdict.status)

    def missed(self, obs: ObsT, known: KnownT, verdict: Verdict) -> Life:
        """The life after a frame without a pose."""
        return replace(known.life, status=verdict.status)

    def expected(self, obs: ObsT, known: KnownT) -> np.ndarray | None:
        """T_cam_obj of an absent object: its last pose, None where it had none."""
        return known.life.T_cam_obj
