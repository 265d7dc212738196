"""Find an object that was absent, where its tracked points are back, or by its colours where its motion leads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from p2p_lib.core.depth import depths_at
from p2p_lib.core.image import in_mask
from p2p_lib.core.interfaces import Hint
from p2p_lib.segmenters.builtin.cut import by_colour, by_geometry, by_surface, cut, standing_out
from p2p_lib.segmenters.builtin.patch import (
    Patch,
    around,
    components_touching,
    connected_components,
    dilated,
    keep_seeded_components,
    support_plane,
)
from p2p_lib.segmenters.builtin.prompted import NO_PX, ROOM_PX
from p2p_lib.segmenters.builtin.target import Target
from p2p_lib.segmenters.builtin.view import Claim, View

#: The expected object has at least this many pixels, with mean log-odds of colour (nats) of at least this.
_MIN_COMPONENT_PX, _MIN_LIKELIER = 80, 1.0
#: An object may move this far from one frame to the next, m.
_LEAP_M = 0.15


def find(view: View, target: Target, hint: Hint, taken: np.ndarray) -> Claim:
    """Find a target where enough of its points are back or it is expected, outside ``taken`` (H, W) bool."""
    frame, cfg, uv_px = view.frame, view.config, hint.uv_px[~in_mask(hint.uv_px, taken)]
    if target.colours is None or target.size_m is None:
        return None
    expected = len(uv_px) < cfg.find_points and hint.place is not None
    if expected and hint.place is not None:
        uv_px = _coloured_px(view, target, hint.place, taken)
    if len(uv_px) < cfg.find_points:
        return None
    z_m = float(np.nanmedian(depths_at(uv_px, frame)))
    low, high = uv_px.min(0), uv_px.max(0)
    half = np.maximum(target.size_m * view.focal_px / z_m * (0.5 + cfg.margin), high - low) + ROOM_PX
    patch = Patch.of(frame, around((low + high) / 2, half, frame.shape), view.camera, cfg)
    barred = patch.down(taken.astype(np.float32)) > 0.5
    seeds = patch.dots(uv_px, 0 if expected else 1) & (patch.depth_m > 0) & ~barred
    surface = by_surface(patch, hint, cfg)
    outside = ~dilated(seeds | (surface > 0), 3)
    plane = support_plane(patch, (patch.depth_m > 0) & outside)
    log_odds, component = by_geometry(patch, seeds, plane, cfg)
    colour = by_colour(patch, target.colours, outside & ~component, cfg)
    background = (patch.border() | barred) & ~seeds
    x = keep_seeded_components(cut(patch, log_odds + surface + colour, seeds=seeds, background=background), seeds)
    own_colours = colour[x > 0.5]
    # Back in another light it has other colours; points that agree on its pose are on it all the same.
    sure = hint.sighted or (hint.T_cam_obj is not None and target.seen is None)
    return (patch.box, patch.up(x)) if len(own_colours) and (sure or own_colours.mean() > 0) else None


def near_last(view: View, target: Target, hint: Hint) -> Hint:
    """A hint that expects the object where it was seen last, unless the hint itself says where it is."""
    if hint.place is not None or len(hint.uv_px) >= view.config.find_points or target.seen is None:
        return hint
    centre_m = view.camera.unproject(target.seen.centre_px[None], np.array([target.seen.z_m]))[0]
    return replace(hint, place=np.append(centre_m, _LEAP_M))


def _coloured_px(view: View, target: Target, place: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """(N, 2) pixels near the place of a hint that show the object's colours; none where its surroundings do too."""
    assert target.colours is not None and target.size_m is not None  # else nobody looks for it
    frame, centre_m, within_m = view.frame, place[:3], target.size_m.max() / 2 + place[3]
    (centre_px,) = view.camera.project(centre_m[None])
    if not view.camera.inside(centre_px, -0.5):
        return NO_PX
    half = within_m * view.focal_px / centre_m[2] + ROOM_PX
    patch = Patch.like(frame, around(centre_px, half, frame.shape), 1, view.camera)
    measured = patch.depth_m > 0
    near = measured & (patch.squared_distances_m2(centre_m) < within_m**2)
    if np.count_nonzero(near) < _MIN_COMPONENT_PX:
        return NO_PX
    colour = by_colour(patch, target.colours, measured & ~near, view.config)
    free = standing_out(patch, measured)
    # What depth connects with another object belongs to that one, even outside its mask.
    like = near & (colour > 0) & free & ~components_touching(connected_components(free), taken[patch.box.slices])
    component = np.where(like, connected_components(dilated(like, 1)), 0)
    size = np.bincount(component.ravel())
    likelier = np.bincount(component.ravel(), colour.ravel()) / np.maximum(size, 1)
    size[(likelier < _MIN_LIKELIER) | (size < _MIN_COMPONENT_PX)], size[0] = 0, 0
    if target.bystanders is not None:
        size[target.bystanders.are(patch, component)] = 0
    if not size.any():
        return NO_PX
    v, u = np.nonzero(component == size.argmax())
    return np.stack([u + patch.box.left, v + patch.box.top], -1).astype(float)
