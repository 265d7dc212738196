"""Corners, and their descriptors under known turns, scales and slants of the surface."""

import cv2
import numpy as np
import pytest

from p2p_lib.trackers.builtin import features

SHAPE = (240, 320)


def picture(seed: int = 0) -> np.ndarray:
    """Blocks and blobs of many sizes, uint8."""
    rng = np.random.default_rng(seed)
    h, w = SHAPE
    layers = [cv2.resize(rng.normal(0, 1, (h // s, w // s)), (w, h), interpolation=cv2.INTER_CUBIC) for s in (4, 8, 24)]
    return np.clip(128 + 30 * sum(layers), 0, 255).astype(np.uint8)


def described(image: np.ndarray, A: np.ndarray, limit: int = 200, region=None) -> tuple[np.ndarray, np.ndarray]:
    """Corners, and descriptors on a surface whose steps appear in the picture as the columns of A."""
    uv = features.detect(image, region, limit)
    return uv, features.describe(image, uv, [np.tile(1.5 * A, (len(uv), 1, 1))])[:, 0]


def seen_under(A: np.ndarray) -> np.ndarray:
    """(2, 3): the picture's plane warped by A about its middle."""
    middle = np.array(SHAPE[::-1]) / 2
    return np.column_stack([A, middle - A @ middle])


def turned(deg: float) -> np.ndarray:
    c, s = np.cos(np.radians(deg)), np.sin(np.radians(deg))
    return np.array([[c, -s], [s, c]])


WARPS = {
    "as it was": np.eye(2),
    "turned": turned(-100),
    "smaller": 0.7 * turned(20),
    "at a slant of 53 degrees": np.diag([0.6, 1.0]),
    "turned, then at a slant of 60 degrees": np.diag([1.0, 0.5]) @ turned(35),
}


@pytest.mark.parametrize("A", WARPS.values(), ids=WARPS)
def test_finds_corners_again_where_the_surface_is_known(A):
    image, M = picture(), seen_under(A)
    uv, before = described(image, np.eye(2))
    uv_after, after = described(cv2.warpAffine(image, M, SHAPE[::-1]), A)
    wanted, found = features.match(before, after, uv_after, 0.8)
    error_px = np.linalg.norm(uv_after[found] - (uv @ M[:, :2].T + M[:, 2])[wanted], axis=1)
    assert len(error_px) > 15 and (error_px < 4).mean() > 0.8


def test_a_slant_that_is_not_known_costs_most_of_them():
    A = WARPS["turned, then at a slant of 60 degrees"]
    image, M = picture(), seen_under(A)
    uv, before = described(image, np.eye(2))
    slanted = cv2.warpAffine(image, M, SHAPE[::-1])

    def right(known: np.ndarray) -> int:
        uv_after, after = described(slanted, known)
        wanted, found = features.match(before, after, uv_after, 0.8)
        there = (uv @ M[:, :2].T + M[:, 2])[wanted]
        return int((np.linalg.norm(uv_after[found] - there, axis=1) < 4).sum())

    assert right(A) > 2 * right(np.eye(2))


def test_another_picture_matches_nothing():
    (_, one), (uv, other) = described(picture(0), np.eye(2)), described(picture(1), np.eye(2))
    assert len(features.match(one, other, uv, 0.8)[0]) < 0.06 * len(one)


def test_two_places_that_look_alike_are_both_named():
    card = picture()[60:160, 80:200]
    twice = np.full(SHAPE, 128, np.uint8)
    twice[20:120, 20:140], twice[120:220, 180:300] = card, card
    twice = np.clip(twice + np.random.default_rng(1).normal(0, 3, twice.shape), 0, 255).astype(np.uint8)
    uv, found = described(twice, np.eye(2))
    uv_left, left = described(card, np.eye(2), 60)
    left = left[(np.abs(uv_left - [60, 50]) < [40, 30]).all(1)]
    wanted, place = features.match(left, found, uv, 0.8)
    named = [uv[place[wanted == i]] for i in range(len(left))]
    twins = [len(at) == 2 and (np.abs(np.abs(at[0] - at[1]) - [160, 100]) < 3).all() for at in named]
    assert len(left) > 5 and np.mean(twins) > 0.6


def test_a_match_is_nearer_than_the_third_place():
    wanted = np.eye(4, dtype=np.float32)[:1]
    at = [np.float32([np.cos(a), np.sin(a), 0, 0]) for a in (0.30, 0.28, 0.32, 0.9)]
    uv = np.array([[10.0, 10], [12, 10], [50, 50], [90, 90]])
    places = features.match(wanted, np.stack(at), uv, 0.8)[1]
    assert list(places) == [1, 2], "the two corners at one place are one place"
    assert not len(features.match(wanted, np.stack(at[:3]), 4 * uv[:3], 0.8)[0]), "three places that look alike"


def test_stays_in_the_region():
    region = np.zeros(SHAPE, bool)
    region[60:160, 100:220] = True
    uv, descriptors = described(picture(), np.eye(2), 100, region)
    px = np.rint(uv).astype(int)
    assert len(uv) > 20 and cv2.dilate(region.view(np.uint8), np.ones((5, 5)))[px[:, 1], px[:, 0]].all()
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1, atol=1e-3)


def test_nothing_to_find():
    assert features.detect(np.full(SHAPE, 70, np.uint8), None, 50).shape == (0, 2)
    assert features.detect(picture(), np.zeros(SHAPE, bool), 50).shape == (0, 2)


def test_a_turn_in_the_plane_is_found_out():
    """Nobody says by how much the surface has turned about its normal."""
    A, image = turned(70), picture()
    M, (uv, before) = seen_under(A), described(image, np.eye(2))
    uv_after, after = described(cv2.warpAffine(image, M, SHAPE[::-1]), np.eye(2))
    wanted, found = features.match(before, after, uv_after, 0.8)
    error_px = np.linalg.norm(uv_after[found] - (uv @ M[:, :2].T + M[:, 2])[wanted], axis=1)
    assert len(error_px) > 60 and (error_px < 4).mean() > 0.8


def test_noise_makes_few_wrong_matches():
    right, wrong = [], []
    for seed in range(3):
        image, noise = picture(seed), np.random.default_rng(seed).normal(0, 20, SHAPE)
        uv = features.detect(image, None, 120)
        steps = np.tile(1.5 * np.eye(2), (len(uv), 1, 1))
        noisy = np.clip(image + noise, 0, 255).astype(np.uint8)
        described = (features.describe(one, uv, [steps])[:, 0] for one in (image, noisy))
        wanted, found = features.match(*described, uv, 0.85)
        same = np.linalg.norm(uv[wanted] - uv[found], axis=1) < 4
        right.append(same.sum() / len(uv))
        wrong.append((~same).sum() / len(uv))
    assert np.mean(right) > 0.9 and np.mean(wrong) < 0.07
