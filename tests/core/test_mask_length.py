"""How long what masks hold usually is, on bars before a wall."""

import warnings

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import Doubt
from p2p_lib.core.mask_length import UsualLengths, mask_length_m
from p2p_lib.core.types import Frame

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)


def bar(k: int, columns: int, left: int = 40) -> tuple[Frame, np.ndarray]:
    """A frame in which so many columns of a bar, 1 m away, are in its mask."""
    mask = np.zeros((240, 320), bool)
    mask[100:120, left : left + columns] = True
    return Frame(k, k / 30, np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32)), mask


def test_the_length_is_that_of_what_is_measured():
    assert mask_length_m(*bar(0, 150), CAMERA) == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize(("usual", "doubted"), [(60, True), (120, False)])
def test_a_correction_is_compared_with_what_is_usual_not_with_the_first_mask(usual, doubted):
    lengths = UsualLengths(CAMERA)
    for k in range(20):
        assert not lengths.doubt("bar", *bar(k, usual if k else 60), prompted=k == 0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert bool(lengths.doubt("bar", *bar(20, 130), prompted=True)) == doubted


def test_of_what_was_removed_nothing_is_known():
    lengths = UsualLengths(CAMERA)
    lengths.doubt("bar", *bar(0, 60), prompted=True)
    lengths.forget("bar")
    assert not lengths.doubt("bar", *bar(1, 130), prompted=True)


def test_what_the_border_of_the_image_cuts_is_not_the_usual_length():
    """A bar that comes into view is not doubted before all of it was seen, nor for how short it was before."""
    lengths = UsualLengths(CAMERA)
    for k in range(20):
        assert not lengths.doubt("bar", *bar(k, 60, left=k % 3), prompted=k == 0)
    assert not lengths.doubt("bar", *bar(20, 130), prompted=True)
    with pytest.warns(Doubt, match="times as long as before"):
        assert lengths.doubt("bar", *bar(21, 260), prompted=True)
