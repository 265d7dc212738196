"""Rigid motion segments: groups of points that move as one rigid body. Started, fitted, split, lost and found again."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from p2p_lib.core import se3
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.image import in_mask
from p2p_lib.core.robust import consensus
from p2p_lib.trackers.builtin.direct_alignment import overruling
from p2p_lib.trackers.builtin.image import Image
from p2p_lib.trackers.builtin.landmarks import Landmarks, corners
from p2p_lib.trackers.builtin.rigid_motion import PointPrediction, PoseFit, fit_pose, pose_distance_m, predict
from p2p_lib.trackers.builtin.segment_view import Matched, SegmentView
from p2p_lib.trackers.builtin.tangent_planes import lifted_cov, planes_at
from p2p_lib.trackers.builtin.tracked_points import Points
from p2p_lib.trackers.builtin.wide_baseline import corners_of, matched

#: Covariance of a pose that matches have proposed: rad, m.
_PROPOSED_COV = np.diag(np.repeat([0.05, 0.004], 3) ** 2)
#: Fraction of a segment's points that should show which must be found: fewer are chance, on something like it. Where
#: a caller expects them no corner has been recognised: on rows of keys every third point is found a key beside its own.
MIN_FOUND, MIN_SUGGESTED = 0.25, 0.4
#: Effective information: errors of so many successive frames count as one observation of a position.
_REPEATS = 4.0
#: Error of a position (px) beside what alignment states: when a point is placed, when it is observed again.
_PLACED_PX, _OBSERVED_PX = 0.2, 0.3
#: A neighbouring pixel's depth may be read: depth noise of an observation is larger than the sensor's by this.
_DEPTH_NOISE = 1.5
#: Points farther from where the surface takes them, beyond its errors, say nothing of its motion, px.
_WITH_PX = 2.0
_EYE2, _EYE3 = np.eye(2), np.eye(3)
#: A segment is matched where fewer than this share of the points are followed that were seen on it.
_FOLLOWED = 0.5
#: Covariance of a matched corner on its segment, m^2.
_MATCHED_M2 = 0.001**2 * _EYE3


@dataclass(eq=False)
class MotionSegment:
    """A rigid motion segment: its newest pose, and its landmarks.

    before        T_cam_seg of the frame before
    hidden_for    frames since the pose was known
    rejected      (M, 3) points in the camera's frame where it was found wrongly: a look-alike may be there
    rejected_for  frames for which it is not searched for around them
    last_view     the newest frame in which it had a pose; None before it has points enough to be searched for
    matched       what corners or the surface of that frame have been matched with in the newest one; None where nothing
    T_by_points   its pose in that frame by its points alone, where they were overruled; None: as it is
    """

    fit: PoseFit
    before: np.ndarray
    hidden_for: int = 0
    rejected: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    rejected_for: int = 0
    landmarks: Landmarks = field(default_factory=Landmarks)
    last_view: SegmentView | None = None
    matched: Matched | None = None
    T_by_points: np.ndarray | None = None

    @property
    def posed(self) -> bool:
        """Whether the pose is that of the newest frame."""
        return self.hidden_for == 0

    @property
    def extrapolated(self) -> np.ndarray:
        """T_cam_seg in the next frame, if the motion goes on."""
        T = self.fit.T_cam_seg
        # Without this, rounding errors of the rotation would grow with every frame.
        return se3.orthonormalised(T @ se3.inverse(self.before) @ T) if self.posed else T


class MotionSegments:
    """All rigid motion segments; ``Points.segment`` is the place in this list, -1 for points of none."""

    def __init__(self, config: TrackingConfig):
        self.config = config
        self.segments: list[MotionSegment] = []
        self._rng = np.random.default_rng(0)  # part of the method: the same stream gives the same tracks

    def _poses(self, p: Points, rows: np.ndarray) -> np.ndarray:
        """T_cam_seg (N, 4, 4) for points of segments."""
        return np.stack([segment.fit.T_cam_seg for segment in self.segments])[p.segment[rows]]

    def posed(self, p: Points, within: int = 0) -> np.ndarray:
        """(N,) points on segments whose pose is known, or was ``within`` so many frames."""
        return np.array([segment.hidden_for <= within for segment in self.segments] + [False])[p.segment]

    def matched(self, p: Points) -> np.ndarray:
        """(N,) points on segments that corners of the frame before show in the newest one."""
        return np.array([segment.matched is not None for segment in self.segments] + [False])[p.segment]

    def predict(self, p: Points, rows: np.ndarray, now: Image) -> PointPrediction:
        """Where these points of segments are by their segments' poses."""
        of, fits = p.segment[rows], [segment.fit for segment in self.segments]
        covariance, centre = np.stack([f.covariance for f in fits])[of], np.stack([f.centre for f in fits])[of]
        points = p.p_seg[rows], p.map_cov[rows], p.tangent[rows]
        return predict(self._poses(p, rows), covariance, centre, *points, now.camera)

    def compact(self, p: Points) -> None:
        """Remove segments without points."""
        held = np.unique(p.segment[p.segment >= 0])
        self.segments = [self.segments[s] for s in held]
        p.segment = np.where(p.segment >= 0, np.searchsorted(held, p.segment), -1)

    def invalidate(self, p: Points, wrong: np.ndarray) -> None:
        """Segments most of whose followed points are ``wrong`` (N,) are lost and for a while not searched for there."""
        for s, segment in enumerate(self.segments):
            own = p.verified & (p.segment == s)
            if (own & wrong).sum() > 0.5 * own.sum():
                segment.rejected = se3.transform(segment.fit.T_cam_seg, p.p_seg[own & wrong])
                segment.rejected_for = self.config.reject_frames
                segment.hidden_for, segment.last_view = self.config.linger_frames + 1, None

    def fit(self, p: Points, now: Image, search: np.ndarray | None = None) -> None:
        """Fit poses to the points that were followed; where too few agree, to the corners of the frame before, too.

        Points that disagree are not verified. ``search`` (H, W): where objects are; None: anywhere.
        """
        p.leaving[:] = False
        rows = [np.flatnonzero(p.verified & (p.segment == s)) for s in range(len(self.segments))]
        for segment in self.segments:
            segment.rejected_for, segment.matched = max(segment.rejected_for - 1, 0), None
        fits = [self._fitted(segment.extrapolated, p, at, now) for segment, at in zip(self.segments, rows, strict=True)]
        self._match(fits, now, search)
        self._overrule(fits, now)
        for segment, at, fit in zip(self.segments.copy(), rows, fits, strict=True):
            if (pairs := segment.matched) is not None:
                start = pairs.T_cam_seg
                if pairs.overruling:
                    at = self._with(self._fitted(start, p, at[:0], now, pairs=pairs), p, at, now)
                elif fit is not None and self._same(fit.T_cam_seg, start, fit.centre):
                    start = fit.T_cam_seg
                fit = self._fitted(start, p, at, now, pairs=pairs)
            if fit is None:
                segment.hidden_for += 1
                continue
            segment.before = segment.fit.T_cam_seg if segment.posed else fit.T_cam_seg
            segment.fit, segment.hidden_for = fit, 0
            p.verified[at[~fit.agrees]] = False
            if segment.matched is None:  # else they were left behind
                self._split(p, at[~fit.agrees], now)

    @staticmethod
    def _with(fit: PoseFit | None, p: Points, at: np.ndarray, now: Image) -> np.ndarray:
        """Points, of the rows ``at``, that move with a segment, as far as is known how that moves."""
        if fit is None or not len(at):
            return at
        T, covariance, centre = (np.repeat(a[None], len(at), 0) for a in (fit.T_cam_seg, fit.covariance, fit.centre))
        there = predict(T, covariance, centre, p.p_seg[at], p.map_cov[at], p.tangent[at], now.camera)
        return at[np.linalg.norm(there.uv_px - p.uv[at], axis=1) < _WITH_PX + 3 * there.sigma_px]

    def fit_found(self, p: Points, now: Image, sought: np.ndarray, fewest: float) -> None:
        """Fit poses of lost segments to the points found among those sought, rows (M,), a share of these at least.

        A segment with a pose keeps it, unless hardly any of its points are found there.
        """
        for s, segment in enumerate(self.segments):
            at = np.flatnonzero(p.verified & (p.segment == s))
            own = sought[p.segment[sought] == s]
            shown = len(at) + np.count_nonzero(~p.verified[own])
            if segment.posed and segment.matched is None:
                if len(at) < MIN_FOUND * shown:
                    segment.hidden_for, p.verified[at] = 1, False
                continue
            if segment.matched is not None and segment.matched.overruling:
                at = self._with(segment.fit, p, at, now)
            least = fewest * shown if segment.matched is None else 0.0
            fit = self._fitted(segment.fit.T_cam_seg, p, at, now, least, segment.matched)
            if fit is not None:
                segment.before = segment.before if segment.posed else fit.T_cam_seg
                segment.fit, segment.hidden_for = fit, 0
                p.verified[at[~fit.agrees]] = False
            elif not segment.posed:  # what was found at a pose that is refused is refused with it
                p.verified[own] = False

    def _fitted(
        self,
        start: np.ndarray,
        p: Points,
        at: np.ndarray,
        now: Image,
        fewest: float = 0.0,
        pairs: Matched | None = None,
    ) -> PoseFit | None:
        """A segment's pose, near ``start``, by its points at these rows and by ``pairs``; None where few agree."""
        seen = [p.p_seg[at], p.map_cov[at], p.uv[at].astype(float), p.cov[at].astype(float), now.depth_at(p.uv[at])]
        if pairs is not None:
            noise_m2 = np.broadcast_to(_MATCHED_M2, (len(pairs), 3, 3))
            noise_px2 = np.broadcast_to(pairs.cov_px2, (len(pairs), 2, 2))
            more = pairs.p_seg, noise_m2, pairs.uv_px, noise_px2, pairs.z_m
            seen = [np.concatenate(column) for column in zip(seen, more, strict=True)]
        fewest = max(self.config.segment_min_points, fewest)
        if len(seen[0]) < fewest:
            return None
        p_seg, map_cov, uv_px, cov_px2, z_m = seen
        fit = fit_pose(start, p_seg, map_cov, uv_px, cov_px2, z_m, now.camera)
        return replace(fit, agrees=fit.agrees[: len(at)]) if fit.agrees.sum() >= fewest else None

    def _match(self, fits: list[PoseFit | None], now: Image, search: np.ndarray | None) -> None:
        """Look for corners of segments on which too few points were followed; kept where more of them agree.

        Not where they have hardly moved: reflections stand still while their object turns, and agree with that. Points,
        if there are some, tell a short step better.
        """
        agreeing = [0 if fit is None else np.count_nonzero(fit.agrees) for fit in fits]
        lost = [
            (segment, count, segment.last_view)
            for segment, count in zip(self.segments, agreeing, strict=True)
            if segment.last_view is not None
            and segment.hidden_for < self.config.linger_frames
            and not segment.rejected_for
            and count < _FOLLOWED * len(segment.last_view.uv_px)
        ]
        if not lost:
            return
        found, regions = corners_of([then for _, _, then in lost], now, search)
        for (segment, count, then), region in zip(lost, regions, strict=True):
            pairs = matched(then, found.select(in_mask(found.uv_px, region)), self.config, self._rng)
            if pairs is None or len(pairs) <= count:
                continue
            still = self._same(pairs.T_cam_seg, then.T_cam_seg, segment.fit.centre)
            if not (still and count >= MIN_FOUND * len(then.uv_px)):
                segment.matched = pairs

    def _overrule(self, fits: list[PoseFit | None], now: Image) -> None:
        """Where what shows of a segment agrees clearly better with another motion than with its points', that counts.

        Points that slide, as on reflections, agree with each other.
        """
        for segment, fit in zip(self.segments, fits, strict=True):
            then = segment.last_view
            if then is None or segment.hidden_for >= self.config.linger_frames or segment.rejected_for:
                continue
            T_seg_then = se3.inverse(then.T_cam_seg)
            known = [] if segment.matched is None else [segment.matched.T_cam_seg @ T_seg_then]
            if fit is not None:
                # From frame to frame: by their places alone points have no errors that add up.
                by_points = T_seg_then if segment.T_by_points is None else se3.inverse(segment.T_by_points)
                known.append(fit.T_cam_seg @ by_points)
            predicted = segment.extrapolated @ T_seg_then
            far = fit is None or bool(np.count_nonzero(fit.agrees) < _FOLLOWED * len(then.uv_px))
            motion = overruling(then.surface, then.patch(now), known, predicted, self.config.overruled_below, far)
            if motion is not None:
                segment.matched = then.carried(motion, now)

    def _same(self, T_a: np.ndarray, T_b: np.ndarray, centre: np.ndarray) -> bool:
        """Whether two poses of a segment differ by less than points that agree."""
        return pose_distance_m(T_a, T_b, centre) < self.config.segment_inlier_m

    def remember(self, p: Points, now: Image, search: np.ndarray | None) -> None:
        """Where segments show in the newest frame: there they are searched for in the next one."""
        for s, segment in enumerate(self.segments):
            own = p.visible & (p.segment == s)
            if segment.posed and np.count_nonzero(own) >= 2 * self.config.segment_min_points:
                found, segment.T_by_points = None if segment.matched is None else segment.matched.found, None
                if segment.matched is not None and segment.matched.overruling:
                    alone = np.flatnonzero(p.verified & (p.segment == s))
                    fit = self._fitted(segment.fit.T_cam_seg, p, alone, now)
                    segment.T_by_points = None if fit is None else fit.T_cam_seg
                segment.last_view = SegmentView(now, p.uv[own], segment.fit.T_cam_seg, search, found)

    def _split(self, p: Points, strays: np.ndarray, now: Image) -> None:
        """Points that leave their segment together stay verified, and are a new segment once they are far enough.

        Until then the segment's pose may be the wrong one: its prediction does not count for them.
        """
        cfg = self.config
        z = now.depth_at(p.uv[strays])
        known = (p.coasting[strays] == 0) & (z > 0)
        strays, p_cam = strays[known], now.camera.unproject(p.uv[strays[known]], z[known])
        if len(strays) < cfg.split_points:
            return
        T, agrees = consensus(p.p_seg[strays], p_cam, cfg.segment_inlier_m)
        own = strays[agrees]
        if len(own) < cfg.split_points:
            return
        p.verified[own] = True
        centre, left = p.p_seg[own].mean(0), self.segments[p.segment[own[0]]].fit.T_cam_seg
        p.leaving[own] = pose_distance_m(left, T, centre) < cfg.split_m
        if not p.leaving[own[0]]:
            p.segment[own] = len(self.segments)
            self.segments.append(MotionSegment(PoseFit(T, _PROPOSED_COV, centre), T))

    def search(self, now: Image, region: np.ndarray | None) -> None:
        """Propose poses for lost segments by their landmarks, outside of the regions where they were rejected."""
        lost = [segment for segment in self.segments if not segment.posed and len(segment.landmarks.p_seg)]
        if not lost:
            return
        cfg, found = self.config, corners(now, region, self.config.corners)
        for segment in lost:
            here = found
            if segment.rejected_for:
                gap_m, _ = cKDTree(segment.rejected).query(found.p_cam)
                here = found.select(gap_m > cfg.segment_reach_m)
            if len(here.uv_px) >= cfg.min_landmark_matches:
                self._propose(segment, *segment.landmarks.match(here, cfg.match_ratio, self._rng))

    def suggest(self, p: Points, rows: np.ndarray, uv_px: np.ndarray, now: Image) -> list[MotionSegment]:
        """Propose poses for lost segments by where the caller expects points of them, uv_px (M, 2).

        Returns copies of all segments as they were, for :meth:`restore`.
        """
        z, before = now.depth_at(uv_px), [replace(segment) for segment in self.segments]
        for s, segment in enumerate(self.segments):
            own = (p.segment[rows] == s) & (z > 0)
            if not segment.posed:
                p_cam = now.camera.unproject(uv_px[own], z[own])
                self._propose(segment, p.p_seg[rows[own]], p_cam, np.arange(len(p_cam)))
        return before

    def restore(self, before: list[MotionSegment]) -> None:
        """Segments that were not found where they were expected are as they were: nothing is searched for there."""
        self.segments = [now if now.posed else then for now, then in zip(self.segments, before, strict=True)]

    def _propose(self, segment: MotionSegment, p_seg: np.ndarray, p_cam: np.ndarray, corner: np.ndarray) -> None:
        """Have a lost segment's points searched for at the pose that most pairs p_seg, p_cam (M, 3) agree on."""
        T, agrees = consensus(p_seg, p_cam, self.config.segment_inlier_m, corner)
        if len(np.unique(corner[agrees])) >= self.config.min_landmark_matches:
            segment.fit, segment.hidden_for = PoseFit(T, _PROPOSED_COV, segment.fit.centre), 1

    def add_landmarks(self, p: Points, now: Image, first: bool = False) -> None:
        """Remember the corners on segments that show a new side; on those without any alone, if ``first``."""
        cfg = self.config
        for s, segment in enumerate(self.segments):
            rows = np.flatnonzero(p.visible & (p.segment == s))
            # What is fast is blurred: nothing to be remembered by where there is anything else.
            skip = (segment.matched or first) and len(segment.landmarks.p_seg)
            if not segment.posed or skip or len(rows) < 2 * cfg.segment_min_points:
                continue
            T_seg_cam = se3.inverse(segment.fit.T_cam_seg)
            view = T_seg_cam[:3, 3] - segment.fit.centre
            if not segment.landmarks.taken_from(view, cfg.landmark_view_deg):
                segment.landmarks.add(now, T_seg_cam, view, p.uv[rows], p.p_seg[rows], cfg, self._rng)

    def update_positions(self, p: Points, rows: np.ndarray, now: Image) -> None:
        """Kalman update of points' positions on their segments by where they were seen."""
        z = now.depth_at(p.uv[rows])
        rows, z = rows[z > 0], z[z > 0]
        if not len(rows):
            return
        T = self._poses(p, rows)
        R, Rt = T[:, :3, :3], T[:, :3, :3].transpose(0, 2, 1)
        off = now.camera.unproject(p.uv[rows], z) - (R @ p.p_seg[rows][..., None])[..., 0] - T[:, :3, 3]
        cov_px2 = p.cov[rows] + _OBSERVED_PX**2 * _EYE2
        noise = _REPEATS * lifted_cov(now.camera, p.uv[rows], z, cov_px2, _DEPTH_NOISE * depth_noise_m(z))
        cov = R @ p.map_cov[rows] @ Rt
        gain = cov @ np.linalg.inv(cov + noise)
        gain[np.abs(off[:, 2]) > self.config.depth_jump_m] = 0
        p.p_seg[rows] += (Rt @ gain @ off[..., None])[..., 0]
        p.map_cov[rows] = Rt @ ((_EYE3 - gain) @ cov) @ R + 1e-10 * _EYE3

    def assign(self, p: Points, rows: np.ndarray, now: Image) -> None:
        """Give points of no segment, where there is depth, a position on the segments nearby, or on new ones."""
        planes = planes_at(now.depth_m, now.camera, p.uv[rows])
        known = np.isfinite(planes.p_cam[:, 0])
        rows, planes = rows[known], planes.select(known)
        label = self._nearby(p, rows, planes.p_cam)
        self._start(label, planes.p_cam)
        p.segment[rows] = label
        rows, planes = rows[label >= 0], planes.select(label >= 0)
        if not len(rows):
            return
        T = self._poses(p, rows)
        R, Rt = T[:, :3, :3], T[:, :3, :3].transpose(0, 2, 1)
        cov_px2 = p.cov[rows] + _PLACED_PX**2 * _EYE2
        p.p_seg[rows] = (Rt @ (planes.p_cam - T[:, :3, 3])[..., None])[..., 0]
        p.tangent[rows] = Rt @ planes.per_px @ p.warp[rows]
        p.map_cov[rows] = Rt @ lifted_cov(now.camera, p.uv[rows], planes.p_cam[:, 2], cov_px2, planes.sigma_m) @ R

    def _nearby(self, p: Points, rows: np.ndarray, p_cam: np.ndarray) -> np.ndarray:
        """(M,) segment of the nearest point within reach, in steps over other new points; -1 for none."""
        label = np.full(len(rows), -1)
        old = np.flatnonzero(p.visible & self.posed(p))  # the new ones are on no segment
        if not len(old):
            return label
        reached = se3.transform(self._poses(p, old), p.p_seg[old][:, None])[:, 0]
        segment = p.segment[old]
        while len(reached) and (label < 0).any():
            free = np.flatnonzero(label < 0)
            gap_m, nearest = cKDTree(reached).query(p_cam[free])
            near = gap_m < self.config.segment_reach_m
            label[free[near]] = segment[nearest[near]]
            reached, segment = p_cam[free[near]], label[free[near]]
        return label

    def _start(self, label: np.ndarray, p_cam: np.ndarray) -> None:
        """Start segments of connected components of points p_cam (M, 3) without one, ``label`` (M,) -1."""
        free = np.flatnonzero(label < 0)
        if not len(free):
            return
        pairs = cKDTree(p_cam[free]).query_pairs(self.config.segment_reach_m, output_type="ndarray")
        graph = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(free), len(free)))
        count, component = connected_components(graph, directed=False)
        for c in range(count):
            members = free[component == c]
            if len(members) >= 2 * self.config.segment_min_points:
                label[members] = len(self.segments)
                fit = PoseFit(np.eye(4), np.zeros((6, 6)), p_cam[members].mean(0))
                self.segments.append(MotionSegment(fit, fit.T_cam_seg))
