"""Planes measured around pixels, against a plane and a step rendered by the formula."""

import numpy as np
import pytest

from p2p_lib.core.camera import Camera
from p2p_lib.trackers.builtin.tangent_planes import lifted_cov, planes_at, projection, tangent_steps

CAMERA = Camera(580, 600, 159, 121, 320, 240)
NORMAL, OFFSET = np.array([0.5, -0.3, 1.0]) / np.linalg.norm([0.5, -0.3, 1.0]), 0.6
UV = np.array([[100.3, 80.7], [160.0, 120.0], [211.4, 170.2]])


def slanted(noise_m: float = 0.0) -> np.ndarray:
    """Depth (H, W) of the plane NORMAL p = OFFSET."""
    depth = OFFSET / (CAMERA.rays.astype(float) @ NORMAL)
    return depth + np.random.default_rng(0).normal(0, noise_m, depth.shape)


@pytest.mark.parametrize("step_px", [1, 2])
def test_finds_a_plane(step_px):
    surface = planes_at(slanted(), CAMERA, UV, step_px)
    np.testing.assert_allclose(CAMERA.project(surface.p_cam), UV, atol=1e-6)
    # Depth is linear in the pixel only nearly, and a ridge holds the slope back.
    np.testing.assert_allclose(surface.p_cam @ NORMAL, OFFSET, atol=2e-4)
    across = np.cross(surface.per_px[..., 0], surface.per_px[..., 1])
    cosine = across @ NORMAL / np.linalg.norm(across, axis=1)
    assert (cosine > np.cos(np.radians(2))).all()


def test_noise_and_holes_cost_little():
    depth = slanted(0.001)
    depth[78:83, 98:102] = 0
    surface = planes_at(depth, CAMERA, UV)
    assert np.isfinite(surface.p_cam).all() and np.abs(surface.p_cam @ NORMAL - OFFSET).max() < 0.002
    assert not np.isfinite(planes_at(np.zeros_like(depth), CAMERA, UV).p_cam).any()


def test_the_surface_behind_a_step_is_another():
    depth = np.where(np.arange(320) < 160, 0.5, 0.7) * np.ones((240, 1))
    surface = planes_at(depth, CAMERA, np.array([[158.0, 100.0], [162.0, 100.0]]))
    np.testing.assert_allclose(surface.p_cam[:, 2], [0.5, 0.7], atol=1e-3)


def test_steps_on_the_tangent_plane_are_square():
    surface = planes_at(slanted(), CAMERA, UV)
    steps = tangent_steps(surface, CAMERA, 0.002)
    for at, step in zip(surface.p_cam, steps, strict=True):
        moved = np.stack([_on_plane(CAMERA.project(at) + step[:, axis]) - at for axis in (0, 1)])
        np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 0.002, rtol=0.06)
        assert abs(moved[0] @ moved[1]) < 0.06 * 0.002**2


def _on_plane(uv: np.ndarray) -> np.ndarray:
    ray = CAMERA.unproject(uv, 1.0)
    return ray * OFFSET / (ray @ NORMAL)


def test_jacobian_and_covariance_are_each_others_inverse():
    p_cam = np.array([[0.1, -0.05, 0.6]])
    uv, J = projection(CAMERA, p_cam)
    np.testing.assert_allclose(uv, CAMERA.project(p_cam))
    moved = CAMERA.project(p_cam + 1e-6 * np.eye(3)) - uv
    np.testing.assert_allclose(J[0], moved.T / 1e-6, rtol=1e-4)
    cov_px2 = np.array([[[0.5, 0.1], [0.1, 0.3]]])
    cov = lifted_cov(CAMERA, uv, p_cam[:, 2], cov_px2, np.array([0.004]))
    np.testing.assert_allclose(J @ cov @ J.transpose(0, 2, 1), cov_px2, atol=1e-12)
    np.testing.assert_allclose(cov[0, 2, 2], 0.004**2)
