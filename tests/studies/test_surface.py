"""Bodies on a turntable: images, exact distances, fused surfaces and refinement agree with each other."""

from dataclasses import replace

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import TsdfConfig, preset
from p2p_lib.method.observation import sample_cloud
from p2p_lib.synthetic.noise import PERFECT
from p2p_lib.synthetic.scene import VGA
from studies import surface
from studies.mesh_view import draw_mesh

trimesh = pytest.importorskip("trimesh")
CONFIG = preset("default")
BODY, POSES = surface.carton(0), surface.ring(4)


@pytest.mark.parametrize("body", [surface.carton(1), surface.tin(1)], ids=lambda body: body.name)
def test_perfect_pictures_lie_on_the_exact_surface(body):
    shots = surface.photograph(body, surface.ring(3), 0, PERFECT)
    for shot in shots:
        v, u = np.nonzero(shot.mask)
        p_cam = VGA.unproject(np.stack([u, v], -1), shot.depth_m[v, u].astype(float))
        off_m = body.distance_m(se3.transform(se3.inverse(shot.T_cam_obj), p_cam))
        assert shot.mask.sum() > 5000 and np.abs(off_m).max() < 1e-4


@pytest.mark.parametrize("body", [surface.carton(2), surface.tin(2)], ids=lambda body: body.name)
def test_exact_distances_are_signed_and_of_unit_slope(body):
    points, normals = body.mesh.sample(500, np.random.default_rng(0))
    np.testing.assert_allclose(body.distance_m(points + 0.004 * normals), 0.004, atol=1e-4)
    assert (body.distance_m(points - 0.002 * normals) < 0).all()


def test_ring_looks_at_the_middle():
    poses = surface.ring(5, 0.4)
    np.testing.assert_allclose(VGA.project(poses[:, :3, 3]), np.tile([VGA.cx, VGA.cy], (5, 1)), atol=1e-6)
    np.testing.assert_allclose(poses[:, 2, 3], 0.4)


def test_perturbations_and_errors_are_of_the_same_size():
    T = surface.ring(1)[0]
    for degrees, millimetres in ((3, 0), (0, 7), (12, 20)):
        off = surface.perturbed(T, degrees, millimetres, np.random.default_rng(1))
        turned, moved = se3.error_deg_mm(off, T)
        assert turned == pytest.approx(degrees, abs=1e-5)
        assert moved == pytest.approx(millimetres, rel=0.02, abs=1e-9)


def test_near_starts_come_back_and_far_ones_do_not_and_a_tin_keeps_its_spin():
    body, poses = surface.tin(3), surface.ring(5, turn_deg=60)
    volume = surface.fuse(surface.photograph(body, poses, 3), CONFIG.tsdf)
    shot = surface.photograph(body, poses[2:3], 4)[0]
    cloud = sample_cloud(shot.depth_m, shot.mask, VGA, 700)
    off = np.array([[0.5, 3]] * 3 + [[0.5, 40]] * 3)
    errors = surface.basin_of_convergence(volume, cloud, poses[2], CONFIG.refinement, off)
    assert errors.shape == (6, 2) and errors[:3, 1].max() < 2 < errors[3:, 1].max()
    titles = [axis.get_title(loc="left") for axis in surface.basins({"default": errors}, off, (2.0, 2.0)).axes]
    assert titles[0] == f"default: {(errors <= 2).all(1).sum()} of 6 back"
    at_truth, away = (
        surface.dragged(volume, cloud, poses[2], *by).axes[0].get_title(loc="left") for by in ((0, 0), (20, 0))
    )
    assert float(at_truth.split()[3]) < 2 < float(away.split()[3])
    left = surface.spin_errors(volume, [cloud], poses[2], 6.0, CONFIG.refinement)
    assert left[0] == pytest.approx(6, abs=0.7)
    points, normals = body.mesh.sample(2000, np.random.default_rng(0))
    label = surface.label_points(points, normals, poses[2], 40, 0.0005, np.random.default_rng(0))
    mended = surface.spin_errors(volume, [cloud], poses[2], 6.0, replace(CONFIG.refinement, iterations=15), [label])
    assert abs(mended[0]) < 1


def test_a_shifted_mesh_is_measured_both_ways():
    rng = np.random.default_rng(0)
    seen = surface.seen_points(BODY, POSES, 4000, rng)
    grown = trimesh.creation.box(2 * 0.001 + np.array([0.08, 0.055, 0.11]))
    to_truth, to_mesh = surface.mesh_errors(grown, BODY, seen, rng)
    assert to_truth == pytest.approx(0.001, rel=0.05) and 0.001 < to_mesh < 0.0016
    assert len(seen) < 4000 and seen[:, 2].min() > -0.0551 and not (seen[:, 2] < -0.05499).all()


def test_what_no_camera_saw_is_not_asked_for():
    seen = surface.seen_points(BODY, POSES[:1], 4000, np.random.default_rng(0))
    assert (np.abs(seen[:, 2] + 0.055) > 1e-6).all(), "the bottom is seen by nobody"
    assert (np.abs(seen[:, 0] + 0.04) > 1e-6).all(), "the far side neither"


def test_perfect_pictures_give_the_exact_surface_and_drift_spoils_it():
    shots = surface.photograph(BODY, POSES, 0, PERFECT)
    errors = surface.errors_by_keyframes(shots, (1, 4), BODY, TsdfConfig())
    assert errors[1].max() < 0.0015 and errors[0, 1] > 3 * errors[1, 1]
    wrong = surface.drifted(POSES, 10, 10, np.random.default_rng(1))
    assert np.degrees(se3.angle_rad(se3.inverse(POSES[-1]) @ wrong[-1])) == pytest.approx(10)
    np.testing.assert_array_equal(wrong[0], POSES[0])
    volume = surface.fuse(shots, TsdfConfig(), wrong)
    fused, exact = surface.exact_distance(volume, BODY, np.array([[0.04, 0, 0]]))
    assert exact[0] == pytest.approx(0) and abs(fused[0]) <= volume.tau_m


@pytest.mark.parametrize("clay", [True, False])
def test_a_drawn_mesh_covers_what_the_camera_sees(clay):
    shot = surface.photograph(BODY, POSES[:1], 0, PERFECT)[0]
    drawn = draw_mesh(trimesh.creation.box([0.08, 0.055, 0.11]), VGA, POSES[0], clay)
    assert ((drawn != 255).any(-1) == shot.mask).mean() > 0.995
    assert ((draw_mesh(BODY.mesh, VGA, POSES[0], clay) != 255).any(-1) == shot.mask).mean() > 0.995
