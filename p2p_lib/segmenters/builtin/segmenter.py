"""Which pixels belong to which object (input of the paper: "a segmentation mask of each object").

A segmenter takes a few clicks on each object in some frame and labels every frame from there on, causally.
The built-in one needs no weights: evidence of colour, depth and geometry, of where the object was a
frame ago and of what the rest of the pipeline knows, is weighed per pixel and cut along edges by a random
walker (:mod:`p2p_lib.segmenters.builtin.random_walk`). It labels measured pixels alone: without depth nothing can be
lifted, and depth is missing just where a silhouette is doubtful.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import bounds, in_mask
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt, check_depth, check_prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import colour_codes, histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, by_surface, cut, warped
from p2p_lib.segmenters.builtin.motion import EVERY, Motions, Past, scene_stays
from p2p_lib.segmenters.builtin.patch import Box, Patch, around, dilated, support_plane
from p2p_lib.segmenters.builtin.prompted import ROOM_PX, Cutter, doubt_start, only

_NO_PX = np.zeros((0, 2))


@dataclass(frozen=True, eq=False)
class _Seen:
    """Where an object was: mask (rows, columns) bool of a box of the image, and the depth (m) of its middle."""

    box: Box
    mask: np.ndarray
    z_m: float

    @property
    def centre_px(self) -> np.ndarray:
        """(2,) middle of the box."""
        return np.array([self.box.left + self.box.right, self.box.top + self.box.bottom]) / 2


@dataclass(frozen=True, eq=False)
class _Target:
    """One object between two frames.

    seen     in the newest frame; None while it is absent
    colours  (4096,) shares of the colours it has shown; None if it has not been seen yet
    size_m   (2,) its largest width and height so far
    room_m   (2,) how far parts reach from the middle of what was seen that may be of it too
    past     frames that it was seen in, with its poses
    given    the newest frame with a mask that was given and showed something, from which nothing is learnt yet: that
             costs time, and where every frame brings a mask it is never needed
    """

    seen: _Seen | None = None
    colours: np.ndarray | None = None
    size_m: np.ndarray | None = None
    room_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    past: Past = field(default_factory=Past)
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
        taken = np.zeros(frame.shape, bool)
        for mask in masks.values():
            taken |= mask
        new = [p for p in said.values() if p.mask is None and p.name not in self._targets]
        # An object that is looked for is not one of those in view.
        absent = {name for name, target in self._targets.items() if target.seen is None and target.given is None}
        absent |= {name for name, hint in (hints or {}).items() if hint.sighted}
        for name in sorted(dict.fromkeys([*self._targets, *said]), key=absent.__contains__):
            target, hint = self._targets.get(name, _Target()), (hints or {}).get(name) or Hint()
            if name in masks:
                given = (frame, masks[name]) if masks[name].any() else target.given
                self._targets[name] = replace(target, seen=None, given=given)
                continue
            target = self._targets[name] = self._learnt(target)
            if name in said:
                others_px = [p.points_px for n, p in said.items() if n != name]
                found[name] = self._prompted(
                    frame, target, said[name], np.concatenate([_NO_PX, *others_px]), hint, taken
                )
                self._targets[name] = _Target()  # its colours and its size are learnt anew
            else:
                self._targets[name], found[name] = self._looked_for(frame, target, hint, taken)
            if found[name] is not None:
                box, x = found[name]
                taken[box.slices] |= x > 0.5
        labels = self._shared_out(frame, found)
        for label, name in enumerate(self._targets, 1):
            if name in masks:
                labels[masks[name]] = label
        label_of = {name: label for label, name in enumerate(self._targets, 1)}
        for prompt in new:
            others = {name: labels == label for name, label in label_of.items() if name != prompt.name}
            cutter = Cutter(frame, self.camera, self.config, self._rng, prompt, _NO_PX)
            doubt_start(cutter, labels == label_of[prompt.name], others)
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
        self,
        frame: Frame,
        target: _Target,
        prompt: Prompt,
        others_px: np.ndarray,
        hint: Hint,
        taken: np.ndarray,
    ) -> tuple[Box, np.ndarray] | None:
        """By what is said of it, and for a correction by where it would have been taken for."""
        cutter = Cutter(frame, self.camera, self.config, self._rng, prompt, others_px)
        was = np.zeros(frame.shape, bool)
        found = None if prompt.box_px is not None else self._looked_for(frame, target, hint, taken)[1]
        if found is not None:
            was[found[0].slices] = found[1] > 0.5
        if was.any():
            return cutter.correct(was, hint.uv_px)
        return cutter.start() if prompt.starts else None

    def _looked_for(
        self, frame: Frame, target: _Target, hint: Hint, taken: np.ndarray
    ) -> tuple[_Target, tuple[Box, np.ndarray] | None]:
        """Where an object is, outside what is ``taken`` (H, W) bool where it was absent; and it, with its past."""
        if target.seen is None or hint.sighted:  # what has been followed is not where the object was found
            return target, self._find(frame, target, hint, taken)
        if not self._sure(hint):
            return target, self._follow(frame, target, hint)
        if frame.index % EVERY == 0:
            target = self._with_room(frame, target, hint)
        found = self._follow(frame, target, hint)
        return replace(target, past=target.past.with_frame(frame, hint.T_cam_obj)), found

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

    def _follow(self, frame: Frame, target: _Target, hint: Hint) -> tuple[Box, np.ndarray]:
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
        log_odds, component = by_geometry(patch, core, plane, cfg, self._motions(frame, target, hint))
        stays = cfg.prior_weight * (2 * prior - 1)
        # Parts that come into view are connected with those that were seen before.
        log_odds += np.where(component, np.maximum(stays, 0), stays)
        log_odds[jumped] -= cfg.geometry_weight
        log_odds += by_colour(patch, target.colours, (prior < 0.2) & ~component, cfg) + by_surface(patch, hint, cfg)
        return box, patch.up(only(cut(patch, log_odds, start=prior), core))

    def _sure(self, hint: Hint) -> bool:
        """Whether enough points agree on a pose."""
        return hint.T_cam_obj is not None and len(hint.uv_px) >= self.config.find_points

    def _motions(self, frame: Frame, target: _Target, hint: Hint) -> Motions | None:
        """How an object moved; None where nobody knows."""
        return target.past.motions(frame, hint.T_cam_obj) if self._sure(hint) else None

    def _with_room(self, frame: Frame, target: _Target, hint: Hint) -> _Target:
        """An object with room for parts that move with it, which may reach farther than all that it has shown."""
        cfg, px_m = self.config, self._focal_px / target.seen.z_m
        patch = Patch.of(frame, around(hint.uv_px.mean(0), cfg.reach_m * px_m, frame.shape), self.camera, cfg)
        motions = self._motions(frame, target, hint)
        if motions is None or not scene_stays(patch, motions):
            return target
        plane = support_plane(patch, patch.depth_m > 0, self._rng)
        _, component = by_geometry(patch, patch.dots(hint.uv_px, 0), plane, cfg, motions)
        if not component.any():
            return target
        rows, columns = bounds(component)
        ends = np.array([[columns.start, rows.start], [columns.stop, rows.stop]]) * patch.box.shape[1] / patch.shape[1]
        away_px = np.abs(ends + np.array([patch.box.left, patch.box.top]) - target.seen.centre_px).max(0)
        return replace(target, room_m=away_px / px_m)

    def _find(self, frame: Frame, target: _Target, hint: Hint, taken: np.ndarray) -> tuple[Box, np.ndarray] | None:
        """Where enough of its points have come back, on nothing that is ``taken`` (H, W) bool by another object."""
        cfg, uv_px = self.config, hint.uv_px[~in_mask(hint.uv_px, taken)]
        if target.colours is None or len(uv_px) < cfg.find_points:
            return None
        z_m = float(np.nanmedian(depths_at(uv_px, frame)))
        low, high = uv_px.min(0), uv_px.max(0)
        half = np.maximum(target.size_m * self._focal_px / z_m * (0.5 + cfg.margin), high - low) + ROOM_PX
        box = around((low + high) / 2, half, frame.shape)
        patch = Patch.of(frame, box, self.camera, cfg)
        barred = patch.down(taken.astype(np.float32)) > 0.5
        seeds, surface = patch.dots(uv_px, 1) & (patch.depth_m > 0) & ~barred, by_surface(patch, hint, cfg)
        outside = ~dilated(seeds | (surface > 0), 3)
        plane = support_plane(patch, (patch.depth_m > 0) & outside, self._rng)
        log_odds, component = by_geometry(patch, seeds, plane, cfg)
        colour = by_colour(patch, target.colours, outside & ~component, cfg)
        background = (patch.border() | barred) & ~seeds
        x = only(cut(patch, log_odds + surface + colour, seeds=seeds, background=background), seeds)
        own_colours = colour[x > 0.5]
        return (box, patch.up(x)) if len(own_colours) and (hint.sighted or own_colours.mean() > 0) else None

    def _box_of_all(self, target: _Target, shape: tuple[int, int]) -> Box:
        """Where to look for an object that was seen: room for all of it to either side of what showed."""
        seen, px_m = target.seen, self._focal_px / target.seen.z_m
        half = np.maximum(target.size_m / 2, target.room_m) * px_m
        return around(seen.centre_px, half * (1 + self.config.margin) + ROOM_PX, shape)

    def _updated(self, frame: Frame, target: _Target, seen: _Seen | None) -> _Target:
        """What is known of an object after a frame."""
        if seen is None:
            return replace(target, seen=None)
        size_m = np.array(seen.mask.shape[::-1]) * seen.z_m / self._focal_px
        colours = histogram(colour_codes(frame.rgb[seen.box.slices][seen.mask]))
        if target.colours is None:
            return replace(target, seen=seen, colours=colours, size_m=size_m)
        rate = self.config.colour_rate
        colours = (1 - rate) * target.colours + rate * colours
        return replace(target, seen=seen, colours=colours, size_m=np.maximum(size_m, target.size_m))


def _seen(frame: Frame, mask: np.ndarray, min_px: int) -> _Seen | None:
    """Where the measured pixels of a mask (H, W) lie in a frame; None where they are too few."""
    if not mask.any():
        return None
    rows, columns = bounds(mask)
    depth_m = frame.depth_m[rows, columns]
    mask = mask[rows, columns] & (depth_m > 0)
    if mask.sum() < min_px:
        return None
    inner = bounds(mask)
    left, top = columns.start + inner[1].start, rows.start + inner[0].start
    box = Box(left, top, left + inner[1].stop - inner[1].start, top + inner[0].stop - inner[0].start)
    return _Seen(box, mask[inner], float(np.median(depth_m[mask])))
