"""Errors of a fused surface against exact shapes: known offsets are measured, and pictures of meshes show them."""

import numpy as np
import pytest

from p2p_lib.core import se3
from p2p_lib.core.config import TsdfConfig
from p2p_lib.figures.mesh_view import draw_mesh
from p2p_lib.studies import reconstruction, turntable
from p2p_lib.synthetic.noise import PERFECT
from p2p_lib.synthetic.scene import VGA

trimesh = pytest.importorskip("trimesh")
BODY, POSES = turntable.carton(0), turntable.ring(4)


def test_a_shifted_mesh_is_measured_both_ways():
    rng = np.random.default_rng(0)
    seen = reconstruction.seen_points(BODY, POSES, 4000, rng)
    grown = trimesh.creation.box(2 * 0.001 + np.array([0.08, 0.055, 0.11]))
    to_truth, to_mesh = reconstruction.mesh_errors(grown, BODY, seen, rng)
    assert to_truth == pytest.approx(0.001, rel=0.05) and 0.001 < to_mesh < 0.0016
    assert len(seen) < 4000 and seen[:, 2].min() > -0.0551 and not (seen[:, 2] < -0.05499).all()


def test_what_no_camera_saw_is_not_asked_for():
    seen = reconstruction.seen_points(BODY, POSES[:1], 4000, np.random.default_rng(0))
    assert (np.abs(seen[:, 2] + 0.055) > 1e-6).all(), "the bottom is seen by nobody"
    assert (np.abs(seen[:, 0] + 0.04) > 1e-6).all(), "the far side neither"


def test_perfect_pictures_give_the_exact_surface_and_drift_spoils_it():
    shots = turntable.photograph(BODY, POSES, 0, PERFECT)
    errors = reconstruction.errors_by_keyframes(shots, (1, 4), BODY, TsdfConfig())
    assert errors[1].max() < 0.0015 and errors[0, 1] > 3 * errors[1, 1]
    wrong = reconstruction.drifted(POSES, 10, 10, np.random.default_rng(1))
    assert np.degrees(se3.angle_rad(se3.inverse(POSES[-1]) @ wrong[-1])) == pytest.approx(10)
    np.testing.assert_array_equal(wrong[0], POSES[0])
    volume = turntable.fuse(shots, TsdfConfig(), wrong)
    fused, exact = reconstruction.exact_distance(volume, BODY, np.array([[0.04, 0, 0]]))
    assert exact[0] == pytest.approx(0) and abs(fused[0]) <= volume.tau_m


@pytest.mark.parametrize("clay", [True, False])
def test_a_drawn_mesh_covers_what_the_camera_sees(clay):
    shot = turntable.photograph(BODY, POSES[:1], 0, PERFECT)[0]
    drawn = draw_mesh(trimesh.creation.box([0.08, 0.055, 0.11]), VGA, POSES[0], clay)
    assert ((drawn != 255).any(-1) == shot.mask).mean() > 0.995
    assert ((draw_mesh(BODY.mesh, VGA, POSES[0], clay) != 255).any(-1) == shot.mask).mean() > 0.995
