"""An object cut out by a prompt: clicks on it and beside it, or a box around it.

A prompt starts an object, or corrects its mask.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.errors import doubt
from p2p_lib.core.image import bounds
from p2p_lib.core.prompts import Prompt, points_in_box
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.cut import cut
from p2p_lib.segmenters.builtin.depth_offset import depth_offset_px, with_depth_moved
from p2p_lib.segmenters.builtin.patch import (
    Box,
    Patch,
    around,
    dilated,
    keep_seeded_components,
    plane_heights,
    support_plane,
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
#: Standard deviations of depth below which an object's median height above the plane around it is none.
_FLAT = 2.0
#: A box is drawn a little too tight now and then, by this share of its size.
_TIGHT = 0.05
#: Length of a step between like pixels, where one across the strongest edge has length 1.
_LIKE = 0.1
#: Log odds of what lies nearer to a click beside the object than to one on it: more than geometry says.
_NOT_IT = 3.0
#: Two things are parted by an edge where their outline's ties, which are 1 between like pixels, are less in the mean.
_TIED = 0.02
#: Depth may end this many pixels beside the outline that colour shows.
_TOLERANCE_PX = 3.0
#: Cuts in the wide box and in the one that fits; a click beside the object counts as this many pixels of background.
_ROUNDS, _ROUNDS_MORE, _OTHERS = 3, 2, 30.0
#: Clicks may be close together on something large, or at both ends of something thin: it may be so many times as far
#: across as they are. Then less of its outline is beside edges, by this factor: print inside an object is sharp, too.
_SCALES = {0.4: 0.5, 1.0: 1.0, 2.5: 0.7}
#: So many pixels of the grid around a click on something else belong to that.
_AROUND_PX = 3
#: Cuts are as good as each other where their doubts differ by less than a factor; of two things if their sizes do more.
#: Masks are the same where they overlap by this.
_AS_GOOD, _OTHER_SIZE, _SAME = 1.2, 1.5, 0.7


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
        _, box, x = self.cuts[0]
        return box, x

    @cached_property
    def cuts(self) -> list[tuple[float, Box, np.ndarray]]:
        """Cuts at several scales, the best first: how doubtful each is, where it is, and its probabilities there."""
        found = []
        for scale, share in _SCALES.items():
            patch, x = self._cut_at(scale)
            found.append((self._doubtful(patch, x) / share, patch.box, patch.up(x)))
        return sorted(found, key=lambda cut: cut[0])

    def _doubtful(self, patch: Patch, x: np.ndarray) -> float:
        """How little of a cut's outline is along edges, and how much of what is clicked as something else is inside."""
        mask, others = x > 0.5, patch.dots(self._others_px, _AROUND_PX)
        return patch.outline_tie(mask) + (mask[others].mean() if others.any() else 0.0)

    def _cut_at(self, scale: float) -> tuple[Patch, np.ndarray]:
        """In a wide box at low resolution, then in one that fits: something ``scale`` times as far across as clicks."""
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
        clicked = Clicked.of(patch, clicks, z_m, scale)
        height = Height.of(patch, clicked)
        connected = by_connection(patch, clicked, height) + self._nearer_to_others(patch, clicked)
        prior = clicked.prior_beside(connected)
        x = moved._cut_out(patch, clicked, prior, by_distance(patch, z_m, cfg) + height.log_odds + connected)
        whole, there = np.zeros((2, *frame.shape), np.float32)
        whole[patch.box.slices], there[patch.box.slices] = patch.up(x), patch.up(connected)
        fits = self._room(*patch.ends_px(x > 0.5))
        patch = Patch.of(moved.frame, fits, self.camera, replace(cfg, side_px=2 * cfg.side_px))
        clicked = Clicked.of(patch, clicks, z_m, scale)
        height = height.on(patch, clicked)
        connected = patch.down(there)
        geometry = by_distance(patch, z_m, cfg) + height.log_odds + connected
        x = moved._cut_out(patch, clicked, clicked.prior_beside(connected) / 2, geometry, patch.down(whole))
        return patch, x

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


def doubt_start(cutter: Cutter, mask: np.ndarray, others: Mapping[str, np.ndarray]) -> None:
    """Warn if the prompt that started an object with a mask (H, W) bool may have selected something else.

    cutter  of the prompt alone, as if there were no other objects
    others  object to mask (H, W) bool, of the other objects in this frame
    """
    frame, name = cutter.frame, cutter.prompt.name
    who = f"{'clicks on' if len(cutter.prompt.points_px) else 'box around'} {name!r} in frame {frame.index}"
    if not mask.any():
        fix = "Click in its middle, on parts that look different, or draw a box."
        return doubt(who, "no object is found there", fix)
    rows, columns = bounds(mask)
    corners = np.array([[columns.start, rows.start], [columns.stop, rows.stop]])
    patch = Patch.of(frame, around(corners.mean(0), np.ptp(corners, 0), frame.shape), cutter.camera, cutter.config)
    plane = support_plane(patch, patch.depth_m > 0)
    inside = (patch.down(mask.astype(np.float32)) > 0.5) & (patch.depth_m > 0)
    if plane is not None and inside.any():
        height = np.median(np.abs(plane_heights(patch, plane)[inside]) / patch.sigma_m[inside])
        if height < _FLAT:
            got = f"{np.count_nonzero(mask)} pixels, flat in what is around it, as a table or a wall is"
            fix = "If it is not the object, click in the object's middle; else see that depth is in metres."
            return doubt(who, got, fix)
    beside = {
        other: there
        for other, there in others.items()
        if there.any() and _touch_unparted(patch, inside, patch.down(there.astype(np.float32)) > 0.5)
    }
    cuts = [(doubtful, _whole(frame, box, x)) for doubtful, box, x in cutter.cuts]
    for other, there in beside.items():
        if (cuts[0][1] & there).sum() > there.sum() / 2:
            fix = "If both are one body, leave one out; else give each clicks beside it (negative), on the other."
            return doubt(who, f"most of {other!r} belongs to what is clicked", fix)
    taken = np.logical_or.reduce([np.zeros(frame.shape, bool), *others.values()])
    best = cuts[0][1] & ~taken
    if (best & mask).sum() < _SAME * (best | mask).sum():
        return None  # the mask is somebody else's
    for doubtful, cut_out in cuts[1:]:
        another = cut_out & ~taken
        sizes = sorted([np.count_nonzero(mask), np.count_nonzero(another)])
        if doubtful < _AS_GOOD * cuts[0][0] and 0 < _OTHER_SIZE * sizes[0] < sizes[1]:
            apart = cv2.distanceTransform((another ^ mask).astype(np.uint8), cv2.DIST_L2, 3)
            v, u = np.unravel_index(apart.argmax(), apart.shape)
            got = f"{np.count_nonzero(mask)} pixels; {np.count_nonzero(another)} have as good an outline"
            fix = f"See where ({u}, {v}) belongs: click there, too, or beside the object (negative)."
            return doubt(who, got, fix)
    return None


def _whole(frame: Frame, box: Box, x: np.ndarray) -> np.ndarray:
    """(H, W) bool of a cut in a box."""
    whole = np.zeros(frame.shape, bool)
    whole[box.slices] = x > 0.5
    return whole


def _touch_unparted(patch: Patch, one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two masks (h, w) bool touch, and not along an edge of colour or depth alone."""
    right, below = patch.edge_weights
    tie = np.ones(patch.shape, np.float32)
    tie[:, :-1] = np.minimum(tie[:, :-1], right)
    tie[:-1] = np.minimum(tie[:-1], below)
    tied = cv2.erode(tie, np.ones((3, 3), np.uint8))[dilated(one, 1) & dilated(other, 1)]
    return bool(len(tied)) and tied.mean() > _TIED


def _within(patch: Patch, box_px: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of a patch inside a box (4,) of the image."""
    u, v = patch.centres_px()
    slack = _TIGHT * np.ptp(box_px.reshape(2, 2), 0)
    left, top, right, bottom = box_px + np.concatenate([-slack, slack])
    return ((v >= top) & (v <= bottom))[:, None] & ((u >= left) & (u <= right))
