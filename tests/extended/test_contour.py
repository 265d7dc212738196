"""The contour of something flat and plain: it holds where neither points nor shape do."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.config import preset
from p2p_lib.core.types import Frame, Status
from p2p_lib.extended.contour import REACH_PX, ContourFit, contour_px, on_plane
from p2p_lib.extended.default import Point2Pose
from p2p_lib.method.observation import sample_cloud

CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
SIDES_M, WALL_M = (0.07, 0.045), 1.2
CORNERS = np.array([[x, y, 0] for x in (-SIDES_M[0], SIDES_M[0]) for y in (-SIDES_M[1], SIDES_M[1])])
START = se3.from_rt(np.eye(3), np.array([-0.03, 0.02, 0.6])) @ se3.exp(np.array([0.5, 0.3, 0.2, 0, 0, 0]))


def plate(T_cam_obj: np.ndarray, index: int = 0) -> tuple[Frame, np.ndarray]:
    """A plain dark plate before a plain wall, exactly, and its mask."""
    rays = CAMERA.rays.reshape(-1, 3).astype(float)
    T_obj_cam = se3.inverse(T_cam_obj)
    z = -T_obj_cam[2, 3] / (rays @ T_obj_cam[2, :3])
    p_obj = se3.transform(T_obj_cam, rays * z[:, None])
    mask = (np.abs(p_obj[:, :2]) < SIDES_M).all(1).reshape(240, 320)
    depth_m = np.where(mask, z.reshape(240, 320), WALL_M).astype(np.float32)
    rgb = np.where(mask[..., None], np.uint8([30, 40, 45]), np.uint8([170, 170, 165]))
    return Frame(index, index / 30, rgb, depth_m), mask


def known(T_cam_obj: np.ndarray) -> np.ndarray | None:
    """The plate's contour as an object is known by it, (K, 3)."""
    frame, mask = plate(T_cam_obj)
    p_cam = on_plane(contour_px(frame, mask), sample_cloud(frame.depth_m, mask, CAMERA, 500), CAMERA)
    return None if p_cam is None else se3.transform(se3.inverse(T_cam_obj), p_cam)


def fit(mask: np.ndarray | None = None) -> ContourFit:
    """The plate's contour beside that of a mask, its own by default."""
    frame, own = plate(START)
    return ContourFit(known(START), contour_px(frame, own if mask is None else mask), frame, CAMERA)


def moved(*by_m: float) -> np.ndarray:
    return se3.from_rt(np.eye(3), np.array(by_m)) @ START


@pytest.mark.parametrize("mechanisms", ["all", "all but contour"])
def test_a_plain_plate_is_followed_by_where_it_ends(mechanisms):
    method, off_m, lost = Point2Pose(CAMERA, preset().with_values({"method.mechanisms": mechanisms})), [], 0
    for k in range(30):
        truth = moved(0.003 * k, -0.0015 * k, 0.002 * k) @ se3.exp(np.array([0, 0, 0.01 * k, 0, 0, 0]))
        frame, mask = plate(truth, k)
        if not k:
            method.add_object("plate", mask=mask)
        estimate = method.step(frame, {"plate": mask})["plate"]
        if not k:
            p_obj = se3.transform(se3.inverse(estimate.T_cam_obj) @ truth, CORNERS)
        lost += estimate.status is Status.LOST
        if estimate.T_cam_obj is not None:
            apart_m = se3.transform(estimate.T_cam_obj, p_obj) - se3.transform(truth, CORNERS)
            off_m.append(np.linalg.norm(apart_m, axis=1).max())
    assert (lost == 0 and max(off_m) < 0.008) == (mechanisms == "all"), (lost, max(off_m))


@pytest.mark.parametrize(
    ("hidden", "points", "length"),
    [("half", 30, 2), ("half", 5, 1), ("all round", 5, 2)],
    ids=["renewed", "few points renew nothing", "learnt late"],
)
def test_a_contour_hidden_at_first_is_learnt_later(hidden, points, length):
    """Enough points to be sure of the pose replace what is known; where nothing is, a few will do."""
    method = Point2Pose(CAMERA, preset().with_values({"sampling.points": points}))
    grains, lengths = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8), []
    for k in range(2):
        truth = moved(0.01 * k, 0, 0)
        frame, mask = plate(truth, k)
        print_ = cv2.GaussianBlur(np.roll(grains, 5 * k, 1), (0, 0), 1.5)
        wall = frame.rgb + np.uint8(30 * k)  # what hides the plate at first does not look like the wall
        frame = replace(frame, rgb=np.where(mask[..., None], print_, wall))
        if not k:
            beside = np.arange(320) > np.median(np.nonzero(mask)[1]) if hidden == "half" else ~mask
            hides = np.broadcast_to(beside, mask.shape)
            frame.depth_m[hides], mask[hides] = 0.3, False
            method.add_object("plate", mask=mask)
        T_plate_obj = se3.inverse(truth) @ method.step(frame, {"plate": mask})["plate"].T_cam_obj
        contour = method.objects["plate"].life.contour
        lengths.append(0 if contour is None else np.ptp(se3.transform(T_plate_obj, contour)[:, 0]) / SIDES_M[0])
    np.testing.assert_allclose(lengths, [hidden == "half", length], atol=0.1)


def test_what_points_hold_is_not_moved_by_its_contour():
    grains = np.random.default_rng(0).integers(0, 255, (240, 320, 3), np.uint8)
    poses = []
    for mechanisms in ("all", "all but contour"):
        method, found = Point2Pose(CAMERA, preset().with_values({"method.mechanisms": mechanisms})), []
        for k in range(6):
            frame, mask = plate(moved(0.01 * k, 0, 0), k)
            print_ = cv2.GaussianBlur(np.roll(grains, 5 * k, 1), (0, 0), 1.5)
            frame = replace(frame, rgb=np.where(mask[..., None], print_, frame.rgb))
            if not k:
                method.add_object("plate", mask=mask)
            found.append(method.step(frame, {"plate": mask})["plate"])
        assert min(estimate.inliers for estimate in found) >= 3
        poses.append(np.stack([estimate.T_cam_obj for estimate in found]))
    np.testing.assert_array_equal(*poses)


def test_a_return_is_not_laid_on_a_contour(monkeypatch):
    """Another plate would end like that, too."""
    method, asked, hidden = Point2Pose(CAMERA), [], range(6, 12)
    pairs = ContourFit.pairs
    monkeypatch.setattr(ContourFit, "pairs", lambda *args: asked.append(k) or pairs(*args))
    for k in range(18):
        frame, mask = plate(moved(0.002 * k, 0, 0), k)
        if not k:
            method.add_object("plate", mask=mask)
        if k in hidden:
            mask = np.zeros_like(mask)
            frame = replace(frame, depth_m=np.full_like(frame.depth_m, 0.3))
        method.step(frame, {"plate": mask})
    assert set(asked) == set(range(1, hidden.start))


def test_a_contour_is_known_where_the_plate_ends():
    p_obj = known(START)
    from_side_m = np.abs(np.abs(p_obj[:, :2]) - SIDES_M).min(1)
    assert len(p_obj) > 100 and np.abs(p_obj[:, 2]).max() < 1e-3 and from_side_m.max() < 0.004


def test_what_is_seen_along_itself_or_is_no_plane_is_not_known_by_its_contour():
    along = START @ se3.exp(np.array([0.6, 0, 0, 0, 0, 0]))
    assert len(contour_px(*plate(along))) > 100 and known(along) is None
    ball = np.random.default_rng(0).normal(size=(300, 3))
    ball = 0.05 * ball / np.linalg.norm(ball, axis=1, keepdims=True) + [0, 0, 0.6]
    assert on_plane(contour_px(*plate(START)), ball[ball[:, 2] < 0.6], CAMERA) is None


def test_it_does_not_end_where_the_image_does_or_something_hides_it():
    frame, mask = plate(START)
    whole, middle = contour_px(frame, mask), round(np.median(np.nonzero(mask)[1]))
    depth_m, cut = frame.depth_m.copy(), mask.copy()
    depth_m[:, :middle], cut[:, :middle] = 0.3, False  # behind a board
    beside = contour_px(Frame(0, 0.0, frame.rgb, depth_m), cut)
    assert 0.3 * len(whole) < len(beside) < 0.7 * len(whole)
    assert (beside[:, 0] > middle + 1).mean() > 0.9
    at_border = contour_px(*plate(moved(-0.31, 0, 0)))
    assert 24 < len(at_border) < 0.8 * len(whole) and at_border[:, 0].min() > 0


def test_a_contour_is_laid_on_the_one_that_is_seen():
    """Its points are where they are seen, at the depth that the pose gives them."""
    pairs = fit().pairs(moved(0.006, 0.004, 0), REACH_PX[0])
    p_cam = se3.transform(moved(0.006, 0.004, 0), pairs.p_obj)
    assert len(pairs.p_obj) > 100 and np.linalg.norm(p_cam - pairs.p_cam, axis=1).mean() > 0.002
    np.testing.assert_allclose(pairs.p_cam[:, 2], p_cam[:, 2], atol=1e-9)
    assert fit().pairs(moved(0.02, 0.02, 0), REACH_PX[-1]) is None
    assert fit().share(START) > 0.95 and fit().share(moved(0.006, 0.004, 0)) < 0.7


def test_what_something_nearer_hides_of_a_contour_is_laid_on_nothing():
    """Where a board hides the corner of a plate, the plate's mask ends near by, but the plate does not."""
    frame, mask = plate(START)
    edge = round(np.quantile(np.nonzero(mask)[1], 0.9))
    depth_m, rest = frame.depth_m.copy(), mask.copy()
    depth_m[:, edge:], rest[:, edge:] = 0.3, False
    hidden = Frame(0, 0.0, frame.rgb, depth_m)
    pairs = ContourFit(known(START), contour_px(hidden, rest), hidden, CAMERA).pairs(START, REACH_PX[0])
    assert CAMERA.project(se3.transform(START, pairs.p_obj))[:, 0].max() < edge


@pytest.mark.parametrize("what", ["half", "more", "nothing"])
def test_a_part_of_a_contour_is_not_all_of_it(what):
    """A mask of half the plate ends along half its contour, and one that goes on beyond it ends elsewhere, too."""
    _, mask = plate(START)
    v, u = (round(np.median(at)) for at in np.nonzero(mask))
    if what == "half":
        mask[:, u:] = False
    if what == "more":
        mask[v - 5 : v + 5, u : u + 120] = True
    if what == "nothing":
        mask[:] = False
    assert fit(mask).share(START) < 0.7
    assert what == "more" or fit(mask).pairs(START, REACH_PX[-1]) is None
