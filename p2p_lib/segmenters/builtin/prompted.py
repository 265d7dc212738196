"""An object cut out by a prompt: clicks on it and beside it, or a box around it.

A prompt starts an object, or corrects its mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.prompts import Prompt, points_in_box
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.cut import cut
from p2p_lib.segmenters.builtin.depth_offset import depth_offset_px, with_depth_moved
from p2p_lib.segmenters.builtin.patch import (
    Box,
    Patch,
    around,
    keep_seeded_components,
)
from p2p_lib.segmenters.builtin.start_evidence import (
    Clicked,
    Height,
    by_connection,
    by_distance,
    by_shares,
    filled,
    tolerant,
)

#: Room around an object, besides a share of its size: small ones move by pixels too.
ROOM_PX = 6
#: About so many pixels of a mask stand for what is right about it.
_MIDDLE = 40
NO_PX = np.zeros((0, 2))
#: A box is drawn a little too tight now and then, by this share of its size.
_TIGHT = 0.05
#: Length of a step between like pixels, where one across the strongest edge has length 1.
_LIKE = 0.1
#: Log odds of what lies nearer to a click beside the object than to one on it: more than geometry says.
_NOT_IT = 3.0
#: Depth may end this many pixels beside the outline that colour shows.
_TOLERANCE_PX = 3.0
#: Cuts in the wide box and in the one that fits; a click beside the object counts as this many pixels of background.
_ROUNDS, _ROUNDS_MORE, _OTHERS = 3, 2, 30.0
#: Clicks may be close together on something large, or at both ends of something thin: it may be so many times as far
#: across as they are. Then less of its outline is beside edges, by this factor: print inside an object is sharp, too.
_SCALES = {0.4: 0.5, 1.0: 1.0, 2.5: 0.7}
#: So many pixels of the grid around a click on something else belong to that.
_AROUND_PX = 3


@dataclass(frozen=True, eq=False)
class Cut:
    """An object cut out in a box, its probability x (rows, columns).

    doubtful  how little of its outline is along edges, and how much of what is clicked as something else is inside;
              more for another scale than that of the clicks
    """

    doubtful: float
    box: Box
    x: np.ndarray

    def whole(self, shape: tuple[int, int]) -> np.ndarray:
        """(H, W) bool: in the whole image."""
        mask = np.zeros(shape, bool)
        mask[self.box.slices] = self.x > 0.5
        return mask


@dataclass(frozen=True, eq=False)
class Cutter:
    """Cuts an object out of a frame.

    others_px  (K, 2) clicks on other objects in this frame
    """

    frame: Frame
    camera: Camera
    config: SegmentationConfig
    prompt: Prompt
    others_px: np.ndarray

    def start(self) -> tuple[Box, np.ndarray]:
        """From clicks or a box: of cuts at several scales the one whose outline is along edges the most."""
        best = self.cuts[0]
        return best.box, best.x

    @cached_property
    def cuts(self) -> list[Cut]:
        """From clicks or a box, at several scales, the best first."""
        cfg, frame, around_px = self.config, self.frame, self.prompt.box_px
        clicks = self.prompt.points_px if len(self.prompt.points_px) else points_in_box(around_px, frame)
        z_m = float(np.nanmedian(depths_at(clicks, frame)))
        if around_px is None:
            reach_px = cfg.reach_m * np.array([self.camera.fx, self.camera.fy]) / z_m
            box = around(clicks.mean(0), np.maximum(reach_px, 2 * np.ptp(clicks, 0)), frame.shape)
        else:
            box = self._room(around_px[:2], around_px[2:])
        moved = replace(self, frame=with_depth_moved(frame, depth_offset_px(frame, box)))
        patch = Patch.of(moved.frame, box, self.camera, cfg)
        found = [moved._cut_at(scale, patch, clicks, z_m) for scale in _SCALES]
        return sorted(found, key=lambda cut: cut.doubtful)

    def _cut_at(self, scale: float, patch: Patch, clicks_px: np.ndarray, z_m: float) -> Cut:
        """On a wide patch at low resolution, then on one that fits; ``scale`` times as far across as the clicks."""
        cfg = self.config
        clicked = Clicked.of(patch, clicks_px, z_m, scale)
        height = Height.of(patch, clicked)
        connected = by_connection(patch, clicked, height) + self._nearer_to_others(patch, clicked)
        prior = clicked.prior_beside(connected)
        x = self._cut_out(patch, clicked, prior, by_distance(patch, z_m, cfg) + height.log_odds + connected)
        whole, there = np.zeros((2, *self.frame.shape), np.float32)
        whole[patch.box.slices], there[patch.box.slices] = patch.up(x), patch.up(connected)
        fits = self._room(*patch.ends_px(x > 0.5))
        patch = Patch.of(self.frame, fits, self.camera, replace(cfg, side_px=2 * cfg.side_px))
        clicked = Clicked.of(patch, clicks_px, z_m, scale)
        height = height.on(patch, clicked)
        connected = patch.down(there)
        geometry = by_distance(patch, z_m, cfg) + height.log_odds + connected
        x = self._cut_out(patch, clicked, clicked.prior_beside(connected) / 2, geometry, patch.down(whole))
        mask, others = x > 0.5, patch.dots(self._others_px, _AROUND_PX)
        inside = mask[others].mean() if others.any() else 0.0
        return Cut(float(patch.outline_tie(mask) + inside) / _SCALES[scale], patch.box, patch.up(x))

    def correct(self, was: np.ndarray, known_px: np.ndarray) -> tuple[Box, np.ndarray]:
        """Anew, from clicks that say what is wrong with a mask (H, W) bool, and from what is right about it.

        known_px  (K, 2) pixels that are thought to be on the object, as is the middle of the mask: those are that lie
                  nearer to a click on it than to one beside it; with clicks beside it alone, the third that
                  is farthest from them
        """
        inner = cv2.distanceTransform(np.pad(was, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = np.nonzero(inner >= inner.max() / 2)
        right_px = np.concatenate([known_px, np.stack([u, v], -1)[:: max(1, len(u) // _MIDDLE)]])
        on, beside = (
            np.linalg.norm(right_px[:, None] - at, axis=-1).min(1, initial=np.inf)
            for at in (self.prompt.points_px, self.prompt.negative_px)
        )
        right_px = right_px[beside >= (on if np.isfinite(on).all() else np.quantile(beside, 2 / 3))]
        points_px = np.concatenate([self.prompt.points_px, right_px])
        return replace(self, prompt=replace(self.prompt, points_px=points_px)).start()

    def _cut_out(
        self, patch: Patch, clicked: Clicked, prior: np.ndarray, geometry: np.ndarray, x: np.ndarray | None = None
    ) -> np.ndarray:
        """(h, w) probability of what is connected with the clicks, which count as certain.

        The colours of object and background are learnt from each cut for the next one; before the first, from
        what lies around the clicks and what lies beyond. ``x`` (h, w) is a cut on another patch.
        """
        seeds, cfg = clicked.seeds, self.config
        others = patch.dots(self._others_px, 1) & ~seeds
        fixed = prior + tolerant(filled(geometry, patch.depth_m > 0), _TOLERANCE_PX / patch.cell_px)
        barred = others | patch.border()
        if self.prompt.box_px is not None:
            barred |= ~_within(patch, self.prompt.box_px)
        own, other = (clicked.near, clicked.beyond + _OTHERS * others) if x is None else (x, 1 - x)
        for _ in range(_ROUNDS if x is None else _ROUNDS_MORE):
            log_odds = fixed + by_shares(patch, own, other, cfg)
            x = cut(patch, log_odds, start=x, seeds=seeds, background=barred & ~seeds, sharp=True)
            x = keep_seeded_components(x, seeds)
            own, other = np.maximum(2 * x - 1, 0) + clicked.hull / 2, np.maximum(1 - 2 * x, 0)
        return x

    @property
    def _others_px(self) -> np.ndarray:
        """(K, 2) clicks that are not on the object: beside it, and on others."""
        return np.concatenate([self.prompt.negative_px, self.others_px])

    def _nearer_to_others(self, patch: Patch, clicked: Clicked) -> np.ndarray:
        """(h, w) log-odds of what lies nearer to a click that is not on the object than to one on it."""
        others = patch.dots(self._others_px, 0) & ~clicked.seeds
        if not others.any():
            return np.zeros(patch.shape, np.float32)
        return np.where(patch.nearer(others, clicked.seeds, _LIKE), np.float32(-_NOT_IT), 0)

    def _room(self, low: np.ndarray, high: np.ndarray) -> Box:
        """A box with room around the pixels from ``low`` to ``high`` (x, y)."""
        half = (high - low) / 2 * (1 + 2 * self.config.margin) + ROOM_PX
        return around((low + high) / 2, half, self.frame.shape)


def _within(patch: Patch, box_px: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of a patch inside a box (4,) of the image."""
    u, v = patch.centres_px()
    slack = _TIGHT * np.ptp(box_px.reshape(2, 2), 0)
    left, top, right, bottom = box_px + np.concatenate([-slack, slack])
    return ((v >= top) & (v <= bottom))[:, None] & ((u >= left) & (u <= right))
