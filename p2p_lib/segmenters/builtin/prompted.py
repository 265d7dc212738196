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
    unlike,
)

#: Room around an object on top of ``config.margin``, which is too little for small ones, px.
ROOM_PX = 6
#: About so many pixels of a mask's middle count as clicks on the object when it is corrected.
_MIDDLE = 40
NO_PX = np.zeros((0, 2))
#: A box may be drawn too tight by this share of its size.
_TIGHT = 0.05
#: Length of a step between pixels that are alike, relative to about 1 across the strongest edge.
_LIKE = 0.1
#: Log-odds against pixels nearer to a click beside the object than to one on it: more than geometry's.
_NOT_IT = 3.0
#: Depth edges may be this many image pixels beside the outline that colour shows.
_TOLERANCE_PX = 3.0
#: Cuts in the wide box and in the tight one; weight, in the background's colours, of a cell at a click beside it.
_ROUNDS, _ROUNDS_MORE, _OTHERS = 3, 2, 30.0
#: Clicks may be close together on something large, or at the ends of something thin: the scales tried, as the object's
#: extent over theirs. A cut's doubt is divided by the scale's value: the print inside an object has edges, too.
_SCALES = {0.4: 0.5, 1.0: 1.0, 2.5: 0.7}
#: A click on something else claims the cells of the grid within this radius.
_AROUND_PX = 3


@dataclass(frozen=True, eq=False)
class Cut:
    """An object cut out in a box, its probability x (rows, columns).

    doubtful  mean tie across its outline, low along edges, plus the share of clicks on something else that it holds;
              larger for scales other than 1
    """

    doubtful: float
    box: Box
    x: np.ndarray

    def whole(self, shape: tuple[int, int]) -> np.ndarray:
        """(H, W) bool: the mask in the whole image."""
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
        """From clicks or a box: of the cuts at several scales the least doubtful one."""
        best = self.cuts[0]
        return best.box, best.x

    @cached_property
    def cuts(self) -> list[Cut]:
        """From clicks or a box, at several scales, the least doubtful first."""
        cfg, frame, around_px = self.config, self.frame, self.prompt.box_px
        clicks = self.prompt.points_px
        if not len(clicks) and around_px is not None:
            clicks = points_in_box(around_px, frame)
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
        """Cut on a wide, coarse patch, then on one that fits, an object ``scale`` times as far across as the clicks."""
        cfg = self.config
        clicked = Clicked.of(patch, clicks_px, z_m, scale)
        height = Height.of(patch, clicked)
        looks = unlike(patch, height.plane)
        connected = by_connection(patch, clicked, height, looks) + self._nearer_to_others(patch, clicked)
        clicked = clicked.within(looks) if height.flat else clicked
        prior = clicked.prior_beside(connected)
        x = self._cut_out(patch, clicked, prior, by_distance(patch, z_m, cfg) + height.log_odds + connected)
        whole, there, other = np.zeros((3, *self.frame.shape), np.float32)
        for image, values in ((whole, x), (there, connected), (other, looks)):
            image[patch.box.slices] = patch.up(values)
        fits = self._room(*patch.ends_px(x > 0.5))
        patch = Patch.of(self.frame, fits, self.camera, replace(cfg, side_px=2 * cfg.side_px))
        connected = patch.down(there)
        clicked = Clicked.of(patch, clicks_px, z_m, scale)
        height = height.on(patch, clicked)
        clicked = clicked.within(patch.down(other) > 0.5) if height.flat else clicked
        geometry = by_distance(patch, z_m, cfg) + height.log_odds + connected
        x = self._cut_out(patch, clicked, clicked.prior_beside(connected) / 2, geometry, patch.down(whole))
        mask, others = x > 0.5, patch.dots(self._others_px, _AROUND_PX)
        inside = mask[others].mean() if others.any() else 0.0
        return Cut(float(patch.outline_tie(mask) + inside) / _SCALES[scale], patch.box, patch.up(x))

    def correct(self, was: np.ndarray, known_px: np.ndarray) -> tuple[Box, np.ndarray]:
        """Cut anew, from the clicks that correct a mask (H, W) bool, and from what is right about the mask.

        known_px  (K, 2) pixels that are probably on the object, as is the mask's middle. Of both are used those nearer
                  to a positive click than to a negative one; with negative clicks alone, the third that is
                  farthest from them
        """
        inner = cv2.distanceTransform(np.pad(was, 1).astype(np.uint8), cv2.DIST_L2, 3)[1:-1, 1:-1]
        v, u = np.nonzero(inner >= inner.max() / 2)
        right_px = np.concatenate([known_px, np.stack([u, v], -1)[:: max(1, len(u) // _MIDDLE)]])
        positive, negative = (
            np.linalg.norm(right_px[:, None] - at, axis=-1).min(1, initial=np.inf)
            for at in (self.prompt.points_px, self.prompt.negative_px)
        )
        right_px = right_px[negative >= (positive if np.isfinite(positive).all() else np.quantile(negative, 2 / 3))]
        points_px = np.concatenate([self.prompt.points_px, right_px])
        return replace(self, prompt=replace(self.prompt, points_px=points_px)).start()

    def _cut_out(
        self, patch: Patch, clicked: Clicked, prior: np.ndarray, geometry: np.ndarray, x: np.ndarray | None = None
    ) -> np.ndarray:
        """(h, w) probability of what is connected with the clicks, which count as certain.

        Each cut gives the next one the colours of object and background; the first takes them from around the clicks
        and from farther away, or from ``x`` (h, w), a cut on another patch.
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
        assert x is not None  # there are rounds
        return x

    @property
    def _others_px(self) -> np.ndarray:
        """(K, 2) clicks that are not on the object: negative ones, and those on other objects."""
        return np.concatenate([self.prompt.negative_px, self.others_px])

    def _nearer_to_others(self, patch: Patch, clicked: Clicked) -> np.ndarray:
        """(h, w) log-odds against pixels nearer to a click that is not on the object than to one on it."""
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
