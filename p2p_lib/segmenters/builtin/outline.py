"""Where an outline runs, by the colours on its two sides as they are nearby.

Depth ends some pixels beside an object: cameras smooth it, lose it along silhouettes, and see it from another place.
Colours of the whole object are often like some of those around it; on the two sides of one piece of its outline they
seldom are (as in Bai et al., "Video SnapCut", 2009).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.patch import Patch, averaged

#: An outline moves by less than this, px.
_REACH_PX = 8
#: Pixels farther than this from it are certainly on their side.
_CERTAIN_PX = 5
#: They lend it their colours over a square of so many pixels, where so many of them are certain on either side.
_AROUND_PX, _FEWEST_PX = 41, 30
#: Most that colours say, nats, against so much for each pixel of the way; least variance of a channel.
_LOUDEST, _PER_PX, _NOISE = 3.0, 0.3, 25.0
#: Colours whose means differ by more than this hardly overlap, in variances of both: a print is on both sides alike.
_UNLIKE = 2.5


def outlined(frame: Frame, patch: Patch, x: np.ndarray) -> np.ndarray:
    """The probabilities x (h, w) of a patch at the pixels of its box, the outline moved to where colours change."""
    probability = patch.up(x)
    inside = probability > 0.5
    if inside.all() or not inside.any():
        return probability
    within, beyond = (cv2.distanceTransform(side.astype(np.uint8), cv2.DIST_L2, 3) for side in (inside, ~inside))
    says = np.where(inside, within - 0.5, 0.5 - beyond)  # the distance from the outline, px
    near = np.nonzero(np.abs(says) < _REACH_PX)
    own, other = (_Colours.around(patch, side > _CERTAIN_PX) for side in (within, beyond))
    cell = tuple(np.minimum(px // patch.cell_px, n - 1) for px, n in zip(near, patch.shape, strict=True))
    lab = cv2.cvtColor(frame.rgb[patch.box.slices][near][None], cv2.COLOR_RGB2LAB)[0].astype(np.float32)
    likelier = np.clip(own.log_likelihood(lab, cell) - other.log_likelihood(lab, cell), -_LOUDEST, _LOUDEST)
    told = own.unlike(other)[cell]
    says *= _PER_PX
    says[near] += np.where(told, likelier, 0)
    now = cv2.GaussianBlur(says, (0, 0), 1.0)[near] > 0
    changes = told & (now != inside[near])
    probability[near] = np.where(changes, np.where(now, 0.6, 0.4), probability[near])
    return probability


@dataclass(frozen=True, eq=False)
class _Colours:
    """Of the pixels around each cell of a patch that are certainly on one side: their colours in CIELAB.

    enough  (h, w) bool: whether there are enough of them
    mean, variance  (h, w, 3)
    """

    enough: np.ndarray
    mean: np.ndarray
    variance: np.ndarray

    @classmethod
    def around(cls, patch: Patch, side: np.ndarray) -> _Colours:
        """Of a side (rows, columns) bool of the patch's box."""
        weight = averaged(side.astype(np.float32), patch.cell_px)[..., None]
        across = 2 * round(_AROUND_PX / 2 / patch.cell_px) + 1

        def summed(values: np.ndarray) -> np.ndarray:
            return cv2.boxFilter(values, -1, (across, across), normalize=False)

        cells = np.maximum(summed(weight), 1e-3)
        mean = summed(weight * patch.lab) / cells[..., None]
        variance = summed(weight * patch.lab**2) / cells[..., None] - mean**2
        return cls(cells * patch.cell_px**2 >= _FEWEST_PX, mean, np.maximum(variance, 0) + _NOISE)

    def unlike(self, other: _Colours) -> np.ndarray:
        """(h, w) bool: whether enough is known of both, and they hardly overlap."""
        apart = ((self.mean - other.mean) ** 2 / (self.variance + other.variance)).sum(-1)
        return self.enough & other.enough & (apart > _UNLIKE)

    def log_likelihood(self, lab: np.ndarray, cell: tuple[np.ndarray, ...]) -> np.ndarray:
        """(N,) of colours lab (N, 3) at cells, but for a constant."""
        variance = self.variance[cell]
        return -((lab - self.mean[cell]) ** 2 / variance + np.log(variance)).sum(-1) / 2
