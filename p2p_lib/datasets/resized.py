"""A sequence at another resolution: what a camera of fewer pixels at the same place would have delivered, or more."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput
from p2p_lib.core.interfaces import Wrapper
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.datasets.sequence import Sequence


@dataclass(frozen=True, eq=False)
class Resized(Wrapper):
    """A :class:`~p2p_lib.datasets.sequence.Sequence` scaled by a factor up to 4.

    Colour is averaged over areas, or interpolated where it is enlarged, which shows what more pixels cost, not what
    they gain; depth and masks are taken from the nearest pixel, since averages across an edge are neither of its sides.
    Names, times, truth and ``visible_px`` stay the original's, so that the same frames are scored.
    """

    original: Sequence
    scale: float

    def __post_init__(self) -> None:
        if not 0 < self.scale <= 4:
            raise BadInput("scale", self.scale, "above 0 and at most 4")

    @property
    def camera(self) -> Camera:
        """The original's camera with its pixels merged or split."""
        camera = self.original.camera
        return camera.resized(*_size((camera.height, camera.width), self.scale))

    def frame(self, i: int) -> Frame:
        """The i-th image, resized."""
        frame, size = self.original.frame(i), (self.camera.width, self.camera.height)
        depth_m = cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST_EXACT)
        how = cv2.INTER_AREA if self.scale <= 1 else cv2.INTER_CUBIC
        return replace(frame, rgb=cv2.resize(frame.rgb, size, interpolation=how), depth_m=depth_m)

    def masks(self, i: int) -> dict[str, np.ndarray] | None:
        """The masks at frame i, resized."""
        masks = self.original.masks(i)
        return None if masks is None else {name: _resized(mask, self.scale) for name, mask in masks.items()}

    def __len__(self) -> int:
        return len(self.original)


def resized_prompt(prompt: Prompt, scale: float) -> Prompt:
    """A prompt of a sequence, in the pixels of its :class:`Resized`."""
    points, negative = ((px + 0.5) * scale - 0.5 for px in (prompt.points_px, prompt.negative_px))
    box = None if prompt.box_px is None else (prompt.box_px + 0.5) * scale - 0.5
    mask = None if prompt.mask is None else _resized(prompt.mask, scale)
    return replace(prompt, points_px=points, negative_px=negative, box_px=box, mask=mask)


def _size(shape: tuple[int, int], scale: float) -> tuple[int, int]:
    """Width and height of an image (H, W) that is scaled."""
    return round(shape[1] * scale), round(shape[0] * scale)


def _resized(mask: np.ndarray, scale: float) -> np.ndarray:
    """A mask (H, W) bool, scaled."""
    size = _size(mask.shape, scale)
    return cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST_EXACT) > 0
