"""Poses of bodies from pixels and depth, predictions from poses, and consensus among wrong matches."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.robust import consensus
from p2p_lib.trackers.builtin import rigid_motion
from p2p_lib.trackers.builtin.rigid_motion import fit_pose, pose_distance_m, predict

CAMERA = Camera(600, 610, 318, 242, 640, 480)


def scene(seed: int, n: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T_cam_seg half a metre away, points of a hand's size, and where they are in the camera's frame."""
    rng = np.random.default_rng(seed)
    T = se3.exp(rng.normal(size=6) * np.repeat([0.6, 0.05], 3))
    T[2, 3] += 0.6
    p_seg = rng.uniform(-0.06, 0.06, (n, 3))
    return T, p_seg, se3.transform(T, p_seg)


def off_deg_mm(T: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    step = se3.inverse(true) @ T
    return np.degrees(se3.angle_rad(step)), 1e3 * np.linalg.norm(step[:3, 3])


def seen(p_cam: np.ndarray, seed: int, px: float = 0.3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pixels with noise, their covariance, and noisy depth."""
    rng = np.random.default_rng([seed, 7])
    z = p_cam[:, 2] + rng.normal(0, 1, len(p_cam)) * depth_noise_m(p_cam[:, 2])
    return CAMERA.project(p_cam) + rng.normal(0, px, (len(p_cam), 2)), np.tile(px**2 * np.eye(2), (len(z), 1, 1)), z


@pytest.mark.parametrize("seed", range(3))
def test_fits_through_wrong_points_and_missing_depth(seed):
    T, p_seg, p_cam = scene(seed)
    uv, cov, z = seen(p_cam, seed)
    wrong = np.arange(len(z)) % 4 == 0
    uv[wrong] += 25
    z[5:25] = 0
    start = T @ se3.exp(np.array([0.1, -0.08, 0.06, 0.01, -0.01, 0.015]))
    fit = fit_pose(start, p_seg, np.zeros((len(z), 3, 3)), uv, cov, z, CAMERA)
    turn_deg, shift_mm = off_deg_mm(fit.T_cam_seg, T)
    assert turn_deg < 0.5 and shift_mm < 1.5
    assert not fit.agrees[wrong].any() and fit.agrees[~wrong].mean() > 0.9


def test_its_covariance_is_that_of_its_errors():
    """Mahalanobis distances of many fits have the mean of a chi square of 6; the prior and 0.3 px make it careful."""
    chi2 = []
    for seed in range(60):
        T, p_seg, p_cam = scene(seed)
        fit = fit_pose(T, p_seg, np.zeros((len(p_cam), 3, 3)), *seen(p_cam, seed), CAMERA)
        turn = se3.so3_log(fit.T_cam_seg[:3, :3] @ T[:3, :3].T)
        shift = (fit.T_cam_seg[:3, :3] - T[:3, :3]) @ fit.centre + fit.T_cam_seg[:3, 3] - T[:3, 3]
        error = np.concatenate([turn, shift])
        chi2.append(error @ np.linalg.solve(fit.covariance, error))
    assert 1.5 < np.mean(chi2) < 7


def test_points_that_slide_along_an_edge_do_not_pull():
    T, p_seg, p_cam = scene(3)
    uv, cov, z = seen(p_cam, 3)
    slid = np.arange(len(z)) < 30
    uv[slid] += [6, 0]
    cov[slid, 0, 0] = 10.0**2
    fit = fit_pose(T, p_seg, np.zeros((len(z), 3, 3)), uv, cov, z, CAMERA)
    turn_deg, shift_mm = off_deg_mm(fit.T_cam_seg, T)
    assert turn_deg < 0.5 and shift_mm < 1.5 and fit.agrees.mean() > 0.9


def test_predicts_place_warp_and_which_way_a_surface_faces():
    T, p_seg, p_cam = scene(1, 8)
    rng = np.random.default_rng(2)
    tangent = rng.normal(0, 1e-3, (8, 3, 2))
    n, centre = len(p_seg), np.zeros((8, 3))
    told = predict(np.tile(T, (n, 1, 1)), np.zeros((n, 6, 6)), centre, p_seg, np.zeros((n, 3, 3)), tangent, CAMERA)
    np.testing.assert_allclose(told.uv_px, CAMERA.project(p_cam), atol=1e-9)
    for axis in (0, 1):  # the warp is the derivative of the projection along the tangent
        moved = CAMERA.project(se3.transform(T, p_seg + 1e-4 * tangent[..., axis]))
        np.testing.assert_allclose((moved - told.uv_px) / 1e-4, told.warp[..., axis], atol=2e-3)
    # The surface faces the camera where its picture is not mirrored.
    assert (np.sign(np.linalg.det(told.warp)) == np.sign(told.cosine)).all() and len(set(np.sign(told.cosine))) == 2


def test_a_body_known_worse_predicts_worse():
    T, p_seg, _ = scene(1, 8)
    many, zero = np.tile(T, (8, 1, 1)), np.zeros((8, 3, 3))
    rest = np.zeros((8, 3)), p_seg, zero, np.tile(np.eye(3)[:, :2] * 1e-3, (8, 1, 1)), CAMERA
    tilted = np.tile(np.diag([0.02, 0.02, 0.02, 0, 0, 0]) ** 2, (8, 1, 1))
    sigma = predict(many, tilted, *rest).sigma_px
    # 0.02 rad at 6 cm are 1.2 mm, at 0.6 m about 1.2 px.
    arm = np.linalg.norm(p_seg, axis=1)
    assert (sigma < 0.025 * arm * 600 / 0.4).all() and sigma[arm.argmax()] > sigma[arm.argmin()] > 0


@pytest.mark.parametrize("share", [0.3, 0.7, 0.85])
def test_consensus_among_wrong_matches(share):
    T, p_seg, p_cam = scene(4, 120)
    rng = np.random.default_rng(5)
    p_cam = p_cam + rng.normal(0, 0.0015, p_cam.shape)
    wrong = rng.random(120) < share
    p_cam[wrong] = rng.uniform(-0.08, 0.08, (wrong.sum(), 3)) + np.array([0, 0, 0.6])
    found, agrees = consensus(p_seg, p_cam, 0.008)
    turn_deg, shift_mm = off_deg_mm(found, T)
    assert turn_deg < 3 and shift_mm < 4 and agrees[~wrong].mean() > 0.9 and agrees[wrong].mean() < 0.1


def test_no_consensus_among_nothing_and_among_noise():
    rng = np.random.default_rng(6)
    assert not consensus(np.zeros((0, 3)), np.zeros((0, 3)), 0.008)[1].any()
    assert not consensus(np.zeros((5, 3)), np.zeros((5, 3)), 0.008)[1].any()
    one, other = rng.uniform(-0.2, 0.2, (2, 40, 3))
    assert consensus(one, other, 0.008)[1].sum() < 8


def test_distance_between_poses():
    T = se3.exp(np.array([0, 0, 0.2, 0, 0, 0]))
    assert pose_distance_m(T, T, np.ones(3)) == 0
    # A turn of 0.2 rad about the centre moves what is 5 cm off by 1 cm; sqrt 2 of it as the norm counts both axes.
    np.testing.assert_allclose(pose_distance_m(np.eye(4), T, np.zeros(3)), 0.01 * np.sqrt(2), rtol=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_a_start_far_off_is_no_crowd_of_outliers(seed):
    """Ten degrees and ten centimetres off, no point is near where the start has it."""
    T, p_seg, p_cam = scene(seed)
    start = T @ se3.exp(np.array([0.2, -0.15, 0.2, 0.08, -0.08, 0.04]))
    fit = fit_pose(start, p_seg, np.zeros((len(p_seg), 3, 3)), *seen(p_cam, seed), CAMERA)
    turn_deg, shift_mm = off_deg_mm(fit.T_cam_seg, T)
    assert turn_deg < 0.5 and shift_mm < 1.5 and fit.agrees.all()


def test_what_the_points_leave_free_stays_as_expected():
    """Points on a line say nothing of the turn about it: it is kept, and known as well as motion is expected."""
    T, p_seg = scene(1)[0], np.outer(np.linspace(-0.06, 0.06, 8), [1, 0, 0])
    start = T @ se3.exp(np.array([0.1, 0.05, -0.05, 0.002, 0.002, 0.002]))
    fit = fit_pose(start, p_seg, np.zeros((8, 3, 3)), *seen(se3.transform(T, p_seg), 1), CAMERA)
    roll_deg, *across_deg = np.degrees(se3.log(se3.inverse(T) @ fit.T_cam_seg)[:3])
    assert abs(roll_deg - np.degrees(0.1)) < 0.3 and np.abs(across_deg).max() < 0.6
    axis = T[:3, 0]
    np.testing.assert_allclose(np.sqrt(axis @ fit.covariance[:3, :3] @ axis), 0.15, rtol=0.01)


def test_depth_tells_the_range_better_than_pixels():
    T, p_seg, p_cam = scene(2)
    uv, cov, z = seen(p_cam, 2)
    range_sigma = []
    for measured in (z, 0 * z):
        fit = fit_pose(T, p_seg, np.zeros((len(z), 3, 3)), uv, cov, measured, CAMERA)
        range_sigma.append(np.sqrt(fit.covariance[5, 5]))
    assert range_sigma[0] < 0.5 * range_sigma[1]


def test_it_is_compiled_once_however_its_arrays_lie_in_memory():
    """Broadcast arrays, as of a segment that corners alone are matched of, are concatenated in any order."""
    T, p_seg, p_cam = scene(1)
    uv, cov, z = seen(p_cam, 1)
    map_cov = np.zeros((len(z), 3, 3))
    fit = fit_pose(T, p_seg, map_cov, uv, cov, z, CAMERA)
    ready = set(rigid_motion._fit_pose.signatures)
    other = [np.asfortranarray(of) for of in (p_seg, map_cov, uv, cov)]
    again = fit_pose(T, *other, z, CAMERA)
    np.testing.assert_array_equal(again.T_cam_seg, fit.T_cam_seg)
    assert set(rigid_motion._fit_pose.signatures) == ready
