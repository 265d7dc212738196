"""A smaller camera at the same place sees the same points at the same places."""

from copy import copy

import numpy as np
import pytest

from p2p_lib.core.errors import BadInput
from p2p_lib.core.prompts import Prompt
from p2p_lib.datasets.resized import Resized, resized_prompt
from p2p_lib.datasets.sequence import open_sequence


@pytest.fixture(scope="module")
def half() -> Resized:
    return Resized(open_sequence("synthetic/crossing"), 0.5)


def test_pixels_are_merged_where_they_lie(half):
    camera, original = half.camera, half.original.camera
    assert (camera.width, camera.height) == (320, 240)
    p_cam = np.random.default_rng(0).normal([0, 0, 1], 0.1, (50, 3))
    # The centre of the first small pixel lies between the first two large ones.
    np.testing.assert_allclose(2 * camera.project(p_cam) + 0.5, original.project(p_cam), atol=1e-9)


def test_pictures_agree_with_the_camera(half):
    small, large = half.frame(3), half.original.frame(3)
    assert small.rgb.shape == (240, 320, 3) and small.depth_m.shape == (240, 320) and small.index == 3
    blocks = large.rgb.reshape(240, 2, 320, 2, 3).mean((1, 3))
    assert np.abs(small.rgb - blocks).max() <= 0.75, "areas averaged"
    nearest = large.depth_m.reshape(240, 2, 320, 2)
    assert (np.abs(nearest - small.depth_m[:, None, :, None]).min((1, 3)) == 0).all(), "a depth that was measured"


def test_masks_shrink_and_the_scored_frames_stay(half):
    masks, large = half.masks(3), half.original.masks(3)
    for name, mask in masks.items():
        assert mask.shape == (240, 320)
        assert 4 * mask.sum() == pytest.approx(large[name].sum(), rel=0.03)
    assert half.visible_px(3) == half.original.visible_px(3)
    assert half.truth is half.original.truth and len(half) == len(half.original) and half.name == half.original.name


def test_a_prompt_stays_on_what_it_was_said_of(half):
    """Two large pixels' centres meet in the small one's; a mask is that of the smaller image."""
    mask = half.original.masks(3)["box"]
    clicks = Prompt(
        "box", 3, np.array([[0.5, 0.5], [101, 60]]), np.array([[20.5, 8.5]]), np.array([10.5, 4.5, 30.5, 8.5])
    )
    small = resized_prompt(clicks, 0.5)
    assert small.points_px.tolist() == [[0, 0], [50.25, 29.75]] and small.negative_px.tolist() == [[10, 4]]
    assert small.box_px.tolist() == [5, 2, 15, 4] and small.frame == 3
    painted = resized_prompt(Prompt("box", 3, mask=mask), 0.5)
    np.testing.assert_array_equal(painted.mask, half.masks(3)["box"])


def test_enlarged_and_made_small_again_it_is_what_it_was(half):
    original = half.original
    large = Resized(original, 2.0)
    assert (large.camera.width, large.camera.height) == (1280, 960)
    blocks = large.frame(3).rgb.reshape(480, 2, 640, 2, 3)
    assert np.ptp(blocks, axis=(1, 3)).max() > 5, "colour is interpolated, not repeated"
    again = Resized(large, 0.5)
    assert again.camera == original.camera
    back, frame = again.frame(3), original.frame(3)
    np.testing.assert_array_equal(back.depth_m, frame.depth_m)
    assert np.abs(back.rgb.astype(float) - frame.rgb).mean() < 2
    np.testing.assert_array_equal(again.masks(3)["box"], original.masks(3)["box"])


@pytest.mark.parametrize("scale", [0, -0.5, 4.5])
def test_a_scale_that_is_none(scale):
    with pytest.raises(BadInput, match="scale"):
        Resized(open_sequence("synthetic/crossing"), scale)


def test_it_can_be_copied(half):
    assert copy(half).name == half.name
