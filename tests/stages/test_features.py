"""Corners and descriptors under known turns and scales."""

import cv2
import numpy as np
import pytest

from p2p_lib.stages import features


def picture(seed: int = 0) -> np.ndarray:
    """Blocks and blobs of many sizes, uint8."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(0, 1, (240 // s, 320 // s)), (320, 240), interpolation=cv2.INTER_CUBIC)
        for s in (4, 8, 24)
    ]
    return np.clip(128 + 30 * sum(layers), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("turn_deg, scale", [(0, 1.0), (35, 1.0), (-100, 1.0), (20, 0.75), (180, 0.6)])
def test_finds_corners_again_after_turn_and_scale(turn_deg, scale):
    image = picture()
    M = cv2.getRotationMatrix2D((160, 120), turn_deg, scale)
    before, after = features.detect(image, None, 200), features.detect(cv2.warpAffine(image, M, (320, 240)), None, 200)
    best, distance, rival = features.nearest(before.descriptors, after, 4.0)
    there = before.uv_px @ M[:, :2].T + M[:, 2]
    best, distance = best[:, 0], distance[:, 0]
    error_px = np.linalg.norm(after.uv_px[best] - there, axis=1)
    sure = distance < 0.8 * rival
    assert sure.sum() > 40 and (error_px[sure] < 4).mean() > 0.75
    right = sure & (error_px < 4)
    A = after.frames[best[right]] @ np.linalg.inv(before.frames[right])
    turned = np.degrees(np.arctan2(A[:, 1, 0], A[:, 0, 0]))
    # OpenCV turns counter-clockwise in a picture whose y runs down.
    assert np.median(np.abs((turned + turn_deg + 180) % 360 - 180)) < 6
    assert abs(np.log(np.median(np.sqrt(np.linalg.det(A))) / scale)) < 0.25


def test_another_picture_matches_nothing():
    _, distance, rival = features.nearest(
        features.detect(picture(0), None, 200).descriptors, features.detect(picture(1), None, 200), 4.0
    )
    assert (distance[:, 0] < 0.8 * rival).mean() < 0.06


def test_two_places_that_look_alike_are_both_named():
    card = picture()[60:160, 80:200]
    twice = np.full((240, 320), 128, np.uint8)
    twice[20:120, 20:140], twice[120:220, 180:300] = card, card
    twice = np.clip(twice + np.random.default_rng(1).normal(0, 3, twice.shape), 0, 255).astype(np.uint8)
    found = features.detect(twice, None, 200, (1.0,))
    left = features.detect(card, None, 60, (1.0,))
    left = left.descriptors[(np.abs(left.uv_px - [60, 50]) < [40, 30]).all(1)]
    best, distance, rival = features.nearest(left, found, 4.0, 2)
    apart = found.uv_px[best[:, 0]] - found.uv_px[best[:, 1]]
    twins = (np.abs(np.abs(apart) - [160, 100]) < 3).all(1)
    assert len(left) > 5 and twins.mean() > 0.8
    assert (distance[twins, 1] < 0.8 * rival[twins]).mean() > 0.7
    # With one place asked for, its twin is the rival.
    np.testing.assert_array_equal(features.nearest(left, found, 4.0)[2][twins], distance[twins, 1])


def test_stays_in_the_region():
    region = np.zeros((240, 320), bool)
    region[60:160, 100:220] = True
    found = features.detect(picture(), region, 100)
    px = np.rint(found.uv_px).astype(int)
    assert len(found) > 20 and cv2.dilate(region.view(np.uint8), np.ones((5, 5)))[px[:, 1], px[:, 0]].all()


def test_nothing_to_find():
    assert len(features.detect(np.full((240, 320), 70, np.uint8), None, 50)) == 0
    assert len(features.detect(picture(), np.zeros((240, 320), bool), 50)) == 0
    assert features.detect(picture(), np.zeros((240, 320), bool), 50).descriptors.shape == (0, features.SIZE)
