"""An object cut out by what somebody says of it: clicks on it and beside it, or a box around it.

It starts an object, or corrects what was made of it so far.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import bounds
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt, points_in_box
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, cut
from p2p_lib.segmenters.builtin.patch import Box, Patch, around, connected, dilated, support_plane

#: Room around an object, besides a share of its size: small ones move by pixels too.
ROOM_PX = 6
#: Length of a step between like pixels, where one across the strongest edge has length 1.
_LIKE = 0.02
#: Log odds of what lies nearer to a click beside the object than to one on it: more than all other evidence.
_NOT_IT = 6.0


@dataclass(frozen=True, eq=False)
class Cutter:
    """Cuts an object out of a frame.

    others_px  (K, 2) clicks on other objects in this frame
    """

    frame: Frame
    camera: Camera
    config: SegmentationConfig
    rng: np.random.Generator
    prompt: Prompt
    others_px: np.ndarray

    def start(self) -> tuple[Box, np.ndarray]:
        """From clicks or a box: in a wide box at low resolution, then in one that fits."""
        cfg, frame, around_px = self.config, self.frame, self.prompt.box_px
        clicks = self.prompt.points_px if len(self.prompt.points_px) else points_in_box(around_px, frame)
        if around_px is None:
            reach_px = cfg.reach_m * np.array([self.camera.fx, self.camera.fy]) / np.median(depths_at(clicks, frame))
            box = around(clicks.mean(0), np.maximum(reach_px, 2 * np.ptp(clicks, 0)), frame.shape)
        else:
            box = self._room(around_px[:2], around_px[2:])
        patch = Patch.of(frame, box, self.camera, cfg)
        plane = support_plane(patch, patch.depth_m > 0, self.rng)
        seeds = patch.dots(clicks, 1)
        outside = ~dilated(seeds, min(seeds.shape) // 6) if around_px is None else ~_within(patch, around_px)
        x = self._cut_out(patch, plane, clicks, dilated(seeds, 2), outside)
        whole = np.zeros(frame.shape, np.float32)
        whole[box.slices] = patch.up(x)
        patch = Patch.of(frame, self._fitting(patch, x > 0.5), self.camera, cfg)
        was = patch.down(whole)
        x = self._cut_out(patch, plane, clicks, was > 0.5, was < 0.5, was)
        return patch.box, patch.up(x)

    def correct(self, was: np.ndarray, hint: Hint) -> tuple[Box, np.ndarray]:
        """From what was made of it, probabilities (H, W), and clicks that say where this is wrong."""
        cfg, prompt = self.config, self.prompt
        rows, columns = bounds(was > 0.5)
        spots = np.array([[columns.start, rows.start], [columns.stop, rows.stop], *prompt.points_px])
        patch = Patch.of(self.frame, self._room(spots.min(0), spots.max(0)), self.camera, cfg)
        before = patch.down(was)
        on = np.concatenate([prompt.points_px, hint.uv_px])
        seeds = patch.dots(on, 1)
        if not len(on):  # what lies far from the clicks beside it is right
            v, u = np.nonzero(before > 0.5)
            apart = np.stack([u, v], -1)[:, None] - patch.grid(prompt.negative_px)
            away = np.linalg.norm(apart, axis=-1).min(1, initial=np.inf)
            far = away >= np.median(away)
            seeds[v[far], u[far]] = True
        plane = support_plane(patch, (patch.depth_m > 0) & (before < 0.2), self.rng)
        by_depth, _ = by_geometry(patch, seeds, plane, cfg)
        colour = by_colour(patch, histogram(patch.codes[seeds]), (before < 0.2) & ~seeds, cfg)
        log_odds = by_depth + colour + cfg.prior_weight * (2 * before - 1)
        return patch.box, patch.up(self._settled(patch, log_odds, seeds, before))

    def _cut_out(
        self,
        patch: Patch,
        plane: np.ndarray | None,
        clicks: np.ndarray,
        inside: np.ndarray,
        outside: np.ndarray,
        start: np.ndarray | None = None,
    ) -> np.ndarray:
        """(h, w) probability of what is connected with the clicks; colours are those ``inside`` and ``outside``."""
        seeds = patch.dots(clicks, 1)
        by_depth, _ = by_geometry(patch, seeds, plane, self.config)
        colour = by_colour(patch, histogram(patch.codes[inside]), outside, self.config)
        return self._settled(patch, by_depth + colour, seeds, start)

    def _settled(self, patch: Patch, log_odds: np.ndarray, seeds: np.ndarray, start: np.ndarray | None) -> np.ndarray:
        """(h, w) probability by the evidence, of what is connected with the seeds; clicks count as certain."""
        beside = patch.dots(self.prompt.negative_px, 1) & ~seeds
        if beside.any():
            log_odds = log_odds - _NOT_IT * patch.nearer(beside, seeds, _LIKE)
        barred = beside | patch.dots(self.others_px, 1) | patch.border()
        if self.prompt.box_px is not None:
            barred |= ~_within(patch, self.prompt.box_px)
        return only(cut(patch, log_odds, start=start, seeds=seeds, background=barred & ~seeds), seeds)

    def _fitting(self, patch: Patch, inside: np.ndarray) -> Box:
        """A box with room around what is ``inside`` a patch."""
        rows, columns = bounds(inside)
        scale = np.array(patch.box.shape[::-1]) / patch.shape[::-1]
        corner = np.array([patch.box.left, patch.box.top])
        low, high = np.array([columns.start, rows.start]) * scale, np.array([columns.stop, rows.stop]) * scale
        return self._room(low + corner, high + corner)

    def _room(self, low: np.ndarray, high: np.ndarray) -> Box:
        """A box with room around the pixels from ``low`` to ``high`` (x, y)."""
        half = (high - low) / 2 * (1 + 2 * self.config.margin) + ROOM_PX
        return around((low + high) / 2, half, self.frame.shape)


def only(x: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The probabilities without the islands that hold no seed."""
    return np.where(connected(x > 0.5, seeds) | (x <= 0.5), x, 0)


def _within(patch: Patch, box_px: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of a patch inside a box (4,) of the image."""
    (h, w), (rows, columns) = patch.shape, patch.box.shape
    u = (np.arange(w) + 0.5) * (columns / w) - 0.5 + patch.box.left
    v = (np.arange(h) + 0.5) * (rows / h) - 0.5 + patch.box.top
    left, top, right, bottom = box_px
    return ((v >= top) & (v <= bottom))[:, None] & ((u >= left) & (u <= right))
