"""The rigid bodies that the embedded tracker's points lie on: found, fitted, split and joined."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.trackers.builtin.image import Picture
from p2p_lib.trackers.builtin.landmarks import STEPS_M, Landmarks, corners
from p2p_lib.trackers.builtin.rigid_motion import Fit, Prediction, apart_m, consensus, fit_pose, linked, predict
from p2p_lib.trackers.builtin.tangent_planes import lifted_cov, surface_at
from p2p_lib.trackers.builtin.tracked_points import Points

#: How well a pose is known that matches have proposed: rad, m.
_PROPOSED = np.diag(np.repeat([0.05, 0.004], 3) ** 2)
_EYE2, _EYE3 = np.eye(2), np.eye(3)


@dataclass(eq=False)
class Body:
    """A rigid body: its newest pose, and the corners that were seen on it.

    before       T_cam_body of the frame before
    hidden_for   frames since the pose was known
    kept         whether enough of what it should show was there, when that was last looked at
    trail        the poses of the newest looks at whether it moves with another body
    shunned      (M, 3) places in the camera's frame where it was found and is not: its double may be there
    shunned_for  frames for which it is not looked for around them
    """

    fit: Fit
    before: np.ndarray
    hidden_for: int = 0
    kept: bool = True
    trail: list[np.ndarray] = field(default_factory=list)
    shunned: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    shunned_for: int = 0
    landmarks: Landmarks = field(default_factory=Landmarks)

    @property
    def posed(self) -> bool:
        """Whether the pose is that of the newest frame."""
        return self.hidden_for == 0

    @property
    def expected(self) -> np.ndarray:
        """T_cam_body in the next frame, if it goes on as it did."""
        T = self.fit.T_cam_body
        return T @ np.linalg.inv(self.before) @ T if self.posed else T

    @property
    def eye(self) -> np.ndarray:
        """(3,) the camera as seen from the body's centre."""
        T = self.fit.T_cam_body
        return -T[:3, :3].T @ T[:3, 3] - self.fit.centre


class Bodies:
    """All rigid bodies; ``Points.body`` counts them. A point of none has body -1."""

    def __init__(self, config: TrackingConfig):
        self.config = config
        self._bodies: list[Body] = []
        self._rng = np.random.default_rng(0)  # part of the method: the same stream gives the same tracks

    def _of(self, p: Points, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """T_cam_body (N, 4, 4), its covariance (N, 6, 6) and centre (N, 3) for points of bodies."""
        fits = [body.fit for body in self._bodies]
        names = ("T_cam_body", "covariance", "centre")
        return tuple(np.stack([getattr(fit, name) for fit in fits])[p.body[rows]] for name in names)

    def posed(self, p: Points, within: int = 0) -> np.ndarray:
        """(N,) points on bodies whose pose is known, or was ``within`` so many frames."""
        return np.array([body.hidden_for <= within for body in self._bodies] + [False])[p.body]

    def predict(self, p: Points, rows: np.ndarray, now: Picture) -> Prediction:
        """Where these points of bodies are, by their bodies' poses."""
        return predict(*self._of(p, rows), p.p_body[rows], p.map_cov[rows], p.tangent[rows], now.camera)

    def compact(self, p: Points) -> None:
        """Bodies without points go, the others move up."""
        held = np.unique(p.body[p.body >= 0])
        self._bodies = [self._bodies[b] for b in held]
        p.body = np.where(p.body >= 0, np.searchsorted(held, p.body), -1)

    def doubt(self, p: Points, wrong: np.ndarray) -> None:
        """Bodies most of whose followed points are ``wrong`` (N,) are somewhere else."""
        for b, body in enumerate(self._bodies):
            own = p.verified & (p.body == b)
            if (own & wrong).sum() > 0.5 * own.sum():
                R, t = body.fit.T_cam_body[:3, :3], body.fit.T_cam_body[:3, 3]
                body.shunned, body.shunned_for = p.p_body[own & wrong] @ R.T + t, self.config.shun_frames
                body.hidden_for, body.trail = self.config.linger_frames + 1, []

    def fit(self, p: Points, now: Picture, lost_only: bool = False) -> None:
        """Fit bodies' poses to their points that were followed or found; who disagrees is not verified."""
        p.loose &= lost_only
        for b, body in enumerate(self._bodies):
            if lost_only and body.posed:
                continue
            if not lost_only:
                body.shunned_for = max(body.shunned_for - 1, 0)
            at = np.flatnonzero(p.verified & (p.body == b))
            fit = self._fitted(body, p, at, now)
            if fit is not None:
                body.before = body.fit.T_cam_body if body.posed else fit.T_cam_body
                body.fit, body.hidden_for = fit, 0
                p.verified[at[~fit.agrees]] = False
                self._split(p, at[~fit.agrees], now)
            elif not lost_only:
                body.hidden_for += 1

    def _fitted(self, body: Body, p: Points, at: np.ndarray, now: Picture) -> Fit | None:
        """The pose of a body by its points at these rows; None where they do not agree on one."""
        cfg = self.config
        if len(at) < cfg.body_points:
            return None
        uv, z = p.uv[at].astype(float), now.depth_at(p.uv[at])
        seen = p.p_body[at], p.map_cov[at], uv, p.cov[at].astype(float), z, now.camera
        fit = fit_pose(body.expected, *seen)
        if fit.agrees.sum() < max(cfg.body_points, 0.5 * len(at)):
            known = z > 0
            p_cam = now.camera.unproject(uv[known], z[known])
            T, agrees = consensus(p.p_body[at][known], p_cam, np.arange(len(p_cam)), cfg.body_m)
            other = fit_pose(T, *seen) if agrees.sum() >= cfg.body_points else fit
            fit = max(fit, other, key=lambda one: one.agrees.sum())
        return fit if fit.agrees.sum() >= max(cfg.body_points, 0.3 * len(at)) else None

    def _split(self, p: Points, strays: np.ndarray, now: Picture) -> None:
        """Points that leave their body together go their own way, and are another one when they are far enough.

        Until then the body may be the one that is wrong: its word does not count for them.
        """
        cfg = self.config
        z = now.depth_at(p.uv[strays])
        known = (p.coasting[strays] == 0) & (z > 0)
        strays, p_cam = strays[known], now.camera.unproject(p.uv[strays[known]], z[known])
        if len(strays) < cfg.split_points:
            return
        T, agrees = consensus(p.p_body[strays], p_cam, np.arange(len(strays)), cfg.body_m)
        own = strays[agrees]
        if len(own) < cfg.split_points:
            return
        p.verified[own] = True
        centre, left = p.p_body[own].mean(0), self._bodies[p.body[own[0]]].fit.T_cam_body
        p.loose[own] = apart_m(left, T, centre) < cfg.split_m
        if not p.loose[own[0]]:
            p.body[own] = len(self._bodies)
            self._bodies.append(Body(Fit(T, _PROPOSED, centre, np.ones(len(own), bool)), T))

    def keep(self, p: Points, tried: np.ndarray) -> None:
        """Give up poses that show points, ``tried`` (N,) and not found, that are not there."""
        cfg = self.config
        for b, body in enumerate(self._bodies):
            own = p.body == b
            there, missing = (own & p.verified).sum(), (own & tried & ~p.verified).sum()
            needed = cfg.keep_share if body.kept else cfg.find_share
            body.kept = body.posed and there >= needed * (there + missing)
            if body.posed and not body.kept:
                body.hidden_for = cfg.linger_frames + 1

    def search(self, now: Picture, region: np.ndarray | None, turn: int | None) -> None:
        """Propose poses for lost bodies by their landmarks; one scale in ``turn`` keeps the cost even, None: all."""
        # One that was given up is lost although the few points that it was taken for are followed on.
        lost = [body for body in self._bodies if not (body.posed and body.kept) and len(body.landmarks.p_body)]
        if not lost:
            return
        scales = range(len(STEPS_M)) if turn is None else (turn % len(STEPS_M),)
        found = corners(now, region, self.config.features, scales)
        for body in lost:
            here = found
            if body.shunned_for:
                gap = np.linalg.norm(found.p_cam[:, None] - body.shunned[None], axis=-1).min(1)
                here = found.select(gap > self.config.body_reach_m)
            if len(here.uv_px) > self.config.candidates:
                self._propose(body, *body.landmarks.matches(here, self.config, self._rng))

    def suggest(self, p: Points, rows: np.ndarray, uv_px: np.ndarray, now: Picture) -> None:
        """Propose poses for lost bodies by where somebody expects points of them, uv_px (M, 2)."""
        z = now.depth_at(uv_px)
        for b, body in enumerate(self._bodies):
            own = (p.body[rows] == b) & (z > 0)
            if not body.posed:
                p_cam = now.camera.unproject(uv_px[own], z[own])
                self._propose(body, p.p_body[rows[own]], p_cam, np.arange(len(p_cam)))

    def _propose(self, body: Body, p_body: np.ndarray, p_cam: np.ndarray, corner: np.ndarray) -> None:
        """Let a lost body's points be looked for at the pose that matches p_body, p_cam (M, 3) agree on."""
        cfg = self.config
        T, agrees = consensus(p_body, p_cam, corner, cfg.body_m)
        if len(np.unique(corner[agrees])) >= cfg.support:
            body.fit, body.hidden_for = Fit(T, _PROPOSED, body.fit.centre, np.ones(0, bool)), 1

    def survey(self, p: Points, now: Picture) -> None:
        """Remember the corners on bodies that show a new side."""
        cfg = self.config
        for b, body in enumerate(self._bodies):
            rows = np.flatnonzero(p.visible & (p.body == b))
            enough = body.posed and len(rows) >= 2 * cfg.body_points
            if enough and not body.landmarks.known_from(body.eye, cfg.survey_deg):
                points = p.uv[rows], p.p_body[rows]
                body.landmarks.take(now, body.fit.T_cam_body, body.eye, points, cfg, self._rng)

    def learn(self, p: Points, rows: np.ndarray, now: Picture) -> None:
        """Improve the places of points on their bodies by where they were seen."""
        cfg, camera = self.config, now.camera
        z = now.depth_at(p.uv[rows])
        rows, z = rows[z > 0], z[z > 0]
        if not len(rows):
            return
        T = self._of(p, rows)[0]
        R, Rt = T[:, :3, :3], T[:, :3, :3].transpose(0, 2, 1)
        off = camera.unproject(p.uv[rows], z) - (R @ p.p_body[rows][..., None])[..., 0] - T[:, :3, 3]
        # Errors of successive frames have much in common.
        noise = cfg.repeats * lifted_cov(camera, p.uv[rows], z, p.cov[rows] + 0.3**2 * _EYE2, 1.5 * depth_noise_m(z))
        held = R @ p.map_cov[rows] @ Rt
        gain = held @ np.linalg.inv(held + noise)
        gain[np.abs(off[:, 2]) > cfg.depth_jump_m] = 0
        p.p_body[rows] += (Rt @ gain @ off[..., None])[..., 0]
        p.map_cov[rows] = Rt @ ((_EYE3 - gain) @ held) @ R + 1e-10 * _EYE3

    def adopt(self, p: Points, rows: np.ndarray, now: Picture) -> None:
        """Give points of no body, where there is depth, a place on the bodies nearby, or on new ones."""
        if not len(rows):
            return
        surface = surface_at(now.depth_m, now.camera, p.uv[rows])
        known = np.isfinite(surface.p_cam[:, 0])
        rows, surface = rows[known], surface.select(known)
        label = self._neighbours(p, rows, surface.p_cam)
        self._found_new(label, surface.p_cam)
        p.body[rows] = label
        rows, surface = rows[label >= 0], surface.select(label >= 0)
        if not len(rows):
            return
        T = self._of(p, rows)[0]
        R, Rt = T[:, :3, :3], T[:, :3, :3].transpose(0, 2, 1)
        cov = p.cov[rows] + 0.2**2 * _EYE2
        p.p_body[rows] = (Rt @ (surface.p_cam - T[:, :3, 3])[..., None])[..., 0]
        p.tangent[rows] = Rt @ surface.per_px @ p.warp[rows]
        p.map_cov[rows] = Rt @ lifted_cov(now.camera, p.uv[rows], surface.p_cam[:, 2], cov, surface.sigma_m) @ R

    def _neighbours(self, p: Points, rows: np.ndarray, p_cam: np.ndarray) -> np.ndarray:
        """(M,) bodies that new points belong to: of the nearest point within reach, over others if need be; or -1."""
        label, reach_m = np.full(len(rows), -1), self.config.body_reach_m
        old = np.flatnonzero(p.visible & self.posed(p))
        old = old[~np.isin(old, rows)]
        if not len(old):
            return label
        T = self._of(p, old)[0]
        here, body = (T[:, :3, :3] @ p.p_body[old][..., None])[..., 0] + T[:, :3, 3], p.body[old]
        while len(here) and (label < 0).any():
            free = np.flatnonzero(label < 0)
            gap = np.linalg.norm(p_cam[free][:, None] - here[None], axis=-1)
            near = gap.min(1) < reach_m
            label[free[near]] = body[gap[near].argmin(1)]
            here, body = p_cam[free[near]], label[free[near]]
        return label

    def _found_new(self, label: np.ndarray, p_cam: np.ndarray) -> None:
        """New bodies of points without one, ``label`` -1, that hang together."""
        free = np.flatnonzero(label < 0)
        chain = linked(p_cam[free], self.config.body_reach_m)
        for first in np.unique(chain):
            members = free[chain == first]
            if len(members) >= 2 * self.config.body_points:
                label[members] = len(self._bodies)
                fit = Fit(np.eye(4), np.zeros((6, 6)), p_cam[members].mean(0), np.ones(0, bool))
                self._bodies.append(Body(fit, fit.T_cam_body))

    def join(self, p: Points) -> None:
        """Two bodies that lie in one another and moved together are one: one pair at a time."""
        looks = self.config.join_looks
        for body in self._bodies:
            body.trail = [*body.trail, body.fit.T_cam_body][-looks:] if body.posed else []
        size = np.bincount(p.body[p.body >= 0], minlength=len(self._bodies))
        long = [b for b in np.argsort(-size, kind="stable") if len(self._bodies[b].trail) == looks]
        for large, small in combinations(long, 2):
            if self._are_one(p, large, small):
                self._merge(p, large, small)
                return

    def _are_one(self, p: Points, large: int, small: int) -> bool:
        cfg, one, other = self.config, self._bodies[large], self._bodies[small]
        T_one_other = np.linalg.inv(one.trail[-1]) @ other.trail[-1]
        moved_m = apart_m(other.trail[0], other.trail[-1], other.fit.centre)
        slip_m = apart_m(one.trail[0] @ T_one_other, other.trail[0], other.fit.centre)
        if moved_m < cfg.split_m or slip_m > 0.3 * moved_m:
            return False
        there = p.p_body[p.body == small] @ T_one_other[:3, :3].T + T_one_other[:3, 3]
        gap = np.linalg.norm(there[:, None] - p.p_body[p.body == large][None], axis=-1).min(1)
        return bool((gap < cfg.body_reach_m).mean() >= 0.7)

    def _merge(self, p: Points, large: int, small: int) -> None:
        one, other = self._bodies[large], self._bodies[small]
        T_one_other = np.linalg.inv(one.trail[-1]) @ other.trail[-1]
        R, own = T_one_other[:3, :3], np.flatnonzero(p.body == small)
        p.body[own], p.p_body[own] = large, p.p_body[own] @ R.T + T_one_other[:3, 3]
        p.tangent[own], p.map_cov[own] = R @ p.tangent[own], R @ p.map_cov[own] @ R.T + 0.001**2 * _EYE3
        one.landmarks.absorb(other.landmarks, T_one_other, self.config, self._rng)
        self.compact(p)
