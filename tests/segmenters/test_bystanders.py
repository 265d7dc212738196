"""What was beside an object when it vanished, on red boards before a grey wall and on a red table."""

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.bystanders import Bystanders
from p2p_lib.segmenters.builtin.colours import colour_codes, histogram
from p2p_lib.segmenters.builtin.patch import Box
from p2p_lib.segmenters.builtin.target import seen_in

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
OWN, BESIDE = np.s_[80:140, 40:90], np.s_[80:140, 200:250]
RED = (200, 40, 30)
COLOURS = histogram(colour_codes(np.full((100, 3), RED, np.uint8)))


def picture(k: int = 0, **boards) -> Frame:
    """A wall 1.2 m away; of each board where it is and its depth."""
    rgb, depth_m = np.full((240, 320, 3), 120, np.uint8), np.full((240, 320), 1.2, np.float32)
    for where, z_m in boards.values():
        rgb[where], depth_m[where] = RED, z_m
    return Frame(k, k / 30, rgb, depth_m)


def beside(frame: Frame) -> Bystanders:
    mask = np.zeros(frame.shape, bool)
    mask[OWN] = True
    seen = seen_in(frame, mask, Box(0, 0, 320, 240), 20)
    assert seen is not None
    return Bystanders.beside(seen, COLOURS, frame, CAMERA)


def share(of: Bystanders, where) -> float:
    mask = np.zeros((240, 320), bool)
    mask[where] = True
    return float(of.there[mask[2::4, 2::4]].mean())


def test_a_board_beside_the_object_is_followed_and_the_object_is_none():
    known = beside(picture(own=(OWN, 0.7), other=(BESIDE, 0.7)))
    assert share(known, OWN) == 0 and share(known, BESIDE) > 0.7 and known.there.sum() < 250
    for k in range(1, 10):
        moved = np.s_[80:140, 200 - 10 * k : 250 - 10 * k]
        known = known.followed(picture(k, other=(moved, 0.7)))
        assert share(known, moved) > 0.7, "it moves, or the camera does"
    again = known.followed(picture(10, own=(OWN, 0.7), other=(moved, 0.7)))
    assert share(again, OWN) == 0 and share(again, moved) > 0.7
    out = np.s_[80:140, 150:200]
    assert share(known.followed(picture(10, own=(out, 0.7))), out) == 0, "a tenth of it is where the other was"


def test_where_a_hand_was_the_object_may_come_out():
    hand = picture(own=(OWN, 0.7), hand=(BESIDE, 0.7))
    hand.rgb[BESIDE] = 210, 160, 130
    assert share(beside(hand).followed(picture(1, own=(BESIDE, 0.7))), BESIDE) == 0


@pytest.mark.parametrize(("far_m", "stays"), [(0.7, True), (0.9, False)])
def test_what_comes_out_before_it_is_something_else(far_m, stays):
    known = beside(picture(own=(OWN, 0.7), other=(BESIDE, far_m)))
    assert (share(known.followed(picture(1, nearer=(BESIDE, 0.7))), BESIDE) > 0.7) == stays


def test_a_table_of_its_colours_is_none_and_what_stands_on_it_may_come_out():
    """A red box stands on a red table: depth has no edge at its foot."""
    v = np.arange(240)[:, None]
    slant_m = np.broadcast_to(np.where(v > 60, 1.2 * 60 / np.maximum(v, 1), 1.2), (240, 320))

    def scene(k: int, box: bool) -> Frame:
        frame = picture(k, own=(OWN, 0.6))
        frame.depth_m[60:] = np.where(frame.rgb[60:, :, 0] == RED[0], frame.depth_m[60:], slant_m[60:])
        frame.rgb[60:] = RED
        if box:
            frame.depth_m[100:140, 200:250] = slant_m[140, 0]
        return frame

    known = beside(scene(0, False))
    assert share(known, np.s_[150:230, 150:300]) < 0.1
    assert share(known.followed(scene(1, True)), np.s_[104:130, 204:246]) == 0


def test_which_parts_they_are():
    known = beside(picture(own=(OWN, 0.7), other=(BESIDE, 0.7)))
    patch, part = known.patch, np.zeros(known.there.shape, int)
    part[20:35, 10:22], part[20:35, 50:68] = 1, 2
    assert known.are(patch, part).tolist() == [False, False, True]
