"""One object's step: observe, find, then accept or go without (paper: Fig. "Overview of the framework").

:class:`p2p_lib.method.pipeline.Point2Pose` tracks and segments for all objects; here the observation of one becomes
its pose. What it asks of the shared tracker it returns as :class:`p2p_lib.method.object_model.Requests`.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config
from p2p_lib.core.interfaces import Detector, Hint
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import NOT_SEEN, OUT_OF_VIEW, WAITS, Frame, PoseEstimate, Status, Tracks
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.object_model import Known, Life, ObjectModel, Requests
from p2p_lib.method.observation import Observation, Observer
from p2p_lib.method.policy import Candidate, Policy, Verdict
from p2p_lib.method.refinement import surface_distance
from p2p_lib.method.sampling import choose, usable_region


@dataclass(frozen=True, eq=False)
class ObjectStep:
    """One object's answer to a frame."""

    estimate: PoseEstimate
    requests: Requests = field(default_factory=Requests)


class ObjectTracker:
    """State and step of one object; ``known`` holds its model and its life so far.

    policy  makes what decides the open questions of a step; the paper's by default
    model   makes an empty model
    map_id  the number of its first map
    """

    def __init__(
        self,
        name: str,
        camera: Camera,
        config: Config,
        detector: Detector,
        rng: np.random.Generator,
        stopwatch: Stopwatch,
        executor: Executor,
        policy: Callable[..., Policy] = Policy,
        model: Callable[..., ObjectModel] = ObjectModel,
        map_id: int = 0,
    ):
        self.name, self.config, self.detector = name, config, detector
        self.observer = Observer(camera, config.depth, config.refinement.max_points if config.method.surface else 0)
        self.new_model: Callable[[], ObjectModel] = partial(model, config, self.observer, stopwatch, executor)
        self.policy = policy(self.observer, config, rng, stopwatch)
        self.known = Known(self.new_model(), self.policy.life, map_id)
        self._stopwatch = stopwatch

    @property
    def model(self) -> ObjectModel:
        """Its keypoint map, surface and graph."""
        return self.known.model

    @property
    def map(self) -> KeypointMap:
        """Its keypoints."""
        return self.known.map

    @property
    def life(self) -> Life:
        """Its status and newest pose."""
        return self.known.life

    @life.setter
    def life(self, life: Life) -> None:
        self.known = replace(self.known, life=life)

    @property
    def ids(self) -> np.ndarray:
        """The tracker's ids of all its points."""
        return self.map.ids

    def known_as(self, map_id: int) -> Known | None:
        """What is known in the map of this number; None where there is none."""
        return self.known if map_id == self.known.map_id else None

    # -- the step ------------------------------------------------------------------------------

    def observe(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> Observation:
        """What a frame shows of the object, by its mask (H, W) bool, None where unknown, and all objects' tracks."""
        with self._stopwatch("observation"):
            return self.observer.observe(frame, mask, tracks.select(self.map.ids))

    def step(self, obs: Observation) -> ObjectStep:
        """The object's pose at a frame."""
        if self.model.empty:
            return self.begin(obs)
        best, verdict = self.find(obs)
        return self.absent(obs, verdict) if best is None or not verdict.accepted else self.accept(obs, best, verdict)

    def find(self, obs: Observation) -> tuple[Candidate | None, Verdict]:
        """Register, select, refine and judge: the candidate, None where there is none, and the verdict on it."""
        if self.policy.hidden(obs):
            return None, Verdict(False, Status.OCCLUDED, f"{obs.mask_px} mask pixels")
        best, reason = self.policy.choose(obs, self.known, self.policy.propose(obs, self.known))
        if best is None:
            nothing = obs.mask is None and not obs.seen.any()
            return None, Verdict(False, Status.OCCLUDED if nothing else Status.LOST, reason)
        return best, self.policy.judge(obs, self.known, best)

    def accept(self, obs: Observation, best: Candidate, verdict: Verdict, due: bool = False) -> ObjectStep:
        """Take a frame with a pose into the model, with a keyframe where one is ``due`` or the appendix asks for it."""
        T_cam_obj, agrees, model, keyframe = best.T_cam_obj, best.hypothesis.inliers, self.model, False
        admission = self.policy.admit(obs, self.known, best, verdict)
        requests = self.policy.request(obs, self.known, best, admission)
        if admission.learns:
            with self._stopwatch("map"):
                model.observe(obs, T_cam_obj, agrees, self.life.moved_from_last(T_cam_obj), admission.in_camera)
                keyframe = due or (admission.keyframe and model.keyframe_due(obs, T_cam_obj, agrees))
        model.settle_surface()
        if keyframe:
            rows = admission.rows(obs, model)
            rated = admission.covariance, admission.confidence
            added = model.insert_keyframe(obs, T_cam_obj, *self._sample(obs), rows, *rated)
            requests = replace(added, reject=requests.reject)
        covariance, confidence = admission.rated(model)
        self.life = self.policy.followed(obs, self.known, best, admission, confidence)
        support = best.hypothesis.support
        pose = {"confidence": confidence, "covariance": covariance, "inliers": support, "keyframe": keyframe}
        return ObjectStep(self._estimate(obs, admission.verdict, **pose), requests)

    def absent(self, obs: Observation, verdict: Verdict) -> ObjectStep:
        """A frame without a pose."""
        self.life = self.policy.missed(obs, self.known, verdict)
        if verdict.status is Status.OCCLUDED and self._out_of_view(obs):
            verdict = replace(verdict, reason=f"{OUT_OF_VIEW}: {verdict.reason}")
        return ObjectStep(self._estimate(obs, verdict))

    def begin(self, obs: Observation) -> ObjectStep:
        """The first frame of a map: fix the object frame and start with the first points."""
        if obs.mask_px is None or self.policy.hidden(obs):
            return self.absent(obs, Verdict(False, Status.INITIALISING, NOT_SEEN + WAITS * (obs.mask is None)))
        v, u = np.nonzero(self.observer.measured(obs))
        if len(v) < self.config.lifecycle.min_mask_px:
            return self.absent(obs, Verdict(False, Status.INITIALISING, f"only {len(v)} mask pixels with depth"))
        uv_px, p_cam = self._sample(obs)
        verdict = self.policy.start(self.known, len(p_cam))
        if not verdict.accepted:
            return self.absent(obs, replace(verdict, status=Status.INITIALISING))
        T_cam_obj = np.eye(4)
        if self.config.method.object_frame == "centroid":
            seen = self.observer.camera.unproject(np.stack([u, v], -1), obs.frame.depth_m[v, u])
            T_cam_obj[:3, 3] = np.median(seen, 0)
        requests = self.model.insert_keyframe(obs, T_cam_obj, uv_px, p_cam, np.zeros(0, bool))
        self.model.adopt()
        self.life = self.policy.begun(obs, T_cam_obj, verdict)
        # The first pose defines the object frame: it is right by definition, but of few points nothing can be followed.
        confidence = min(1.0, len(self.map) / self.config.registration.min_inliers)
        pose = {"confidence": confidence, "covariance": self.model.covariance, "inliers": len(self.map)}
        estimate = self._estimate(obs, verdict, keyframe=True, **pose)
        return ObjectStep(estimate, requests)

    def _sample(self, obs: Observation) -> tuple[np.ndarray, np.ndarray]:
        """New points chosen by the sampling objective: uv_px (M, 2) and p_cam (M, 3)."""
        assert obs.mask is not None  # nobody asks for points where no mask is known
        with self._stopwatch("sampling"):
            cfg = self.config.sampling
            depth = self.config.depth
            region = usable_region(obs.frame, obs.mask, depth.edge_m, depth.narrow)
            candidates = self.detector.detect(obs.frame, region)
            p_cam = self.observer.lift(obs.frame, candidates.uv_px)
            liftable = np.isfinite(p_cam[:, 0])
            candidates, p_cam = candidates.select(liftable), p_cam[liftable]
            count = min(cfg.points, cfg.max_visible - int(obs.seen.sum()))
            chosen = choose(candidates, obs.tracks.uv_px[obs.seen], count, cfg)
            return candidates.uv_px[chosen], p_cam[chosen]

    def _estimate(self, obs: Observation, verdict: Verdict, **pose: Any) -> PoseEstimate:
        """The estimate of a frame, after ``life`` is updated; ``pose`` has the fields of one with a pose."""
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

    # -- between the steps ---------------------------------------------------------------------

    def adopt(self) -> None:
        """Take in what the graph has solved since the frame before; called before the frame is observed."""
        T_cam_obj = self.model.adopt()
        if T_cam_obj is not None:
            self.life = self.life.corrected(T_cam_obj)

    def awaited(self, mask: np.ndarray | None) -> bool:
        """Whether the object had no pose in the frame before and its mask says that it is back."""
        away = not self.model.empty and not self.life.has_pose
        return away and mask is not None and int(np.count_nonzero(mask)) >= self.config.lifecycle.min_mask_px

    def hint(self, obs: Observation) -> Hint:
        """Where the object should be by its tracks and its model, for the segmenter; ``obs`` has no mask yet."""
        if self.model.empty:
            return Hint()
        best = max(self.policy.propose(obs, self.known), key=lambda h: h.support, default=None)
        enough = best is not None and best.support >= self.config.lifecycle.return_inliers
        if best is None or (self.life.sought and not enough):
            return Hint()
        return hint_at(obs.frame, self.known, self.observer, obs.tracks.uv_px[best.inliers], best.T_cam_obj)

    def _out_of_view(self, obs: Observation) -> bool:
        """Whether most keypoints of an absent object lie outside the image where it is expected."""
        T_cam_obj = self.policy.expected(obs, self.known)
        inside = () if T_cam_obj is None else self.observer.in_image(T_cam_obj, self.map.p_obj)
        return len(inside) > 0 and bool(np.mean(inside) < 0.5)


def hint_at(frame: Frame, known: Known, observer: Observer, uv_px: np.ndarray, T_cam_obj: np.ndarray) -> Hint:
    """The hint of a pose: points uv_px (K, 2) that agree with it, and the measured pixels' distances to the surface."""
    distance_m, surface = None, known.model.seen_surface
    if surface is not None:
        distance_m = surface_distance(surface, frame.depth_m, observer.camera, T_cam_obj)
    return Hint(uv_px, distance_m, T_cam_obj)
