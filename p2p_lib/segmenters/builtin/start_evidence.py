"""Evidence, in the frame that starts an object, that a pixel belongs to what was clicked; on a patch's grid.

All of it is foreground log-odds (h, w), to be added up.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from p2p_lib.core.config import SegmentationConfig
from p2p_lib.segmenters.builtin.colours import evidence, histogram
from p2p_lib.segmenters.builtin.patch import (
    Patch,
    approximate_median,
    components_touching,
    connected_components,
    dilated,
    plane_heights,
    support_plane,
)

#: Least extent of clicks on one object, and the extent that a lone click stands for, m.
_EXTENT_M, _LONE_M = 0.03, 0.1
#: Log-odds between the clicks; right beside them; their loss with each extent of distance; and their least.
_BETWEEN, _BESIDE, _PER_EXTENT, _FAR = 2.0, 0.8, 2.0, -2.5
#: What hides an object is this much nearer than the clicks on it, m, and so many times as large as is between them.
_HIDES_M, _REACHES = 0.005, 2.0
#: What rises less than this many standard deviations plus this many metres above its support is flat.
_FLAT_SIGMAS, _FLAT_M = 2.0, 0.003
#: A plane's fit adds this to the noise of depth, m.
_PLANE_SIGMA_M = 0.001
#: Log-odds of a pixel in the support plane, and most of one above it: other things stand on it, too.
_IN_PLANE, _ABOVE_PLANE = -2.0, 0.5
#: Log-odds of what depth connects with the clicks, of what it does not, and of what alone looks unlike the support.
_CONNECTED, _APART, _UNLIKE = 2.5, -1.5, 1.0
#: The support's colours are those within this share of the patch's side, and vary by this much at least, in CIELAB;
#: what is darker differs by this share: it may be a shade.
_NEARBY, _LOOK, _SHADE = 0.2, 4.0, 0.4
#: Standard deviations up to which a colour is the support's, and from which on another; so many times it is looked.
_ALIKE, _OTHER, _LOOKS = 3.0, 4.0, 4
#: An unmeasured pixel has this share of its nearest measured one's log-odds.
_UNMEASURED = 0.8


@dataclass(frozen=True, eq=False)
class Clicked:
    """Where the clicks on an object are, on a patch.

    centres   (h, w) bool, their cells
    seeds     (h, w) bool, squares around them
    hull      (h, w) bool, their convex hull and the seeds
    extents   (h, w) distance from the hull, in extents of the clicks
    beside    (h, w) bool, what is known to be beside the object, however near to the clicks
    hides     (h, w) bool, of that what is before the object, between the clicks
    """

    centres: np.ndarray
    seeds: np.ndarray
    hull: np.ndarray
    extents: np.ndarray
    beside: np.ndarray
    hides: np.ndarray

    @classmethod
    def of(cls, patch: Patch, clicks_px: np.ndarray, z_m: float, scale: float = 1.0, exact: bool = True) -> Clicked:
        """Of clicks (N, 2) in the image at a depth, on something ``scale`` times as far across as they are.

        exact  whether somebody clicked there: beside a click on an edge is what lies behind it. Points that stand for a
               box have it around them
        """
        centres, seeds = patch.dots(clicks_px, 0), patch.dots(clicks_px, 1)
        if exact:
            here_m = cv2.dilate(np.where(centres, patch.depth_m, np.float32(0)), np.ones((3, 3), np.uint8))
            seeds &= (here_m == 0) | (patch.depth_m - here_m <= patch.step_m)
        at = (clicks_px - [patch.box.left, patch.box.top] + 0.5) / patch.cell_px - 0.5
        hull = np.zeros(patch.shape, np.uint8)
        cv2.fillConvexPoly(hull, cv2.convexHull(np.rint(at).astype(np.int32)[:, None]), 1)
        hull = (hull > 0) | seeds
        least_m = _EXTENT_M if len(clicks_px) > 1 else _LONE_M
        extent = scale * max(float(np.ptp(at, 0).max()), least_m * patch.camera.fx / z_m / patch.cell_px)
        away = cv2.distanceTransform((~hull).astype(np.uint8), cv2.DIST_L2, 5)
        return cls(centres, seeds, hull, away / extent, *np.zeros((2, *patch.shape), bool))

    def within(self, unlike: np.ndarray) -> Clicked:
        """Without what looks like the support, which is most of the hull of a thin thing, unless most clicks do."""
        if unlike[self.centres].mean() <= 0.5:
            return self
        seeds = self.seeds & unlike | self.centres
        return replace(self, seeds=seeds, hull=self.hull & unlike | seeds, beside=~unlike)

    def hidden_by(self, hides: np.ndarray) -> Clicked:
        """With something (h, w) bool before it."""
        hides = hides & self.hull & ~self.centres
        return replace(self, hull=self.hull & ~hides, beside=self.beside | hides, hides=hides)

    def prior_beside(self, connected: np.ndarray) -> np.ndarray:
        """(h, w) log-odds by distance from the clicks; never against pixels whose ``connected`` (h, w) is positive."""
        least, most = np.where(connected > 0, 0, _FAR), np.where(self.beside, 0, _BESIDE)
        outside = np.clip(_BESIDE - _PER_EXTENT * self.extents, least, most)
        return np.where(self.hull, _BETWEEN, outside).astype(np.float32)

    @property
    def near(self) -> np.ndarray:
        """(h, w) weight in the object's colours before it is cut out."""
        return np.where(self.beside, 0, np.exp(-4 * self.extents))

    @property
    def beyond(self) -> np.ndarray:
        """(h, w) weight in the background's colours before the object is cut out."""
        return (self.extents > min(1.0, self.extents.max() / 2)).astype(np.float32)


def hiding(patch: Patch, clicked: Clicked) -> np.ndarray:
    """(h, w) bool: what is before an object between the clicks on it, as a finger: nearer, and beyond a step of depth.

    What ends between the clicks, as a camera's lens, is a part of it.
    """
    measured = patch.depth_m > 0
    at = np.nonzero(clicked.centres & measured)
    if not len(at[0]):
        return np.zeros(patch.shape, bool)
    own = components_touching(connected_components(clicked.hull & patch.smooth), clicked.seeds & patch.smooth)
    own = dilated(own, 1) | clicked.seeds
    nearer = clicked.hull & measured & ~own & (patch.depth_m < _through(at, patch.depth_m[at], patch.shape) - _HIDES_M)
    part = connected_components(patch.smooth & ~own)
    inside, whole = (np.bincount(part[where], minlength=part.max() + 1) for where in (nearer, part > 0))
    return nearer & (whole > _REACHES * inside)[part] & (part > 0)


def _through(at: tuple[np.ndarray, ...], z_m: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """(h, w) depth of the plane through cells ``at``; of less than three, or in a line, the least of theirs."""
    known = np.stack([*at, np.ones(len(z_m))], -1)
    if np.linalg.matrix_rank(known - known.mean(0), tol=1.0) < 2:
        return np.full(shape, z_m.min())
    of = np.linalg.lstsq(known, 1 / z_m, rcond=None)[0]
    v, u = np.indices(shape)
    return 1 / np.clip(of[0] * v + of[1] * u + of[2], 0.02, None)


@dataclass(frozen=True, eq=False)
class Height:
    """The evidence of height above the support plane.

    plane     (4,) the plane around the clicks; None where there is none
    flat      whether height tells nothing: the clicks are in the plane, or there is none
    log_odds  (h, w) of a height, uniform up to twice that of the clicks, against the plane with its noise
    """

    plane: np.ndarray | None
    flat: bool
    log_odds: np.ndarray

    @classmethod
    def of(cls, patch: Patch, clicked: Clicked, near: np.ndarray) -> Height:
        """By the plane that holds most of what surrounds the clicks, or else of what is ``near`` (h, w) bool, too.

        To a camera beside a table most of what surrounds an object is far behind it.
        """
        weight = np.exp(-((clicked.extents / 2) ** 2) / 2) + 0.05
        around = (patch.depth_m > 0) & (clicked.extents > 0.5)
        plane = support_plane(patch, around, weight)
        plane = support_plane(patch, around & near, weight) if plane is None else plane
        return cls(plane, True, np.zeros(patch.shape, np.float32)).on(patch, clicked)

    def on(self, patch: Patch, clicked: Clicked) -> Height:
        """By the same plane on another patch."""
        nothing, at = np.zeros(patch.shape, np.float32), clicked.seeds & (patch.depth_m > 0)
        if self.plane is None or not at.any():
            return replace(self, flat=True, log_odds=nothing)
        height, sigma_m = plane_heights(patch, self.plane), patch.sigma_m + _PLANE_SIGMA_M
        clicks_m = approximate_median(height[at])
        least_m = _FLAT_SIGMAS * approximate_median(patch.sigma_m[at]) + _FLAT_M
        if clicks_m < least_m:
            return replace(self, flat=clicks_m > -least_m, log_odds=nothing)
        # The peak of the noise's density, 1 / (2.5 sigma), over a uniform one up to twice the height of the clicks.
        surprise = np.log(np.maximum(2 * clicks_m / (2.5 * sigma_m), 1.05))
        log_odds = np.maximum(height, 0) ** 2 / (2 * sigma_m**2) - surprise
        log_odds = np.where(patch.depth_m > 0, np.clip(log_odds, _IN_PLANE, _ABOVE_PLANE), 0)
        return replace(self, flat=False, log_odds=log_odds.astype(np.float32))


def by_distance(patch: Patch, z_m: float, config: SegmentationConfig) -> np.ndarray:
    """Evidence against what is farther in depth from the clicks than ``config.reach_m``."""
    far = (patch.depth_m > 0) & (np.abs(patch.depth_m - z_m) > config.reach_m)
    return np.where(far, -config.geometry_weight, 0).astype(np.float32)


def by_connection(
    patch: Patch, clicked: Clicked, height: Height, looks: np.ndarray, through_holes: bool = False
) -> np.ndarray:
    """Evidence for what depth connects with the clicks and is not their support, if it ends within the patch.

    What is not the support stands above it or, as the handle of a fork on a table, ``looks`` (h, w) bool unlike it.
    It may go on ``through_holes`` of depth, as from a mug's rim to its inside, and from one thing to the next.
    """
    log_odds, measured = np.zeros(patch.shape, np.float32), patch.depth_m > 0
    above = np.zeros(patch.shape, bool) if height.flat else height.log_odds >= 0
    if not height.flat:
        component = components_touching(connected_components(above & patch.smooth), clicked.seeds)
        log_odds[measured & ~dilated(component, 1)] = _APART
        if patch.encloses(component):
            log_odds[component] = _CONNECTED
    if height.plane is not None:
        linked = ((above & measured) | looks) & (patch.smooth | (through_holes & ~measured))
        component = components_touching(connected_components(linked), clicked.seeds)
        if patch.encloses(component):
            log_odds[component] = np.maximum(log_odds[component], _UNLIKE)
    return log_odds


def unlike(patch: Patch, plane: np.ndarray | None) -> np.ndarray:
    """(h, w) bool: what does not look like the support, a ``plane`` (4,), does around it; nothing without a support.

    A table's colour changes with the light: it is taken nearby. What lies on the table is in its plane, too: so it is
    taken again without what is off it.
    """
    if plane is None:
        return np.zeros(patch.shape, bool)
    height, lab = plane_heights(patch, plane), cv2.cvtColor(patch.rgb, cv2.COLOR_RGB2LAB).astype(np.float32)
    support = (patch.depth_m > 0) & (np.abs(height) < _FLAT_SIGMAS * patch.sigma_m + _FLAT_M)
    alike, squared_off = support, np.zeros(patch.shape, np.float32)
    for _ in range(_LOOKS):
        squared_off = _squared_off(lab, alike)
        alike = support & (squared_off < _ALIKE**2)
    return squared_off > _OTHER**2


def _squared_off(lab: np.ndarray, support: np.ndarray) -> np.ndarray:
    """(h, w) squared distance, in standard deviations, of CIELAB colours (h, w, 3) from those of the support around."""
    reach, weight = (0, 0), support.astype(np.float32)[..., None]
    sigma = _NEARBY * max(support.shape)
    shares = cv2.GaussianBlur(weight, reach, sigma)[..., None] + np.float32(1e-4)
    off = lab - cv2.GaussianBlur(lab * weight, reach, sigma) / shares
    off[..., 0] *= np.where(off[..., 0] < 0, _SHADE, 1)
    variance = cv2.GaussianBlur(off**2 * weight, reach, sigma) / shares
    return (off**2 / (variance + _LOOK**2)).sum(-1)


def by_shares(patch: Patch, own: np.ndarray, other: np.ndarray, config: SegmentationConfig) -> np.ndarray:
    """Evidence of colour: shares weighted by ``own`` (h, w), the object, against ``other`` (h, w), the rest."""
    shares = (histogram(patch.codes.ravel(), weights.ravel()) for weights in (own, other))
    return config.colour_weight * evidence(*shares)[patch.codes]


def filled(log_odds: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Log-odds (h, w); where nothing is ``measured`` (h, w) bool, a share of the nearest measured pixel's."""
    if measured.all() or not measured.any():
        return log_odds
    _, nearest = cv2.distanceTransformWithLabels(
        (~measured).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    value_of = np.zeros(nearest.max() + 1, np.float32)
    value_of[nearest[measured]] = log_odds[measured]
    return np.where(measured, log_odds, _UNMEASURED * value_of[nearest])


def tolerant(log_odds: np.ndarray, radius: float) -> np.ndarray:
    """Log-odds (h, w) that hold within ``radius`` cells: depth ends beside the outline that colour shows."""
    if radius < 0.5:
        return log_odds
    around = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * round(radius) + 1,) * 2)
    return np.minimum(cv2.dilate(log_odds, around), 0) + np.maximum(cv2.erode(log_odds, around), 0)
