"""Which pixels belong to which object (input of the paper: "a segmentation mask of each object").

A segmenter takes a few clicks on each object in some frame and labels every frame from there on, causally.
The built-in one needs no weights: evidence of colour, depth and geometry, of where the object was a
frame ago and of what the rest of the pipeline knows, is weighed per pixel and cut along edges by a random
walker (:mod:`p2p_lib.segmenters.builtin.random_walk`). It labels measured pixels alone: without depth nothing can be
lifted, and depth is missing just where a silhouette is doubtful.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import bounds
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt, check_depth, check_prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import colour_codes, histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, by_surface, cut, warped
from p2p_lib.segmenters.builtin.patch import Box, Patch, around, dilated, support_plane
from p2p_lib.segmenters.builtin.prompted import ROOM_PX, Cutter, only

_NO_PX = np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Where an object was: mask (rows, columns) bool of a box of the image, and the depth (m) of its middle."""

    box: Box
    mask: np.ndarray
    z_m: float


@dataclass(frozen=True, eq=False)
class _Target:
    """One object between two frames.

    seen     in the newest frame; None while it is absent
    colours  (4096,) shares of the colours it has shown; None if it has not been seen yet
    size_m   (2,) its largest width and height so far
    given    the newest frame with a mask that was given and showed something, from which nothing is learnt yet: that
             costs time, and where every frame brings a mask it is never needed
    """

    seen: _Seen | None = None
    colours: np.ndarray | None = None
    size_m: np.ndarray | None = None
    given: tuple[Frame, np.ndarray] | None = None


class BuiltinSegmenter:
    """The segmenter without weights."""

    name = "builtin"

    def __init__(self, camera: Camera, config: SegmentationConfig, rng: np.random.Generator):
        self.camera, self.config, self._rng = camera, config, rng
        self._focal_px = np.array([camera.fx, camera.fy])
        self._targets: dict[str, _Target] = {}
        self._previous: Frame | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """The objects, in the order in which they were added."""
        return tuple(self._targets)

    def segment(
        self,
        frame: Frame,
        prompts: Iterable[Prompt] = (),
        hints: Mapping[str, Hint] | None = None,
    ) -> np.ndarray:
        """One frame in, one label image out; where two objects claim a pixel the likelier one has it."""
        said = {prompt.name: prompt for prompt in prompts}
        for prompt in (p for p in said.values() if p.mask is None):
            check_prompt(prompt, self.camera)
            check_depth(prompt, frame)
        masks = {name: prompt.mask for name, prompt in said.items() if prompt.mask is not None}
        found: dict[str, tuple[Box, np.ndarray] | None] = {}
        for name in dict.fromkeys([*self._targets, *said]):
            target, hint = self._targets.get(name, _Target()), (hints or {}).get(name) or Hint()
            if name in masks:
                given = (frame, masks[name]) if masks[name].any() else target.given
                self._targets[name] = replace(target, seen=None, given=given)
                continue
            target = self._targets[name] = self._learnt(target)
            if name in said:
                others_px = [p.points_px for n, p in said.items() if n != name]
                found[name] = self._prompted(frame, target, said[name], np.concatenate([_NO_PX, *others_px]), hint)
                self._targets[name] = _Target()  # its colours and its size are learnt anew
            else:
                found[name] = self._looked_for(frame, target, hint)
        labels = self._shared_out(frame, found)
        for label, name in enumerate(self._targets, 1):
            if name in masks:
                labels[masks[name]] = label
        self._previous = frame
        return labels

    def _learnt(self, target: _Target) -> _Target:
        """What is known of an object with what the mask that was given of it tells."""
        if target.given is None:
            return target
        frame, mask = target.given
        target = self._updated(frame, target, _seen(frame, mask, self.config.min_px))
        return replace(target, given=None, seen=target.seen if frame is self._previous else None)

    def _prompted(
        self, frame: Frame, target: _Target, prompt: Prompt, others_px: np.ndarray, hint: Hint
    ) -> tuple[Box, np.ndarray] | None:
        """By what is said of it, and for a correction by where it would have been taken for."""
        cutter = Cutter(frame, self.camera, self.config, self._rng, prompt, others_px)
        was = np.zeros(frame.shape, bool)
        found = None if prompt.box_px is not None else self._looked_for(frame, target, hint)
        if found is not None:
            was[found[0].slices] = found[1] > 0.5
        if was.any():
            return cutter.correct(was, hint.uv_px)
        return cutter.start() if prompt.starts else None

    def _looked_for(self, frame: Frame, target: _Target, hint: Hint) -> tuple[Box, np.ndarray] | None:
        return self._find(frame, target, hint) if target.seen is None else self._follow(frame, target, hint)

    def remove(self, name: str) -> None:
        """Forget an object."""
        del self._targets[name]

    def _shared_out(self, frame: Frame, found: Mapping[str, tuple[Box, np.ndarray] | None]) -> np.ndarray:
        """The label image of what was found of every object: its probability in a box of the image."""
        labels = np.zeros(frame.shape, np.int32)
        if not found:
            return labels
        best = np.full(frame.shape, 0.5, np.float32)
        for label, name in enumerate(self._targets, 1):
            if found.get(name) is not None:
                box, x = found[name]
                part, likeliest = labels[box.slices], best[box.slices]
                wins = (x > likeliest) & (frame.depth_m[box.slices] > 0)
                part[wins], likeliest[wins] = label, x[wins]
        for label, (name, target) in enumerate(self._targets.items(), 1):
            if name in found:
                mask = labels == label
                seen = _seen(frame, mask, self.config.min_px)
                self._targets[name] = self._updated(frame, target, seen)
                if seen is None:
                    labels[mask] = 0
        return labels

    def _follow(self, frame: Frame, target: _Target, hint: Hint) -> tuple[Box, np.ndarray] | None:
        """From where it was a frame ago."""
        cfg, seen = self.config, target.seen
        box = self._box_of_all(target, frame.shape)
        patch, before = (Patch.of(f, box, self.camera, cfg) for f in (frame, self._previous))
        mask = np.zeros(frame.shape, np.float32)
        mask[seen.box.slices] = seen.mask
        prior, z_before = warped(before.down(mask), before, patch)
        measured = (patch.depth_m > 0) & (z_before > 0)
        jumped = measured & (prior > 0.5) & (np.abs(patch.depth_m - z_before) > patch.step_m)
        core = (prior > 0.8) & ~jumped
        plane = support_plane(patch, (patch.depth_m > 0) & (prior < 0.2), self._rng)
        log_odds, component = by_geometry(patch, core, plane, cfg)
        stays = cfg.prior_weight * (2 * prior - 1)
        # Parts that come into view are connected with those that were seen before.
        log_odds += np.where(component, np.maximum(stays, 0), stays)
        log_odds[jumped] -= cfg.geometry_weight
        log_odds += by_colour(patch, target.colours, (prior < 0.2) & ~component, cfg) + by_surface(patch, hint, cfg)
        return box, patch.up(only(cut(patch, log_odds, start=prior), core))

    def _find(self, frame: Frame, target: _Target, hint: Hint) -> tuple[Box, np.ndarray] | None:
        """Where enough of its points have come back."""
        cfg = self.config
        if target.colours is None or len(hint.uv_px) < cfg.find_points:
            return None
        z_m = float(np.nanmedian(depths_at(hint.uv_px, frame)))
        low, high = hint.uv_px.min(0), hint.uv_px.max(0)
        half = np.maximum(target.size_m * self._focal_px / z_m * (0.5 + cfg.margin), high - low) + ROOM_PX
        box = around((low + high) / 2, half, frame.shape)
        patch = Patch.of(frame, box, self.camera, cfg)
        seeds, surface = patch.dots(hint.uv_px, 1) & (patch.depth_m > 0), by_surface(patch, hint, cfg)
        outside = ~dilated(seeds | (surface > 0), 3)
        plane = support_plane(patch, (patch.depth_m > 0) & outside, self._rng)
        log_odds, component = by_geometry(patch, seeds, plane, cfg)
        colour = by_colour(patch, target.colours, outside & ~component, cfg)
        background = patch.border() & ~seeds
        x = only(cut(patch, log_odds + surface + colour, seeds=seeds, background=background), seeds)
        own_colours = colour[x > 0.5]
        return (box, patch.up(x)) if len(own_colours) and (hint.sighted or own_colours.mean() > 0) else None

    def _box_of_all(self, target: _Target, shape: tuple[int, int]) -> Box:
        """Where to look for an object that was seen: room for all of it to either side of what showed."""
        seen, whole_px = target.seen, target.size_m * self._focal_px / target.seen.z_m
        extent = np.array(seen.mask.shape[::-1])
        half = np.maximum(extent / 2, np.minimum(whole_px / 2, whole_px - extent / 2))
        centre = np.array([seen.box.left, seen.box.top]) + extent / 2
        return around(centre, half * (1 + self.config.margin) + ROOM_PX, shape)

    def _updated(self, frame: Frame, target: _Target, seen: _Seen | None) -> _Target:
        """What is known of an object after a frame."""
        if seen is None:
            return replace(target, seen=None)
        size_m = np.array(seen.mask.shape[::-1]) * seen.z_m / self._focal_px
        colours = histogram(colour_codes(frame.rgb[seen.box.slices][seen.mask]))
        if target.colours is None:
            return _Target(seen, colours, size_m)
        rate = self.config.colour_rate
        return _Target(seen, (1 - rate) * target.colours + rate * colours, np.maximum(size_m, target.size_m))


def _seen(frame: Frame, mask: np.ndarray, min_px: int) -> _Seen | None:
    """Where the measured pixels of a mask (H, W) lie in a frame; None where they are too few."""
    mask = mask & (frame.depth_m > 0)
    if mask.sum() < min_px:
        return None
    rows, columns = bounds(mask)
    box = Box(columns.start, rows.start, columns.stop, rows.stop)
    return _Seen(box, mask[rows, columns], float(np.median(frame.depth_m[mask])))
