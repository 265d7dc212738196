"""An object cut out by what somebody says of it: clicks on it and beside it, or a box around it.

It starts an object, or corrects what was made of it so far.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import bounds
from p2p_lib.core.prompts import Prompt, points_in_box
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, cut
from p2p_lib.segmenters.builtin.patch import Box, Patch, around, connected, dilated, support_plane

#: Room around an object, besides a share of its size: small ones move by pixels too.
ROOM_PX = 6
#: About so many pixels of a mask stand for what is right about it.
_MIDDLE = 40
#: A box is drawn a little too tight now and then, by this share of its size.
_TIGHT = 0.05
#: Length of a step between like pixels, where one across the strongest edge has length 1.
_LIKE = 0.1
#: Log odds of what lies nearer to a click beside the object than to one on it: more than geometry says.
_NOT_IT = 3.0


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
            reach_px = cfg.reach_m * np.array([self.camera.fx, self.camera.fy]) / np.nanmedian(depths_at(clicks, frame))
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

    def correct(self, was: np.ndarray, known_px: np.ndarray) -> tuple[Box, np.ndarray]:
        """Anew, from clicks that say what is wrong with a mask (H, W) bool, and from what is right about it.

        known_px  (K, 2) pixels that are known to be on the object; what lies in the middle of the mask counts as well,
                  where it is far from clicks beside the object
        """
        inner = cv2.distanceTransform(np.pad(was, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = np.nonzero(inner >= inner.max() / 2)
        middle_px = np.stack([u, v], -1)[:: max(1, len(u) // _MIDDLE)]
        away_px = np.linalg.norm(middle_px[:, None] - self.prompt.negative_px, axis=-1).min(1, initial=np.inf)
        middle_px = middle_px[away_px >= np.median(away_px)]
        points_px = np.concatenate([self.prompt.points_px, known_px, middle_px])
        return replace(self, prompt=replace(self.prompt, points_px=points_px)).start()

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
        beside = patch.dots(self.prompt.negative_px, 0) & ~seeds
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
    slack = _TIGHT * np.ptp(box_px.reshape(2, 2), 0)
    left, top, right, bottom = box_px + np.concatenate([-slack, slack])
    return ((v >= top) & (v <= bottom))[:, None] & ((u >= left) & (u <= right))
