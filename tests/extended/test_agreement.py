"""What says that camera and masks contradict themselves, on made-up values."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core.types import Frame
from p2p_lib.extended.agreement import outline_share, scene_ratio
from p2p_lib.extended.frame_guard import StaleFrames


def scene(left: int, grey: int = 100, wall_m: float = 0.9) -> tuple[Frame, np.ndarray]:
    """A square of 20 px at 0.5 m before a wall, and its mask."""
    mask = np.zeros((40, 80), bool)
    mask[10:30, left : left + 20] = True
    depth_m = np.where(mask, 0.5, wall_m).astype(np.float32)
    return Frame(0, 0.0, np.full((40, 80, 3), grey, np.uint8), depth_m), mask


def table(left: int, shift: int = 0, contrast: int = 30) -> tuple[Frame, np.ndarray]:
    """A table at 0.9 m, half of it under a cloth of small squares; a square object of 60 px at 0.5 m; its mask."""
    squares = np.random.default_rng(0).integers(0, 5, (20, 11)).repeat(16, 0).repeat(16, 1)[:, shift : shift + 160]
    grey = np.hstack([np.full((320, 160), 60), 60 + contrast * squares]).astype(np.uint8)
    mask = np.zeros((320, 320), bool)
    mask[100:160, left : left + 60] = True
    return Frame(0, 0.0, np.repeat(grey[..., None], 3, 2), np.where(mask, 0.5, 0.9).astype(np.float32)), mask


@pytest.mark.parametrize("factor", [0.9, 1.0, 1.2])
def test_a_camera_that_measures_otherwise_does_so_beside_the_object_too(factor):
    (before, mask_before), (frame, mask) = table(100), table(140)
    other = replace(frame, depth_m=np.where(mask, 2.0, factor) * frame.depth_m)
    assert scene_ratio(other, mask, before, mask_before) == pytest.approx(factor), "whatever the object does"
    noise = np.random.default_rng(1).integers(-5, 6, other.rgb.shape)
    noisy = replace(other, rgb=(other.rgb + noise).astype(np.uint8))
    assert scene_ratio(noisy, mask, before, mask_before) == pytest.approx(factor)
    assert scene_ratio(replace(other, depth_m=0 * other.depth_m), mask, before, mask_before) == 1, "no depth"


@pytest.mark.parametrize("contrast", [0, 30])
def test_a_camera_that_comes_nearer_measures_no_otherwise(contrast):
    """Half of the table looks the same from there, and all of a plain one; a cloth does not."""
    (before, mask_before), (frame, mask) = table(100, 0, contrast), table(100, 16, contrast)
    assert (before.rgb == frame.rgb).mean() > 0.5
    assert scene_ratio(replace(frame, depth_m=0.9 * frame.depth_m), mask, before, mask_before) == 1


def test_a_table_whose_grain_looks_alike_from_everywhere_does_not_tell_that_the_camera_stands():
    """Of two places nine in ten look the same, so that nine in ten do wherever the camera goes."""
    (before, mask_before), (frame, mask) = table(100), table(100)
    grain = np.random.default_rng(0).integers(60, 76, (2, 40, 40)).repeat(8, 1).repeat(8, 2)
    before, moved = (replace(before, rgb=np.repeat(of[..., None], 3, 2).astype(np.uint8)) for of in grain)
    nearer = replace(moved, depth_m=0.9 * frame.depth_m)
    assert (np.abs(before.rgb[::8, ::8].astype(int) - moved.rgb[::8, ::8]) < 12).mean() > 0.8
    assert scene_ratio(nearer, mask, before, mask_before) == 1
    (cloth, _), still = table(100), replace(nearer, rgb=frame.rgb)
    assert scene_ratio(still, mask, cloth, mask_before) == pytest.approx(0.9)


def test_a_mask_ends_where_depth_has_steps():
    frame, mask = scene(30)
    assert outline_share(frame, mask) == 1
    wide, beside = cv2.dilate(mask.astype(np.uint8), np.ones((15, 15), np.uint8)) > 0, np.roll(mask, 14, 1)
    assert outline_share(frame, wide) == 0 and outline_share(frame, beside) < 0.4
    half = np.where(np.arange(mask.shape[0])[:, None] < 20, np.roll(frame.depth_m, 8, 1), frame.depth_m)
    assert 0.3 < outline_share(replace(frame, depth_m=half), mask) < 0.9


def test_what_ends_before_something_nearer_has_no_outline_of_its_own():
    (frame, mask), (pit, _) = scene(30), scene(30, wall_m=0.3)
    assert outline_share(frame, mask, own=True) == 1
    assert outline_share(pit, mask) == 1 and outline_share(pit, mask, own=True) == 0


def test_where_nothing_is_measured_an_outline_tells_nothing():
    frame, mask = scene(30)
    assert outline_share(replace(frame, depth_m=np.where(mask, frame.depth_m, 0)), mask) is None
    assert outline_share(frame, np.zeros_like(mask)) is None


def test_at_the_border_of_the_image_depth_has_no_step():
    inside, mask = scene(30)
    shown = [outline_share(*scene(left)) for left in (30, 60, 0)]
    assert shown == [1, pytest.approx(0.75, abs=0.05), pytest.approx(0.75, abs=0.05)], "one side of a square is cut off"
    assert outline_share(inside, np.ones_like(mask)) == 0, "it ends nowhere"


def stood(frame: Frame, before: Frame) -> tuple[bool, bool]:
    """What is said of a frame that comes a tenth of a second after another."""
    return StaleFrames().with_frame(replace(before, time_s=0.0)).with_frame(replace(frame, time_s=0.1)).for_long(0.1)


def test_half_an_image_stands_where_the_other_half_goes_on():
    half, whole, nothing = (True, False), (False, True), (False, False)
    (before, _), (moved, _), (later, _) = scene(20), scene(21), scene(20, grey=101)
    assert stood(later, before) == stood(moved, before) == half, "depth stands, colour stands"
    noisy = later.depth_m.copy()
    noisy[3, 5] += 1e-4
    assert stood(replace(later, depth_m=noisy), before) == nothing, "to the last bit"
    assert stood(before, before) == whole
    assert StaleFrames().with_frame(before).with_frame(before).for_long(0.05) == nothing, "a camera may be slow"
    empty = np.zeros_like(later.depth_m)
    assert stood(replace(later, depth_m=empty), replace(before, depth_m=empty)) == nothing
    black = np.zeros_like(before.rgb)
    assert stood(replace(moved, rgb=black), replace(before, rgb=black)) == nothing
