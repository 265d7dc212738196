"""An object cut out by a prompt: clicks on it and beside it, or a box around it.

A prompt starts an object, or corrects its mask.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.errors import doubt
from p2p_lib.core.image import bounds
from p2p_lib.core.prompts import Prompt, points_in_box
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, cut
from p2p_lib.segmenters.builtin.patch import (
    Box,
    Patch,
    around,
    dilated,
    keep_seeded_components,
    plane_heights,
    support_plane,
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
        whole[patch.box.slices] = patch.up(x)
        patch = Patch.of(frame, self._room(*patch.ends_px(x > 0.5)), self.camera, cfg)
        was = patch.down(whole)
        x = self._cut_out(patch, plane, clicks, was > 0.5, was < 0.5, was)
        return patch.box, patch.up(x)

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
        self,
        patch: Patch,
        plane: np.ndarray | None,
        clicks: np.ndarray,
        inside: np.ndarray,
        outside: np.ndarray,
        start: np.ndarray | None = None,
    ) -> np.ndarray:
        """(h, w) probability of what is connected with the clicks, which count as certain.

        Colours are those ``inside`` and ``outside``.
        """
        seeds = patch.dots(clicks, 1)
        by_depth, _ = by_geometry(patch, seeds, plane, self.config)
        log_odds = by_depth + by_colour(patch, histogram(patch.codes[inside]), outside, self.config)
        beside = patch.dots(self.prompt.negative_px, 0) & ~seeds
        if beside.any():
            log_odds = log_odds - _NOT_IT * patch.nearer(beside, seeds, _LIKE)
        barred = beside | patch.dots(self.others_px, 1) | patch.border()
        if self.prompt.box_px is not None:
            barred |= ~_within(patch, self.prompt.box_px)
        return keep_seeded_components(cut(patch, log_odds, start=start, seeds=seeds, background=barred & ~seeds), seeds)

    def _room(self, low: np.ndarray, high: np.ndarray) -> Box:
        """A box with room around the pixels from ``low`` to ``high`` (x, y)."""
        half = (high - low) / 2 * (1 + 2 * self.config.margin) + ROOM_PX
        return around((low + high) / 2, half, self.frame.shape)


def doubt_start(cutter: Cutter, mask: np.ndarray, others: Mapping[str, np.ndarray]) -> None:
    """Warn if the prompt that started an object with a mask (H, W) bool selected background or another object.

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
    plane = support_plane(patch, patch.depth_m > 0, np.random.default_rng(0))
    inside = (patch.down(mask.astype(np.float32)) > 0.5) & (patch.depth_m > 0)
    if plane is not None and inside.any():
        height = np.median(np.abs(plane_heights(patch, plane)[inside]) / patch.sigma_m[inside])
        if height < _FLAT:
            got = f"{np.count_nonzero(mask)} pixels, flat in what is around it, as a table or a wall is"
            fix = "If it is not the object, click in the object's middle; else see that depth is in metres."
            return doubt(who, got, fix)
    alone = np.zeros(frame.shape, bool)
    box, x = cutter.start()
    alone[box.slices] = x > 0.5
    for other, there in others.items():
        if there.any() and (alone & there).sum() > there.sum() / 2:
            fix = "If both are one body, leave one out; else give each clicks beside it (negative), on the other."
            doubt(who, f"most of {other!r} belongs to what is clicked", fix)


def _within(patch: Patch, box_px: np.ndarray) -> np.ndarray:
    """(h, w) bool: the pixels of a patch inside a box (4,) of the image."""
    u, v = patch.centres_px()
    slack = _TIGHT * np.ptp(box_px.reshape(2, 2), 0)
    left, top, right, bottom = box_px + np.concatenate([-slack, slack])
    return ((v >= top) & (v <= bottom))[:, None] & ((u >= left) & (u <= right))
