"""What was seen beside an object when it vanished: something of its colours that stays in view is not the object.

It is followed from frame to frame, so that neither it nor the camera has to stand still.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.colours import evidence, histogram
from p2p_lib.segmenters.builtin.cut import standing_out
from p2p_lib.segmenters.builtin.patch import Box, Patch, connected_components
from p2p_lib.segmenters.builtin.target import Seen, Target
from p2p_lib.segmenters.builtin.view import View

#: Side of a cell of the grid, px.
_CELL_PX = 4
#: A part is what it was if more than this share of it was there a frame ago, as far away; or the object, if that was.
_SAME = 0.25


@dataclass(frozen=True, eq=False)
class Bystanders:
    """Parts of a frame that are not an object which was seen before.

    patch     the frame, on a coarse grid
    likelier  (4096,) bool: the colours that were likelier the object's than its surroundings'
    there     (h, w) bool: parts in these colours that are something else
    """

    patch: Patch
    likelier: np.ndarray
    there: np.ndarray

    @classmethod
    def beside(cls, seen: Seen, colours: np.ndarray, frame: Frame, camera: Camera) -> Bystanders:
        """In the frame in which an object was seen last, by its ``colours`` (4096,)."""
        patch, mask = _whole(frame, camera), np.zeros(frame.shape, np.float32)
        mask[seen.box.slices] = seen.mask
        own = patch.down(mask) > 0
        likelier = evidence(colours, histogram(patch.codes[~own])) > 0
        part = _parts(patch, likelier)
        return cls(patch, likelier, (part > 0) & ~_in(part, own)[part])

    def followed(self, frame: Frame) -> Bystanders:
        """In the next frame."""
        patch = _whole(frame, self.patch.camera)
        part = _parts(patch, self.likelier)
        stayed = self.there & (np.abs(patch.depth_m - self.patch.depth_m) < 2 * patch.step_m)
        return Bystanders(patch, self.likelier, (part > 0) & _in(part, stayed)[part])

    def are(self, patch: Patch, part: np.ndarray) -> np.ndarray:
        """(K,) bool: which parts, by (h, w) int numbers on a patch of the newest frame, they are."""
        image = np.zeros((patch.camera.height, patch.camera.width), np.float32)
        image[self.patch.box.slices] = self.patch.up(self.there)
        return _in(part, patch.down(image) > 0.5)


def with_bystanders(view: View, target: Target) -> Target:
    """A target that was seen a frame ago, and vanishes in this one."""
    if target.seen is None:
        return target
    assert target.colours is not None and view.previous is not None  # a frame ago
    return replace(target, bystanders=Bystanders.beside(target.seen, target.colours, view.previous, view.camera))


def _whole(frame: Frame, camera: Camera) -> Patch:
    """The whole frame on the coarse grid."""
    h, w = (side // _CELL_PX * _CELL_PX for side in frame.shape)
    return Patch.like(frame, Box(0, 0, w, h), _CELL_PX, camera)


def _parts(patch: Patch, likelier: np.ndarray) -> np.ndarray:
    """(h, w) int: the parts in these colours that stand out from what everything stands on; 0 elsewhere."""
    return connected_components(likelier[patch.codes] & standing_out(patch, patch.depth_m > 0))


def _in(part: np.ndarray, region: np.ndarray) -> np.ndarray:
    """(K,) bool: the parts (h, w) int of which a share lies in a region (h, w) bool."""
    return np.bincount(part.ravel(), region.ravel()) > _SAME * np.maximum(np.bincount(part.ravel()), 1)
