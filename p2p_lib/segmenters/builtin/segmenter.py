"""Which pixels belong to which object (input of the paper: "a segmentation mask of each object").

A segmenter takes a few clicks on each object in some frame and labels every frame from there on, causally.
The built-in one needs no weights: evidence of colour, depth and geometry, of where the object was a
frame ago and of what the rest of the pipeline knows, is weighed per pixel and cut along edges by a random
walker (:mod:`p2p_lib.segmenters.builtin.random_walk`). Depth is missing just where a silhouette is doubtful: there
colours say whose a pixel is, and only beside what is measured.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import bounds, in_mask
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt, check_depth, check_prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import colour_codes, histogram
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, by_surface, cut, of_plane_m, warped
from p2p_lib.segmenters.builtin.motion import Past, scene_stays
from p2p_lib.segmenters.builtin.patch import (
    Box,
    Patch,
    around,
    dilated,
    holding,
    middle,
    only,
    parts_of,
    plane_heights,
    support_plane,
)
from p2p_lib.segmenters.builtin.prompted import ROOM_PX, Cutter, doubt_start

#: An object's probability in a box of the image; None where nothing of it is found.
_Found = tuple[Box, np.ndarray] | None
_NO_PX = np.zeros((0, 2))
#: An object whose points agree is cut out in every third frame, in turns, and moved by the optical flow in between,
_TURNS = 3
#: unless more of it than this jumped in depth, its area changed by more, or more of it has no depth.
_JUMPED, _CHANGED, _BLIND = 0.03, 0.1, 0.25
#: What shows again after nothing of an object was measured is near to where it was.
_APART_M = 0.1
#: So many pixels together, each so much likelier in an object's colours (nats), are the object where it is expected.
_ENOUGH_PX, _TOLD = 80, 1.0


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
class _Moved:
    """An object's mask of a frame ago, moved by the optical flow: on a patch of this frame, what it is there (h, w).

    jumped    (h, w) bool: its depth is another one, something else has come before it or it has gone
    shown     (h, w) bool: it has a depth, and had none: that of the object or of what has come before it
    doubtful  whether that says too little
    """

    patch: Patch
    prior: np.ndarray
    jumped: np.ndarray
    shown: np.ndarray
    doubtful: bool


@dataclass(frozen=True, eq=False)
class _Target:
    """One object between two frames.

    seen     in the newest frame; None while it is absent
    colours  (4096,) shares of the colours it has shown; None if it has not been seen yet
    size_m   (2,) its largest width and height so far
    room_m   (2,) how far parts reach from the middle of what was seen that may be of it too
    past     frames that it was seen in, with its poses
    sure     whether enough points agreed on its pose when it was cut out last
    given    the newest frame with a mask that was given and showed something, from which nothing is learnt yet: that
             costs time, and where every frame brings a mask it is never needed
    """

    seen: _Seen | None = None
    colours: np.ndarray | None = None
    size_m: np.ndarray | None = None
    room_m: np.ndarray = field(default_factory=lambda: np.zeros(2))
    past: Past = field(default_factory=Past)
    sure: bool = False
    given: tuple[Frame, np.ndarray] | None = None


class Refiner(Protocol):
    """What mends the masks of :class:`BuiltinSegmenter`, see :class:`p2p_lib.segmenters.sam2.Sam2Refiner`."""

    name: str

    def refine(
        self,
        frame: Frame,
        prompts: Mapping[str, Prompt],
        found: Mapping[str, np.ndarray],
        hints: Mapping[str, Hint],
    ) -> dict[str, np.ndarray]:
        """Better masks (H, W) bool of some of the objects in this frame; the others' stay as they were ``found``."""


class BuiltinSegmenter:
    """The segmenter without weights.

    refiner  mends what it has made of a frame, before that is labelled and learnt from
    """

    def __init__(
        self, camera: Camera, config: SegmentationConfig, rng: np.random.Generator, refiner: Refiner | None = None
    ):
        self.name = "builtin" if refiner is None else refiner.name
        self.camera, self.config, self._rng, self._refiner = camera, config, rng, refiner
        self._focal_px = np.array([camera.fx, camera.fy])
        self._targets: dict[str, _Target] = {}
        self._previous: Frame | None = None
        self._frames = 0

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
        found: dict[str, _Found] = {}
        taken = np.logical_or.reduce([np.zeros(frame.shape, bool), *masks.values()])
        new = [p for p in said.values() if p.mask is None and p.name not in self._targets]
        self._frames += 1
        in_turn = {name for turn, name in enumerate(self._targets) if (self._frames - turn) % _TURNS == 0}

        def hint(name: str) -> Hint:
            return (hints or {}).get(name) or Hint()

        def absent(name: str) -> bool:
            """An object that is looked for is not one of those in view."""
            target = self._targets.get(name, _Target())
            if name in masks or target.given is not None:
                return False
            return target.seen is None or (self._cuts(target, name in in_turn) and hint(name).sighted)

        for name in sorted(dict.fromkeys([*self._targets, *said]), key=absent):
            target = self._targets.get(name, _Target())
            if name in masks:
                given = (frame, masks[name]) if masks[name].any() else target.given
                self._targets[name] = replace(target, seen=None, given=given)
                continue
            target = self._targets[name] = self._learnt(target)
            if name in said:
                others_px = np.concatenate([_NO_PX, *(p.points_px for n, p in said.items() if n != name)])
                cutter = Cutter(frame, self.camera, self.config, self._rng, said[name], others_px)
                found[name] = self._prompted(cutter, target, hint(name), taken)
                self._targets[name] = _Target()  # its colours and its size are learnt anew
            else:
                moved = None if target.seen is None else self._moved(frame, target)
                if moved is not None and not (self._cuts(target, name in in_turn) or moved.doubtful):
                    found[name] = moved.patch.box, moved.patch.up(moved.prior)
                else:
                    self._targets[name], found[name] = self._looked_for(frame, target, hint(name), taken, moved)
            if found[name] is not None:
                box, x = found[name]
                taken[box.slices] |= x > 0.5
        found |= self._refined(frame, said, found, hints or {})
        labels = self._shared_out(frame, found)
        for label, name in enumerate(self._targets, 1):
            if name in masks:
                labels[masks[name]] = label
        label_of = {name: label for label, name in enumerate(self._targets, 1)}
        for prompt in new:
            others = {name: labels == label for name, label in label_of.items() if name != prompt.name}
            cutter = Cutter(frame, self.camera, self.config, np.random.default_rng(0), prompt, _NO_PX)
            doubt_start(cutter, labels == label_of[prompt.name], others)
        self._previous = frame
        return labels

    def _refined(
        self, frame: Frame, said: Mapping[str, Prompt], found: Mapping[str, _Found], hints: Mapping[str, Hint]
    ) -> dict[str, _Found]:
        """What the refiner makes of what was found, where it has something to say."""
        if self._refiner is None:
            return {}
        masks = {name: np.zeros(frame.shape, bool) for name in found}
        for name, claim in found.items():
            if claim is not None:
                masks[name][claim[0].slices] = claim[1] > 0.5
        prompts = {name: prompt for name, prompt in said.items() if prompt.mask is None}
        refined = self._refiner.refine(frame, prompts, masks, hints)
        whole = Box(0, 0, *frame.shape[::-1])
        return {name: (whole, mask.astype(np.float32)) for name, mask in refined.items()}

    def _learnt(self, target: _Target) -> _Target:
        """What is known of an object with what the mask that was given of it tells."""
        if target.given is None:
            return target
        frame, mask = target.given
        target = self._updated(frame, target, _seen(frame, mask, self.config.min_px, Box(0, 0, *mask.shape[::-1])))
        return replace(target, given=None, seen=target.seen if frame is self._previous else None)

    def _prompted(self, cutter: Cutter, target: _Target, hint: Hint, taken: np.ndarray) -> _Found:
        """By what is said of it, and for a correction by where it would have been taken for."""
        frame, prompt = cutter.frame, cutter.prompt
        was = np.zeros(frame.shape, bool)
        moved = None if target.seen is None else self._moved(frame, target)
        found = None if prompt.box_px is not None else self._looked_for(frame, target, hint, taken, moved)[1]
        if found is not None:
            was[found[0].slices] = found[1] > 0.5
        if was.any():
            return cutter.correct(was, hint.uv_px)
        return cutter.start() if prompt.starts else None

    def _looked_for(
        self, frame: Frame, target: _Target, hint: Hint, taken: np.ndarray, moved: _Moved | None
    ) -> tuple[_Target, _Found]:
        """Where an object is, outside what is ``taken`` (H, W) bool where it was absent; and it, with its past."""
        agreed = hint.T_cam_obj is not None and len(hint.uv_px) >= self.config.find_points
        target = replace(target, sure=agreed)
        if hint.gone:
            return target, None
        if moved is None or hint.sighted:  # what has been followed is not where the object was found
            return target, self._find(frame, target, hint, taken)
        if not (target.sure and target.past.due(frame)):
            return target, self._follow(frame, target, hint, moved)
        target = self._with_room(frame, target, hint)
        found = self._follow(frame, target, hint, moved)
        return replace(target, past=target.past.with_frame(frame, hint.T_cam_obj)), found

    def remove(self, name: str) -> None:
        """Forget an object."""
        del self._targets[name]

    def _shared_out(self, frame: Frame, found: Mapping[str, _Found]) -> np.ndarray:
        """The label image of what was found of every object."""
        labels, best = np.zeros(frame.shape, np.int32), np.zeros(frame.shape, np.float32)
        for label, name in enumerate(self._targets, 1):
            if found.get(name) is not None:
                box, x = found[name]
                part, likeliest = labels[box.slices], best[box.slices]
                wins = x > np.maximum(likeliest, 0.5)
                part[wins], likeliest[wins] = label, x[wins]
        for label, (name, target) in enumerate(self._targets.items(), 1):
            if found.get(name) is None:
                self._targets[name] = replace(target, seen=None) if name in found else target
                continue
            box = found[name][0]
            part = labels[box.slices]
            mask = part == label
            seen = _seen(frame, mask, self.config.min_px, box, None if target.seen is None else target.seen.z_m)
            self._targets[name] = self._updated(frame, target, seen)
            if seen is None:
                part[mask] = 0
        return labels

    def _moved(self, frame: Frame, target: _Target) -> _Moved:
        """What was seen of an object a frame ago, moved by the optical flow."""
        seen, px_m = target.seen, self._focal_px / target.seen.z_m
        # Room for all of it to either side of what showed.
        half = np.maximum(target.size_m / 2, target.room_m) * px_m * (1 + self.config.margin) + ROOM_PX
        patch = Patch.of(frame, around(seen.centre_px, half, frame.shape), self.camera, self.config)
        before = Patch.like(self._previous, patch.box, patch.cell_px, self.camera)
        image = np.zeros(frame.shape, np.float32)
        image[seen.box.slices] = seen.mask
        was = before.down(image)
        prior, z_before = warped(was, before, patch)
        likely, measured, known = prior > 0.5, patch.depth_m > 0, z_before > 0
        jumped = likely & measured & known & (np.abs(patch.depth_m - z_before) > patch.step_m)
        shown = likely & measured & ~known
        area, blind = np.count_nonzero(likely), np.count_nonzero(likely & ~measured) + np.count_nonzero(shown)
        changed = abs(area - np.count_nonzero(was > 0.5)) > _CHANGED * area
        doubtful = changed or np.count_nonzero(jumped) > _JUMPED * area or blind > _BLIND * area
        return _Moved(patch, prior, jumped, shown, doubtful)

    def _follow(self, frame: Frame, target: _Target, hint: Hint, moved: _Moved) -> tuple[Box, np.ndarray]:
        """From where it was a frame ago."""
        cfg, patch, prior, jumped = self.config, moved.patch, moved.prior, moved.jumped
        core = (prior > 0.8) & ~(jumped | moved.shown)
        if not (core & (patch.depth_m > 0)).any():
            core |= moved.shown & (np.abs(patch.depth_m - target.seen.z_m) < _APART_M)
        plane = support_plane(patch, (patch.depth_m > 0) & (prior < 0.2), self._rng)
        motions = target.past.motions(frame, hint.T_cam_obj) if target.sure else None
        log_odds, component = by_geometry(patch, core, plane, cfg, motions)
        stays = cfg.prior_weight * np.where(jumped | moved.shown, 0, 2 * prior - 1)
        stays[patch.depth_m == 0] /= 2  # where nothing is measured, colours have as much to say
        # Parts that come into view are connected with those that were seen before.
        log_odds += np.where(component, np.maximum(stays, 0), stays)
        log_odds[jumped] -= cfg.geometry_weight
        log_odds += by_colour(patch, target.colours, (prior < 0.2) & ~component, cfg) + by_surface(patch, hint, cfg)
        x = only(cut(patch, log_odds, start=prior), core)
        beside = dilated((x > 0.5) & (patch.depth_m > 0), 1)
        return patch.box, patch.up(np.where((patch.depth_m > 0) | (prior > 0.5) | beside, x, 0))

    @staticmethod
    def _cuts(target: _Target, in_turn: bool) -> bool:
        """Whether an object that was seen is cut out anew, whatever its flow says."""
        return in_turn or not target.sure

    def _with_room(self, frame: Frame, target: _Target, hint: Hint) -> _Target:
        """An object with room for parts that move with it, which may reach farther than all that it has shown."""
        cfg, px_m = self.config, self._focal_px / target.seen.z_m
        patch = Patch.of(frame, around(hint.uv_px.mean(0), cfg.reach_m * px_m, frame.shape), self.camera, cfg)
        motions = target.past.motions(frame, hint.T_cam_obj)
        if motions is None or not scene_stays(patch, motions):
            return target
        plane = support_plane(patch, patch.depth_m > 0, self._rng)
        _, component = by_geometry(patch, patch.dots(hint.uv_px, 0), plane, cfg, motions)
        if not component.any():
            return target
        away_px = np.abs(patch.ends_px(component) - target.seen.centre_px).max(0)
        return replace(target, room_m=away_px / px_m)

    def _find(self, frame: Frame, target: _Target, hint: Hint, taken: np.ndarray) -> _Found:
        """Where enough of its points are back, or it is expected, on nothing ``taken`` (H, W) by another object."""
        cfg, uv_px = self.config, hint.uv_px[~in_mask(hint.uv_px, taken)]
        if target.colours is None:
            return None
        expected = len(uv_px) < cfg.find_points and hint.place is not None
        if expected:
            uv_px = self._expected(frame, target, hint.place, taken)
        if len(uv_px) < cfg.find_points:
            return None
        z_m = float(np.nanmedian(depths_at(uv_px, frame)))
        low, high = uv_px.min(0), uv_px.max(0)
        half = np.maximum(target.size_m * self._focal_px / z_m * (0.5 + cfg.margin), high - low) + ROOM_PX
        patch = Patch.of(frame, around((low + high) / 2, half, frame.shape), self.camera, cfg)
        barred = patch.down(taken.astype(np.float32)) > 0.5
        seeds = patch.dots(uv_px, 0 if expected else 1) & (patch.depth_m > 0) & ~barred
        surface = by_surface(patch, hint, cfg)
        outside = ~dilated(seeds | (surface > 0), 3)
        plane = support_plane(patch, (patch.depth_m > 0) & outside, self._rng)
        log_odds, component = by_geometry(patch, seeds, plane, cfg)
        colour = by_colour(patch, target.colours, outside & ~component, cfg)
        background = (patch.border() | barred) & ~seeds
        x = only(cut(patch, log_odds + surface + colour, seeds=seeds, background=background), seeds)
        own_colours = colour[x > 0.5]
        return (patch.box, patch.up(x)) if len(own_colours) and (hint.sighted or own_colours.mean() > 0) else None

    def _expected(self, frame: Frame, target: _Target, place: np.ndarray, taken: np.ndarray) -> np.ndarray:
        """(N, 2) pixels of what shows an object's colours near the place of a hint, and nothing beside that does."""
        middle_m, within_m = place[:3], target.size_m.max() / 2 + place[3]
        (middle_px,) = self.camera.project(middle_m[None])
        if not self.camera.inside(middle_px, -0.5):
            return _NO_PX
        half = within_m * self._focal_px / middle_m[2] + ROOM_PX
        patch = Patch.like(frame, around(middle_px, half, frame.shape), 1, self.camera)
        measured = patch.depth_m > 0
        near = measured & (patch.squared_distances_m2(middle_m) < within_m**2)
        if np.count_nonzero(near) < _ENOUGH_PX:
            return _NO_PX
        colour = by_colour(patch, target.colours, measured & ~near, self.config)
        plane, free = support_plane(patch, measured, self._rng), patch.smooth
        if plane is not None:
            free = free & (plane_heights(patch, plane) > of_plane_m(patch.sigma_m))
        # What hangs together with another object is of that one, whatever its mask has left out.
        like = near & (colour > 0) & free & ~holding(parts_of(free), taken[patch.box.slices])
        part = np.where(like, parts_of(dilated(like, 1)), 0)
        size = np.bincount(part.ravel())
        told = np.bincount(part.ravel(), colour.ravel()) / np.maximum(size, 1)
        size[(told < _TOLD) | (size < _ENOUGH_PX)], size[0] = 0, 0
        if not size.any():
            return _NO_PX
        v, u = np.nonzero(part == size.argmax())
        return np.stack([u + patch.box.left, v + patch.box.top], -1).astype(float)

    def _updated(self, frame: Frame, target: _Target, seen: _Seen | None) -> _Target:
        """What is known of an object after a frame."""
        if seen is None:
            return replace(target, seen=None)
        size_m = np.array(seen.mask.shape[::-1]) * seen.z_m / self._focal_px
        some = np.s_[:: 1 + max(seen.mask.shape) // self.config.side_px,] * 2
        colours = histogram(colour_codes(frame.rgb[seen.box.slices][some][seen.mask[some]]))
        if target.colours is None:
            return replace(target, seen=seen, colours=colours, size_m=size_m)
        rate = self.config.colour_rate
        colours = (1 - rate) * target.colours + rate * colours
        return replace(target, seen=seen, colours=colours, size_m=np.maximum(size_m, target.size_m))


def _seen(frame: Frame, mask: np.ndarray, min_px: int, box: Box, z_m: float | None = None) -> _Seen | None:
    """Where a mask (rows, columns) of a box lies; None where it is small.

    z_m  its depth where nothing of it is measured: it is nowhere where that is not known either
    """
    if np.count_nonzero(mask) < min_px:
        return None
    inner = rows, columns = bounds(mask)
    box = Box(box.left + columns.start, box.top + rows.start, box.left + columns.stop, box.top + rows.stop)
    mask, depth_m = mask[inner], frame.depth_m[box.slices]
    measured = mask & (depth_m > 0)
    z_m = middle(depth_m[measured]) if np.count_nonzero(measured) >= min_px else z_m
    return None if z_m is None else _Seen(box, mask, z_m)
