"""Sources of candidates: where they lie, how they are spread, and that the appendix's variants are what they say."""

import cv2
import numpy as np
import pytest

from p2p_lib.core.backends import DETECTORS, make_detector
from p2p_lib.core.config import SamplingConfig, preset
from p2p_lib.core.types import Frame
from p2p_lib.method.sampling import choose
from studies.sampling import CHOICES

DEFAULT = SamplingConfig()
EMBEDDED = pytest.mark.parametrize("name", ["corners", "uniform", "farthest", "orb"])
H, W = 240, 320


def textured(seed=0):
    rng = np.random.default_rng(seed)
    layers = [cv2.resize(rng.integers(0, 256, (s, s, 3)).astype(np.float32), (W, H)) for s in (8, 24, 70)]
    return np.clip(np.mean(layers, 0) * 1.5 - 60, 0, 255).astype(np.uint8)


def disc(at=(160, 120), radius=60):
    return cv2.circle(np.zeros((H, W), np.uint8), at, radius, 1, -1) > 0


def detect(name, mask, rgb=None, config=DEFAULT, seed=0):
    frame = Frame(0, 0.0, textured() if rgb is None else rgb, np.full((H, W), 0.5, np.float32))
    return make_detector(name, config, np.random.default_rng(seed)).detect(frame, mask)


@EMBEDDED
@pytest.mark.parametrize("at", [(160, 120), (0, 0), (319, 239), (10, 200)])
def test_candidates_lie_in_the_mask_best_first(name, at):
    mask = disc(at)
    found = detect(name, mask)
    least = 1 if name == "orb" else 20  # ORB needs a whole patch around a corner
    assert len(found.score) >= least * (at == (160, 120) or name != "orb")
    px = np.rint(found.uv_px).astype(int)
    assert mask[px[:, 1], px[:, 0]].all()
    assert (np.diff(found.score) <= 0).all() and ((found.score >= 0) & (found.score <= 1)).all()
    assert len(found.score) <= DEFAULT.candidates


@EMBEDDED
def test_empty_masks_single_pixels_and_small_limits(name):
    assert len(detect(name, np.zeros((H, W), bool)).score) == 0
    one = np.zeros((H, W), bool)
    one[100, 100] = True
    assert len(detect(name, one).score) == (1 if name in ("uniform", "farthest") else len(detect(name, one).score)) <= 1
    assert 0 < len(detect(name, disc(), config=SamplingConfig(candidates=7)).score) <= 7


@EMBEDDED
def test_the_same_seed_gives_the_same(name):
    np.testing.assert_array_equal(detect(name, disc()).uv_px, detect(name, disc()).uv_px)


def test_uniform_is_uniform():
    mask = np.zeros((H, W), bool)
    mask[40:80, 40:240] = True  # five squares in a row
    uv = np.concatenate([detect("uniform", mask, seed=s).uv_px for s in range(20)])
    counts = np.histogram(uv[:, 0], np.arange(40, 241, 40))[0]
    expected = len(uv) / 5
    # Draws without replacement scatter less than this; 5 standard deviations of independent ones.
    assert np.abs(counts - expected).max() < 5 * np.sqrt(expected)
    assert len(np.unique(detect("uniform", mask).uv_px, axis=0)) == DEFAULT.candidates


def test_each_farthest_point_is_the_farthest_of_the_mask():
    mask = disc(radius=20)
    found = detect("farthest", mask, config=SamplingConfig(candidates=40))
    every = np.argwhere(mask)[:, ::-1]
    assert np.linalg.norm(found.uv_px[0] - [160, 120]) < 1
    for k in range(1, 40):
        gap = np.linalg.norm(every[:, None] - found.uv_px[None, :k], axis=-1).min(1)
        own = np.linalg.norm(found.uv_px[k] - found.uv_px[:k], axis=1).min()
        assert own == pytest.approx(gap.max())


def test_orb_finds_the_corners_of_a_square():
    rgb = np.full((H, W, 3), 220, np.uint8)
    rgb[100:140, 100:140] = 30
    found = detect("orb", np.ones((H, W), bool), rgb)
    for corner in ((99.5, 99.5), (139.5, 99.5), (99.5, 139.5), (139.5, 139.5)):
        assert np.linalg.norm(found.uv_px - corner, axis=1).min() < 3
    shifted = detect("orb", disc((180, 130)), np.roll(textured(), (10, 20), (0, 1)))
    still = detect("orb", disc())
    gap = np.linalg.norm(still.uv_px[:, None] + [20, 10] - shifted.uv_px[None], axis=-1).min(1)
    assert np.median(gap) < 0.05, "positions are those of the whole picture, not of a cut-out"


def test_the_variants_of_the_comparison_are_what_they_say():
    for detector, settings in CHOICES.values():
        assert detector in DETECTORS
        preset().with_values(settings)
    config = preset().with_values(CHOICES["score alone"][1]).sampling
    found = detect("corners", disc(), config=config)
    assert choose(found, np.zeros((0, 2)), 30, config).tolist() == list(range(30))  # the best, wherever they are
    config = preset().with_values(CHOICES["uniform"][1]).sampling
    found = detect("uniform", disc(), config=config)
    assert choose(found, np.zeros((0, 2)), 30, config).tolist() == list(range(30))  # the first drawn


def test_blobs_are_found_at_their_middle():
    spots = np.array([[130, 100], [190, 110], [160, 150]])
    far2 = ((np.stack(np.meshgrid(np.arange(W), np.arange(H)), -1)[:, :, None] - spots) ** 2).sum(-1)
    grey = 60 + 150 * np.exp(-0.5 * far2 / 5.0**2).max(-1)
    found = detect("corners", disc(), np.repeat(grey[..., None], 3, 2).astype(np.uint8))
    near = np.linalg.norm(found.uv_px[:, None] - spots, axis=-1) < 0.5
    best = [found.score[at].max() for at in near.T]
    assert min(best) > 0.5, "blobs stand above corners"
