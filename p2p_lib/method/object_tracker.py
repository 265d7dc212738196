"""One object's side of the algorithm: its map, its surface, its graph, and what its next pose is.

``Point2Pose.step`` tracks all objects' points in one pass and hands each object its share; here the
share becomes a pose: lift, register, select, refine, judge, and extend the map.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import Config, TsdfConfig
from p2p_lib.core.depth import depth_noise_m, in_range, lift
from p2p_lib.core.image import in_mask
from p2p_lib.core.interfaces import Detector, Hint, PointTracker
from p2p_lib.core.stopwatch import Stopwatch
from p2p_lib.core.types import WITH_POSE, Frame, PoseEstimate, Status, Tracks
from p2p_lib.method import refinement, registration
from p2p_lib.method.confidence import confidence
from p2p_lib.method.factor_graph import ObjectGraph
from p2p_lib.method.keyframe_views import Views, slide_covariance
from p2p_lib.method.keypoint_map import KeypointMap
from p2p_lib.method.refinement import Keypoints, Refinement, surface_distance
from p2p_lib.method.registration import Hypothesis
from p2p_lib.method.sampling import choose, usable_region

#: A tentative pose finds points, which make a better one, which finds more.
_SEEKING_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class View:
    """What one frame shows of one object; rows as in its map.

    mask     (H, W) bool, None where nobody knows it
    tracks   of the map's points
    p_cam    (N, 3) their lifted positions; NaN where not visible, outside the mask, or without depth
    cloud    (M, 3) dense depth points in the mask, camera frame (paper: P_cur)
    """

    frame: Frame
    mask: np.ndarray | None
    tracks: Tracks
    p_cam: np.ndarray
    cloud: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(N,) bool: points with a 3D observation."""
        return np.isfinite(self.p_cam[:, 0])


class TrackedObject:
    """State and behaviour of one object. ``step`` is called once a frame."""

    def __init__(
        self,
        name: str,
        camera: Camera,
        config: Config,
        tracker: PointTracker,
        detector: Detector,
        rng: np.random.Generator,
        stopwatch: Stopwatch,
    ):
        self.name, self.camera, self.config = name, camera, config
        self.tracker, self.detector = tracker, detector
        self.map = KeypointMap(config.keypoint_map)
        self.surface = make_volume(config.tsdf) if config.tsdf.enabled else None
        self.graph = ObjectGraph(config.factor_graph)
        self.views = Views(config.keypoint_map.max_views)  # of the keyframes
        self._map_covariance = np.zeros((6, 6))  # of the newest keyframe, by the graph
        self._corrected: dict[int, np.ndarray] = {}  # keyframe poses that the surface has yet to follow
        self._rng, self._stopwatch = rng, stopwatch
        self._T_last: np.ndarray | None = None  # newest pose, of whatever frame
        self._last_seen_s = float("nan")
        self._T_left: np.ndarray | None = None  # the newest before it went away
        self._T_before: np.ndarray | None = None  # pose of the frame before, None after a gap
        self._status = Status.INITIALISING
        self._since_keyframe = 0
        self._recovering = 0  # frames that are still marked recovered
        self._start_px: int | None = None  # pixels of the mask in the frame before the first pose
        self._carried = 0  # frames in a row that the surface alone carried

    def awaited(self, mask: np.ndarray | None) -> bool:
        """Whether the object was hidden or lost until now and its mask says that it is back."""
        away = len(self.views) > 0 and self._status not in WITH_POSE
        return away and mask is not None and mask.sum() >= self.config.pipeline.min_mask_px

    def hint(self, frame: Frame, tracks: Tracks) -> Hint:
        """Where this object should be, by its tracks and what it knows, before anybody has segmented the frame.

        While it is away, points that agree on no pose are somewhere else: they are to be looked for anew.
        """
        if not len(self.views):
            return Hint()
        view = self._observe(frame, None, tracks.select(self.map.ids))
        found = self._hypotheses(view)
        best = max(found, key=lambda h: h.support, default=None)
        away = self._status not in WITH_POSE
        if away:
            agrees = np.zeros(len(self.map), bool) if best is None else best.inliers
            self.tracker.reject(self.map.ids[view.tracks.visible & ~agrees])
        if best is None or (away and best.support < self.config.pipeline.recover_min_inliers):
            return Hint()
        distance_m = None
        if self.surface is not None and not self.surface.empty:
            corners = self.surface.corners_m()
            distance_m = surface_distance(self.surface, corners, frame.depth_m, self.camera, best.T_cam_obj)
        return Hint(view.tracks.uv_px[best.inliers], distance_m)

    def step(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> PoseEstimate:
        """This object's estimate at a frame, given its mask and everybody's tracks."""
        view = self._observe(frame, mask, tracks.select(self.map.ids))
        if not len(self.views):
            return self._start(view)
        if mask is not None and self._status not in WITH_POSE:
            # Found where the object is not, on its twin perhaps: let them be looked for elsewhere.
            self.tracker.reject(self.map.ids[view.tracks.visible & ~in_mask(view.tracks.uv_px, mask)])
        if mask is not None and mask.sum() < self.config.pipeline.min_mask_px:
            return self._without_pose(view, Status.OCCLUDED, f"{int(mask.sum())} mask pixels")
        hypotheses, view = self._sought(view)
        hypothesis, refined, reason = self._choose(view, hypotheses)
        if hypothesis is None:
            nothing = mask is None and not view.seen.any()
            return self._without_pose(view, Status.OCCLUDED if nothing else Status.LOST, reason)
        return self._accept(view, hypothesis, refined)

    def _sought(self, view: View) -> tuple[list[Hypothesis], View]:
        """The hypotheses of a view; and the view itself, joined by keypoints that a tentative pose helped to find.

        A few points that agree say where all the others should show, which the tracker checks by their looks:
        that is how an object is back in the frame of its return.
        """
        with self._stopwatch("registration"):
            hypotheses = self._hypotheses(view)
        for _ in range(_SEEKING_ROUNDS):
            tentative = self._tentative(view, hypotheses)
            if tentative is None:
                break
            with self._stopwatch("tracking"):
                told = self.tracker.suggest(self.map.ids, self._expected_px(view, tentative.T_cam_obj))
            if told is None:
                break
            tracks, seen = told.select(self.map.ids), view.seen.sum()
            view = replace(view, tracks=tracks, p_cam=self._lifted(view.frame, view.mask, tracks))
            with self._stopwatch("registration"):
                hypotheses = self._hypotheses(view)
            if view.seen.sum() <= seen:
                break
        return hypotheses, view

    def _tentative(self, view: View, hypotheses: list[Hypothesis]) -> Hypothesis | None:
        """The pose by which to look for more keypoints; None where there are enough, or none to go by."""
        pipe, returning = self.config.pipeline, self._status not in WITH_POSE
        enough = not returning and (view.seen & self.map.promoted).sum() >= pipe.seek_below
        if enough or not pipe.seek_inliers or view.mask is None or self.tracker.latency_frames:
            return None
        if returning and not hypotheses:
            fewer = replace(self.config.registration, min_inliers=pipe.seek_inliers)
            sigma_m = self._noise_m(view.p_cam)
            hypotheses = registration.generate(self.map.p_obj, view.p_cam, fewer, self._rng, sigma_m=sigma_m)
        return max(hypotheses, key=lambda h: h.support, default=None)

    def _expected_px(self, view: View, T_cam_obj: np.ndarray) -> np.ndarray:
        """(N, 2) where a pose shows the keypoints; NaN for those that something hides, the object itself included."""
        p_cam = se3.transform(T_cam_obj, self.map.p_obj)
        uv_px = self.camera.project(p_cam)
        at = np.flatnonzero(self.map.promoted & (p_cam[:, 2] > 0) & self.camera.inside(uv_px))
        u, v = np.rint(uv_px[at]).astype(int).T
        off_m = np.abs(view.frame.depth_m[v, u] - p_cam[at, 2])
        at = at[view.mask[v, u] & (off_m < self.config.pipeline.seek_depth_m)]
        expected = np.full_like(uv_px, np.nan)
        expected[at] = uv_px[at]
        return expected

    def _choose(self, view: View, hypotheses: list[Hypothesis]) -> tuple[Hypothesis | None, Refinement | None, str]:
        """The hypothesis to go on with, refined, and why it was chosen."""
        cfg = self.config.registration
        hypotheses = registration.competing(hypotheses, cfg)
        refined: dict[int, Refinement] = {}
        with self._stopwatch("refinement"):
            if cfg.refine_all:
                refined = {id(h): self._refine(view, h.T_cam_obj, h.inliers) for h in hypotheses}
        with self._stopwatch("selection"):
            T_cam_obj = [refined[id(h)].T_cam_obj if cfg.refine_all else h.T_cam_obj for h in hypotheses]
            distance_m = self._surface_distances(view, T_cam_obj)
            odds = registration.motion_odds(T_cam_obj, list(self._priors().values()), cfg)
            chosen, reason = registration.select(hypotheses, distance_m, cfg, odds)
        if chosen is None:
            return None, None, reason
        with self._stopwatch("refinement"):
            return chosen, refined.get(id(chosen)) or self._refine(view, chosen.T_cam_obj, chosen.inliers), reason

    def _observe(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> View:
        """One frame's share of this object."""
        cloud = np.zeros((0, 3))
        if mask is not None and self.surface is not None:
            with self._stopwatch("refinement"):
                cloud = refinement.sample_cloud(frame.depth_m, mask, self.camera, self.config.refinement.max_points)
        return View(frame, mask, tracks, self._lifted(frame, mask, tracks), cloud)

    def _lifted(self, frame: Frame, mask: np.ndarray | None, tracks: Tracks) -> np.ndarray:
        """(N, 3) of the visible points that lie in the mask; NaN for the others."""
        p_cam = np.full((len(tracks), 3), np.nan)
        rows = np.flatnonzero(tracks.visible)
        if mask is not None:
            rows = rows[in_mask(tracks.uv_px[rows], mask)]
        p_cam[rows] = self._lift(frame, tracks.uv_px[rows])
        return p_cam

    def _lift(self, frame: Frame, uv_px: np.ndarray) -> np.ndarray:
        return lift(frame, uv_px, self.camera, self.config.depth)

    def _noise_m(self, p_cam: np.ndarray) -> np.ndarray:
        """Standard deviation (N,) of measured points (N, 3)."""
        return depth_noise_m(p_cam[:, 2], self.config.depth)

    def _start(self, view: View) -> PoseEstimate:
        """The first frame: fix the object frame and found the map on the first points."""
        pipe = self.config.pipeline
        coming = self._coming_into_view(view.mask)
        if view.mask is None or view.mask.sum() < pipe.min_mask_px:
            return self._without_pose(view, Status.INITIALISING, "not seen yet")
        if coming:
            return self._without_pose(view, Status.INITIALISING, "still coming into view")
        v, u = np.nonzero(self._measured(view))
        if len(v) < pipe.min_mask_px:
            return self._without_pose(view, Status.INITIALISING, f"only {len(v)} mask pixels with depth")
        points = self._sample(view)
        few = len(points[0]) < self.config.registration.min_inliers
        carried = self.surface is not None and self.config.registration.motion_priors
        if few and not carried:
            return self._without_pose(view, Status.INITIALISING, f"only {len(points[0])} points to start from")
        T_cam_obj = np.eye(4)
        if pipe.object_frame == "centroid":
            p_cam = self.camera.unproject(np.stack([u, v], -1), view.frame.depth_m[v, u])
            T_cam_obj[:3, 3] = np.median(p_cam, 0)
        self._add_keyframe(view, T_cam_obj, points, np.zeros(0, bool))
        status, reason = (Status.DEGRADED, f"only {len(self.map)} points") if few else (Status.TRACKED, "")
        # The first pose defines the object frame: it is right by definition, whatever the points are worth.
        return self._with_pose(view, T_cam_obj, status, len(self.map), 1.0, self._map_covariance, reason, keyframe=True)

    def _coming_into_view(self, mask: np.ndarray | None) -> bool:
        """Whether the mask still grows: points on the first sliver of an object would all be at its rim."""
        before, self._start_px = self._start_px, None if mask is None else int(mask.sum())
        growth = self.config.pipeline.start_growth
        return bool(growth) and before is not None and self._start_px is not None and self._start_px > growth * before

    def _hypotheses(self, view: View) -> list[Hypothesis]:
        """Candidate poses from the keypoints seen; rows as in the map."""
        cfg = self.config.registration
        certain = view.seen & (view.tracks.uncertainty <= cfg.max_uncertainty)
        use = certain & self.map.promoted
        if use.sum() < cfg.min_promoted:
            use = certain
        priors = self._priors()
        found = self._registered(view, use, priors)
        most = max((h.support for h in found), default=0)
        if cfg.multi_hypothesis and priors and most < cfg.contradicted * use.sum():
            # Most points are wrong, whichever: pending ones may tell, and some may agree with where the surface leads.
            found = self._registered(view, certain, priors)
            carried = self._refine(view, list(priors.values())[-1])
            if carried.refined:
                p_cam = np.where(certain[:, None], view.p_cam, np.nan)
                found += registration.refit(
                    carried.T_cam_obj, "surface", self.map.p_obj, p_cam, cfg, self._noise_m(p_cam)
                )
        found = self._without_jumps(found)
        if found or not cfg.motion_priors or self._carried >= self.config.pipeline.carry_frames:
            return found
        # Too few points to register: the surface may carry the pose on for a while, from where it should be.
        nobody, unknown = np.zeros(len(self.map), bool), np.full(len(self.map), np.inf)
        return [Hypothesis(T_cam_obj, nobody, unknown, name) for name, T_cam_obj in priors.items()]

    def _registered(self, view: View, use: np.ndarray, priors: dict[str, np.ndarray]) -> list[Hypothesis]:
        """Hypotheses from the points ``use`` (N,) alone."""
        p_cam = np.where(use[:, None], view.p_cam, np.nan)
        cfg, sigma_m = self.config.registration, self._noise_m(p_cam)
        return registration.generate(self.map.p_obj, p_cam, cfg, self._rng, sigma_m=sigma_m, priors=priors)

    def _without_jumps(self, found: list[Hypothesis]) -> list[Hypothesis]:
        """Objects do not jump between frames: a hypothesis that does must have more support than any that does not.

        It also needs as many points as a return. A box whose faces look alike flips otherwise.
        """
        if self._status not in WITH_POSE or self._T_last is None or not found:
            return found
        pipe, T_cam_obj = self.config.pipeline, np.stack([h.T_cam_obj for h in found])
        moved_m = np.linalg.norm(T_cam_obj[:, :3, 3] - self._T_last[:3, 3], axis=1)
        turned = np.degrees(se3.angle_rad(se3.inverse(self._T_last) @ T_cam_obj))
        jumps = (moved_m > pipe.max_jump_m) | (turned > pipe.max_jump_deg)
        support = np.array([h.support for h in found])
        needed = max([pipe.recover_min_inliers, *(support[~jumps] + 1)])
        return [h for h, jumped in zip(found, jumps, strict=True) if not jumped or h.support >= needed]

    def _surface_distances(self, view: View, T_cam_obj: list[np.ndarray]) -> np.ndarray | None:
        """How far each dense point lies from the surface under each pose; None where there is nothing to compare."""
        if len(T_cam_obj) < 2 or self.surface is None or self.surface.empty or not len(view.cloud):
            return None
        unseen = self.config.registration.unseen_share
        return refinement.surface_distances(self.surface, view.cloud, np.stack(T_cam_obj), unseen)

    def _refine(self, view: View, T_cam_obj: np.ndarray, agreeing: np.ndarray | None = None) -> Refinement:
        """The pose refined on the surface, with the ``agreeing`` (N,) keypoints where the configuration says so."""
        cfg = self.config.refinement
        if not cfg.enabled or self.surface is None or self.surface.empty or not len(view.cloud):
            return Refinement(T_cam_obj, reason="no surface")
        keypoints = None
        if agreeing is not None:
            p_cam = view.p_cam[agreeing]
            keypoints = Keypoints(self.map.p_obj[agreeing], p_cam, self._noise_m(p_cam))
        return refinement.refine(T_cam_obj, view.cloud, self.surface, cfg, keypoints=keypoints)

    def _priors(self) -> dict[str, np.ndarray]:
        """Where the object should be if it went on as it did; empty after a gap."""
        if self._status not in WITH_POSE or self._T_last is None:
            return {}
        priors = {"last pose": self._T_last}
        if self._T_before is not None:
            priors["constant velocity"] = self._T_last @ se3.inverse(self._T_before) @ self._T_last
        return priors

    def _accept(self, view: View, hypothesis: Hypothesis, refined: Refinement) -> PoseEstimate:
        """Judge the pose; if it stands, take the frame's observations into the map."""
        pipe, T_cam_obj = self.config.pipeline, refined.T_cam_obj
        returning = self._status not in WITH_POSE
        if (returning or self._recovering) and (doubt := self._doubt(hypothesis, refined)):
            return self._without_pose(view, Status.LOST, doubt)
        if returning:
            self._T_left = self._T_last
        if not hypothesis.support and refined.inliers < pipe.carry_min_share:
            return self._without_pose(view, Status.LOST, "too few points, and the surface does not fit either")
        self._carried = 0 if hypothesis.support else self._carried + 1
        self._recovering = pipe.recovered_frames if returning else max(self._recovering - 1, 0)
        status, reason = Status.RECOVERED if self._recovering else Status.TRACKED, ""
        if hypothesis.support < pipe.degraded_inliers:
            status, reason = Status.DEGRADED, f"only {hypothesis.support} points agree"
        used = view.seen & self.map.promoted
        agreement = (hypothesis.inliers & used).sum() / max(used.sum(), 1)
        # Points that a wrong pose placed agree with it for ever after: each counts as much as that pose was trusted.
        agreeing = self.map.trust[hypothesis.inliers].sum()
        covariance = self._covariance(view, hypothesis, refined)
        with self._stopwatch("map"):
            self._update_map(view, T_cam_obj, used, hypothesis.inliers)
            keyframe = self._keyframe_due(view, T_cam_obj, hypothesis.inliers)
        self._settle_surface()
        if keyframe:
            good = view.seen & (hypothesis.inliers | ~self.map.promoted)
            _, sure = self._worth(T_cam_obj, refined, covariance, agreeing, agreement)
            T_cam_obj = self._add_keyframe(view, T_cam_obj, self._sample(view), good, covariance, trust=sure)
        of_all, sure = self._worth(T_cam_obj, refined, covariance, agreeing, agreement)
        return self._with_pose(view, T_cam_obj, status, hypothesis.support, sure, of_all, reason, keyframe)

    def _worth(
        self, T_cam_obj: np.ndarray, refined: Refinement, covariance: np.ndarray, agreeing: float, agreement: float
    ) -> tuple[np.ndarray, float]:
        """(6, 6) covariance and confidence of a pose, with what the map itself may be wrong by.

        covariance           (6, 6) of the pose relative to the map
        agreeing, agreement  keypoints that agree with it, by their trust, and their share of those seen
        """
        graph = self.config.factor_graph
        slid = slide_covariance(refined.free_turns, self.views.way_rad(T_cam_obj), graph.slide_share)
        of_all = graph.covariance_scale * (covariance + self._map_covariance + slid)
        return of_all, confidence(of_all, agreeing, agreement, self.config.confidence)

    def _doubt(self, hypothesis: Hypothesis, refined: Refinement) -> str:
        """Why a return is not believed (any more): keypoints and surface have to agree until it is confirmed."""
        pipe = self.config.pipeline
        if hypothesis.support < pipe.recover_min_inliers:
            return f"only {hypothesis.support} points agree on a return"
        if refined.refined and refined.inliers < pipe.recover_min_share:
            return f"{100 * refined.inliers:.0f} % of the depth lies on the surface: not a return"
        return ""

    def _covariance(self, view: View, hypothesis: Hypothesis, refined: Refinement) -> np.ndarray:
        """(6, 6) of the pose relative to the map, right tangent of T_cam_obj."""
        if refined.covariance is not None:
            return refined.covariance
        return registration.covariance(hypothesis, self.map.p_obj, view.p_cam, self._noise_m(view.p_cam))

    def _update_map(self, view: View, T_cam_obj: np.ndarray, used: np.ndarray, agrees: np.ndarray) -> None:
        """Verify pending points, count which keypoints agreed, have the others looked for anew."""
        self.map.count(used, agrees)
        self.tracker.reject(self.map.ids[used & ~agrees])
        p_obj = se3.transform(se3.inverse(T_cam_obj), view.p_cam)
        self.map.observe(p_obj, view.tracks.uncertainty, self._moved_little(T_cam_obj))

    def _keyframe_due(self, view: View, T_cam_obj: np.ndarray, agrees: np.ndarray) -> bool:
        """The appendix's "Sampling Criteria": a new view of the object, or too few points left."""
        cfg = self.config.keypoint_map
        self._since_keyframe += 1
        turned = np.degrees(self.views.turned_rad(T_cam_obj))
        visible = int((view.seen & (agrees | ~self.map.promoted)).sum())
        starved = visible < cfg.keyframe_min_points and self._since_keyframe > cfg.cooldown
        return view.mask is not None and not self._recovering and (turned > cfg.keyframe_angle_deg or starved)

    def _add_keyframe(
        self,
        view: View,
        T_cam_obj: np.ndarray,
        points: tuple[np.ndarray, np.ndarray],
        good: np.ndarray,
        covariance: np.ndarray | None = None,
        trust: float = 1.0,
    ) -> np.ndarray:
        """New points, a vertex of the graph, a view of the surface. Returns the pose as the graph corrects it.

        points       uv_px (K, 2) and p_cam (K, 3) of the new points
        good         (N,) bool: points of the map whose observation the pose agrees with
        covariance   (6, 6) of the pose relative to the map; None at the first keyframe
        trust        the pose's confidence
        """
        uv_px, p_cam = points
        new_ids = self.tracker.add(uv_px)
        ids, p_cam_all = np.concatenate([self.map.ids[good], new_ids]), np.concatenate([view.p_cam[good], p_cam])
        self.map.add(new_ids, se3.transform(se3.inverse(T_cam_obj), p_cam), not len(self.views), trust)
        key, registered = None, T_cam_obj
        if self.config.factor_graph.enabled:
            with self._stopwatch("graph"):
                key, T_cam_obj = self._optimise(T_cam_obj, ids, p_cam_all, covariance)
        self.views.add(registered)
        self._since_keyframe = 0
        if self.surface is not None:
            with self._stopwatch("fusion"):
                measured = self._measured(view)
                self.surface.integrate(view.frame.depth_m, view.frame.rgb, measured, self.camera, T_cam_obj, key=key)
        gone = self.map.retire()
        self.graph.forget(gone)
        self.tracker.drop(gone)
        return T_cam_obj

    def _optimise(
        self, T_cam_obj: np.ndarray, ids: np.ndarray, p_cam: np.ndarray, covariance: np.ndarray | None
    ) -> tuple[int, np.ndarray]:
        """Add a vertex to the graph, solve, and carry the result into map and surface; its key and its pose.

        Only what the graph still holds can be moved later: pictures of keyframes that it has merged are let go.
        """
        p_obj = se3.transform(se3.inverse(T_cam_obj), p_cam)
        sigma_m = self._noise_m(p_cam)
        key = self.graph.add_keyframe(T_cam_obj, ids, p_cam, p_obj_init=p_obj, covariance=covariance, sigma_m=sigma_m)
        result = self.graph.optimise()
        if self.surface is not None:
            self.surface.keep_only(result.keys)
        if not result.ok:
            return key, T_cam_obj
        self.map.move(result.point_ids, result.p_obj)
        if result.covariance is not None:
            self._map_covariance = result.covariance
        self._corrected = dict(zip(result.keys.tolist(), result.T_cam_obj, strict=True))
        return key, result.T_cam_obj[-1]

    def _settle_surface(self) -> None:
        """Re-integrate some of the keyframes that the graph has moved: a few per frame, so that no frame waits long."""
        if self.surface is not None and self._corrected:
            with self._stopwatch("fusion"):
                if not self.surface.move(self._corrected, self.config.tsdf.max_moves):
                    self._corrected = {}

    def _measured(self, view: View) -> np.ndarray:
        """(H, W) bool: pixels of the mask with a depth within range."""
        return view.mask & in_range(view.frame.depth_m, self.config.depth)

    def _moved_little(self, T_cam_obj: np.ndarray) -> bool:
        """The appendix's "Pose Stability" check against the frame before."""
        if self._status not in WITH_POSE or self._T_last is None:
            return False
        step = se3.log(se3.inverse(self._T_last) @ T_cam_obj)
        cfg = self.config.keypoint_map
        turned, moved = np.degrees(np.linalg.norm(step[:3])), np.linalg.norm(T_cam_obj[:3, 3] - self._T_last[:3, 3])
        return bool(turned < cfg.stable_rotation_deg and moved < cfg.stable_translation_m)

    def _sample(self, view: View) -> tuple[np.ndarray, np.ndarray]:
        """New points where the objective wants them: uv_px (K, 2) and p_cam (K, 3)."""
        with self._stopwatch("sampling"):
            cfg = self.config.sampling
            candidates = self.detector.detect(
                view.frame, usable_region(view.frame, view.mask, cfg, self.config.depth.edge_m)
            )
            p_cam = self._lift(view.frame, candidates.uv_px)
            liftable = np.isfinite(p_cam[:, 0])
            candidates, p_cam = candidates.select(liftable), p_cam[liftable]
            count = min(cfg.points, cfg.max_visible - int(view.seen.sum()))
            chosen = choose(candidates, view.tracks.uv_px[view.seen], count, cfg)
            return candidates.uv_px[chosen], p_cam[chosen]

    def _with_pose(
        self,
        view: View,
        T_cam_obj: np.ndarray,
        status: Status,
        support: int,
        sure: float,
        covariance: np.ndarray,
        reason: str = "",
        keyframe: bool = False,
    ) -> PoseEstimate:
        self._T_before = self._T_last if self._status in WITH_POSE else None
        self._T_last, self._last_seen_s, self._status = T_cam_obj, view.frame.time_s, status
        return PoseEstimate(
            self.name,
            view.frame.index,
            view.frame.time_s,
            status,
            T_cam_obj,
            sure,
            covariance,
            reason=reason,
            visible_points=int(view.seen.sum()),
            inliers=support,
            last_T_cam_obj=T_cam_obj,
            last_seen_s=view.frame.time_s,
            keyframe=keyframe,
        )

    def _without_pose(self, view: View, status: Status, reason: str) -> PoseEstimate:
        if self._recovering:  # a return that was not confirmed is taken back
            self._T_last, self._recovering = self._T_left, 0
        self._status = status
        return PoseEstimate(
            self.name,
            view.frame.index,
            view.frame.time_s,
            status,
            reason=reason,
            visible_points=int(view.seen.sum()),
            last_T_cam_obj=self._T_last,
            last_seen_s=self._last_seen_s,
        )


def make_volume(config: TsdfConfig):
    """An empty surface. torch, which holds it, takes seconds to import: only when there is to be one."""
    from p2p_lib.method.tsdf import TsdfVolume

    return TsdfVolume(config)
