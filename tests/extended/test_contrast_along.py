"""What of an image a turn would change: an oracle by drawing, points on a wall that turns about the line of sight."""

import numpy as np
import pytest

from p2p_lib.core.types import Frame
from p2p_lib.extended.confidence import contrast_along
from tests.method.analytic_scene import CAMERA

SPIN = np.array([0, 0, 1.0, 0, 0, 0])
H, W = CAMERA.height, CAMERA.width


def on_the_wall(radius_m: float = 0.12, count: int = 24) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), np.ones(count)], -1)


def changes(grey) -> np.ndarray:
    """For a brightness (0 to 1) of the points (x, y, 1) of a wall 1 m away."""
    v, u = np.mgrid[:H, :W]
    x, y, _ = np.moveaxis(CAMERA.unproject(np.stack([u, v], -1).reshape(-1, 2), np.ones(H * W)), -1, 0)
    rgb = np.repeat((255 * np.clip(grey(x, y), 0, 1)).astype(np.uint8).reshape(H, W, 1), 3, -1)
    frame = Frame(0, 0.0, rgb, np.ones((H, W), np.float32))
    return contrast_along(frame, CAMERA, np.eye(4), on_the_wall(), SPIN)


def test_spokes_are_seen_to_turn_rings_and_shading_are_not():
    spokes = changes(lambda x, y: 0.5 + 0.4 * np.sin(40 * np.arctan2(y, x)))
    rings = changes(lambda x, y: 0.5 + 0.4 * np.sign(np.hypot(x, y) - 0.12))
    shading = changes(lambda x, y: 0.5 + 2 * x + y)
    assert np.median(spokes) > 20
    assert np.median(rings) < 0.25 * np.median(spokes) and np.median(shading) < 1


def test_it_is_in_grey_levels_of_two_pixels():
    amplitude = 0.2
    px = 1 / CAMERA.fx
    waves = changes(lambda x, y: 0.5 + amplitude * np.sin(2 * np.pi * np.arctan2(y, x) / (8 * px / 0.12)))
    step = 255 * amplitude * 2 * np.sin(2 * np.pi / 8)  # from one pixel before to one behind, a wave of eight pixels
    assert np.median(waves) == pytest.approx(step / np.sqrt(2), rel=0.2)


def test_without_points_there_is_nothing():
    frame = Frame(0, 0.0, np.zeros((H, W, 3), np.uint8), np.ones((H, W), np.float32))
    assert contrast_along(frame, CAMERA, np.eye(4), np.zeros((0, 3)), SPIN).shape == (0,)
