"""Which pixels an image and a mask hold."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from p2p_lib.core.image import in_image, in_mask, nearest_px

SHAPE = (4, 6)
PLACES = np.array([(0, 0), (5, 3), (5.4, 3.4), (-0.4, 0), (5.6, 1), (2, -0.6), (np.nan, 1), (np.inf, 2)])


def test_an_image_ends_half_a_pixel_beyond_its_outermost_centres():
    assert in_image(PLACES, SHAPE).tolist() == [True, True] + 6 * [False]
    assert in_image(PLACES, SHAPE, -0.5).tolist() == [True] * 4 + [False] * 4
    assert in_image(PLACES, SHAPE, 1).tolist() == 8 * [False]


def test_a_full_mask_holds_what_the_image_holds():
    assert in_mask(PLACES, np.ones(SHAPE, bool)).tolist() == [True] * 4 + [False] * 4


@given(st.floats(-9, 15), st.floats(-9, 13), st.integers(0, 23))
def test_a_mask_of_one_pixel_holds_the_square_around_its_centre(u, v, at):
    row, column = divmod(at, SHAPE[1])
    mask = np.zeros(SHAPE, bool)
    mask[row, column] = True
    off = max(abs(u - column), abs(v - row))
    if abs(off - 0.5) > 1e-9:
        assert bool(in_mask(np.array([[u, v]]), mask)[0]) == (off < 0.5)


def test_the_nearest_pixel_is_one_of_the_image():
    u, v = nearest_px(PLACES, SHAPE)
    assert list(zip(u.tolist(), v.tolist(), strict=True)) == [
        (0, 0), (5, 3), (5, 3), (0, 0), (5, 1), (2, 0), (0, 1), (5, 2)
    ]  # fmt: skip
