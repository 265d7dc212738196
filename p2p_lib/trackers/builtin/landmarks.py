"""Corners that were seen on a body, and the search for it by them anywhere in the picture."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np

from p2p_lib.core.config import TrackingConfig
from p2p_lib.core.image import nearest_px
from p2p_lib.trackers.builtin import features
from p2p_lib.trackers.builtin.image import Picture
from p2p_lib.trackers.builtin.tangent_planes import surface_at, tangent_steps

#: Steps of the grids on the surface on which corners are described.
STEPS_M = (0.0015, 0.003)
#: Corners within this many pixels are one.
_SAME_PX = 4.0
#: A view from this many times nearer or farther shows other corners.
_ZOOM = 1.4


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of a picture where there is depth: uv_px (M, 2), p_cam (M, 3), descriptors (M, SIZE) by scale."""

    uv_px: np.ndarray
    p_cam: np.ndarray
    descriptors: dict[int, np.ndarray]

    def select(self, rows: np.ndarray) -> Corners:
        """The corners at these rows or under this mask."""
        return Corners(self.uv_px[rows], self.p_cam[rows], {k: d[rows] for k, d in self.descriptors.items()})


def corners(now: Picture, region: np.ndarray | None, limit: int, scales: Iterable[int]) -> Corners:
    """The strongest corners, inside ``region`` (H, W) if given, described at these of :data:`STEPS_M`."""
    uv = features.detect(now.gray, region, limit)
    surface = surface_at(now.depth_m, now.camera, uv, 2)
    known = np.isfinite(surface.p_cam[:, 0])
    uv, surface = uv[known], surface.select(known)
    steps = {scale: tangent_steps(surface, now.camera, STEPS_M[scale]) for scale in scales}
    return Corners(uv, surface.p_cam, {k: features.describe(now.gray, uv, step) for k, step in steps.items()})


@dataclass(eq=False)
class Landmarks:
    """Corners of a body: p_body (L, 3), descriptors (L, scales, SIZE); and from where, views (V, 3), body's frame."""

    p_body: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    descriptors: np.ndarray = field(default_factory=lambda: np.zeros((0, len(STEPS_M), features.SIZE), np.float32))
    views: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))

    def known_from(self, eye: np.ndarray, survey_deg: float) -> bool:
        """Whether corners were taken from about there; eye (3,) is the camera, from the body's centre."""
        length, views = np.linalg.norm(eye), np.linalg.norm(self.views, axis=1)
        apart = np.degrees(np.arccos(np.clip(self.views @ eye / (views * length), -1, 1)))
        return bool(((apart < survey_deg) & (np.abs(np.log(views / length)) < np.log(_ZOOM))).any())

    def take(
        self,
        now: Picture,
        T_cam_body: np.ndarray,
        eye: np.ndarray,
        points: tuple[np.ndarray, np.ndarray],
        cfg: TrackingConfig,
        rng: np.random.Generator,
    ) -> None:
        """Add the corners near points of the body, uv_px (N, 2) and p_body (N, 3), seen from ``eye`` now."""
        uv, p_body = points
        region, reach = np.zeros(now.gray.shape, np.uint8), 2 * cfg.anchor_px + 1
        u, v = nearest_px(uv, region.shape)
        region[v, u] = 1
        region = cv2.dilate(region, np.ones((reach, reach), np.uint8)) > 0
        found = corners(now, region, cfg.features, range(len(STEPS_M)))
        at = (found.p_cam - T_cam_body[:3, 3]) @ T_cam_body[:3, :3]
        near = np.linalg.norm(at[:, None] - p_body[None], axis=-1).min(1) < cfg.body_reach_m
        self.views = np.vstack([self.views, eye])
        self._add(at[near], np.stack([found.descriptors[k] for k in sorted(found.descriptors)], 1)[near], cfg, rng)

    def absorb(self, other: Landmarks, T_mine_other: np.ndarray, cfg: TrackingConfig, rng: np.random.Generator) -> None:
        """Take over the landmarks of a body that turned out to be this one."""
        p_body = other.p_body @ T_mine_other[:3, :3].T + T_mine_other[:3, 3]
        self._add(p_body, other.descriptors, cfg, rng)

    def _add(self, p_body: np.ndarray, descriptors: np.ndarray, cfg: TrackingConfig, rng: np.random.Generator) -> None:
        p_body = np.concatenate([self.p_body, p_body])
        keep = np.sort(rng.permutation(len(p_body))[: cfg.max_landmarks])
        self.p_body, self.descriptors = p_body[keep], np.concatenate([self.descriptors, descriptors])[keep]

    def matches(
        self, found: Corners, cfg: TrackingConfig, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pairs of some of the landmarks with corners: p_body (M, 3), p_cam (M, 3), and which corner (M,)."""
        pick = rng.permutation(len(self.p_body))[: cfg.landmarks]
        pairs = [
            features.match(self.descriptors[pick, k], there, found.uv_px, _SAME_PX, cfg.ratio, cfg.candidates)
            for k, there in found.descriptors.items()
        ]
        which, corner = (np.concatenate([getattr(m, n) for m in pairs]) for n in ("wanted", "found"))
        return self.p_body[pick[which]], found.p_cam[corner], corner
