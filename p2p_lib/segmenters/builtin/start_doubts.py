"""Warnings about the mask that a prompt started an object with, each with what settles it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import cv2
import numpy as np

from p2p_lib.core.depth import depths_at
from p2p_lib.core.errors import doubt
from p2p_lib.core.image import ends_px, in_mask
from p2p_lib.segmenters.builtin.patch import Patch, around, dilated, plane_heights, support_plane
from p2p_lib.segmenters.builtin.prompted import NO_PX, Cutter, Effect

#: An object is flat if its median height over the plane around it is less than this, in standard deviations of depth.
_FLAT = 2.0
#: Two masks are parted by an edge if the mean tie along their contact is at most this; it is 1 between like pixels.
_TIED = 0.02
#: Of more clicks one that is astray does little harm, and each takes a cut.
_FEW = 10
#: Two cuts are equally good if their doubts differ by less than the first factor, and show different things if their
#: sizes differ by more than the second. Two masks are the same from this intersection over union on.
_AS_GOOD, _OTHER_SIZE, _SAME = 1.2, 1.5, 0.7


def doubt_prompt(cutter: Cutter, mask: np.ndarray, others: Mapping[str, np.ndarray], effect: Effect) -> str:
    """Warn if a prompt has selected nothing, or something else than its object, or has not mended its mask.

    Returns the warning; empty where nothing is doubtful.

    cutter  the one that cut it out, with a mask (H, W) bool
    others  the other objects' masks (H, W) bool in this frame
    effect  of the prompt on that mask
    """
    if not mask.any():
        return doubt_nothing(cutter)
    if effect is Effect.MENDED:
        return _not_mended(cutter, mask)
    frame, name, who = cutter.frame, cutter.prompt.name, _who(cutter)
    corners = ends_px(mask)
    patch = Patch.of(frame, around(corners.mean(0), np.ptp(corners, 0), frame.shape), cutter.camera, cutter.config)
    inside = (patch.down(mask.astype(np.float32)) > 0.5) & (patch.depth_m > 0)
    if _flat(patch, inside):
        got = f"the {np.count_nonzero(mask)} pixels selected lie in the plane around them, like a table or a wall"
        fix = "If this is not the object, click near its centre; if it is, check that depth is in metres."
        return doubt(who, got, fix, name)
    if one_body := _one_body(cutter, patch, inside, others):
        fix = "If they are one object, leave one out; else give each a negative click on the other."
        return " ".join([doubt(who, f"the prompt selects most of {other!r}, too", fix, name) for other in one_body])
    if (astray := _astray(cutter)) is not None:
        got = f"alone, the click at ({astray[0]}, {astray[1]}) selects something else than the others do"
        return doubt(who, got, "If it is not on the object, leave it out, or make it a negative click.", name)
    if (another := _as_good(cutter, mask, others)) is not None:
        pixels, (u, v) = another
        got = f"{np.count_nonzero(mask)} pixels selected; a mask of {pixels} fits as well"
        fix = f"If pixel ({u}, {v}) is on the object, click on it, too; else give a negative click on it."
        return doubt(who, got, fix, name)
    if effect is Effect.BEGUN_ELSEWHERE:
        boxed = cutter.prompt.box_px is not None
        got = "nothing of its mask is inside" if boxed else "they are farther from its mask than that is long"
        return doubt(who, got, "It starts anew there.", name)
    return ""


def _not_mended(cutter: Cutter, mask: np.ndarray) -> str:
    """Warn of clicks that the mended mask (H, W) bool goes against."""
    on, beside = cutter.prompt.points_px, cutter.prompt.negative_px
    missed, held = on[~in_mask(on, mask)], beside[in_mask(beside, mask)]
    if not len(missed) and not len(held):
        return ""
    (u, v), where = (missed[0], "outside") if len(missed) else (held[0], "inside")
    fix = "Click where it has depth and is one piece with the object, draw a box, or paint the mask."
    return doubt(_who(cutter), f"({u:.0f}, {v:.0f}) is {where} its mask all the same", fix, cutter.prompt.name)


def doubt_nothing(cutter: Cutter, instead: str = "") -> str:
    """Warn that a prompt has selected nothing; ``instead`` says what its object has for a mask."""
    boxed = cutter.prompt.box_px is not None
    if not cutter.prompt.starts:
        got, fix = "it has no mask that they could be taken from", "Click on it, too."
        return doubt(_who(cutter), got, f"{instead} {fix}".strip(), cutter.prompt.name)
    fix = "Click near its centre and on parts of other colours" + (", too." if boxed else ", or draw a box.")
    return doubt(_who(cutter), "no object was found there", f"{instead} {fix}".strip(), cutter.prompt.name)


def _who(cutter: Cutter) -> str:
    what = "box around" if cutter.prompt.starts else "negative clicks on"
    what = "clicks on" if len(cutter.prompt.points_px) else what
    return f"{what} {cutter.prompt.name!r} in frame {cutter.frame.index}"


def _flat(patch: Patch, inside: np.ndarray) -> bool:
    """Whether the measured pixels ``inside`` (h, w) bool an object do not rise above the plane around it."""
    plane = support_plane(patch, patch.depth_m > 0)
    if plane is None or not inside.any():
        return False
    return bool(np.median(np.abs(plane_heights(patch, plane)[inside]) / patch.sigma_m[inside]) < _FLAT)


def _one_body(cutter: Cutter, patch: Patch, inside: np.ndarray, others: Mapping[str, np.ndarray]) -> list[str]:
    """The other objects most of which would be cut out with this one, had nobody clicked on them."""
    touched = {
        other: there
        for other, there in others.items()
        if there.any() and _touch_unparted(patch, inside, patch.down(there.astype(np.float32)) > 0.5)
    }
    if not touched:
        return []
    alone = replace(cutter, others_px=NO_PX).cuts[0].whole(cutter.frame.shape)
    return [other for other, there in touched.items() if (alone & there).sum() > there.sum() / 2]


def _astray(cutter: Cutter) -> tuple[int, int] | None:
    """A click (u, v) of the fewer, where clicks fall apart: what one part selects alone holds no click of the other.

    On one object a click alone selects what most of the others are on, though rarely all of it.
    """
    clicks = cutter.prompt.points_px
    clicks = clicks[np.isfinite(depths_at(clicks, cutter.frame))]
    part = np.arange(len(clicks))
    for k, click in enumerate(clicks if len(clicks) <= _FEW else ()):
        if (part == part[0]).all():
            return None
        alone = replace(cutter, prompt=replace(cutter.prompt, points_px=click[None])).cuts[0]
        linked = in_mask(clicks, alone.whole(cutter.frame.shape))
        part[np.isin(part, part[linked])] = part[k]
    parts, size = np.unique(part, return_counts=True)
    if len(parts) < 2 or len(clicks) > _FEW:
        return None
    u, v = clicks[part == parts[::-1][size[::-1].argmin()]][-1].astype(int)
    return int(u), int(v)


def _as_good(cutter: Cutter, mask: np.ndarray, others: Mapping[str, np.ndarray]) -> tuple[int, tuple[int, int]] | None:
    """The size in pixels of an equally good cut of another size, and a pixel (u, v) that only one of the two holds."""
    taken = np.logical_or.reduce([np.zeros(mask.shape, bool), *others.values()])
    best = cutter.cuts[0].whole(mask.shape) & ~taken
    if (best & mask).sum() < _SAME * (best | mask).sum():
        return None  # it is not this cutter's mask: another object or a refiner changed it
    for cut in cutter.cuts[1:]:
        another = cut.whole(mask.shape) & ~taken
        small, large = sorted([np.count_nonzero(mask), np.count_nonzero(another)])
        if cut.doubtful < _AS_GOOD * cutter.cuts[0].doubtful and 0 < _OTHER_SIZE * small < large:
            apart = cv2.distanceTransform((another ^ mask).astype(np.uint8), cv2.DIST_L2, 3)
            v, u = np.unravel_index(apart.argmax(), apart.shape)
            return int(np.count_nonzero(another)), (int(u), int(v))
    return None


def _touch_unparted(patch: Patch, one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two masks (h, w) bool touch without an edge of colour or depth between them."""
    right, below = patch.edge_weights
    tie = np.ones(patch.shape, np.float32)
    tie[:, :-1] = np.minimum(tie[:, :-1], right)
    tie[:-1] = np.minimum(tie[:-1], below)
    tied = cv2.erode(tie, np.ones((3, 3), np.uint8))[dilated(one, 1) & dilated(other, 1)]
    return bool(len(tied)) and tied.mean() > _TIED
