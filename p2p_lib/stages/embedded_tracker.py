"""The embedded 2D tracker: long-range, without weights, on the CPU.

Every point keeps a few appearances of itself (:mod:`p2p_lib.stages.appearance`). From frame to frame
Lucas-Kanade proposes its place, and alignment with the best fitting appearance decides: that takes the
drift out, and a place that does not look like the point is not one. Points that move together make a
rigid body (:mod:`p2p_lib.stages.rigid_bodies`), whose pose says where all its points are, how they are
warped and which of them face the camera: those not followed are looked for there. A body that is
nowhere is looked for in the whole picture by the corners that were once on it
(:mod:`p2p_lib.stages.features`). Whatever is found is verified by alignment.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.errors import BadInput
from p2p_lib.core.types import Frame, Tracks
from p2p_lib.stages import features, rigid_bodies
from p2p_lib.stages.appearance import Alignment, align, take
from p2p_lib.stages.rigid_bodies import Fit, Prediction
from p2p_lib.stages.tracked_points import Points

_EYE = np.eye(2, dtype=np.float32)
#: Steps of the grids on the surface on which corners are described.
_STEPS_M = (0.0015, 0.003)


@dataclass(eq=False)
class Body:
    """A rigid body: its newest pose, and the corners that were seen on it.

    hidden_for   frames since the pose was known
    kept         whether enough of what it should show was there, when that was last looked at
    descriptors  (L, scales, SIZE) of the corners, p_body (L, 3) their places
    views        (V, 3) where the camera was when corners were taken, from the body's centre
    """

    fit: Fit
    before: np.ndarray
    hidden_for: int = 0
    kept: bool = True
    descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, len(_STEPS_M), features.SIZE), np.float32))
    p_body: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    views: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def posed(self) -> bool:
        """Whether the pose is that of the newest frame."""
        return self.hidden_for == 0

    @property
    def eye(self) -> np.ndarray:
        """(3,) the camera as seen from the body's centre."""
        T = self.fit.T_cam_body
        return -T[:3, :3].T @ T[:3, 3] - self.fit.centre


class EmbeddedTracker:
    """Long-range point tracker; see the module's text. Implements :class:`p2p_lib.stages.tracking.PointTracker`."""

    name = "embedded"
    latency_frames = 0

    def __init__(self, config: TrackingConfig, rng: np.random.Generator | None = None):
        self.config = config
        self._gray: np.ndarray | None = None
        self._clear()

    def _clear(self) -> None:
        self._next_id, self._frames = 0, 0
        self._points = Points.new(np.zeros(0, np.int64), np.zeros((0, 2)), self.config.appearances)
        self._bodies: list[Body] = []
        self._rng = np.random.default_rng(0)

    def start(self, frame: Frame, camera: Camera | None = None) -> None:
        """Begin a stream at this frame."""
        self._clear()
        self._camera = camera or rigid_bodies.usual_camera(*frame.shape[::-1])
        self._see(frame)

    def add(self, uv_px: np.ndarray) -> np.ndarray:
        """Add queries (N, 2) in the newest frame; returns their ids."""
        if self._gray is None:
            raise BadInput("tracker", "queries before a frame", "start(frame) first")
        uv = np.asarray(uv_px, np.float32).reshape(-1, 2)
        ids = np.arange(self._next_id, self._next_id + len(uv))
        self._next_id += len(uv)
        held = len(self._points)
        self._points = self._points.joined(Points.new(ids, uv, self.config.appearances))
        if len(ids):
            self._remember(held + np.arange(len(ids)))
            self._embody(held + np.arange(len(ids)))
        return ids

    def drop(self, ids: np.ndarray) -> None:
        """Forget these queries for good."""
        self._points = p = self._points.select(~np.isin(self._points.ids, ids))
        # Bodies without points go, the others move up.
        held = np.unique(p.body[p.body >= 0])
        self._bodies = [self._bodies[b] for b in held]
        p.body = np.where(p.body >= 0, np.searchsorted(held, p.body), -1)

    def reject(self, ids: np.ndarray) -> None:
        """Take these tracks for invisible until they are found again."""
        gone = np.isin(self._points.ids, ids)
        p = self._points
        held = np.bincount(p.body[p.verified & (p.body >= 0)], minlength=len(self._bodies))
        lost = np.bincount(p.body[p.verified & (p.body >= 0) & gone], minlength=len(self._bodies))
        for body, a, b in zip(self._bodies, held, lost, strict=True):
            if b > 0.5 * a:
                body.hidden_for = self.config.linger_frames + 1
        p.visible &= ~gone
        p.verified &= ~gone
        # Where it was is wrong: not the place to look first.
        p.hidden_for[gone] = self.config.linger_frames + 1

    def suggest(self, ids: np.ndarray, uv_px: np.ndarray) -> Tracks:
        """Look for bodies that are lost where the caller expects their points in the newest frame.

        ids, uv_px  (N,), (N, 2): all points of one rigid body, the visible ones too: they say how it is turned.
        """
        p, cfg = self._points, self.config
        at = p.rows(ids)
        ok = (at >= 0) & np.isfinite(uv_px).all(1)
        at, uv = at[ok], uv_px[ok]
        z = self._depth_at(uv)
        lost = [body for body in self._bodies if not body.posed]
        for b, body in enumerate(self._bodies):
            own = np.flatnonzero((p.body[at] == b) & (z > 0))
            if body.posed or len(own) < cfg.support:
                continue
            p_cam = self._camera.unproject(uv[own], z[own])
            self._propose(body, p.p_body[at[own]], p_cam, np.arange(len(own)))
        self._look(None)
        if any(body.posed for body in lost):
            self._judge(None)
            self._check_depth(self._depth_m)
            p.hidden_for[p.visible] = 0
        return self._told()

    def track(self, frame: Frame, search: np.ndarray | None = None, urgent: bool = False) -> Tracks:
        """Follow all live queries into the next frame."""
        if self._gray is None:
            raise BadInput("tracker", "a frame to track before any start", "start(frame) first")
        previous = self._gray
        self._see(frame)
        self._frames += 1
        self._follow(previous)
        self._pose()
        self._search_everywhere(search, urgent)
        self._look(search)
        self._judge(search)
        self._check_depth(frame.depth_m)
        p, cfg = self._points, self.config
        p.hidden_for = np.where(p.visible, 0, p.hidden_for + 1)
        if self._frames % cfg.renew_every == 0:
            self._renew()
            self._survey()
        return self._told()

    def _told(self) -> Tracks:
        """The points as the caller gets them."""
        p = self._points
        # A bounded, monotonous reading of the standard deviation: 1/2 at uncertain_px.
        uncertainty = np.where(p.visible, p.sigma_px / (p.sigma_px + self.config.uncertain_px), 1.0)
        return Tracks(p.ids.copy(), p.uv.astype(float), p.visible.copy(), uncertainty.astype(float))

    def _see(self, frame: Frame) -> None:
        self._gray = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        self._depth_m = frame.depth_m
        self._fine = self._gray.astype(np.float32)
        self._coarse = cv2.pyrDown(self._gray).astype(np.float32)
        quarter = cv2.resize(frame.rgb, None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
        self._chroma = cv2.cvtColor(quarter, cv2.COLOR_RGB2LAB)[..., 1:].astype(np.float32)

    def _follow(self, previous: np.ndarray) -> None:
        """Lucas-Kanade proposes, the appearance that fits best decides."""
        p, cfg = self._points, self.config
        at = np.flatnonzero(p.verified | ((p.body < 0) & (p.hidden_for <= cfg.linger_frames)))
        p.verified[:] = False
        if not len(at):
            return
        flow = {"winSize": (cfg.window_px, cfg.window_px), "maxLevel": cfg.levels}
        here = p.uv[at]
        there, found, _ = cv2.calcOpticalFlowPyrLK(previous, self._gray, here, None, **flow)
        there = np.where(found > 0, there, here)
        k = self._fitting(at)
        seen = align(self._fine, p.fine[at, k], there, p.warp[at] @ np.linalg.inv(p.view[at, k]), cfg.iterations)
        moved_px = np.linalg.norm(seen.uv_px - there, axis=1)
        good = (seen.ncc >= cfg.min_ncc) & (moved_px < cfg.search_px) & self._plausible(at, k, seen)
        self._settle(at[good], k[good], seen, good)
        self._coast(at[~good], previous, here[~good], there[~good], seen.ncc[~good], flow)

    def _fitting(self, at: np.ndarray) -> np.ndarray:
        """The appearance of each point that its present warp distorts least; the older in doubt."""
        p = self._points
        A = p.warp[at][:, None] @ np.linalg.inv(p.view[at])
        squared = A @ A.transpose(0, 1, 3, 2) - _EYE
        distortion = np.sqrt((squared**2).sum((2, 3))) + 0.1 * np.arange(A.shape[1])
        distortion[np.arange(A.shape[1]) >= p.count[at][:, None]] = np.inf
        return distortion.argmin(1)

    def _settle(self, at: np.ndarray, k: np.ndarray, seen: Alignment, rows: np.ndarray) -> None:
        """Points ``at`` are where ``seen`` (its ``rows``) found their appearances k."""
        p = self._points
        p.uv[at], p.warp[at] = seen.uv_px[rows], seen.A[rows] @ p.view[at, k]
        p.cov[at] = seen.cov_px2[rows] + p.view_cov[at, k]
        p.verified[at], p.coasting[at], p.ncc[at] = True, 0, seen.ncc[rows]

    def _coast(self, at, previous, here, there, ncc, flow) -> None:
        """Points that changed their looks go on by Lucas-Kanade alone for a while, if it comes home again."""
        p, cfg = self._points, self.config
        if not len(at):
            return
        home, found, _ = cv2.calcOpticalFlowPyrLK(self._gray, previous, there, None, **flow)
        error_px = np.linalg.norm(home - here, axis=1)
        h, w = self._gray.shape
        ok = (found[:, 0] > 0) & (error_px < cfg.forward_backward_px) & (ncc > cfg.coast_ncc)
        ok &= (there >= 0).all(1) & (there <= [w - 1, h - 1]).all(1) & (p.coasting[at] < cfg.coast_frames)
        p.uv[at] = there
        p.verified[at] = ok
        p.coasting[at] += 1
        p.cov[at] += cfg.coast_sigma_px**2 / 2 * _EYE

    def _depth_at(self, uv: np.ndarray) -> np.ndarray:
        """(N,) metres measured at the nearest pixels; 0 where nothing is, and outside the picture."""
        h, w = self._depth_m.shape
        px = np.clip(np.rint(np.nan_to_num(uv)), 0, [w - 1, h - 1]).astype(int)
        return self._depth_m[px[:, 1], px[:, 0]].astype(float)

    def _pose(self, lost_only: bool = False) -> None:
        """Fit every body's pose to its points that were followed."""
        p = self._points
        for b, body in enumerate(self._bodies):
            if lost_only and body.posed:
                continue
            at = np.flatnonzero(p.verified & (p.body == b))
            fit = self._fitted(body, at)
            if fit is None:
                if not lost_only:
                    body.hidden_for += 1
                continue
            if body.posed and not lost_only:
                body.before = body.fit.T_cam_body
            else:
                body.before = fit.T_cam_body
            body.fit, body.hidden_for = fit, 0
            strays = at[~fit.agrees]
            p.verified[strays] = False
            self._split(strays)

    def _fitted(self, body: Body, at: np.ndarray) -> Fit | None:
        """The pose of a body by its points at these rows; None where they do not agree on one."""
        p, cfg = self._points, self.config
        if len(at) < cfg.body_points:
            return None
        uv, z = p.uv[at].astype(float), self._depth_at(p.uv[at])
        seen = p.p_body[at], p.map_cov[at], uv, p.cov[at].astype(float), z, self._camera
        T = body.fit.T_cam_body
        if body.posed:
            T = T @ np.linalg.inv(body.before) @ T
        fit = rigid_bodies.fit_pose(T, *seen)
        if fit.agrees.sum() < max(cfg.body_points, 0.5 * len(at)):
            known = np.flatnonzero(z > 0)
            p_cam = self._camera.unproject(uv[known], z[known])
            T, agrees = rigid_bodies.consensus(
                p.p_body[at[known]], p_cam, np.arange(len(known)), self._rng, 300, cfg.body_m
            )
            if agrees.sum() >= cfg.body_points:
                other = rigid_bodies.fit_pose(T, *seen)
                fit = other if other.agrees.sum() > fit.agrees.sum() else fit
        if fit.agrees.sum() < max(cfg.body_points, 0.3 * len(at)):
            return None
        return fit

    def _split(self, strays: np.ndarray) -> None:
        """Points that left their body together are another one."""
        p, cfg = self._points, self.config
        strays = strays[p.coasting[strays] == 0]
        z = self._depth_at(p.uv[strays])
        strays, z = strays[z > 0], z[z > 0]
        if len(strays) < 2 * cfg.body_points:
            return
        p_cam = self._camera.unproject(p.uv[strays], z)
        T, agrees = rigid_bodies.consensus(p.p_body[strays], p_cam, np.arange(len(strays)), self._rng, 300, cfg.body_m)
        if agrees.sum() < 2 * cfg.body_points:
            return
        own = strays[agrees]
        p.body[own], p.verified[own] = len(self._bodies), True
        fit = Fit(T, np.diag(np.repeat([0.05, 0.005], 3) ** 2), p.p_body[own].mean(0), np.ones(len(own), bool))
        self._bodies.append(Body(fit, T))

    def _embody(self, rows: np.ndarray) -> None:
        """Give new points a place on the bodies nearby, or on new ones."""
        p, cfg = self._points, self.config
        surface = rigid_bodies.surface_at(self._depth_m, self._camera, p.uv[rows])
        known = np.isfinite(surface.p_cam[:, 0])
        rows, p_cam, per_px, sigma = rows[known], surface.p_cam[known], surface.per_px[known], surface.sigma_m[known]
        if not len(rows):
            return
        label = np.full(len(rows), -1)
        posed = np.array([body.posed for body in self._bodies] + [False])
        old = np.flatnonzero(p.visible & (p.body >= 0) & posed[p.body])
        old = old[~np.isin(old, rows)]
        old_cam = np.zeros((0, 3))
        if len(old):
            T = np.stack([body.fit.T_cam_body for body in self._bodies])[p.body[old]]
            old_cam = (T[:, :3, :3] @ p.p_body[old][..., None])[..., 0] + T[:, :3, 3]
        # Whoever is linked, over others if need be, to a point of a body belongs to it; the nearest first.
        here, body_of = old_cam, p.body[old]
        while len(here) and (label < 0).any():
            free = np.flatnonzero(label < 0)
            gap = np.linalg.norm(p_cam[free][:, None] - here[None], axis=-1)
            near = gap.min(1) < cfg.body_reach_m
            if not near.any():
                break
            label[free[near]] = body_of[gap[near].argmin(1)]
            here, body_of = p_cam[free[near]], label[free[near]]
        free = np.flatnonzero(label < 0)
        chain = rigid_bodies.linked(p_cam[free], cfg.body_reach_m)
        for first in np.unique(chain):
            members = free[chain == first]
            if len(members) < 2 * cfg.body_points:
                continue
            label[members] = len(self._bodies)
            fit = Fit(np.eye(4), np.zeros((6, 6)), p_cam[members].mean(0), np.ones(0, bool))
            self._bodies.append(Body(fit, np.eye(4)))
        keep = label >= 0
        rows, p_cam, per_px, sigma, label = rows[keep], p_cam[keep], per_px[keep], sigma[keep], label[keep]
        if not len(rows):
            return
        T = np.stack([body.fit.T_cam_body for body in self._bodies])[label]
        Rt = T[:, :3, :3].transpose(0, 2, 1)
        p.body[rows] = label
        p.p_body[rows] = (Rt @ (p_cam - T[:, :3, 3])[..., None])[..., 0]
        p.tangent[rows] = Rt @ per_px @ p.warp[rows]
        noise = self._noise(p.uv[rows], p_cam[:, 2], p.cov[rows] + 0.2**2 * _EYE, sigma)
        p.map_cov[rows] = Rt @ noise @ Rt.transpose(0, 2, 1)
        normal = np.cross(per_px[..., 0], per_px[..., 1])
        p.cosine[rows] = (normal * p_cam).sum(1) / np.linalg.norm(normal, axis=1) / np.linalg.norm(p_cam, axis=1)

    def _noise(self, uv: np.ndarray, z: np.ndarray, cov_px2: np.ndarray, sigma_m: np.ndarray) -> np.ndarray:
        """(N, 3, 3) covariance of points lifted from uv (N, 2) at depth z (N,), in the camera's axes."""
        camera = self._camera
        G = np.zeros((len(uv), 3, 3))
        G[:, 0, 0], G[:, 1, 1] = z / camera.fx, z / camera.fy
        G[:, 0, 2], G[:, 1, 2], G[:, 2, 2] = (uv[:, 0] - camera.cx) / camera.fx, (uv[:, 1] - camera.cy) / camera.fy, 1
        cov = np.zeros((len(uv), 3, 3))
        cov[:, :2, :2], cov[:, 2, 2] = cov_px2, sigma_m**2
        return G @ cov @ G.transpose(0, 2, 1)

    def _predicted(self, rows: np.ndarray) -> Prediction:
        """Where these points of bodies are, by their bodies' poses."""
        p = self._points
        fits = [body.fit for body in self._bodies]
        T, cov, centre = (
            np.stack([getattr(f, n) for f in fits])[p.body[rows]] for n in ("T_cam_body", "covariance", "centre")
        )
        return rigid_bodies.predict(T, cov, centre, p.p_body[rows], p.map_cov[rows], p.tangent[rows], self._camera)

    def _exposed(self, seen: Prediction, search: np.ndarray | None) -> np.ndarray:
        """Whether predicted points face the camera, with nothing before them."""
        cfg = self.config
        gap = self._depth_at(seen.uv_px) - seen.z_m
        before = (gap < -cfg.depth_jump_m) & (gap > -seen.z_m)
        behind = gap > cfg.depth_jump_m
        return (seen.cosine > cfg.min_cosine) & ~before & ~behind & self._inside(seen.uv_px, search)

    def _look(self, search: np.ndarray | None) -> None:
        """Align the points that were not followed where their bodies say they are."""
        p, cfg = self._points, self.config
        near = np.array([body.hidden_for <= cfg.linger_frames for body in self._bodies] + [False])
        rows = np.flatnonzero(~p.verified & near[p.body] & ~self._bare())
        tried = np.zeros(len(p), bool)
        if len(rows):
            told = self._predicted(rows)
            sigma = np.sqrt(np.trace(told.cov_px2, axis1=1, axis2=2))
            pick = np.flatnonzero(self._exposed(told, search) & (sigma < cfg.search_px))
            pick = pick[np.isin(rows[pick], self._turn(rows[pick], cfg.tries))]
            at, uv, warp, sigma = rows[pick], told.uv_px[pick], told.warp[pick].astype(np.float32), sigma[pick]
            p.warp[at] = warp
            k = self._fitting(at)
            A = warp @ np.linalg.inv(p.view[at, k])
            seen, good = self._found(at, k, uv, A, sigma)
            self._settle(at[good], k[good], seen, good)
            tried[at] = True
        self._pose(lost_only=True)
        # A pose that shows points that are not there is wrong.
        for b, body in enumerate(self._bodies):
            own = p.body == b
            there, missing = (own & p.verified).sum(), (own & tried & ~p.verified).sum()
            needed = cfg.keep_share if body.kept else cfg.find_share
            body.kept = body.posed and there >= needed * (there + missing)
            if body.posed and not body.kept:
                body.hidden_for = cfg.linger_frames + 1

    def _judge(self, search: np.ndarray | None) -> None:
        """Hold points against their bodies: what is turned away or hidden is invisible, what is vague follows."""
        p, cfg = self._points, self.config
        p.visible = p.verified.copy()
        posed = np.array([body.posed for body in self._bodies] + [False])
        rows = np.flatnonzero(posed[p.body])
        if not len(rows):
            return
        told = self._predicted(rows)
        exposed = self._exposed(told, search)
        said = told.cov_px2 + 0.5**2 * _EYE
        off = p.uv[rows] - told.uv_px
        mine = p.cov[rows].astype(float)
        inverse = np.linalg.inv(mine + said)
        chi2 = ((off[:, None] @ inverse)[:, 0] * off).sum(1)
        seen = p.verified[rows] & (chi2 < 16)
        p.verified[rows] = seen
        gain = np.where(seen[:, None, None], mine @ inverse, _EYE)
        self._learn(rows[seen & exposed & (p.coasting[rows] == 0)], told)
        p.uv[rows] -= (gain @ off[..., None])[..., 0].astype(np.float32)
        p.cov[rows] = np.where(seen[:, None, None], (_EYE - gain) @ mine, told.cov_px2 + 1.0 * _EYE)
        sigma = np.sqrt(np.trace(told.cov_px2, axis1=1, axis2=2))
        p.visible[rows] = exposed & (seen | (sigma < cfg.guess_px))
        p.verified[rows] &= exposed
        guess = ~seen
        p.warp[rows[guess]] = told.warp[guess]

    def _learn(self, rows: np.ndarray, told: Prediction) -> None:
        """Improve the places of points on their bodies by where they were seen."""
        p, cfg = self._points, self.config
        z = self._depth_at(p.uv[rows])
        rows, z = rows[z > 0], z[z > 0]
        if not len(rows):
            return
        T = np.stack([body.fit.T_cam_body for body in self._bodies])[p.body[rows]]
        R = T[:, :3, :3]
        measured = self._camera.unproject(p.uv[rows], z)
        expected = (R @ p.p_body[rows][..., None])[..., 0] + T[:, :3, 3]
        # Errors of successive frames have much in common.
        noise = cfg.repeats * self._noise(
            p.uv[rows], z, p.cov[rows] + 0.3**2 * _EYE, 1.5 * rigid_bodies.depth_noise_m(z)
        )
        held = R @ p.map_cov[rows] @ R.transpose(0, 2, 1)
        gain = held @ np.linalg.inv(held + noise)
        off = measured - expected
        far = np.abs(off[:, 2]) > cfg.depth_jump_m
        gain[far] = 0
        p.p_body[rows] += (R.transpose(0, 2, 1) @ gain @ off[..., None])[..., 0]
        p.map_cov[rows] = R.transpose(0, 2, 1) @ ((np.eye(3) - gain) @ held) @ R + 1e-10 * np.eye(3)

    def _turn(self, rows: np.ndarray, count: int) -> np.ndarray:
        """At most ``count`` of these points: those that vanished last, and of the others everyone in turn."""
        if len(rows) <= count:
            return rows
        late = self._points.hidden_for[rows] > 2
        order = np.argsort(late * (1 + (self._points.ids[rows] * 7919 + self._frames * 104729) % 1000), kind="stable")
        return np.sort(rows[order[:count]])

    def _check_depth(self, depth_m: np.ndarray) -> None:
        """A point whose depth jumps has slid off its object or something has come before it."""
        p, cfg = self._points, self.config
        px = np.clip(np.rint(p.uv), 0, np.array(depth_m.shape[::-1]) - 1).astype(int)
        now = depth_m[px[:, 1], px[:, 0]]
        jumped = p.visible & (now > 0) & (p.depth_m > 0) & (np.abs(now - p.depth_m) > cfg.depth_jump_m)
        # While a point is hidden its object goes anywhere: what it comes back to is not held against it.
        p.visible[jumped] = False
        p.depth_m = np.where(p.visible & (now > 0), now, np.where(p.visible, p.depth_m, 0)).astype(np.float32)

    def _bare(self) -> np.ndarray:
        """(N,) points whose surroundings were too even to be recognised."""
        return self._points.fine.contrast[:, 0] < self.config.bare_contrast

    def _search_everywhere(self, search: np.ndarray | None, urgent: bool) -> None:
        """Look for bodies that are nowhere at corners that look like those once on them."""
        cfg = self.config
        lost = [body for body in self._bodies if body.hidden_for >= 1 and len(body.p_body)]
        if not lost or not (urgent or self._frames % cfg.redetect_every == 0):
            return
        uv, p_cam, descriptors = self._corners(search, cfg.features)
        if len(uv) <= cfg.candidates:
            return
        for body in lost:
            pick = self._rng.permutation(len(body.p_body))[: cfg.landmarks]
            pairs = [
                features.match(body.descriptors[pick, i], descriptors[:, i], uv, 4.0, cfg.ratio, cfg.candidates)
                for i in range(len(_STEPS_M))
            ]
            which, corner = (np.concatenate([getattr(m, n) for m in pairs]) for n in ("wanted", "found"))
            self._propose(body, body.p_body[pick[which]], p_cam[corner], corner)

    def _propose(self, body: Body, p_body: np.ndarray, p_cam: np.ndarray, corner: np.ndarray) -> None:
        """Let a lost body's points be looked for at the pose that matches p_body, p_cam (M, 3) agree on."""
        cfg = self.config
        T, agrees = rigid_bodies.consensus(p_body, p_cam, corner, self._rng, 1000, cfg.body_m)
        if len(np.unique(corner[agrees])) >= cfg.support:
            covariance = np.diag(np.repeat([0.05, 0.004], 3) ** 2)
            body.fit, body.hidden_for = Fit(T, covariance, body.fit.centre, np.ones(0, bool)), 1

    def _corners(self, region: np.ndarray | None, limit: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Corners in the picture where there is depth: uv (M, 2), p_cam (M, 3), descriptors (M, scales, SIZE)."""
        uv = features.detect(self._gray, region, limit)
        surface = rigid_bodies.surface_at(self._depth_m, self._camera, uv, 2)
        known = np.isfinite(surface.p_cam[:, 0])
        uv, surface = uv[known], surface.select(known)
        if not len(uv):
            return uv, surface.p_cam, np.zeros((0, len(_STEPS_M), features.SIZE), np.float32)
        steps = [rigid_bodies.tangent_steps(surface, self._camera, step) for step in _STEPS_M]
        return uv, surface.p_cam, np.stack([features.describe(self._gray, uv, step) for step in steps], 1)

    def _inside(self, uv: np.ndarray, search: np.ndarray | None) -> np.ndarray:
        """Whether places (N, 2) lie in the picture, and in the region searched."""
        h, w = self._gray.shape
        uv = np.nan_to_num(uv, nan=-1)
        inside = (uv >= 0).all(1) & (uv <= [w - 1, h - 1]).all(1)
        if search is not None:
            px = np.clip(np.rint(uv), 0, [w - 1, h - 1]).astype(int)
            inside &= search[px[:, 1], px[:, 0]]
        return inside

    def _found(self, at, k, uv, A, sigma_px) -> tuple[Alignment, np.ndarray]:
        """Align points' appearances k from about uv and A, coarse to fine; and which of them look like the point."""
        p, cfg = self._points, self.config
        rough = align(self._coarse, p.coarse[at, k], uv / 2, A, cfg.iterations)
        seen = align(self._fine, p.fine[at, k], 2 * rough.uv_px, rough.A, cfg.iterations)
        off = np.linalg.norm(seen.uv_px - uv, axis=1)
        own_px = np.sqrt(np.trace(seen.cov_px2, axis1=1, axis2=2))
        good = (seen.ncc >= cfg.return_ncc) & (off < np.minimum(cfg.search_px, 2 + 3 * np.hypot(sigma_px, own_px)))
        return seen, good & self._plausible(at, k, seen)

    def _plausible(self, at: np.ndarray, k: np.ndarray, seen: Alignment) -> np.ndarray:
        """Whether brightness, contrast, colour and foreshortening are those of the appearance, about."""
        p, cfg = self._points, self.config
        off = np.abs(self._colour(seen.uv_px) - p.colour[at, k]).max(1)
        stretch = np.abs(np.linalg.det(seen.A))
        return (
            (off < cfg.colour_change)
            & (np.abs(seen.lighter) < cfg.grey_change)
            & (np.abs(np.log(seen.stronger)) < np.log(cfg.contrast_change))
            & (np.abs(np.log(stretch)) < np.log(cfg.area_change))
        )

    def _colour(self, uv: np.ndarray) -> np.ndarray:
        """Chroma (N, 2) around places (N, 2)."""
        if not len(uv):
            return np.zeros((0, 2), np.float32)
        x, y = (np.ascontiguousarray((uv[:, i] + 0.5) / 4 - 0.5, np.float32)[:, None] for i in (0, 1))
        return cv2.remap(self._chroma, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]

    def _renew(self) -> None:
        """Remember how points look whose view has changed much since any appearance of theirs."""
        p, cfg = self._points, self.config
        at = np.flatnonzero(p.verified & p.visible & (p.coasting == 0))
        if not len(at):
            return
        k = self._fitting(at)
        A = p.warp[at] @ np.linalg.inv(p.view[at, k])
        stretch = np.linalg.svd(A, compute_uv=False)
        far = (stretch.max(1) > cfg.renew_stretch) | (stretch.min(1) < 1 / cfg.renew_stretch)
        far |= p.ncc[at] < cfg.renew_ncc
        far &= p.sigma_px[at] < cfg.return_sigma_px
        self._remember(self._turn(at[far], cfg.tries))

    def _remember(self, rows: np.ndarray) -> None:
        """Store the present looks of these points as one more appearance; a full set gives up its last but first."""
        p = self._points
        if not len(rows):
            return
        slots = p.view.shape[1]
        k = np.where(p.count[rows] < slots, p.count[rows], 1 + (self._frames // self.config.renew_every) % (slots - 1))
        uv = p.uv[rows]
        p.view[rows, k], p.view_cov[rows, k] = p.warp[rows], p.cov[rows]
        p.fine[rows, k], p.coarse[rows, k] = take(self._fine, uv), take(self._coarse, uv / 2)
        p.colour[rows, k] = self._colour(uv)
        p.count[rows] = np.minimum(p.count[rows] + 1, slots)

    def _survey(self) -> None:
        """Remember the corners on bodies that show a new side."""
        p, cfg = self._points, self.config
        for b, body in enumerate(self._bodies):
            rows = np.flatnonzero(p.visible & (p.body == b))
            if not body.posed or len(rows) < 2 * cfg.body_points:
                continue
            eye = body.eye
            if len(body.views):
                length, views = np.linalg.norm(eye), np.linalg.norm(body.views, axis=1)
                apart = np.degrees(np.arccos(np.clip(body.views @ eye / (views * length), -1, 1)))
                if ((apart < cfg.survey_deg) & (np.abs(np.log(views / length)) < np.log(1.4))).any():
                    continue
            body.views = np.vstack([body.views, eye])
            self._add_landmarks(body, rows)

    def _add_landmarks(self, body: Body, rows: np.ndarray) -> None:
        p, reach = self._points, self.config.anchor_px
        region = np.zeros(self._gray.shape, np.uint8)
        px = np.clip(np.rint(p.uv[rows]).astype(int), 0, np.array(region.shape[::-1]) - 1)
        region[px[:, 1], px[:, 0]] = 1
        region = cv2.dilate(region, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)) > 0
        _, p_cam, descriptors = self._corners(region, self.config.features)
        T = body.fit.T_cam_body
        p_body = (p_cam - T[:3, 3]) @ T[:3, :3]
        gap = np.linalg.norm(p_body[:, None] - p.p_body[rows][None], axis=-1).min(1)
        near = gap < self.config.body_reach_m
        descriptors = np.concatenate([body.descriptors, descriptors[near]])
        p_body = np.concatenate([body.p_body, p_body[near]])
        keep = np.sort(self._rng.permutation(len(p_body))[: self.config.max_landmarks])
        body.descriptors, body.p_body = descriptors[keep], p_body[keep]
