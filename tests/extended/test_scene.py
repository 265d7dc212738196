"""The static scene tells how the camera moved, whatever moves in it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.types import Frame, Status
from p2p_lib.extended.default import Point2Pose
from p2p_lib.extended.scene import CameraTracker, two_nearest

CAMERA = Camera(260.0, 260.0, 160.0, 120.0, 320, 240)
WALL_M = 1.2
RNG = np.random.default_rng(0)
PRINT = cv2.GaussianBlur(RNG.integers(0, 256, (1200, 4000), np.uint8), (0, 0), 2.0)
PRINT = cv2.normalize(PRINT, None, 0, 255, cv2.NORM_MINMAX)


def wall_seen_from(T_world_cam: np.ndarray, index: int = 0) -> Frame:
    """A printed wall in the plane z = WALL_M of the world, exactly."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = CAMERA.unproject(np.stack([u, v], -1), np.ones(u.shape)) @ T_world_cam[:3, :3].T
    z = (WALL_M - T_world_cam[2, 3]) / ray[..., 2]
    p = T_world_cam[:3, 3] + ray * z[..., None]
    at = [(500 * p[..., i] + half).astype(np.float32) for i, half in ((0, 2000), (1, 600))]
    grey = cv2.remap(PRINT, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
    return Frame(index, index / 30, np.repeat(grey[..., None], 3, 2), z.astype(np.float32))


def moved(x_m: float, turn_deg: float = 0.0) -> np.ndarray:
    return se3.from_rt(cv2.Rodrigues(np.radians([0, turn_deg, 0]))[0], np.array([x_m, 0, 0]))


def scene() -> CameraTracker:
    return CameraTracker(CAMERA, preset().depth, np.random.default_rng(0))


def off(T: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    error = se3.inverse(truth) @ T
    return float(np.linalg.norm(error[:3, 3])), float(np.degrees(se3.angle_rad(error)))


def test_the_camera_is_followed_away_and_back():
    tracked = scene()
    path = [moved(x, 40 * x) for x in [*np.arange(0, 0.7, 0.05), *np.arange(0.65, -0.01, -0.05)]]
    for k, truth in enumerate(path):
        T = tracked.locate(wall_seen_from(truth, k), None)
        apart_m, apart_deg = off(T, truth)
        assert apart_m < 0.02 and apart_deg < 1.0


def test_it_is_found_again_after_a_gap_with_nothing_to_see():
    tracked, blank = scene(), Frame(1, 0.1, np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32))
    places = [moved(0.3 * k - 1.5) for k in range(11)]
    for k, truth in enumerate(places):
        tracked.locate(wall_seen_from(truth, k), None)
    assert tracked.locate(blank, None) is None
    found = [tracked.locate(wall_seen_from(places[0]), None) for _ in range(4)]
    known = [off(T, np.eye(4))[0] for T in found if T is not None]
    assert known and known[0] < 0.03


def test_while_the_camera_is_lost_every_view_is_tried(monkeypatch):
    tracked, tried = scene(), []
    for k in range(11):
        tracked.locate(wall_seen_from(moved(0.3 * k), k), None)
    nothing = np.zeros((0, 3)), np.zeros((0, 3))
    monkeypatch.setattr(tracked, "_matched", lambda view, seen: tried.append(view) or nothing)
    for _ in range(3):
        assert tracked.locate(wall_seen_from(moved(0)), None) is None
    assert len(tracked._views) == 11 and {id(view) for view in tried} == {id(view) for view in tracked._views}


def test_objects_are_no_part_of_it():
    """A board with most of the corners moves against the wall: the camera stands still."""
    board = np.zeros((240, 320), bool)
    board[40:200, 60:260] = True

    def with_board(shift: int) -> Frame:
        frame = wall_seen_from(np.eye(4))
        rgb, depth = frame.rgb.copy(), frame.depth_m.copy()
        rgb[board] = np.roll(PRINT[:160, :400], -shift, 1)[:, :200].reshape(-1)[:, None]
        depth[board] = 0.8
        return Frame(0, 0.0, rgb, depth)

    tracked, fooled = scene(), scene()
    for shift in (0, 12):
        T, T_fooled = tracked.locate(with_board(shift), board), fooled.locate(with_board(shift), None)
    assert off(T, np.eye(4))[0] < 0.01
    assert T_fooled is None or off(T_fooled, np.eye(4))[0] > 0.02


def test_the_oldest_views_outweigh_those_that_have_drifted():
    """Of views that overlap, the newest are off by what the way there has added up."""
    tracked = scene()
    for x_m in (0.0, 0.17, 0.34):
        tracked.locate(wall_seen_from(moved(x_m)), None)
    drift = se3.from_rt(np.eye(3), np.array([0.05, 0.05, 0.0]))
    for x_m in np.linspace(0.1, 0.3, 5):
        seen = tracked._corners(wall_seen_from(moved(x_m)), None)
        T = drift @ moved(x_m)
        tracked._views.append(replace(seen, p=se3.transform(T, seen.p), T_world_cam=T))
    tracked._T_world_cam = drift @ moved(0.2)
    apart_m, _ = off(tracked.locate(wall_seen_from(moved(0.2)), None), moved(0.2))
    assert apart_m < 0.02


@pytest.mark.parametrize("depth_m", [0.0, 9.0])
def test_without_depth_nobody_knows(depth_m):
    frame = wall_seen_from(np.eye(4))
    nothing = Frame(0, 0.0, frame.rgb, np.full_like(frame.depth_m, depth_m))
    assert scene().locate(nothing, None) is None


def ball_before_the_wall(x_m: float, index: int) -> tuple[Frame, np.ndarray]:
    """The wall from a camera at x_m, a plain red ball before it, and the ball's mask."""
    frame, centre, radius_m = wall_seen_from(moved(x_m), index), np.array([-x_m, 0.0, 0.7]), 0.06
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    ray = CAMERA.unproject(np.stack([u, v], -1), np.ones(u.shape))
    a, b, c = (ray**2).sum(-1), ray @ centre, centre @ centre - radius_m**2
    mask = b**2 > a * c
    z = (b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
    rgb = np.where(mask[..., None], np.uint8([200, 60, 50]), frame.rgb)
    return Frame(index, index / 30, rgb, np.where(mask, z, frame.depth_m).astype(np.float32)), mask


@pytest.mark.parametrize("with_scene", [True, False])
def test_what_lies_still_is_back_when_the_camera_is(with_scene):
    """A ball without texture leaves the image and returns: no point tells where it is, the scene does."""
    method = Point2Pose(
        CAMERA, preset().with_values({"method.mechanisms": "all" if with_scene else "all but scene, shape_search"})
    )
    path = [*np.arange(0, 0.6, 0.03), *np.arange(0.57, -0.01, -0.03)]
    estimates = []
    for k, x_m in enumerate(path):
        frame, mask = ball_before_the_wall(x_m, k)
        if not k:
            method.add_object("ball", mask=mask)
        estimates.append(method.step(frame)["ball"])
    assert estimates[len(path) // 2].status == Status.OCCLUDED
    last, centre = estimates[-1], np.array([0.0, 0.0, 0.7])
    if with_scene:
        # Which side of a plain ball it shows is anybody's guess.
        in_object = se3.transform(se3.inverse(estimates[0].T_cam_obj), centre)
        assert np.linalg.norm(se3.transform(last.T_cam_obj, in_object) - centre) < 0.02
    else:
        assert last.T_cam_obj is None


def test_the_camera_is_located_often_until_points_confirm_a_return(monkeypatch):
    located, locate = [], CameraTracker.locate
    monkeypatch.setattr(
        CameraTracker, "locate", lambda self, frame, *more: located.append(frame.index) or locate(self, frame, *more)
    )
    method, back = Point2Pose(CAMERA), []
    for k, x_m in enumerate([*np.arange(0, 0.6, 0.03), *np.arange(0.57, -0.01, -0.03)]):
        frame, mask = ball_before_the_wall(x_m, k)
        if not k:
            method.add_object("ball", mask=mask)
        estimate = method.step(frame)["ball"]
        back += [k] if k > 20 and estimate.T_cam_obj is not None else []
    assert len(back) > 5 and np.diff([k for k in located if k in back]).max() == 2


def test_the_two_nearest_descriptors():
    rng = np.random.default_rng(1)
    ours, others = (rng.integers(0, 256, (n, 32), np.uint8) for n in (40, 70))
    nearest, distance, second = two_nearest(ours.view(np.uint64), others.view(np.uint64))
    for m, (first, next_best) in enumerate(cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(ours, others, 2)):
        assert (nearest[m], distance[m], second[m]) == (first.trainIdx, first.distance, next_best.distance)
