"""Evidence on made-up patches: what depth, the support plane and the reconstructed surface say of each pixel."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import SegmentationConfig
from p2p_lib.core.interfaces import Hint
from p2p_lib.segmenters.builtin.cut import by_geometry, by_surface, warped
from p2p_lib.segmenters.builtin.patch import Box, Patch

H, W = 30, 40
CAMERA = Camera(300.0, 300.0, (W - 1) / 2, (H - 1) / 2, W, H)
CONFIG = SegmentationConfig()
WEIGHT = CONFIG.geometry_weight
CARD = np.s_[8:22, 10:30]
#: n . p = d of a plane one metre away that faces the camera.
WALL = np.array([0, 0, -1.0, -1.0])


def patch_of(depth_m: np.ndarray, gray: np.ndarray | None = None) -> Patch:
    gray = np.zeros((H, W), np.uint8) if gray is None else gray
    return Patch(
        Box(0, 0, W, H), 1, CAMERA, np.repeat(gray[..., None], 3, 2), depth_m, np.full((H, W), 0.002, np.float32)
    )


def card_before_wall(at=CARD, card_m=0.9) -> tuple[Patch, np.ndarray, np.ndarray]:
    """A patch, seeds on the card, and where the card is."""
    depth, card, seeds = np.ones((H, W), np.float32), np.zeros((H, W), bool), np.zeros((H, W), bool)
    depth[at], card[at] = card_m, True
    seeds[12:15, 15:18] = True
    return patch_of(depth), seeds, card


def test_what_is_connected_with_the_seeds_is_the_object():
    patch, seeds, card = card_before_wall()
    log_odds, component = by_geometry(patch, seeds, None, CONFIG)
    assert component.sum() > 0.85 * card.sum() and not (component & ~card).any()
    assert (log_odds[component] == WEIGHT).all() and (log_odds[0] == -WEIGHT).all()


def test_what_goes_on_beyond_the_patch_is_not_one_object():
    patch, seeds, _ = card_before_wall(np.s_[8:22, :])
    log_odds, component = by_geometry(patch, seeds, None, CONFIG)
    assert not component.any() and not (log_odds > 0).any()


def test_depth_beyond_the_reach_is_background_even_without_an_edge():
    """A slope goes on beyond the patch on both sides, so that nothing but its depth speaks."""
    depth = np.repeat(np.linspace(0.85, 1.1, W, dtype=np.float32)[None], H, 0)
    patch, seeds = patch_of(depth), np.zeros((H, W), bool)
    seeds[15, 3] = True
    log_odds, component = by_geometry(patch, seeds, None, replace(CONFIG, reach_m=0.1))
    far = np.abs(depth - depth[15, 3]) > 0.1
    assert not component.any() and (log_odds[far] < 0).all() and not log_odds[~far].any()


def test_a_slope_between_an_object_and_its_support_does_not_join_them():
    """Without the plane, all of it would be one thing that goes on beyond the patch."""
    patch, seeds, _ = card_before_wall(card_m=0.93)
    patch.depth_m[8:22, 22:38] = np.linspace(0.93, 1.0, 16)
    _, component = by_geometry(patch, seeds, WALL, CONFIG)
    assert component[9:20, 11:21].all() and not component[:, 37:].any() and not component[:7].any()
    assert not by_geometry(patch, seeds, None, CONFIG)[1].any()


def test_a_strip_above_the_support_plane_belongs_to_the_plane():
    patch, seeds, _card = card_before_wall(card_m=0.97)
    low = np.zeros((H, W), bool)
    low[20:22, 10:30] = True
    patch.depth_m[low] = 0.995
    log_odds, component = by_geometry(patch, seeds, WALL, CONFIG)
    assert component.any() and not (component & low).any()
    assert (log_odds[20, 14:26] == -WEIGHT).all(), "once: colour may say that it touches its support"


@pytest.mark.parametrize("plane", [WALL, None])
def test_what_lies_flat_in_its_support_is_not_told_from_it_by_depth(plane):
    patch, seeds, _ = card_before_wall(card_m=0.999)
    log_odds, component = by_geometry(patch, seeds, plane, CONFIG)
    assert not log_odds.any() or plane is None
    assert not component.any()


def test_the_surface_speaks_for_what_lies_on_it_and_against_what_is_before_it():
    distance_m = np.full((H, W), np.nan, np.float32)
    distance_m[:, :4], distance_m[:, 4:8], distance_m[:, 8:12] = 0.001, 0.05, -0.05
    says = by_surface(patch_of(np.ones((H, W), np.float32)), Hint(distance_m=distance_m), CONFIG)
    assert (says[:, :4] == CONFIG.surface_weight).all() and (says[:, 4:8] == -CONFIG.surface_weight).all()
    assert not says[:, 8:].any()
    assert not by_surface(patch_of(np.ones((H, W), np.float32)), Hint(), CONFIG).any()


def test_what_lies_on_the_surface_of_another_object_alone_is_not_of_this_one():
    """Where both surfaces are, neither says anything against the other; a pose of few points says nothing at all."""
    own, other = (np.full((H, W), np.nan, np.float32) for _ in range(2))
    own[:, :8], other[:, 4:12] = 0.001, 0.002
    points_px, patch = np.zeros((CONFIG.find_points, 2)), patch_of(np.ones((H, W), np.float32))
    says = by_surface(patch, Hint(points_px, own), CONFIG, [Hint(points_px, other), Hint()])
    assert (says[:, :8] == CONFIG.surface_weight).all() and (says[:, 8:12] == -CONFIG.surface_weight).all()
    assert not says[:, 12:].any()
    assert (by_surface(patch, Hint(), CONFIG, [Hint(points_px, other)])[:, 4:12] == -CONFIG.surface_weight).all()
    assert not by_surface(patch, Hint(), CONFIG, [Hint(points_px[1:], other)]).any()


def test_a_mask_moves_with_the_texture():
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 255, (H // 2, W // 2)), np.ones((2, 2))).astype(np.uint8)
    depth = np.ones((H, W), np.float32)
    before, after = patch_of(depth, texture), patch_of(depth, np.roll(texture, 2, 1))
    was = np.zeros((H, W), np.float32)
    was[10:20, 10:20] = 1
    now, _ = warped(was, before, after)
    moved = np.roll(was, 2, 1)
    assert np.abs(now - moved).mean() < np.abs(was - moved).mean() / 2


def test_nothing_far_from_a_known_surface_is_of_the_object():
    """What lies off the whole volume, by a pose that enough points give; one of few points tells nothing."""
    distance_m = np.full((H, W), np.nan, np.float32)
    distance_m[:, : W // 2] = np.inf
    sure, unsure = (np.zeros((k, 2)) for k in (CONFIG.find_points, CONFIG.find_points - 1))
    patch = patch_of(np.ones((H, W), np.float32))
    says = by_surface(patch, Hint(sure, distance_m), CONFIG)
    before = by_surface(patch, Hint(unsure, distance_m), CONFIG)
    far = patch.nearest(distance_m) == np.inf
    assert far.any() and (says[far] < before[far]).all() and not says[~far].any()
