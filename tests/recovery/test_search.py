"""A surface laid into the image: found where it is, in its colours, and nowhere else."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.types import Frame
from p2p_lib.method.lifecycle import SIGHTED
from p2p_lib.recovery.search import ImageSearch, SurfaceSample

CAMERA = Camera(300.0, 300.0, 160.0, 120.0, 320, 240)
RADIUS_M = 0.05
BLUE, GREY = (90, 100, 150), (150, 150, 150)
PLACE = se3.from_rt(np.eye(3), np.array([0.02, -0.01, 0.6]))
WALL_M = 1.0


def ball_in_front_of_a_wall(colour=BLUE, centre=PLACE[:3, 3], gain: float = 1.0) -> Frame:
    """Exact image of a ball and a wall behind it."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = CAMERA.unproject(np.stack([u, v], -1), np.ones(u.shape))
    a, b, c = (ray**2).sum(-1), ray @ centre, centre @ centre - RADIUS_M**2
    hit = b**2 - a * c >= 0
    z = np.where(hit, (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a, WALL_M)
    rgb = np.where(hit[..., None], colour, GREY) * gain
    return Frame(0, 0.0, rgb.clip(0, 255).astype(np.uint8), z.astype(np.float32))


def sample_of_the_ball(colour=BLUE) -> SurfaceSample:
    """Points spread evenly over the ball."""
    k = np.arange(300) + 0.5
    z, turn = 1 - 2 * k / 300, np.pi * (1 + 5**0.5) * k
    n = np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], -1)
    lab = cv2.cvtColor(np.uint8([[colour]]), cv2.COLOR_RGB2LAB)[0].astype(np.float32)
    return SurfaceSample(RADIUS_M * n, n, np.repeat(lab, 300, 0))


def moved(*by_m: float) -> np.ndarray:
    T = PLACE.copy()
    T[:3, 3] += by_m
    return T


def search(frame: Frame) -> ImageSearch:
    return ImageSearch(frame, CAMERA, preset().depth)


@pytest.mark.parametrize("by_m", [(0, 0, 0), (0.05, 0, 0), (-0.03, 0.04, 0.04)])
def test_it_is_found_near_where_it_is_expected(by_m):
    found = search(ball_in_front_of_a_wall()).about(moved(*by_m), sample_of_the_ball())
    assert found.share > 0.9
    assert np.linalg.norm((found.T_cam_obj - PLACE)[:3, 3]) < 0.003
    on_it = np.linalg.norm(found.uv_px - CAMERA.project(PLACE[:3, 3]), axis=1)
    assert len(found.uv_px) > 100 and on_it.max() <= 1.05 * CAMERA.fx * RADIUS_M / 0.55


def test_exposure_may_have_changed_colour_not():
    sample = sample_of_the_ball()
    assert search(ball_in_front_of_a_wall(gain=0.5)).at(PLACE, sample).share > 0.9
    assert search(ball_in_front_of_a_wall((150, 100, 90))).at(PLACE, sample).share < 0.1


def test_what_is_seen_through_is_not_there():
    """Free space contradicts a pose, which counts against it."""
    empty = ball_in_front_of_a_wall(centre=np.array([0.5, 0.0, 0.3]))
    assert search(empty).at(PLACE, sample_of_the_ball()).share < -0.5
    best = search(empty).about(PLACE, sample_of_the_ball())
    assert best is None or best.share < SIGHTED


def test_what_hides_it_says_little():
    """Half behind a board it is found by the other half; behind all of it there is nothing to say."""
    frame, sample = ball_in_front_of_a_wall(), sample_of_the_ball()
    depth = frame.depth_m.copy()
    depth[:, : round(CAMERA.project(PLACE[:3, 3])[0])] = 0.4
    assert SIGHTED < search(replace(frame, depth_m=depth)).at(PLACE, sample).share < 0.9
    assert search(replace(frame, depth_m=np.full_like(depth, 0.4))).at(PLACE, sample) is None


def test_outside_the_image_nothing_is_known():
    assert search(ball_in_front_of_a_wall()).about(moved(2.0, 0, 0), sample_of_the_ball()) is None


def test_what_fits_anywhere_proves_nothing():
    """A plain plate on a plain wall of its colour fits everywhere along it."""
    flat = Frame(0, 0.0, np.full((240, 320, 3), BLUE, np.uint8), np.full((240, 320), 0.6, np.float32))
    side = np.linspace(-RADIUS_M, RADIUS_M, 18)
    p = np.stack(np.meshgrid(side, side, [0.0]), -1).reshape(-1, 3)
    plate = replace(sample_of_the_ball(), p_obj=p[:300], n_obj=np.tile([0.0, 0, -1], (300, 1)))
    assert search(flat).at(PLACE, plate).share > 0.9
    assert search(flat).about(PLACE, plate) is None
