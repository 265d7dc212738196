"""Pictures that move in a known way, for models whose weights say nothing."""

import cv2
import numpy as np
import pytest

from p2p_lib.core.types import Frame

SHAPE = (480, 640)


def picture(t: int, shape=SHAPE, seed=0) -> Frame:
    """Noise of several scales that slides by 3 px right and 1 px down a frame."""
    rng = np.random.default_rng(seed)
    h, w = shape
    page = sum(cv2.resize(rng.integers(0, 256, (s, s, 3)).astype(np.float32), (w, h)) for s in (7, 19, 60)) / 3
    rgb = np.roll(page, (t, 3 * t), (0, 1)).round().astype(np.uint8)
    return Frame(t, t / 30, rgb, np.ones(shape, np.float32))


@pytest.fixture(scope="session")
def frames():
    return [picture(t) for t in range(26)]
