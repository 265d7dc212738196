"""The surface against measured depth: full marks at the true pose, fewer the farther off, none for what hides it."""

from types import SimpleNamespace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.types import Frame
from p2p_lib.studies.self_check import errors_against, surface_fit
from p2p_lib.studies.turntable import carton
from p2p_lib.synthetic.render import render

CAMERA = Camera(300, 300, 159.5, 119.5, 320, 240)
N = 4


class Estimates(SimpleNamespace):
    def __len__(self):
        return N


@pytest.fixture(scope="module")
def made():
    """A carton that moves before a wall; in the last frame a board hides its left half, in the second it is lost."""
    body = carton(0).mesh
    T = se3.exp(np.c_[np.linspace(0, 0.4, N), np.zeros(N), np.full(N, 0.5), np.zeros((N, 3))])
    T[:, :3, 3] = np.c_[np.linspace(-0.05, 0.05, N), np.zeros(N), np.full(N, 0.6)]
    frames = []
    for k in range(N):
        depth = render([(body, se3.IDENTITY)], CAMERA, se3.inverse(T[k])).depth_m
        depth = np.where(depth > 0, depth, 1.5).astype(np.float32)
        if k == N - 1:
            depth[:, : int(CAMERA.project(T[k, :3, 3])[0])] = 0.3
        frames.append(Frame(k, k / 30, np.zeros((240, 320, 3), np.uint8), depth))
    T_cam_obj = T.copy()
    T_cam_obj[1] = np.nan
    has = np.arange(N) != 1
    obj = Estimates(T_cam_obj=T_cam_obj, has_pose=has, frame_index=np.arange(N))
    sequence = SimpleNamespace(camera=CAMERA, frame=frames.__getitem__, truth={"box": SimpleNamespace(T_cam_model=T)})
    return sequence, SimpleNamespace(objects={"box": obj}), {"box": body}


def test_at_the_true_pose_all_of_it_is_on_the_surface(made):
    sequence, run, bodies = made
    fit = surface_fit(sequence, run, bodies, range(N))["box"]
    assert fit.row.tolist() == [0, 2, 3], "no pose, no say"
    assert (fit.on > 0.99).all(), "what hides it says nothing"
    np.testing.assert_allclose(fit.offset_m, 0, atol=1e-5)


def test_a_wrong_pose_shows_and_the_more_the_farther(made):
    sequence, run, bodies = made
    shares = [
        surface_fit(sequence, run, bodies, [0], se3.exp(np.radians([0, deg, 0, 0, 0, 0])))["box"].on[0]
        for deg in (0, 5, 10, 20)
    ]
    assert (np.diff(shares) < -0.05).all()


def test_a_surface_too_near_is_measured_behind(made):
    sequence, run, bodies = made
    nearer = se3.inverse(run.objects["box"].T_cam_obj[0])
    towards_camera = se3.from_rt(np.eye(3), nearer[:3, :3] @ [0, 0, -0.003])
    fit = surface_fit(sequence, run, bodies, [0], towards_camera)["box"]
    assert fit.offset_m[0] == pytest.approx(0.003, abs=3e-4)


def test_errors_against_a_truth_that_was_not_known(made):
    sequence, run, _ = made
    T_obj_model, T = se3.exp(np.array([0.1, 0.2, 0, 0.01, 0, 0])), run.objects["box"].T_cam_obj
    drift = np.repeat(np.eye(4)[None], N, 0)
    drift[3] = se3.exp(np.radians([0, 4.0, 0, 0, 0, 0]))
    drift[2, 0, 3] = 0.007
    off = Estimates(has_pose=run.objects["box"].has_pose, frame_index=np.arange(N))
    off.T_cam_obj = T @ drift @ se3.inverse(T_obj_model)
    deg, mm = errors_against(sequence, range(N), SimpleNamespace(objects={"box": off}))["box"]
    np.testing.assert_allclose(deg[[0, 2, 3]], [0, 0, 4], atol=1e-6)
    np.testing.assert_allclose(mm[[0, 2, 3]], [0, 7, 0], atol=1e-6)
    assert np.isnan(deg[1]) and np.isnan(mm[1])
