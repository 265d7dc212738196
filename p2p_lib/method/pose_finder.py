"""Register, refine, select: an object's pose in one frame, by what is known of it (paper: Sec. "Object Registration").

:class:`p2p_lib.method.object_tracker.ObjectTracker` judges what is found here, and goes on with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core.config import Config
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.method import refinement, registration, selection
from p2p_lib.method.lifecycle import SIGHTED, TELLING, Evidence
from p2p_lib.method.object_model import Known
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.refinement import Keypoints, Refinement
from p2p_lib.method.registration import Hypothesis
from p2p_lib.method.shape_search import ShapeSearch
from p2p_lib.recovery.search import laid_on

#: With fewer visible keypoints, pending ones help to register (the release's).
_FEW_KEYPOINTS = 12
#: A pose that nothing has told from others since a gap is compared again every so many frames.
_COMPARE_EVERY = 5


def certain_of(obs: Observation, config: Config) -> np.ndarray:
    """(N,) bool: points seen where the tracker is certain of them."""
    return obs.seen & (obs.tracks.uncertainty <= config.registration.max_uncertainty)


def took_part(obs: Observation, known: Known, config: Config) -> np.ndarray:
    """(N,) bool: the points that register a frame: keypoints, and where these are few the pending ones, too.

    While an object is followed, fast turns leave few keypoints sooner than they leave few points.
    """
    certain = certain_of(obs, config)
    keypoints = certain & known.map.promoted
    followed = config.method.motion and not known.life.unconfirmed
    few = config.keypoint_map.keyframe_min_points if followed else _FEW_KEYPOINTS
    return keypoints if keypoints.sum() >= few else certain


@dataclass(frozen=True, eq=False)
class Candidate:
    """A hypothesis, its pose refined on the surface, and what of the surface shows there, once they are known."""

    hypothesis: Hypothesis
    refined: Refinement | None = None
    sighting: float | None = None
    lead: float | None = None

    @property
    def T_cam_obj(self) -> np.ndarray:
        """(4, 4) the best pose known of it."""
        return (self.refined or self.hypothesis).T_cam_obj

    @property
    def evidence(self) -> Evidence:
        """What speaks for it."""
        share = self.refined.inliers if self.refined.refined else None
        return Evidence(self.hypothesis.support, share, self.sighting, self.lead)

    def agreement(self, keypoints: np.ndarray) -> float:
        """The keypoints seen, (N,) bool, that agree, less those that do not, as a share of all."""
        return float(np.where(self.hypothesis.inliers[keypoints], 1, -1).mean()) if keypoints.any() else 0.0


class PoseFinder:
    """Finds the poses of one object; ``known`` is the map that they are of."""

    def __init__(self, observer: Observer, config: Config, rng: np.random.Generator, stopwatch: Stopwatch):
        self.observer, self.config = observer, config
        self.shape = ShapeSearch(observer, config, stopwatch)
        self._rng, self._stopwatch = rng, stopwatch

    def refine_and_select(
        self, obs: Observation, known: Known, hypotheses: list[Hypothesis]
    ) -> tuple[Candidate | None, str]:
        """The best of some hypotheses, refined, and why. The paper selects one and refines that; ours refines all."""
        candidates = [Candidate(hypothesis) for hypothesis in hypotheses]
        if self.config.selection.rule == "support":
            candidates = self._look_again(obs, known, self._refine(obs, known, candidates))
        best, reason = self._select(obs, known, candidates)
        if best is None:
            return None, reason
        if best.refined is None:
            (best,) = self._refine(obs, known, [best])
        return self._compared(obs, known, best), reason

    # -- register ------------------------------------------------------------------------------

    def register(self, obs: Observation, known: Known) -> list[Hypothesis]:
        """Candidate poses from the keypoints seen; with motion, from the last poses too."""
        cfg, with_motion = self.config.registration, self.config.method.motion
        with self._stopwatch("registration"):
            certain, use = certain_of(obs, self.config), took_part(obs, known, self.config)
            priors = known.life.motion_priors() or self._carried_on(obs, known) if with_motion else {}
            if obs.sighting is not None:
                priors = {"sighting": obs.sighting.T_cam_obj, **priors}
            p_cam = np.where(use[:, None], obs.p_cam, np.nan)
            found = self._hypotheses(known, p_cam, priors)
            most = max((h.support for h in found), default=0)
            if priors and cfg.method != "svd" and most < cfg.contradicted * use.sum():
                # Most points are wrong, whichever: pending ones may tell, or those that agree with the surface.
                p_cam = np.where(certain[:, None], obs.p_cam, np.nan)
                found = self._hypotheses(known, p_cam, priors)
                found += self._along_surface(obs, known, p_cam, priors)
            return found or self._surface_only(known, priors)

    def _carried_on(self, obs: Observation, known: Known) -> dict[str, np.ndarray]:
        """Where an absent object is if it has gone on as it did, and where its depth is, turned like that."""
        motion, time_s = known.life.motion, obs.frame.time_s
        if not (known.carried(time_s) and len(obs.cloud) and self.shape.knows(known)):
            return {}
        T_cam_obj = motion.at(time_s)
        (on_depth,) = laid_on(T_cam_obj[None], obs.cloud, known.model.sample)
        near = np.linalg.norm(on_depth[:3, 3] - T_cam_obj[:3, 3]) < motion.reach_m(time_s)
        return {"motion": T_cam_obj} | ({"motion, on its depth": on_depth} if near else {})

    def _hypotheses(self, known: Known, p_cam: np.ndarray, priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """Hypotheses from the points measured at p_cam (N, 3), as far as they are finite."""
        cfg, sigma_m = self.config.registration, known.model.noise_m(p_cam)
        return registration.register(known.map.p_obj, p_cam, cfg, self._rng, sigma_m=sigma_m, priors=priors)

    def _along_surface(
        self, obs: Observation, known: Known, p_cam: np.ndarray, priors: dict[str, np.ndarray]
    ) -> list[Hypothesis]:
        """The hypothesis that grows from where the surface alone leads."""
        start = self._refined(obs, known, list(priors.values())[-1])
        if not start.refined:
            return []
        cfg, sigma_m = self.config.registration, known.model.noise_m(p_cam)
        return registration.refit(start.T_cam_obj, "surface", known.map.p_obj, p_cam, cfg, sigma_m)

    def _surface_only(self, known: Known, priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """Too few points to register: the surface may track from where the object should be."""
        no_inliers, no_residual = np.zeros(len(known.map), bool), np.full(len(known.map), np.inf)
        return [Hypothesis(T_cam_obj, no_inliers, no_residual, name) for name, T_cam_obj in priors.items()]

    # -- refine and select ---------------------------------------------------------------------

    def _refine(self, obs: Observation, known: Known, candidates: list[Candidate]) -> list[Candidate]:
        with self._stopwatch("refinement"):
            return [
                replace(c, refined=self._refined(obs, known, c.T_cam_obj, c.hypothesis.inliers)) for c in candidates
            ]

    def _refined(
        self, obs: Observation, known: Known, T_cam_obj: np.ndarray, agrees: np.ndarray | None = None
    ) -> Refinement:
        """The pose refined on the surface, with the keypoints that agree (N,) where the configuration says so."""
        cfg = self.config.refinement
        if cfg.residuals == "none" or not known.model.has_surface or not len(obs.cloud):
            return Refinement(T_cam_obj, reason="no surface")
        keypoints = None
        if agrees is not None:
            p_cam = obs.p_cam[agrees]
            keypoints = Keypoints(known.map.p_obj[agrees], p_cam, self.observer.noise_m(p_cam))
        return refinement.refine(T_cam_obj, obs.cloud, known.model.surface, cfg, keypoints=keypoints)

    def _select(self, obs: Observation, known: Known, candidates: list[Candidate]) -> tuple[Candidate | None, str]:
        """The candidate to go on with, and why."""
        with self._stopwatch("selection"):
            few = max((c.hypothesis.support for c in candidates), default=0) < self.config.lifecycle.return_inliers
            if few and any((c.sighting or 0.0) > 0 for c in candidates):
                return max(candidates, key=lambda c: c.sighting or 0.0), "most of the surface shows"
            poses, distance_m, weight = [c.T_cam_obj for c in candidates], None, None
            if len(poses) > 1 and known.model.has_surface and len(obs.cloud):
                distance_m = refinement.surface_distances(known.model.surface, obs.cloud, np.stack(poses))
            if self.config.method.motion:
                weight = selection.motion_weight(poses, list(known.life.motion_priors().values()))
            hypotheses = [c.hypothesis for c in candidates]
            row, reason = selection.select(hypotheses, distance_m, self.config.selection, weight)
            return (None if row is None else candidates[row]), reason

    # -- by shape and colour -------------------------------------------------------------------

    def _look_again(self, obs: Observation, known: Known, candidates: list[Candidate]) -> list[Candidate]:
        """Candidates for a return, with how much of the surface shows in the image under each."""
        if not (known.life.unconfirmed and self.shape.knows(known)):
            return candidates
        found = self.shape.at(obs, known, [c.T_cam_obj for c in candidates])
        return [replace(c, sighting=None if s is None else s.share) for c, s in zip(candidates, found, strict=True)]

    def _compared(self, obs: Observation, known: Known, best: Candidate) -> Candidate:
        """The pose of a return with its lead over the best that is turned otherwise, or that one, where it shows more.

        Asked again now and then until a lead tells. Where no other turn is known, points have to agree with this one.
        """
        life = known.life
        due = life.unconfirmed or (life.doubted and not obs.frame.index % _COMPARE_EVERY)
        if not (due and self.shape.knows(known) and self.config.method.gates == "all"):
            return best
        own, other = self.shape.otherwise(obs, known, best.T_cam_obj)
        if own is None or other is None:
            return replace(best, lead=0.0 if own is None else best.agreement(known.keypoints(obs)))
        lead = (own.share - other.share) / max(own.share, other.share, 1e-6)
        if lead > -TELLING or other.share < SIGHTED or self.observer.cut_off(obs):
            return replace(best, lead=lead)
        (turned,) = self._refine(obs, known, [Candidate(*self._surface_only(known, {"other turn": other.T_cam_obj}))])
        return replace(turned, sighting=other.share, lead=0.0)
