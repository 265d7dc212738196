"""Alignment of patches against known warps, known noise, and the geometry of an edge."""

import cv2
import numpy as np
import pytest

from p2p_lib.core.config import TrackingConfig
from p2p_lib.trackers.builtin.appearance import RADIUS, Alignment, Patches, align, take


def texture(seed: int = 0, shape: tuple[int, int] = (240, 320), blur_px: float = 2.0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, shape)
    smooth = cv2.GaussianBlur(noise, (0, 0), blur_px)
    return (128 + 40 * smooth / smooth.std()).astype(np.float32)


def grid(shape: tuple[int, int] = (240, 320), step: int = 20, margin: int = 50) -> np.ndarray:
    y, x = np.mgrid[margin : shape[0] - margin : step, margin : shape[1] - margin : step]
    return np.stack([x.ravel(), y.ravel()], -1) + 0.3


def warped(image: np.ndarray, A: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The picture in which the point x of ``image`` is at A x + t."""
    return cv2.warpAffine(image, np.hstack([A, t[:, None]]), image.shape[::-1], flags=cv2.INTER_CUBIC)


def start(n: int) -> np.ndarray:
    return np.tile(np.eye(2), (n, 1, 1))


def aligned(image: np.ndarray, patches: Patches, uv: np.ndarray, A: np.ndarray, iterations: int) -> Alignment:
    """Of all patches, one near each of uv."""
    return align(image, patches, np.arange(len(patches)), uv, A, iterations)


@pytest.mark.parametrize("gain, offset", [(1.0, 0.0), (0.6, 30.0), (1.4, -20.0)])
def test_finds_an_affine_warp_whatever_the_light(gain, offset):
    image, uv = texture(), grid()
    A, t = np.array([[1.06, -0.09], [0.05, 0.95]]), np.array([-3.4, 4.7])
    seen = aligned(gain * warped(image, A, t) + offset, take(image, uv), uv @ A.T + t + [1.5, -1.2], start(len(uv)), 12)
    error_px = np.linalg.norm(seen.uv_px - (uv @ A.T + t), axis=1)
    assert np.median(error_px) < 0.03 and (error_px < 0.2).mean() > 0.95
    good = error_px < 0.2
    np.testing.assert_allclose(np.median(seen.A[good], 0), A, atol=0.01)
    assert np.median(seen.ncc) > 0.99
    np.testing.assert_allclose(np.median(seen.contrast_ratio), gain, rtol=0.1)


@pytest.mark.parametrize("slope", [(0.0, 0.0), (4.0, 0.0), (-2.0, 3.0)])
def test_light_that_falls_off_across_a_patch_moves_nothing(slope):
    """Shading of a round body stays in the picture while the body turns: it must not hold the points back."""
    image, uv, t = texture(), grid(), np.array([2.0, -1.0])
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    lit = warped(image, np.eye(2), t) + slope[0] * (x - 160) + slope[1] * (y - 120)
    seen = aligned(lit.astype(np.float32), take(image, uv), uv, start(len(uv)), 12)
    error_px = np.linalg.norm(seen.uv_px - (uv + t), axis=1)
    assert np.median(error_px) < 0.03 and (error_px < 0.2).mean() > 0.95 and np.median(seen.ncc) > 0.99


def test_another_place_does_not_correlate():
    patches = take(texture(0), grid())
    seen = aligned(texture(1), patches, grid(), start(len(grid())), 8)
    # Free to shift and shear, a few chance patches come close: hence the further checks of the tracker.
    assert np.median(seen.ncc) < 0.6 and (seen.ncc > TrackingConfig().return_ncc).mean() < 0.1


def test_error_is_of_the_size_it_says():
    image, uv, rng = texture(blur_px=3.0), grid(step=10), np.random.default_rng(3)
    seen = aligned(image + rng.normal(0, 12, image.shape).astype(np.float32), take(image, uv), uv, start(len(uv)), 10)
    error, cov = seen.uv_px - uv, seen.cov_px2
    squared = np.einsum("ni,nij,nj->n", error, np.linalg.inv(cov), error)
    # Conservative by design (a patch is worth few samples), but not by orders of magnitude; expected 2.
    assert 0.1 < np.mean(squared) < 3
    sigma = np.sqrt(np.trace(cov, axis1=1, axis2=2))
    ranks = [np.argsort(np.argsort(v)) for v in (sigma, np.linalg.norm(error, axis=1))]
    assert np.corrcoef(*ranks)[0, 1] > 0.2


def test_an_edge_holds_a_point_across_and_not_along():
    x = np.arange(320, dtype=np.float32)
    image = np.tile(128 + 60 * np.tanh((x - 160) / 2), (240, 1)).astype(np.float32)
    seen = aligned(image, take(image, np.array([[160.0, 120.0]])), np.array([[160.4, 120.0]]), start(1), 10)
    assert abs(seen.uv_px[0, 0] - 160) < 0.05
    across, along = np.sqrt(seen.cov_px2[0, 0, 0]), np.sqrt(seen.cov_px2[0, 1, 1])
    assert along > 1.0 > across and along > 20 * across


def test_leaving_the_picture_is_no_match():
    image = texture()
    seen = aligned(image, take(image, np.array([[160.0, 120.0]])), np.array([[-40.0, 120.0]]), start(1), 4)
    assert seen.ncc[0] == -1 and np.isfinite(seen.uv_px).all()


def test_a_blank_picture_gives_finite_numbers():
    blank = np.full((100, 100), 90, np.float32)
    patches = take(blank, np.array([[50.0, 50.0]]))
    seen = aligned(blank, patches, np.array([[52.0, 50.0]]), start(1), 4)
    assert all(np.isfinite(v).all() for v in vars(seen).values()) and patches.contrast[0] <= 1


def test_no_points():
    assert len(take(texture(), np.zeros((0, 2)))) == 0
    seen = aligned(texture(), Patches.empty(0), np.zeros((0, 2)), np.zeros((0, 2, 2)), 3)
    assert seen.uv_px.shape == (0, 2) and RADIUS > 0
