"""Bodies on a turntable: pictures, exact distances and the experiments on refinement agree with each other."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.method.observation import sample_cloud
from p2p_lib.studies import refinement, turntable
from p2p_lib.synthetic.noise import PERFECT
from p2p_lib.synthetic.scene import VGA

CONFIG = preset("default")


@pytest.mark.parametrize("body", [turntable.carton(1), turntable.tin(1)], ids=lambda body: body.name)
def test_perfect_pictures_lie_on_the_exact_surface(body):
    shots = turntable.photograph(body, turntable.ring(3), 0, PERFECT)
    for shot in shots:
        v, u = np.nonzero(shot.mask)
        p_cam = VGA.unproject(np.stack([u, v], -1), shot.depth_m[v, u].astype(float))
        off_m = body.distance_m(se3.transform(se3.inverse(shot.T_cam_obj), p_cam))
        assert shot.mask.sum() > 5000 and np.abs(off_m).max() < 1e-4


@pytest.mark.parametrize("body", [turntable.carton(2), turntable.tin(2)], ids=lambda body: body.name)
def test_exact_distances_are_signed_and_of_unit_slope(body):
    points, normals = body.mesh.sample(500, np.random.default_rng(0))
    np.testing.assert_allclose(body.distance_m(points + 0.004 * normals), 0.004, atol=1e-4)
    assert (body.distance_m(points - 0.002 * normals) < 0).all()


def test_ring_looks_at_the_middle():
    poses = turntable.ring(5, 0.4)
    np.testing.assert_allclose(VGA.project(poses[:, :3, 3]), np.tile([VGA.cx, VGA.cy], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(poses[:, 2, 3], 0.4)


def test_perturbations_and_errors_are_of_the_same_size():
    T = turntable.ring(1)[0]
    for degrees, millimetres in ((3, 0), (0, 7), (12, 20)):
        off = refinement.perturbed(T, degrees, millimetres, np.random.default_rng(1))
        turned, moved = se3.error_deg_mm(off, T)
        assert turned == pytest.approx(degrees, abs=1e-5)
        assert moved == pytest.approx(millimetres, rel=0.02, abs=1e-9)


def test_near_starts_come_back_and_far_ones_do_not_and_a_tin_keeps_its_spin():
    body, poses = turntable.tin(3), turntable.ring(5, turn_deg=60)
    volume = turntable.fuse(turntable.photograph(body, poses, 3), CONFIG.tsdf)
    shot = turntable.photograph(body, poses[2:3], 4)[0]
    cloud = sample_cloud(shot.depth_m, shot.mask, VGA, 700)
    errors = refinement.basin_of_convergence(volume, cloud, poses[2], CONFIG.refinement, [0.5], [3, 40], 3)
    assert errors.shape == (1, 2, 3, 2) and errors[0, 0, :, 1].max() < 2 < errors[0, 1, :, 1].max()
    left = refinement.spin_errors(volume, [cloud], poses[2], 6.0, CONFIG.refinement)
    assert left[0] == pytest.approx(6, abs=0.7)
    points, normals = body.mesh.sample(2000, np.random.default_rng(0))
    label = refinement.label_points(points, normals, poses[2], 40, 0.0005, np.random.default_rng(0))
    mended = refinement.spin_errors(volume, [cloud], poses[2], 6.0, replace(CONFIG.refinement, iterations=15), [label])
    assert abs(mended[0]) < 1
