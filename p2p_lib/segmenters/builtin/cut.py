"""Per-pixel foreground log-odds on a patch's grid, and the cut that they lead to.

Log-odds of different evidence add up; they are positive for the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.interfaces import Hint
from p2p_lib.segmenters.builtin import random_walk
from p2p_lib.segmenters.builtin.colours import evidence, histogram
from p2p_lib.segmenters.builtin.motion import Motions, parts_that_follow
from p2p_lib.segmenters.builtin.patch import (
    Patch,
    approximate_median,
    components_touching,
    connected_components,
    dilated,
    plane_heights,
    support_plane,
)

#: Weight of a pixel's evidence at certainty; a tie to a neighbour that is alike weighs 1.
_EVIDENCE = 0.06
#: Where the outline is sharp: log-odds that weigh as much as such a tie, and the weight of what is certain.
_TIE, _CERTAIN = 10.0, 50.0
#: A mask whose colours have lower mean log-odds than this is not the object.
_STRANGE = -1.0
#: Points measured this near to the reconstructed surface are on it; those twice as far in front of it are not.
_ON_SURFACE_M = 0.008
#: What was beside the object a frame ago by this share of it, is: flow moves a mask's outline by a cell or two.
_MOST = 0.8
#: Height in standard deviations of depth at which something stands out of its support.
_STANDS_OUT = 2.0
#: Points up to this height above the plane, besides noise, belong to it: its fit is no better.
_PLANE_SLACK_M = 0.003
#: Least side of an image whose optical flow is taken, px.
_SMALLEST_FLOW = 32
#: What OpenCV's type stubs do not know to be optional.
_NOTHING: Any = None


def max_plane_height_m(sigma_m: np.ndarray | float) -> np.ndarray | float:
    """Height below which a pixel measured with this noise counts as plane."""
    return (_STANDS_OUT + 0.5) * sigma_m + _PLANE_SLACK_M


def standing_out(patch: Patch, where: np.ndarray) -> np.ndarray:
    """(h, w) bool: smooth cells above the plane that those ``where`` (h, w) bool stand on; all smooth ones without."""
    plane = support_plane(patch, where)
    if plane is None:
        return patch.smooth
    return patch.smooth & (plane_heights(patch, plane) > max_plane_height_m(patch.sigma_m))


def by_geometry(
    patch: Patch,
    seeds: np.ndarray,
    plane: np.ndarray | None,
    config: SegmentationConfig,
    motions: Motions | None = None,
    beside: np.ndarray | None = None,
    free: np.ndarray | None = None,
    other: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Evidence that an object is connected in depth and is not what it stands on.

    seeds (h, w) bool lie on the object, ``plane`` (4,) may support it. Returns the log-odds (h, w) and the
    component (h, w) bool that is connected with the seeds, empty unless it looks like one object. Parts beside it
    that share its ``motions`` are added to it. What touches the seeds, but was seen a frame ago ``beside`` (h, w) bool
    the object, or was ``free`` (h, w) bool before, is not of it. What looks like something ``other`` (h, w) bool is
    connected with nothing else.
    """
    log_odds, nothing = np.zeros(patch.shape, np.float32), np.zeros(patch.shape, bool)
    measured = patch.depth_m > 0
    at = seeds & measured
    if not at.any():
        return log_odds, nothing
    from_seeds_m = np.abs(patch.depth_m - approximate_median(patch.depth_m[at]))
    log_odds[measured & (from_seeds_m > config.reach_m)] -= config.geometry_weight
    smooth = patch.smooth if free is None else patch.smooth & ~free
    if plane is not None:
        height, sigma_m = plane_heights(patch, plane), approximate_median(patch.sigma_m[at])
        above_m = approximate_median(height[at])
        if abs(above_m) < _STANDS_OUT * sigma_m:
            return log_odds, nothing  # flat: depth does not tell it from what it lies on
        if above_m > 0:
            low = height < min(above_m / 2, max_plane_height_m(sigma_m))
            log_odds[measured & low] -= config.geometry_weight
            smooth = smooth & ~low
    if other is None:
        part = connected_components(smooth)
    else:
        part, apart = connected_components(smooth & ~other), connected_components(smooth & other)
        part = np.where(apart > 0, apart + part.max(), part)
        seeds = seeds & ~other
    component = components_touching(part, seeds)
    if beside is not None:
        component &= ~_mostly(part, beside)
    if motions is not None:
        parts = parts_that_follow(patch, part, component, motions)
        component |= parts
        log_odds[parts] += config.geometry_weight
    # What is as low as the plane has its penalty already: colour can outweigh one.
    log_odds[measured & ~dilated(component, 1) & (smooth | ~patch.smooth)] -= config.geometry_weight
    if not patch.encloses(component):
        return log_odds, nothing  # it is more than this object
    log_odds[component] += config.geometry_weight
    return log_odds, component


def _mostly(part: np.ndarray, region: np.ndarray) -> np.ndarray:
    """(h, w) bool: the components that lie mostly in a region (h, w) bool."""
    return (np.bincount(part[region], minlength=part.max() + 1) > _MOST * np.bincount(part.ravel()))[part]


def by_colour(patch: Patch, own: np.ndarray, outside: np.ndarray, config: SegmentationConfig) -> np.ndarray:
    """(h, w) log-odds of colours: the object's ``own`` (4096,) shares against those of ``outside`` (h, w) bool."""
    return config.colour_weight * evidence(own, histogram(patch.codes[outside]))[patch.codes]


def by_denial(patch: Patch, own: np.ndarray, denied: np.ndarray | None, config: SegmentationConfig) -> np.ndarray:
    """(h, w) log-odds, 0 at most, of colours ``denied`` (4096,) that a user has taken from the mask; None: of none."""
    if denied is None:
        return np.zeros(patch.shape, np.float32)
    return config.colour_weight * np.minimum(evidence(own, denied), 0)[patch.codes]


def strange(patch: Patch, mask: np.ndarray, own: np.ndarray) -> bool:
    """Whether a mask (h, w) bool has the colours of the rest of the patch, not the object's ``own`` (4096,)."""
    if mask.all() or not mask.any():
        return False
    return bool(evidence(own, histogram(patch.codes[~mask]))[patch.codes[mask]].mean() < _STRANGE)


def by_surface(patch: Patch, hint: Hint, config: SegmentationConfig, others: Sequence[Hint] = ()) -> np.ndarray:
    """(h, w) log-odds for pixels on the object's reconstructed surface, and against those before it or far off.

    Against those on the surfaces of ``others`` alone, too. Only poses that can be trusted say what is not the object's.
    """
    on, off = np.zeros(patch.shape, bool), np.zeros(patch.shape, np.float32)
    if hint.distance_m is not None:
        distance_m = patch.nearest(hint.distance_m)
        on, off = np.abs(distance_m) < _ON_SURFACE_M, (distance_m > 2 * _ON_SURFACE_M).astype(np.float32)
        off += np.isinf(distance_m) & (len(hint.uv_px) >= config.find_points)
    for other in others:
        if other.distance_m is not None and len(other.uv_px) >= config.find_points:
            off += (np.abs(patch.nearest(other.distance_m)) < _ON_SURFACE_M) & ~on
    return config.surface_weight * (on - off)


def cut(
    patch: Patch,
    log_odds: np.ndarray,
    *,
    start: np.ndarray | None = None,
    seeds: np.ndarray | None = None,
    background: np.ndarray | None = None,
    sharp: bool = False,
) -> np.ndarray:
    """(h, w) probability of the object, by a random walk; ``seeds`` and ``background`` (h, w) bool are certain.

    sharp  prefer a short outline, which costs several plain walks
    """
    target, certain = (log_odds > 0).astype(np.float32), _CERTAIN if sharp else 1.0
    says = np.abs(log_odds) / _TIE if sharp else _EVIDENCE * np.tanh(np.abs(log_odds) / 2)
    strength = says.astype(np.float32)
    for given, value in ((seeds, 1), (background, 0)):
        if given is not None:
            target[given], strength[given] = value, certain
    start = 0.25 + 0.5 * target if start is None else start
    walk = random_walk.sharpen if sharp else random_walk.walk
    return walk(target, strength, patch.edge_weights, start)


def warped(was: np.ndarray, before: Patch, patch: Patch) -> tuple[np.ndarray, np.ndarray]:
    """The mask ``was`` (h, w) in [0, 1] and the depth of the patch before, warped to this one by optical flow."""
    v, u = np.mgrid[: patch.shape[0], : patch.shape[1]]
    at = _flow(patch.gray, before.gray) + np.stack([u, v], -1).astype(np.float32)
    mask = cv2.remap(was.astype(np.float32), at, _NOTHING, cv2.INTER_LINEAR, borderValue=0)
    return mask, cv2.remap(before.depth_m, at, _NOTHING, cv2.INTER_NEAREST, borderValue=0)


def _flow(gray: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(h, w, 2) optical flow in pixels from an image (h, w) uint8 to the one before.

    OpenCV chooses its pyramid levels by the longer side, and reads out of bounds where the shorter side of the coarsest
    one is smaller than its window: the images are padded to a square that is large enough for one level.
    """
    h, w = gray.shape
    side = max(h, w, _SMALLEST_FLOW)
    now, then = (cv2.copyMakeBorder(g, 0, side - h, 0, side - w, cv2.BORDER_REPLICATE) for g in (gray, before))
    return cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST).calc(now, then, _NOTHING)[:h, :w]
