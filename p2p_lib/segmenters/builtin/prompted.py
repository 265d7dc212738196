"""An object cut out by a prompt: clicks on it and beside it, or a box around it.

A prompt starts an object, or corrects its mask.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import ends_px, nearest_px, small_parts
from p2p_lib.core.prompts import Prompt, points_in_box
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.cut import cut
from p2p_lib.segmenters.builtin.depth_offset import depth_offset_px, with_depth_moved
from p2p_lib.segmenters.builtin.patch import (
    Box,
    Patch,
    around,
    components_touching,
    connected_components,
    keep_seeded_components,
)
from p2p_lib.segmenters.builtin.start_evidence import (
    Clicked,
    Height,
    by_connection,
    by_distance,
    by_shares,
    filled,
    hiding,
    tolerant,
    unlike,
)

#: Room around an object on top of ``config.margin``, which is too little for small ones, px.
ROOM_PX = 6
#: Log-odds of a mask that is corrected, where no click makes it doubtful.
_KEPT = 4.0
#: Weight of what depth connects with a click on something that the mask lacks: less than where clicks are all there is.
_REACHED = 0.5
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
#: A box may be filled by a mask's own box up to this intersection over union without doubt, which then grows so fast.
_FILLED, _PER_UNFILLED = 0.7, 2.0
#: Clicks may be close together on something large, or at the ends of something thin: the scales tried, as the object's
#: extent over theirs. A cut's doubt is divided by the scale's value: the print inside an object has edges, too.
_SCALES = {0.4: 0.5, 1.0: 1.0, 2.5: 0.7}
#: Depth is looked for this far from a click that has none, px; what differs by less is one surface, m.
_HOLE_PX, _ONE_SURFACE_M = 3, 0.02
#: A part of a corrected mask that is less than this share of it is a speck.
_SPECK = 0.02
#: A click on something else claims the cells of the grid within this radius.
_AROUND_PX = 3


class Effect(StrEnum):
    """What a prompt does to its object's mask: mends it, or begins one, perhaps far from another."""

    MENDED = "mended"
    BEGUN = "begun"
    BEGUN_ELSEWHERE = "begun elsewhere"


@dataclass(frozen=True, eq=False)
class Cut:
    """An object cut out in a box, its probability x (rows, columns).

    doubtful  mean tie across its outline, low along edges, plus the share of clicks on something else that it holds,
              plus what it leaves of a box that was drawn around it; larger for scales other than 1
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
        clicks = _measured(self.prompt.points_px, frame)
        if around_px is not None and not np.isfinite(depths_at(clicks, frame)).any():
            clicks = np.concatenate([clicks, points_in_box(around_px, frame)])
        z_m = float(np.nanmedian(depths_at(clicks, frame)))
        if around_px is None:
            reach_px = cfg.reach_m * np.array([self.camera.fx, self.camera.fy]) / z_m
            box = around(clicks.mean(0), np.maximum(reach_px, 2 * np.ptp(clicks, 0)), frame.shape)
        else:
            box = self._room(around_px[:2], around_px[2:])
        moved = replace(self, frame=with_depth_moved(frame, depth_offset_px(frame, box)))
        patch = Patch.of(moved.frame, box, self.camera, cfg)
        hides = moved._hiding(clicks, z_m)
        found = [moved._cut_at(scale, patch, clicks, z_m, hides) for scale in _SCALES]
        return sorted(found, key=lambda cut: cut.doubtful)

    def _hiding(self, clicks_px: np.ndarray, z_m: float) -> np.ndarray:
        """(H, W) float32: 1 where something is before the object, between the clicks."""
        low, high = clicks_px.min(0), clicks_px.max(0)
        fine = replace(self.config, side_px=2 * self.config.side_px)
        patch = Patch.of(self.frame, self._room(2 * low - high, 2 * high - low), self.camera, fine)
        image = np.zeros(self.frame.shape, np.float32)
        image[patch.box.slices] = patch.up(hiding(patch, Clicked.of(patch, clicks_px, z_m)).astype(np.float32))
        return image

    def _cut_at(self, scale: float, patch: Patch, clicks_px: np.ndarray, z_m: float, hides: np.ndarray) -> Cut:
        """Cut on a wide, coarse patch, then on one that fits, an object ``scale`` times as far across as the clicks.

        hides  (H, W) what is known to be before it
        """
        cfg = self.config
        in_box = self.prompt.box_px is not None

        def clicked_on(patch: Patch) -> Clicked:
            return Clicked.of(patch, clicks_px, z_m, scale, not in_box).hidden_by(patch.down(hides) > 0.5)

        clicked = clicked_on(patch)
        near = by_distance(patch, z_m, cfg)
        height = Height.of(patch, clicked, near >= 0)
        looks = unlike(patch, height.plane)
        connected = by_connection(patch, clicked, height, looks, in_box)
        connected += self._nearer_to_others(patch, clicked)
        clicked = clicked.within(looks) if height.flat else clicked
        prior, geometry = clicked.prior_beside(connected), near + height.log_odds + connected
        # What depth keeps apart from the clicks lends the object no colour, however near it is, but the background.
        own, other = clicked.near * (connected >= 0), np.maximum(clicked.beyond, connected < 0)
        x = self._cut_out(patch, clicked, prior + self._tolerated(patch, geometry), own, other)
        whole, there, odd = np.zeros((3, *self.frame.shape), np.float32)
        for image, values in ((whole, x), (there, connected), (odd, looks)):
            image[patch.box.slices] = patch.up(values)
        fits = self._room(*patch.ends_px(x > 0.5))
        patch = Patch.of(self.frame, fits, self.camera, replace(cfg, side_px=2 * cfg.side_px))
        connected = patch.down(there)
        clicked = clicked_on(patch)
        height = height.on(patch, clicked)
        clicked = clicked.within(patch.down(odd) > 0.5) if height.flat else clicked
        geometry = by_distance(patch, z_m, cfg) + height.log_odds + connected
        fixed, was = clicked.prior_beside(connected) / 2 + self._tolerated(patch, geometry), patch.down(whole)
        x = self._cut_out(patch, clicked, fixed, was, 1 - was, was)
        mask, others = x > 0.5, patch.dots(self._others_px, _AROUND_PX)
        inside = mask[others].mean() if others.any() else 0.0
        doubtful = patch.outline_tie(mask) + inside + self._unfilled(patch, mask)
        return Cut(float(doubtful) / _SCALES[scale], patch.box, patch.up(x))

    def _tolerated(self, patch: Patch, geometry: np.ndarray) -> np.ndarray:
        """Log-odds (h, w) of geometry as far as they hold where depth ends beside the outline that colour shows."""
        return tolerant(filled(geometry, patch.depth_m > 0), _TOLERANCE_PX / patch.cell_px)

    def _unfilled(self, patch: Patch, mask: np.ndarray) -> float:
        """The doubt of a mask (h, w) bool that fills too little of the box that was drawn around it."""
        if self.prompt.box_px is None or not mask.any():
            return 0.0
        (low, high), (first, last) = patch.ends_px(mask), self.prompt.box_px.reshape(2, 2)
        both = np.prod(np.maximum(np.minimum(high, last) - np.maximum(low, first), 0))
        either = np.prod(high - low) + np.prod(last - first) - both
        return float(_PER_UNFILLED * max(_FILLED - both / either, 0))

    def effect(self, was: np.ndarray) -> Effect:
        """On a mask (H, W) bool; negative clicks alone, which cannot begin one, mend an empty one, too."""
        if was.any() and self._leaves(was):
            return Effect.BEGUN_ELSEWHERE
        mends = was.any() and self.prompt.box_px is None
        return Effect.MENDED if mends or not self.prompt.starts else Effect.BEGUN

    def _leaves(self, was: np.ndarray) -> bool:
        """Whether a mask (H, W) bool is of something else: clicks are farther away than it is long, a box beside it."""
        if self.prompt.box_px is not None:
            left, top, right, bottom = self.prompt.box_px.round().astype(int).clip(0).tolist()
            return not was[top : bottom + 1, left : right + 1].any()
        clicks, ends = self.prompt.points_px, ends_px(was)
        away = np.maximum(np.maximum(ends[0] - clicks, clicks - ends[1] + 1), 0)
        return bool(len(clicks) and np.linalg.norm(away, axis=1).min() > np.ptp(ends, 0).max())

    def correct(self, was: np.ndarray) -> tuple[Box, np.ndarray]:
        """Mend a mask (H, W) bool where a click contradicts it: what none contradicts stays, but for specks.

        Those are what is left around a part that a click beside the object takes away.
        """
        clicks, ends = self.prompt.points_px, ends_px(was)
        px = np.concatenate([ends, clicks, self.prompt.negative_px])
        fits = replace(self.config, side_px=2 * self.config.side_px)
        patch = Patch.of(self.frame, self._room(px.min(0), px.max(0)), self.camera, fits)
        on, seeds = patch.down(was.astype(np.float32)) > 0.5, patch.dots(clicks, 1)
        barred = patch.dots(self._others_px, 1) & ~seeds
        apart = _parts(on, barred) & ~_parts(on, seeds)  # a part by itself is the object, or is not
        apart &= (on & ~apart).any()
        x = self._mended(patch, on & ~apart, seeds, barred) > 0.5
        missed, extra = _parts(x & ~on, seeds), _parts(on & ~x & ~apart, barred) | apart
        add, take = (patch.up(part.astype(np.float32)) > 0.5 for part in (missed, extra))
        mended = was[patch.box.slices] & ~take | add
        if len(self.prompt.negative_px):
            mended &= ~_specks(mended, clicks - [patch.box.left, patch.box.top])
        return patch.box, mended.astype(np.float32)

    def _mended(self, patch: Patch, on: np.ndarray, seeds: np.ndarray, barred: np.ndarray) -> np.ndarray:
        """(h, w) probability of an object whose mask was ``on`` (h, w) bool; ``seeds`` and ``barred`` are certain.

        The mask counts as it was, except where the way to a contradicting click is shorter than that to most of its
        side: there colours and edges decide, and what depth connects with a click.
        """
        missed, extra = seeds & ~on, barred & on
        may_be_on, may_be_off = _open(patch, ~on, missed, barred), _open(patch, on, extra, seeds)
        kept, rest = on & ~may_be_off, ~on & ~may_be_on
        known = np.where(kept, _KEPT, 0) - np.where(rest, _KEPT, 0)
        if may_be_on.any():
            known[may_be_on] = _REACHED * self._reached(patch)[may_be_on]
        own, other, x = kept.astype(np.float32), rest.astype(np.float32), on.astype(np.float32)
        for _ in range(_ROUNDS_MORE):
            shares = by_shares(patch, own + _OTHERS * missed, other + _OTHERS * extra, self.config)
            background = (barred | patch.border()) & ~seeds
            x = cut(patch, known + shares, start=x, seeds=seeds, background=background, sharp=True)
            own, other = np.maximum(2 * x - 1, 0), np.maximum(1 - 2 * x, 0)
        return x

    def _reached(self, patch: Patch) -> np.ndarray:
        """(h, w) log-odds of what depth connects with the positive clicks."""
        clicks = self.prompt.points_px
        z_m = float(np.nanmedian(depths_at(clicks, self.frame)))
        clicked = Clicked.of(patch, clicks, z_m)
        near = by_distance(patch, z_m, self.config)
        height = Height.of(patch, clicked, near >= 0)
        return near + height.log_odds + by_connection(patch, clicked, height, unlike(patch, height.plane))

    def _cut_out(
        self,
        patch: Patch,
        clicked: Clicked,
        fixed: np.ndarray,
        own: np.ndarray,
        other: np.ndarray,
        x: np.ndarray | None = None,
    ) -> np.ndarray:
        """(h, w) probability of what is connected with the clicks, which count as certain.

        fixed       (h, w) log-odds of all but colour
        own, other  (h, w) weights by which the first cut takes the colours of object and background: from around the
                    clicks and from farther away, or by ``x``. Each cut gives the next one its own
        x           (h, w) a cut on another patch, from which it goes on
        """
        seeds, cfg = clicked.seeds, self.config
        others = patch.dots(self._others_px, 1) & ~seeds
        barred = others | patch.border()
        if self.prompt.box_px is not None:
            barred |= ~_within(patch, self.prompt.box_px)
        other = other + _OTHERS * others if x is None else other
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
        others = (patch.dots(self._others_px, 0) | clicked.hides) & ~clicked.seeds
        if not others.any():
            return np.zeros(patch.shape, np.float32)
        return np.where(patch.nearer(others, clicked.seeds, _LIKE), np.float32(-_NOT_IT), 0)

    def _room(self, low: np.ndarray, high: np.ndarray) -> Box:
        """A box with room around the pixels from ``low`` to ``high`` (x, y)."""
        half = (high - low) / 2 * (1 + 2 * self.config.margin) + ROOM_PX
        return around((low + high) / 2, half, self.frame.shape)


def _measured(clicks_px: np.ndarray, frame: Frame) -> np.ndarray:
    """Clicks (N, 2) on an object; those on pixels without depth are moved to the nearest pixel of the nearer surface.

    Beside an object's edge, where one of a camera's two views is hidden, most of what is measured is the wall behind.
    """
    reach = np.mgrid[-_HOLE_PX : _HOLE_PX + 1, -_HOLE_PX : _HOLE_PX + 1].reshape(2, -1).T
    reach = reach[np.argsort((reach**2).sum(1), kind="stable")]  # the pixel itself first
    u, v = nearest_px(np.rint(clicks_px)[:, None] + reach, frame.shape)
    z_m = np.where(frame.depth_m[v, u] > 0, frame.depth_m[v, u], np.inf)
    near = np.isfinite(z_m) & (z_m < z_m.min(1, keepdims=True) + _ONE_SURFACE_M)
    moved, rows, first = near.any(1) & np.isinf(z_m[:, 0]), np.arange(len(clicks_px)), near.argmax(1)
    return np.where(moved[:, None], np.stack([u, v], -1)[rows, first], clicks_px)


def _open(patch: Patch, side: np.ndarray, wrong: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(h, w) bool: what of a side (h, w) bool of an outline is nearer to cells that are ``wrong`` than to most of it.

    Most of it is the third that is farthest from them, and those that are known to be ``right`` (h, w) bool.
    """
    if not wrong.any():
        return np.zeros_like(side)
    away = patch.away(wrong, _LIKE)
    most = side & (away >= np.quantile(away[side], 2 / 3))
    return side & (away < patch.away(most | right & side & ~wrong, _LIKE))


def _parts(region: np.ndarray, at: np.ndarray) -> np.ndarray:
    """(h, w) bool: the parts of a region (h, w) bool that hold a cell of ``at`` (h, w) bool."""
    return components_touching(connected_components(region), at)


def _specks(mask: np.ndarray, clicks_px: np.ndarray) -> np.ndarray:
    """(h, w) bool: the parts of a mask (h, w) bool that are a small share of it and hold no click (K, 2) on it."""
    part, small = small_parts(mask, _SPECK * np.count_nonzero(mask), connectivity=8)
    u, v = nearest_px(clicks_px, mask.shape)
    small[part[v, u]] = False
    return small[part]


def _within(patch: Patch, box_px: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of a patch inside a box (4,) of the image."""
    u, v = patch.centres_px()
    slack = _TIGHT * np.ptp(box_px.reshape(2, 2), 0)
    left, top, right, bottom = box_px + np.concatenate([-slack, slack])
    return ((v >= top) & (v <= bottom))[:, None] & ((u >= left) & (u <= right))
