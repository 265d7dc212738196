"""Which pixels belong to which object (input of the paper: "a segmentation mask of each object").

A segmenter takes a few clicks on each object in some frame and labels every frame from there on, causally.
The built-in one needs no weights: evidence of colour, depth and geometry, of where the object was a
frame ago and of what the rest of the pipeline knows, is weighed per pixel and cut along edges by a random
walker (:mod:`p2p_lib.segmenters.builtin.random_walk`). It labels measured pixels alone: without depth nothing can be
lifted, and depth is missing just where a silhouette is doubtful.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.clicks import checked_clicks, depths_at
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.image import bounds, nearest_px
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import colour_codes, histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, by_surface, cut, warped
from p2p_lib.segmenters.builtin.motion import Motion, scene_follows
from p2p_lib.segmenters.builtin.patch import Box, Patch, around, connected, dilated, support_plane

#: Room around an object, besides a share of its size: small ones move by pixels too.
_ROOM_PX = 6
#: Every how many frames one is remembered, and how many are: about a second.
_REMEMBERED, _MEMORY = 5, 6


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
    first    the first frame remembered, with its pose T_cam_obj (4, 4) then
    """

    seen: _Seen | None = None
    colours: np.ndarray | None = None
    size_m: np.ndarray | None = None
    first: tuple[Frame, np.ndarray] | None = None


class BuiltinSegmenter:
    """The segmenter without weights."""

    name = "builtin"

    def __init__(self, camera: Camera, config: SegmentationConfig, rng: np.random.Generator):
        self.camera, self.config, self._rng = camera, config, rng
        self._focal_px = np.array([camera.fx, camera.fy])
        self._targets: dict[str, _Target] = {}
        self._previous: Frame | None = None
        self._past: deque[tuple[Frame, dict[str, np.ndarray]]] = deque(maxlen=_MEMORY)  # with the poses T_cam_obj then

    @property
    def names(self) -> tuple[str, ...]:
        """The objects, in the order in which they were added."""
        return tuple(self._targets)

    def segment(
        self,
        frame: Frame,
        clicks: Mapping[str, ArrayLike] | None = None,
        hints: Mapping[str, Hint] | None = None,
    ) -> np.ndarray:
        """One frame in, one label image out; where two objects claim a pixel the likelier one has it."""
        new = checked_clicks(clicks or {}, self.camera, frame)
        hints = {name: (hints or {}).get(name) or Hint() for name in self._targets}
        present = {name: target for name, target in self._targets.items() if target.seen is not None}
        if frame.index % _REMEMBERED == 0:
            self._targets |= {name: self._with_room(frame, name, hints[name]) for name in present}
        found = {name: self._follow(frame, name, hints[name]) for name in present}
        taken = _taken(frame, found.values())
        absent = [name for name in self._targets if name not in present]
        found |= {name: self._find(frame, self._targets[name], hints[name], taken) for name in absent}
        for name, at in new.items():
            others = np.concatenate([*(c for n, c in new.items() if n != name), np.zeros((0, 2))])
            self._targets[name], found[name] = _Target(), self._start(frame, at, others)
        if frame.index % _REMEMBERED == 0:
            sure = {name: hint.T_cam_obj for name, hint in hints.items() if self._sure(hint)}
            self._past.append((frame, sure))
            for name, T_cam_obj in sure.items():
                if self._targets[name].first is None:
                    self._targets[name] = replace(self._targets[name], first=(frame, T_cam_obj))
        return self._shared_out(frame, found)

    def remove(self, name: str) -> None:
        """Forget an object."""
        del self._targets[name]
        for _, poses in self._past:
            poses.pop(name, None)

    def _shared_out(self, frame: Frame, found: Mapping[str, tuple[Box, np.ndarray] | None]) -> np.ndarray:
        """The label image of what was found of every object: its probability in a box of the image."""
        labels, best = np.zeros(frame.shape, np.int32), np.full(frame.shape, 0.5, np.float32)
        for label, name in enumerate(self._targets, 1):
            if found[name] is not None:
                box, x = found[name]
                part, likeliest = labels[box.slices], best[box.slices]
                wins = (x > likeliest) & (frame.depth_m[box.slices] > 0)
                part[wins], likeliest[wins] = label, x[wins]
        for label, (name, target) in enumerate(self._targets.items(), 1):
            mask = labels == label
            seen = _seen(frame, mask) if mask.sum() >= self.config.min_px else None
            self._targets[name] = self._updated(frame, target, seen)
            if seen is None:
                labels[mask] = 0
        self._previous = frame
        return labels

    def _start(self, frame: Frame, clicks: np.ndarray, others: np.ndarray) -> tuple[Box, np.ndarray]:
        """From clicks, and those on other objects: in a wide box at low resolution, then in one that fits."""
        cfg = self.config
        z_m = float(np.median(depths_at(clicks, frame)))
        box = around(clicks.mean(0), np.maximum(cfg.reach_m * self._focal_px / z_m, 2 * np.ptp(clicks, 0)), frame.shape)
        patch = Patch.of(frame, box, self.camera, cfg)
        plane = support_plane(patch, patch.depth_m > 0, self._rng)
        seeds = patch.dots(clicks, 1)
        x = self._cut_out(patch, plane, seeds, others, dilated(seeds, 2), ~dilated(seeds, min(seeds.shape) // 6))
        whole = np.zeros(frame.shape, np.float32)
        whole[box.slices] = patch.up(x)
        patch = Patch.of(frame, self._fitting(patch, x > 0.5, frame), self.camera, cfg)
        was = patch.down(whole)
        x = self._cut_out(patch, plane, patch.dots(clicks, 1), others, was > 0.5, was < 0.5, was)
        return patch.box, patch.up(x)

    def _cut_out(
        self,
        patch: Patch,
        plane: np.ndarray | None,
        seeds: np.ndarray,
        others: np.ndarray,
        inside: np.ndarray,
        outside: np.ndarray,
        start: np.ndarray | None = None,
    ) -> np.ndarray:
        """(h, w) probability of what is connected with the seeds; colours are those ``inside`` and ``outside``."""
        background = (patch.dots(others, 1) | patch.border()) & ~seeds
        by_depth, _ = by_geometry(patch, seeds, plane, self.config)
        colour = by_colour(patch, histogram(patch.codes[inside]), outside, self.config)
        return _only(cut(patch, by_depth + colour, start=start, seeds=seeds, background=background), seeds)

    def _fitting(self, patch: Patch, inside: np.ndarray, frame: Frame) -> Box:
        """A box with room around what is ``inside`` a patch."""
        rows, columns = bounds(inside)
        scale = np.array(patch.box.shape[::-1]) / patch.shape[::-1]
        low, high = np.array([columns.start, rows.start]) * scale, np.array([columns.stop, rows.stop]) * scale
        half = (high - low) / 2 * (1 + 2 * self.config.margin) + _ROOM_PX
        return around((low + high) / 2 + [patch.box.left, patch.box.top], half, frame.shape)

    def _follow(self, frame: Frame, name: str, hint: Hint) -> tuple[Box, np.ndarray]:
        """From where it was a frame ago."""
        cfg, target = self.config, self._targets[name]
        seen = target.seen
        box = self._box_of_all(target, frame.shape)
        patch, before = (Patch.of(f, box, self.camera, cfg) for f in (frame, self._previous))
        mask = np.zeros(frame.shape, np.float32)
        mask[seen.box.slices] = seen.mask
        prior, z_before = warped(before.down(mask), before, patch)
        measured = (patch.depth_m > 0) & (z_before > 0)
        jumped = measured & (prior > 0.5) & (np.abs(patch.depth_m - z_before) > patch.step_m)
        core = (prior > 0.8) & ~jumped
        plane = support_plane(patch, (patch.depth_m > 0) & (prior < 0.2), self._rng)
        log_odds, component = by_geometry(patch, core, plane, cfg, self._motions(frame, patch, name, hint))
        stays = cfg.prior_weight * (2 * prior - 1)
        # Parts that come into view are connected with those that were seen before.
        log_odds += np.where(component, np.maximum(stays, 0), stays)
        log_odds[jumped] -= cfg.geometry_weight
        log_odds += by_colour(patch, target.colours, (prior < 0.2) & ~component, cfg) + by_surface(patch, hint, cfg)
        return box, patch.up(_only(cut(patch, log_odds, start=prior), core))

    def _sure(self, hint: Hint) -> bool:
        """Whether enough points agree on a pose."""
        return hint.T_cam_obj is not None and len(hint.uv_px) >= self.config.find_points

    def _motions(self, frame: Frame, patch: Patch, name: str, hint: Hint) -> tuple[Motion, Motion] | None:
        """An object's motions since one of the frames remembered, each in its turn, and since its first.

        None where they tell nothing.
        """
        known = [(then, poses[name]) for then, poses in self._past if name in poses]
        if not known or not self._sure(hint):
            return None
        T_obj_cam = se3.inverse(hint.T_cam_obj)
        recent, first = (
            Motion(then, T_cam_obj @ T_obj_cam)
            for then, T_cam_obj in (known[frame.index % len(known)], self._targets[name].first)
        )
        return None if scene_follows(frame, patch, recent) else (recent, first)

    def _with_room(self, frame: Frame, name: str, hint: Hint) -> _Target:
        """An object with room for parts that move with it, which may reach farther than all that it has shown."""
        cfg, target = self.config, self._targets[name]
        if not self._sure(hint):
            return target
        half = cfg.reach_m * self._focal_px / target.seen.z_m
        patch = Patch.of(frame, around(hint.uv_px.mean(0), half, frame.shape), self.camera, cfg)
        motions = self._motions(frame, patch, name, hint)
        if motions is None:
            return target
        plane = support_plane(patch, patch.depth_m > 0, self._rng)
        _, component = by_geometry(patch, patch.dots(hint.uv_px, 0), plane, cfg, motions)
        if not component.any():
            return target
        rows, columns = bounds(component)
        size_px = np.array([columns.stop - columns.start, rows.stop - rows.start]) * patch.box.shape[1] / patch.shape[1]
        return replace(target, size_m=np.maximum(target.size_m, size_px * target.seen.z_m / self._focal_px))

    def _find(self, frame: Frame, target: _Target, hint: Hint, taken: np.ndarray) -> tuple[Box, np.ndarray] | None:
        """Where enough of its points have come back, on nothing that is ``taken`` (H, W) bool by another object."""
        cfg = self.config
        u, v = nearest_px(hint.uv_px, frame.shape)
        uv_px = hint.uv_px[~taken[v, u]]
        if target.colours is None or len(uv_px) < cfg.find_points:
            return None
        z_m = float(np.nanmedian(depths_at(uv_px, frame)))
        low, high = uv_px.min(0), uv_px.max(0)
        half = np.maximum(target.size_m * self._focal_px / z_m * (0.5 + cfg.margin), high - low) + _ROOM_PX
        box = around((low + high) / 2, half, frame.shape)
        patch = Patch.of(frame, box, self.camera, cfg)
        barred = patch.down(taken.astype(np.float32)) > 0.5
        seeds, surface = patch.dots(uv_px, 1) & (patch.depth_m > 0) & ~barred, by_surface(patch, hint, cfg)
        outside = ~dilated(seeds | (surface > 0), 3)
        plane = support_plane(patch, (patch.depth_m > 0) & outside, self._rng)
        log_odds, component = by_geometry(patch, seeds, plane, cfg)
        colour = by_colour(patch, target.colours, outside & ~component, cfg)
        background = (patch.border() | barred) & ~seeds
        x = _only(cut(patch, log_odds + surface + colour, seeds=seeds, background=background), seeds)
        own_colours = colour[x > 0.5]
        return (box, patch.up(x)) if len(own_colours) and own_colours.mean() > 0 else None

    def _box_of_all(self, target: _Target, shape: tuple[int, int]) -> Box:
        """Where to look for an object that was seen: room for all of it to either side of what showed."""
        seen, whole_px = target.seen, target.size_m * self._focal_px / target.seen.z_m
        extent = np.array(seen.mask.shape[::-1])
        half = np.maximum(extent / 2, np.minimum(whole_px / 2, whole_px - extent / 2))
        centre = np.array([seen.box.left, seen.box.top]) + extent / 2
        return around(centre, half * (1 + self.config.margin) + _ROOM_PX, shape)

    def _updated(self, frame: Frame, target: _Target, seen: _Seen | None) -> _Target:
        """What is known of an object after a frame."""
        if seen is None:
            return replace(target, seen=None)
        size_m = np.array(seen.mask.shape[::-1]) * seen.z_m / self._focal_px
        colours = histogram(colour_codes(frame.rgb[seen.box.slices][seen.mask]))
        if target.colours is None:
            return replace(target, seen=seen, colours=colours, size_m=size_m)
        rate = self.config.colour_rate
        colours, size_m = (1 - rate) * target.colours + rate * colours, np.maximum(size_m, target.size_m)
        return replace(target, seen=seen, colours=colours, size_m=size_m)


def _seen(frame: Frame, mask: np.ndarray) -> _Seen:
    """Where a mask (H, W) lies in a frame."""
    rows, columns = bounds(mask)
    box = Box(columns.start, rows.start, columns.stop, rows.stop)
    return _Seen(box, mask[rows, columns], float(np.median(frame.depth_m[mask])))


def _taken(frame: Frame, found: Iterable[tuple[Box, np.ndarray]]) -> np.ndarray:
    """(H, W) bool: pixels that are already somebody's."""
    taken = np.zeros(frame.shape, bool)
    for box, x in found:
        taken[box.slices] |= x > 0.5
    return taken


def _only(x: np.ndarray, seeds: np.ndarray) -> np.ndarray:
    """The probabilities without the islands that hold no seed."""
    return np.where(connected(x > 0.5, seeds) | (x <= 0.5), x, 0)
