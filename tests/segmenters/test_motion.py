"""What moves with an object, on a made-up scene: a plate before a wall, a part of it, a neighbour that stays."""

import cv2
import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.interfaces import Hint
from p2p_lib.core.prompts import Prompt
from p2p_lib.core.types import Frame
from p2p_lib.segmenters.builtin.motion import Motion, Motions, agrees, parts_that_follow, scene_follows
from p2p_lib.segmenters.builtin.patch import Box, Patch, connected
from p2p_lib.segmenters.builtin.segmenter import BuiltinSegmenter

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
CONFIG = preset().segmentation
PLATE_M, PART_M, WALL_M = 0.7, 0.76, 1.2
#: (x, y, width, height) in the first frame; the part shows above the plate, the neighbour stands beside it.
PLATE, PART, NEIGHBOUR = (110, 110, 60, 40), (120, 80, 40, 30), (172, 100, 30, 50)


def _texture(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return cv2.resize(rng.integers(30, 226, (60, 80, 3), np.uint8), (320, 240), interpolation=cv2.INTER_NEAREST)


def at(place: tuple[int, int, int, int], moved_m: float = 0.0, z_m: float = PLATE_M) -> np.ndarray:
    """(H, W) bool of a rectangle at a depth after a motion to the left."""
    x, y, w, h = place
    x -= round(CAMERA.fx * moved_m / z_m)
    mask = np.zeros((240, 320), bool)
    mask[y : y + h, x : x + w] = True
    return mask


def scene(k: int, moved_m: float, camera_m: float = 0.0) -> Frame:
    """Plate and part moved to the left by so much, and everything by what the camera moved."""
    rgb, depth = np.roll(_texture(9), -round(CAMERA.fx * camera_m / WALL_M), 1), np.full((240, 320), WALL_M, np.float32)
    things = (PART, PART_M, 1, moved_m), (NEIGHBOUR, PART_M, 2, 0.0), (PLATE, PLATE_M, 3, moved_m)
    for place, z_m, seed, own_m in things:
        mask = at(place, own_m + camera_m, z_m)
        shift = -round(CAMERA.fx * (own_m + camera_m) / z_m)
        rgb[mask], depth[mask] = np.roll(_texture(seed), shift, 1)[mask], z_m
    return Frame(k, k / 30, rgb, depth)


def left(moved_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = -moved_m
    return T


def motions_of(then: Frame, now: Frame, moved_m: float) -> Motions:
    motion = Motion(then, np.linalg.inv(left(moved_m)))
    return Motions(now, motion, motion)


def patch_and_plate(frame: Frame, moved_m: float) -> tuple[Patch, np.ndarray]:
    patch = Patch.of(frame, Box(60, 60, 220, 180), CAMERA, CONFIG)
    return patch, connected(patch.smooth, patch.down(at(PLATE, moved_m).astype(np.float32)) > 0.9)


def test_a_part_that_moves_along_is_told_from_a_neighbour_that_stays():
    then, now, moved_m = scene(0, 0.0), scene(30, 0.05), 0.05
    patch, plate = patch_and_plate(now, moved_m)
    motions = motions_of(then, now, moved_m)
    parts = parts_that_follow(patch, patch.smooth, plate, motions)
    part, neighbour = (
        patch.down(at(*a).astype(np.float32)) > 0.5 for a in ((PART, moved_m, PART_M), (NEIGHBOUR, 0, PART_M))
    )
    assert (parts & part).sum() > 0.8 * part.sum()
    assert not (parts & ~part).any() and neighbour.any()
    assert not scene_follows(patch, motions)


def test_nothing_is_a_part_before_it_has_moved():
    """Where nothing has moved yet, standing still explains all."""
    then, now = scene(0, 0.0), scene(1, 0.0)
    patch, plate = patch_and_plate(now, 0.0)
    motions = motions_of(then, now, 0.0)
    assert not parts_that_follow(patch, patch.smooth, plate, motions).any()


def test_a_camera_that_moves_past_what_lies_still_tells_nothing():
    moved_m = 0.05
    then, now = scene(0, 0.0), scene(30, 0.0, moved_m)
    patch, _ = patch_and_plate(now, moved_m)
    assert scene_follows(patch, motions_of(then, now, moved_m))


def test_points_agree_with_an_earlier_frame_at_their_depth_and_in_their_colour():
    then = scene(0, 0.0)
    uv = np.array([[140.0, 130], [140, 130], [140, 130], [20, 20]])
    p_cam = CAMERA.unproject(uv, np.array([PLATE_M, PLATE_M, PLATE_M + 0.1, WALL_M]))
    rgb = then.rgb[uv[:, 1].astype(int), uv[:, 0].astype(int)].copy()
    rgb[1] = 255 - rgb[1] // 4
    assert [a.tolist() for a in agrees(p_cam, rgb, CAMERA, then, np.eye(4))] == [
        [True, False, False, True],
        [False, False, False, False],
    ]
    far = np.eye(4)
    far[0, 3] = 5.0
    assert not np.any(agrees(p_cam, rgb, CAMERA, then, far))


@pytest.mark.parametrize("part_moves", [True, False])
def test_the_segmenter_takes_in_what_moves_along(part_moves):
    """Clicks lie on the plate alone; the pose of the plate is known. What stands still beside it stays outside."""
    segmenter = BuiltinSegmenter(CAMERA, CONFIG, np.random.default_rng(0))
    clicks = [Prompt("it", 0, np.array([[130.0, 125], [150, 130], [140, 140]]))]
    points = np.stack(np.meshgrid(np.linspace(115, 165, 5), np.linspace(115, 145, 4)), -1).reshape(-1, 2)
    for k in range(26):
        moved_m = 0.003 * k
        frame = scene(k, moved_m)
        T_cam_obj = left(moved_m) if part_moves else left(0.0)
        hint = Hint(points - [CAMERA.fx * moved_m / PLATE_M, 0], T_cam_obj=T_cam_obj)
        found = segmenter.segment(frame, () if k else clicks, {"it": hint} if k else None) == 1
    part, neighbour = at(PART, moved_m, PART_M), at(NEIGHBOUR, 0.0, PART_M)
    assert found[at(PLATE, moved_m)].mean() > 0.9 and found[neighbour].mean() < 0.05
    assert (found[part].mean() > 0.8) == part_moves
