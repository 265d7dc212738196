"""Which pixels belong to which object (input of the paper: "a segmentation mask of each object").

A segmenter takes a few clicks on each object in some frame and labels every frame from there on, causally.
The built-in one has no learned weights. It sums per-pixel foreground log-odds of colour, depth, geometry, the mask of
the frame before and what the rest of the pipeline knows, and cuts along edges by a random walker
(:mod:`p2p_lib.segmenters.builtin.random_walk`). Depth is often missing along silhouettes: there colours decide, and
only next to measured pixels.

This module is the order of the stages in a frame; the package's docstring says where each is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt, check_depth, check_prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.bystanders import with_bystanders
from p2p_lib.segmenters.builtin.finding import find, near_last
from p2p_lib.segmenters.builtin.following import FlowPrediction, follow, holds, predict, with_room
from p2p_lib.segmenters.builtin.patch import Box
from p2p_lib.segmenters.builtin.prompted import NO_PX, Cutter, Effect
from p2p_lib.segmenters.builtin.start_doubts import doubt_nothing, doubt_prompt
from p2p_lib.segmenters.builtin.target import Target, seen_in
from p2p_lib.segmenters.builtin.view import Claim, View

if TYPE_CHECKING:
    from p2p_lib.segmenters.sam2 import Sam2Refiner

#: An object with a confident pose is cut out in every third frame, in turns, and moved by the optical flow in between.
_TURNS = 3
_NO_HINT = Hint()
#: Objects are beside each other whose boxes are so near, px.
_BESIDE_PX = 12


class BuiltinSegmenter:
    """The segmenter without learned weights. Implements :class:`p2p_lib.core.interfaces.Segmenter`.

    refiner  may replace an object's mask in a frame, before it is labelled and learnt from
    doubts   of objects that a prompt of the newest frame has started or corrected: what is doubtful about their masks
    """

    def __init__(self, camera: Camera, config: SegmentationConfig, refiner: Sam2Refiner | None = None):
        self.name = "builtin" if refiner is None else refiner.name
        self.camera, self.config, self._refiner = camera, config, refiner
        self._targets: dict[str, Target] = {}
        self._previous: Frame | None = None
        self._frames = 0
        self.doubts: dict[str, str] = {}
        self._effects: dict[str, Effect] = {}  # of the newest frame's prompts on their objects' masks

    @property
    def names(self) -> tuple[str, ...]:
        """The objects, in the order in which they were added."""
        return tuple(self._targets)

    def remove(self, name: str) -> None:
        """Forget an object."""
        del self._targets[name]
        self.doubts.pop(name, None)

    def segment(
        self,
        frame: Frame,
        prompts: Iterable[Prompt] = (),
        hints: Mapping[str, Hint] | None = None,
    ) -> np.ndarray:
        """One frame in, one (H, W) label image out; a pixel that two objects claim goes to the likelier one."""
        prompt_of, hints = {prompt.name: prompt for prompt in prompts}, hints or {}
        _check(frame, prompt_of, self.camera)
        self._frames += 1
        view = View(frame, self._previous, self.camera, self.config)
        cutters = {name: _cutter(view, prompt, prompt_of) for name, prompt in prompt_of.items() if prompt.mask is None}
        self.doubts, self._effects = {}, {}
        masks = {name: prompt.mask for name, prompt in prompt_of.items() if prompt.mask is not None}
        due, claims = self._due(), {}
        taken = np.logical_or.reduce([np.zeros(frame.shape, bool), *masks.values()])
        for name in self._absent_last(prompt_of, hints, due):
            if name in masks:
                self._targets[name] = self._targets.get(name, Target()).with_given(frame, masks[name])
            else:
                asked = cutters.get(name), hints, taken, name in due
                self._targets[name], claims[name] = self._locate(view, name, *asked)
                _mark(taken, claims[name])
        claims |= self._refined(frame, prompt_of, claims, hints)
        labels = self._assign(view, claims)
        _label_given(labels, self.names, masks)
        self.doubts |= self._doubts(labels, cutters)
        self._previous = frame
        return labels

    def _due(self) -> set[str]:
        """The objects whose turn it is to be cut out anew."""
        return {name for turn, name in enumerate(self._targets) if (self._frames - turn) % _TURNS == 0}

    def _absent_last(self, prompt_of: Mapping[str, Prompt], hints: Mapping[str, Hint], due: set[str]) -> list[str]:
        """The order in which objects are located: absent ones last, so that none is found on an object in view."""
        names = dict.fromkeys([*self._targets, *prompt_of])
        absent = {}
        for name in names:
            target = self._targets.get(name, Target())
            given = (name in prompt_of and prompt_of[name].mask is not None) or target.given is not None
            cuts = self._cuts(target, name in due)
            absent[name] = not given and (target.seen is None or (cuts and hints.get(name, _NO_HINT).sighted))
        return sorted(names, key=absent.__getitem__)

    def _locate(
        self,
        view: View,
        name: str,
        cutter: Cutter | None,
        hints: Mapping[str, Hint],
        taken: np.ndarray,
        due: bool,
    ) -> tuple[Target, Claim]:
        """Locate one object outside what is ``taken`` (H, W) bool; the updated target and its probability map."""
        target = self._targets.get(name, Target()).with_learnt(view.previous, view.focal_px, view.config)
        if cutter is not None:
            return self._segment_prompt(view, cutter, target, hints, taken, due)
        return self._follow(view, name, target, hints, taken, due)

    def _follow(
        self, view: View, name: str, target: Target, hints: Mapping[str, Hint], taken: np.ndarray, due: bool
    ) -> tuple[Target, Claim]:
        """Move an object's mask by the optical flow where that is enough, else cut it out anew, or find it."""
        predicted = None if target.seen is None else predict(view, target)
        if predicted is not None and not (self._cuts(target, due) or predicted.doubtful):
            return target, predicted.claim
        return self._cut_out(view, name, target, hints, taken, predicted)

    def _beside(self, name: str, target: Target, hints: Mapping[str, Hint]) -> list[Hint]:
        """The hints of objects that were beside this one a frame ago, and of no others: hints cost."""
        assert target.seen is not None  # a frame ago
        box = target.seen.box
        seen = {other: its.seen for other, its in self._targets.items() if other != name and its.seen}
        return [hints.get(other, _NO_HINT) for other, at in seen.items() if at.box.near(box, _BESIDE_PX)]

    def _segment_prompt(
        self, view: View, cutter: Cutter, target: Target, hints: Mapping[str, Hint], taken: np.ndarray, due: bool
    ) -> tuple[Target, Claim]:
        """Segment from a prompt; clicks on an object that has a mask in this frame correct that mask.

        What selects nothing leaves an object the mask that it has.
        """
        had: tuple[Target, Claim]
        if (seen := target.seen) is not None and view.previous is view.frame:
            had = target, (seen.box, seen.mask.astype(np.float32))  # the same image once more: that mask is meant
        else:
            had = self._follow(view, cutter.prompt.name, target, hints, taken, due)
        was = np.zeros(view.frame.shape, bool)
        _mark(was, had[1])
        self._effects[cutter.prompt.name] = effect = cutter.effect(was)
        starts = cutter.prompt.starts
        if not (starts or was.any()):
            return target.anew(view.frame, was), None
        box, x = cutter.correct(was) if effect is Effect.MENDED else cutter.start()
        if starts and was.any() and seen_in(view.frame, x > 0.5, box, view.config.min_px) is None:
            self.doubts[cutter.prompt.name] = doubt_nothing(cutter, "It keeps the mask that it had.")
            return had
        kept = np.zeros(view.frame.shape, bool)
        _mark(kept, (box, x))
        return target.anew(view.frame, was & ~kept & (effect is not Effect.BEGUN_ELSEWHERE)), (box, x)

    def _cut_out(
        self,
        view: View,
        name: str,
        target: Target,
        hints: Mapping[str, Hint],
        taken: np.ndarray,
        predicted: FlowPrediction | None,
    ) -> tuple[Target, Claim]:
        """Follow an object that was seen a frame ago, else find it outside what is ``taken`` (H, W) bool."""
        hint = hints.get(name, _NO_HINT)
        agreed = hint.T_cam_obj is not None and len(hint.uv_px) >= view.config.find_points
        held, target = target.confident, replace(target, confident=agreed)
        if target.bystanders is not None:
            beside = None if hint.place is None else target.bystanders.followed(view.frame)
            target = replace(target, bystanders=beside)
        if hint.gone:
            return target, None
        if predicted is None or hint.sighted:  # a sighting overrules the mask that was followed
            return replace(target, proven=agreed or hint.sighted), find(view, target, hint, taken)
        due = target.confident and target.past.due(view.frame)
        target = with_room(view, target, hint) if due else target
        claim = follow(view, target, hint, self._beside(name, target, hints), predicted)
        if agreed and claim is not None:
            if holds(claim, hint.uv_px):
                target = replace(target, proven=True)
            elif held or not target.proven:  # its points overrule the flow, or a find by colour
                claim = find(view, target, hint, taken) or claim
            else:
                target = replace(target, confident=False)
        if claim is None:  # too fast for the flow: look near its last place
            return target, find(view, target, near_last(view, target, hint), taken)
        if due and hint.T_cam_obj is not None:
            target = replace(target, past=target.past.with_frame(view.frame, hint.T_cam_obj))
        return target, claim

    def _refined(
        self,
        frame: Frame,
        prompt_of: Mapping[str, Prompt],
        claims: Mapping[str, Claim],
        hints: Mapping[str, Hint],
    ) -> dict[str, Claim]:
        """The refiner's claims, of the objects whose masks it replaces."""
        if self._refiner is None:
            return {}
        masks = {name: np.zeros(frame.shape, bool) for name in claims}
        for name, claim in claims.items():
            _mark(masks[name], claim)
        prompts = {name: prompt for name, prompt in prompt_of.items() if prompt.mask is None}
        mended = [name for name, effect in self._effects.items() if effect is Effect.MENDED]
        refined, whole = self._refiner.refine(frame, prompts, masks, hints, mended), Box(0, 0, *frame.shape[::-1])
        return {name: (whole, mask.astype(np.float32)) for name, mask in refined.items()}

    @staticmethod
    def _cuts(target: Target, due: bool) -> bool:
        """Whether an object that was seen is cut out anew even where its flow is not doubtful."""
        return due or not target.confident

    def _assign(self, view: View, claims: Mapping[str, Claim]) -> np.ndarray:
        """The label image of all claims; every target is updated by the pixels that it has won."""
        frame, cfg = view.frame, view.config
        labels, best = np.zeros(frame.shape, np.int32), np.zeros(frame.shape, np.float32)
        for label, name in enumerate(self._targets, 1):
            if (claim := claims.get(name)) is not None:
                box, x = claim
                part, likeliest = labels[box.slices], best[box.slices]
                wins = x > np.maximum(likeliest, 0.5)
                part[wins], likeliest[wins] = label, x[wins]
        for label, (name, target) in enumerate(self._targets.items(), 1):
            if name not in claims:
                continue
            seen = None
            if (claim := claims[name]) is not None:
                box, _ = claim
                part = labels[box.slices]
                mask = part == label
                seen = seen_in(frame, mask, box, cfg.min_px, None if target.seen is None else target.seen.z_m)
                if seen is None:
                    part[mask] = 0
            target = target if seen is not None else with_bystanders(view, target)
            self._targets[name] = target.with_seen(frame, seen, view.focal_px, cfg)
        return labels

    def _doubts(self, labels: np.ndarray, cutters: Mapping[str, Cutter]) -> dict[str, str]:
        """Warn if a prompt has selected nothing, may have selected something else, or was not followed."""
        masks = {name: labels == label for label, name in enumerate(self._targets, 1)}
        said = {}
        for name, cutter in cutters.items():
            if name in self.doubts:  # it has selected nothing: the mask is not of it
                continue
            others = {other: mask for other, mask in masks.items() if other != name}
            said[name] = doubt_prompt(cutter, masks[name], others, self._effects[name])
        return {name: text for name, text in said.items() if text}


def _cutter(view: View, prompt: Prompt, prompt_of: Mapping[str, Prompt]) -> Cutter:
    """The cutter of a prompt's object; the clicks on other objects in ``prompt_of`` count as background."""
    others_px = np.concatenate([NO_PX, *(p.points_px for name, p in prompt_of.items() if name != prompt.name)])
    return Cutter(view.frame, view.camera, view.config, prompt, others_px)


def _check(frame: Frame, prompt_of: Mapping[str, Prompt], camera: Camera) -> None:
    """Refuse clicks and boxes outside the image or without depth, before anything changes."""
    for prompt in (p for p in prompt_of.values() if p.mask is None):
        check_prompt(prompt, camera)
        check_depth(prompt, frame)


def _mark(taken: np.ndarray, claim: Claim) -> None:
    """Mark in ``taken`` (H, W) bool the pixels of a claim with a probability above a half."""
    if claim is not None:
        box, x = claim
        taken[box.slices] |= x > 0.5


def _label_given(labels: np.ndarray, names: Iterable[str], masks: Mapping[str, np.ndarray]) -> None:
    """Label the masks that were given as they are."""
    for label, name in enumerate(names, 1):
        if name in masks:
            labels[masks[name]] = label
