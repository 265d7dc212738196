"""Follow an object that was seen a frame ago: move its mask by the optical flow, then cut it out anew."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core.image import in_mask
from p2p_lib.core.interfaces import Hint
from p2p_lib.segmenters.builtin.cut import by_colour, by_denial, by_geometry, by_surface, cut, strange, warped
from p2p_lib.segmenters.builtin.motion import free_before, scene_stays
from p2p_lib.segmenters.builtin.patch import Box, Patch, around, dilated, keep_seeded_components, support_plane
from p2p_lib.segmenters.builtin.prompted import ROOM_PX
from p2p_lib.segmenters.builtin.target import Target
from p2p_lib.segmenters.builtin.view import Claim, View

#: The flow is doubted if more of the mask jumped in depth, its area changed by more, or more of it lacks depth.
_MAX_JUMPED, _MAX_AREA_CHANGE, _MAX_UNMEASURED = 0.03, 0.1, 0.25
#: What has colours with lower log-odds than minus this looks like something else, as a hand that holds the object.
_OTHER = 1.0
#: Depth that returns after none of the object's was measured is its own within this distance of its last, m.
_REAPPEARS_WITHIN_M = 0.1


@dataclass(frozen=True, eq=False)
class FlowPrediction:
    """An object's mask of a frame ago, moved by the optical flow: on a patch of this frame, its probability (h, w).

    jumped    (h, w) bool: its depth changed, so that something else has come before it or it has gone
    shown     (h, w) bool: it has depth now and had none, of the object or of what has come before it
    beside    (h, w) bool: it was seen a frame ago, too, at the same depth and not in the mask
    left      whether the depth of most of it grew: it has not been covered but has left
    doubtful  whether the flow alone says too little
    """

    patch: Patch
    prior: np.ndarray
    jumped: np.ndarray
    shown: np.ndarray
    beside: np.ndarray
    left: bool
    doubtful: bool

    @property
    def claim(self) -> Claim:
        """The mask as the flow moved it."""
        return self.patch.box, self.patch.up(self.prior)


def predict(view: View, target: Target) -> FlowPrediction:
    """Move the mask of an object that was seen a frame ago by the optical flow."""
    frame, cfg, seen = view.frame, view.config, target.seen
    assert seen is not None and target.size_m is not None and view.previous is not None  # a frame ago
    px_per_m = view.focal_px / seen.z_m
    # Room for its full size, also where only a part of it showed.
    half = np.maximum(target.size_m / 2, target.room_m) * px_per_m * (1 + cfg.margin) + ROOM_PX
    patch = Patch.of(frame, around(seen.centre_px, half, frame.shape), view.camera, cfg)
    before = Patch.like(view.previous, patch.box, patch.cell_px, view.camera)
    image = np.zeros(frame.shape, np.float32)
    image[seen.box.slices] = seen.mask
    was = before.down(image)
    prior, z_before = warped(was, before, patch)
    likely, measured, known = prior > 0.5, patch.depth_m > 0, z_before > 0
    steps = np.abs(patch.depth_m - z_before) > patch.step_m
    jumped, beside = likely & measured & known & steps, ~likely & measured & known & ~steps
    shown = likely & measured & ~known
    area, blind = np.count_nonzero(likely), np.count_nonzero(likely & ~measured) + np.count_nonzero(shown)
    changed = abs(area - np.count_nonzero(was > 0.5)) > _MAX_AREA_CHANGE * area
    doubtful = changed or np.count_nonzero(jumped) > _MAX_JUMPED * area or blind > _MAX_UNMEASURED * area
    left = np.count_nonzero(jumped & (patch.depth_m > z_before)) > area / 2
    return FlowPrediction(patch, prior, jumped, shown, beside, bool(left), bool(doubtful))


def follow(view: View, target: Target, hint: Hint, others: Sequence[Hint], predicted: FlowPrediction) -> Claim:
    """Cut the object out around its predicted mask.

    None if it has left: what shows there lies behind it, or has the surroundings' colours without its points.
    """
    cfg, patch, prior = view.config, predicted.patch, predicted.prior
    assert target.seen is not None and target.colours is not None  # a frame ago
    T_cam_obj = hint.T_cam_obj if target.confident else None
    motions = None if T_cam_obj is None else target.past.motions(view.frame, T_cam_obj)
    surface, free = by_surface(patch, hint, cfg, others), np.zeros(patch.shape, bool)
    if motions is not None and holds((patch.box, patch.up(prior)), hint.uv_px):
        free = free_before(patch, motions) & (surface <= 0)
    foreign = predicted.jumped | free
    core = (prior > 0.8) & ~(foreign | predicted.shown)
    if not (core & (patch.depth_m > 0)).any():
        core |= predicted.shown & (np.abs(patch.depth_m - target.seen.z_m) < _REAPPEARS_WITHIN_M)
    plane = support_plane(patch, (patch.depth_m > 0) & (prior < 0.2))
    known = T_cam_obj is not None and target.past.full
    beside = predicted.beside & (surface <= 0) if known else None
    # Against what was beside it a frame ago: a side that comes into view may have colours that it has not shown yet.
    colour = by_colour(patch, target.colours, predicted.beside & (prior < 0.2), cfg)
    denied = by_denial(patch, target.colours, target.denied, cfg)
    other = (surface <= 0) & (np.minimum(colour, denied) < -_OTHER * cfg.colour_weight)
    log_odds, component = by_geometry(patch, core, plane, cfg, motions, beside, free, other)
    stays = cfg.prior_weight * np.where(foreign | predicted.shown, 0, 2 * prior - 1)
    stays[patch.depth_m == 0] /= 2  # where nothing is measured, colours shall count as much
    # Parts that come into view are connected with those that were seen before.
    log_odds += np.where(component, np.maximum(stays, 0), stays)
    log_odds[foreign] -= cfg.geometry_weight
    log_odds += by_colour(patch, target.colours, (prior < 0.2) & (~component | predicted.beside), cfg) + surface
    log_odds += denied
    x = keep_seeded_components(cut(patch, log_odds, start=prior), core)
    adjacent = dilated((x > 0.5) & (patch.depth_m > 0), 1)
    x = np.where((patch.depth_m > 0) | (prior > 0.5) | adjacent, x, 0)
    claim = patch.box, patch.up(x)
    if predicted.left and not (x > 0.5).any():
        return None
    # Exposure changes colours: points that agree overrule them.
    confirmed = target.confident and holds(claim, hint.uv_px)
    return claim if confirmed or not strange(patch, x > 0.5, target.colours) else None


def holds(claim: tuple[Box, np.ndarray], uv_px: np.ndarray) -> bool:
    """Whether most of an object's own points uv_px (N, 2) lie on its claim."""
    box, x = claim
    return bool(2 * in_mask(uv_px - [box.left, box.top], x > 0.5).sum() > len(uv_px))


def with_room(view: View, target: Target, hint: Hint) -> Target:
    """The target with room for parts that move with it, which may reach farther than what it has shown so far."""
    assert target.seen is not None and hint.T_cam_obj is not None  # it was seen a frame ago, and points agree
    cfg, px_per_m = view.config, view.focal_px / target.seen.z_m
    patch = Patch.of(view.frame, around(hint.uv_px.mean(0), cfg.reach_m * px_per_m, view.frame.shape), view.camera, cfg)
    motions = target.past.motions(view.frame, hint.T_cam_obj)
    if motions is None or not scene_stays(patch, motions):
        return target
    plane = support_plane(patch, patch.depth_m > 0)
    free = free_before(patch, motions)
    _, component = by_geometry(patch, patch.dots(hint.uv_px, 0), plane, cfg, motions, free=free)
    if not component.any():
        return target
    away_px = np.abs(patch.ends_px(component) - target.seen.centre_px).max(0)
    return replace(target, room_m=away_px / px_per_m)
