"""A mask of an earlier frame in a later one: a board before a wall, moved and turned by what is known exactly."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.carried import Moment, carried

CAMERA = Camera(300.0, 300.0, 128, 96, 256, 192)


def seen(T_cam_obj):
    """A board of 16 x 12 cm in its own plane z = 0 before a wall at 1.2 m: frame and mask, by casting every ray."""
    v, u = np.mgrid[:192, :256]
    rays = CAMERA.unproject(np.stack([u, v], -1).astype(float), np.ones((192, 256)))
    R, t = T_cam_obj[:3, :3], T_cam_obj[:3, 3]
    z_m = (R[:, 2] @ t) / (rays @ R[:, 2])
    p_obj = se3.transform(se3.inverse(T_cam_obj), rays * z_m[..., None])
    mask = (np.abs(p_obj[..., 0]) < 0.08) & (np.abs(p_obj[..., 1]) < 0.06) & (z_m > 0)
    depth_m = np.where(mask, z_m, 1.2).astype(np.float32)
    return Frame(0, 0.0, np.zeros((192, 256, 3), np.uint8), depth_m), mask


def placed(x_m=0.0, turn_deg=0.0):
    a = np.radians(turn_deg)
    T = np.eye(4)
    T[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    T[:3, 3] = x_m, 0, 0.7
    return T


def iou(one, other):
    return (one & other).sum() / (one | other).sum()


@pytest.mark.parametrize(("x_m", "turn_deg"), [(0.0, 0.0), (0.05, 0.0), (0.03, 35.0)])
def test_a_mask_moves_as_its_object_did(x_m, turn_deg):
    before, after = placed(), placed(x_m, turn_deg)
    (then, mask), (now, truth) = seen(before), seen(after)
    poor = truth & (np.arange(256) < 128)
    found = carried(Moment(then, before, mask), Moment(now, after, poor), CAMERA)
    assert iou(found, truth) > 0.97 > 0.7 > iou(poor, truth)


def test_what_had_no_depth_now_stays_as_it_was_followed():
    before, after = placed(), placed(0.05)
    (then, mask), (now, truth) = seen(before), seen(after)
    hole = np.s_[80:100, 130:150]
    now.depth_m[hole] = 0
    for followed in (truth, np.zeros_like(truth)):
        found = carried(Moment(then, before, mask), Moment(now, after, followed), CAMERA)
        assert found[hole].all() == followed.any() and found[85:95, 155:165].all()


def test_a_motion_that_shows_nothing_again_carries_nothing():
    before = placed()
    (then, mask), (now, truth) = seen(before), seen(placed(0.2))
    assert carried(Moment(then, before, mask), Moment(now, before, truth), CAMERA) is None
    away = placed(2.0)
    assert carried(Moment(then, before, mask), Moment(now, away, truth), CAMERA) is None
