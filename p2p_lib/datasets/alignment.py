"""Whether depth lies on its colour image, and masks on depth: what goes wrong when one records one's own data.

Where an object ends, its colour usually ends too: edges of depth are laid over the edges of colour at every offset and
at several sizes; depth that was registered to the colour camera fits best where it is. Along a mask's rim, depth must
not fall off to what stands behind. From image to image its scale must not move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core.types import Frame

#: Work is done at this width, which images need to have; offsets up to a tenth of it, and sizes, are tried.
WIDTH_PX = 320
_REACH_PX = WIDTH_PX // 10
SCALES = tuple(2.0 ** np.linspace(-0.5, 0.5, 11))
#: A step of depth between neighbours is an edge from here on, growing with range as noise does.
_STEP_M, _STEP_SHARE = 0.04, 0.03
#: Fewer edge pixels than this (at that width, over all frames) say nothing.
_MIN_EDGE_PX = 300
#: How far a fit must stand out from those elsewhere, in their standard deviations, to be one at all.
_MIN_CONTRAST = 3.5
#: Of the image's width: an offset between depth and colour that does not matter.
_OFFSET_SHARE = 0.01
#: How much better depth must fit elsewhere to be called not registered, and how far such a fit must stand out from all
#: that are farther than this from it (at that width): good sequences have none of both in 15 images and more. Without
#: the lead 26 of 392 windows of a video had one: nearly all of its edges are a hand's, and fit in many places.
_GAIN, _MIN_LEAD, _PEAK_PX = 1.2, 1.35, 12

#: A mask's outermost pixels are left out: no silhouette is that exact, and sensors blur depth there. Its rim is
#: compared with what the mask holds within a distance of it.
_INSET_PX, _NEARBY_PX = 2, 12
#: So much farther than that is background, plus a fraction of the range.
_GAP_M, _GAP_SHARE = 0.03, 0.02

#: A change of all depth from image to image, as a fraction: 0.015 at most on good sequences.
_SCALE_CHANGE = 0.03


@dataclass(frozen=True)
class Misfit:
    """Where the depth images fit best, as they are found: ``scale`` times as large, moved by (du, dv) in pixels.

    gain  how much better the edges fit once that is undone than as they are (1: just as well)
    """

    scale: float
    du_px: float
    dv_px: float
    gain: float

    @property
    def doubt(self) -> tuple[str, str] | None:
        """What is wrong, in words, and what to do; None where depth is registered to colour."""
        if self.gain <= _GAIN:
            return None
        where = f"shifted by ({round(self.du_px):+d}, {round(self.dv_px):+d}) px"
        size = f"{self.scale:.2f} times as large and " if abs(self.scale - 1) > 0.03 else ""
        text = f"offset from colour: {size}{where}, its edges would fit {self.gain:.1f} times as well"
        how = "`align` in the camera's software; p2p convert does for RealSense"
        fix = f"Register depth to colour when recording ({how})."
        return text, f"{fix} If it fits while nothing moves, they are of different moments: record them together."


def misfit(frames: Sequence[Frame]) -> Misfit | None:
    """How depth lies on colour over some frames of one size; None where too few edges, or too few pixels, tell.

    It is compared with the best fit within an offset that still counts as registered.
    """
    shrink = WIDTH_PX / frames[0].shape[1]
    if shrink > 1:
        return None
    colours = [_shrunk(_colour_edges(frame.rgb), shrink) for frame in frames]
    spectra = [np.fft.rfft2(colour - colour.mean()) for colour in colours]
    depths = [_shrunk(_depth_edges(frame.depth_m), shrink) for frame in frames]
    if sum(float(edges.sum()) for edges in depths) < _MIN_EDGE_PX:
        return None
    fits = np.stack([_fit(depths, spectra, scale) for scale in SCALES])
    best = np.unravel_index(fits.argmax(), fits.shape)
    here = SCALES.index(1.0)
    near = max(1, round(_OFFSET_SHARE * frames[0].shape[1] * shrink))
    as_is = fits[here, _REACH_PX - near : _REACH_PX + near + 1, _REACH_PX - near : _REACH_PX + near + 1].max()
    above = fits[best[0]] - fits[best[0]].mean()
    if above[best[1:]] <= _MIN_CONTRAST * above.std():
        return None
    gain = float(fits[best] / max(as_is, 1e-6))
    elsewhere = above.copy()
    elsewhere[tuple(slice(max(0, at - _PEAK_PX), at + _PEAK_PX + 1) for at in best[1:])] = 0
    if gain > _GAIN and above[best[1:]] <= _MIN_LEAD * elsewhere.max():
        return None  # many fit better than where they are, as where few edges are sharp: none of them is true
    dv, du = ((np.array(best[1:]) - _REACH_PX) / shrink).tolist()
    scale = SCALES[best[0]]
    return Misfit(float(1 / scale), float(-du / scale), float(-dv / scale), gain)


def _fit(depths: list[np.ndarray], spectra: list[np.ndarray], scale: float) -> np.ndarray:
    """Mean strength of colour edges under the depth edges, at every offset (dv, du) of the depth at this size."""
    h, w = depths[0].shape
    about_centre = np.array([[scale, 0, (1 - scale) * (w - 1) / 2], [0, scale, (1 - scale) * (h - 1) / 2]])
    moved = [cv2.warpAffine(edges, about_centre, (w, h)) for edges in depths]
    total = sum(np.conj(np.fft.rfft2(edges)) * colour for edges, colour in zip(moved, spectra, strict=True))
    window = np.arange(-_REACH_PX, _REACH_PX + 1)
    count = sum(float(edges.sum()) for edges in moved)
    return np.fft.irfft2(total, (h, w))[np.ix_(window, window)] / max(count, 1e-6)


def _shrunk(image: np.ndarray, factor: float) -> np.ndarray:
    size = tuple(round(side * factor) for side in image.shape[::-1])
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def _depth_edges(depth_m: np.ndarray) -> np.ndarray:
    """(H, W) float32: 1 where depth jumps between measured neighbours."""
    near = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(1e3)), np.ones((5, 5)))
    far = cv2.dilate(depth_m, np.ones((5, 5)))
    return ((far > 0) & (far - near > _STEP_M + _STEP_SHARE * near)).astype(np.float32)


def _colour_edges(rgb: np.ndarray) -> np.ndarray:
    """(H, W) float32: strength of the gradient beside that of its surroundings, at most 3; blurred a little."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    strength = cv2.magnitude(cv2.Scharr(gray, cv2.CV_32F, 1, 0), cv2.Scharr(gray, cv2.CV_32F, 0, 1))
    around = cv2.blur(strength, (61, 61)) + 0.5 * strength.mean() + 1e-6
    return cv2.GaussianBlur(np.minimum(strength / around, 3), (0, 0), 2)


def background_share(mask: np.ndarray, depth_m: np.ndarray) -> float:
    """The fraction of a mask's measured rim that lies clearly behind the mask nearby; NaN where no rim is measured.

    mask  (H, W) bool; depth_m (H, W) metres, 0 = no measurement
    """
    on_rim, behind = rim(mask, depth_m)
    return float(behind.sum() / on_rim.sum()) if on_rim.any() else float("nan")


def rim(mask: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) bool each: the measured pixels of a mask's rim, and those of them that lie on the background."""
    inner = cv2.erode(mask.astype(np.uint8), _disc(_INSET_PX), borderValue=0)
    on_rim = (inner > 0) & (cv2.erode(inner, np.ones((3, 3), np.uint8), borderValue=0) == 0) & (depth_m > 0)
    own = np.where((inner > 0) & (depth_m > 0), depth_m, np.float32(1e3))
    behind_m = depth_m - cv2.erode(own, _disc(_NEARBY_PX))
    return on_rim, on_rim & (behind_m > _GAP_M + _GAP_SHARE * depth_m)


def _disc(radius: int) -> np.ndarray:
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1,) * 2)


def moving_scale(pairs: Sequence[tuple[Frame, Frame]]) -> str:
    """What is wrong with pairs of neighbouring images whose depth has not one scale, in words; "" where nothing is.

    All depth changes from one to the next: the median over the pixels that both measured. A camera that moves changes
    what single pixels see, in both directions. Twice, since an image may be spoilt.
    """
    changes = np.zeros(len(pairs))
    for k, (before, after) in enumerate(pairs):
        both = (before.depth_m > 0) & (after.depth_m > 0)
        changes[k] = abs(np.median(after.depth_m[both] / before.depth_m[both]) - 1) if both.any() else 0
    if (changes > _SCALE_CHANGE).sum() < 2:
        return ""
    first, second = pairs[int(changes.argmax())]
    return f"all depth changes by {100 * changes.max():.0f} % from frame {first.index} to {second.index}"
