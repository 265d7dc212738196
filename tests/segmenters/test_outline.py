"""The outline of a mask by the colours on its two sides, on made images whose depth ends beside their colours."""

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.outline import outlined
from p2p_lib.segmenters.builtin.patch import Box, Patch

H, W = 198, 240  # whole cells
CAMERA = Camera(300.0, 300.0, (W - 1) / 2, (H - 1) / 2, W, H)
CARD = np.s_[60:140, 70:170]


def image(own=(150, 60, 60), other=(70, 90, 90), seed=0) -> Frame:
    """A card before a wall, with the noise of a camera."""
    rgb = np.full((H, W, 3), other, float)
    rgb[CARD] = own
    rgb += np.random.default_rng(seed).normal(0, 6, rgb.shape)
    return Frame(0, 0.0, np.clip(rgb, 0, 255).astype(np.uint8), np.ones((H, W), np.float32))


def outline_of(frame: Frame, mask: np.ndarray) -> np.ndarray:
    patch = Patch.of(frame, Box(0, 0, W, H), CAMERA, SegmentationConfig())
    return outlined(frame, patch, patch.down(mask.astype(np.float32))) > 0.5


def masks(shift=(3, -4)) -> tuple[np.ndarray, np.ndarray]:
    card = np.zeros((H, W), bool)
    card[CARD] = True
    return card, np.roll(card, shift, (0, 1))


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return np.count_nonzero(a & b) / np.count_nonzero(a | b)


@pytest.mark.parametrize("shift", [(3, -4), (-4, 3), (0, 5)])
def test_an_outline_some_pixels_beside_an_edge_of_colour_moves_onto_it(shift):
    card, mask = masks(shift)
    assert overlap(card, mask) < 0.92
    assert overlap(card, outline_of(image(), mask)) > 0.97


def test_where_both_sides_look_alike_it_stays():
    _, mask = masks()
    assert overlap(mask, outline_of(image((70, 90, 90)), mask)) > 0.97


def test_it_does_not_move_far():
    """A mask of a part stays one: the colours of the rest of an object are nothing that it ends at."""
    card, part = masks()
    part[:, :130] = False
    moved = outline_of(image(), part)
    assert (moved[:, :120] == part[:, :120]).all() and np.count_nonzero(moved[CARD]) < 0.6 * np.count_nonzero(card)
