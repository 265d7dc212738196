"""Chamfer distance on bodies whose distance is known, and the part of a surface that frames show."""

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.datasets.sequence import open_sequence
from p2p_lib.evaluation.reconstruction import GRID_M, chamfer_cm, seen_surface, thinned


def sphere(radius_m: float) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=5, radius=radius_m)


@pytest.fixture(scope="module")
def reference() -> np.ndarray:
    return trimesh.sample.sample_surface(sphere(0.05), 60_000, seed=1)[0]


@pytest.fixture(scope="module")
def exact(reference) -> dict[str, float]:
    return chamfer_cm(sphere(0.05), se3.IDENTITY, reference)


def test_thinning_leaves_the_mean_of_each_cell():
    points = np.random.default_rng(0).uniform(-0.02, 0.02, (4000, 3))
    thin = thinned(points)
    cells = {}
    for p in points:
        cells.setdefault(tuple(np.floor(p / GRID_M).astype(int)), []).append(p)
    expected = np.array([np.mean(ps, axis=0) for _, ps in sorted(cells.items())])
    np.testing.assert_allclose(thin[np.lexsort(thin.T[::-1])], expected[np.lexsort(expected.T[::-1])], atol=1e-12)


def test_a_thicker_sphere_is_as_far_as_it_is_thicker(reference, exact):
    thick = chamfer_cm(sphere(0.06), se3.IDENTITY, reference)
    assert all(0 < cm < 0.25 for cm in exact.values()), "what the 5 mm grid leaves"
    assert exact["as aligned"] < 0.05, "nothing but the spacing of the samples"
    for form in exact:
        assert 1.0 <= thick[form] < 1.1, "centimetres"


def test_the_pose_of_the_frame_is_taken_out(reference, exact):
    """As the protocols do: what remains of the alignment is not the surface's fault."""
    T_model_obj = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.1, 0.9]))
    mesh = sphere(0.05)
    mesh.apply_transform(se3.inverse(T_model_obj) @ se3.from_rt(np.eye(3), np.array([0.006, -0.004, 0.003])))
    moved = chamfer_cm(mesh, T_model_obj, reference)
    still = {form: cm for form, cm in exact.items() if form != "as aligned"}
    assert 0.25 < moved.pop("as aligned") < 0.78, "0.8 cm, of which a sphere hides what lies along it"
    # Cells of the 5 mm grid fall elsewhere.
    assert moved == pytest.approx(still, abs=0.04)


def test_pieces_that_do_not_belong_are_left_out(reference, exact):
    near = trimesh.creation.icosphere(subdivisions=1, radius=0.01)
    near.apply_translation([0.15, 0, 0])  # smaller than the body
    far = trimesh.creation.icosphere(subdivisions=6, radius=0.3)
    far.apply_translation([0.9, 0, 0])  # larger, but outside
    whole = trimesh.util.concatenate([near, sphere(0.05), far])
    assert chamfer_cm(whole, se3.IDENTITY, reference) == pytest.approx(exact, abs=0.01)
    assert chamfer_cm(far, se3.IDENTITY, reference) == {}


def test_the_two_forms_weigh_the_directions_differently(reference):
    """Of half a sphere every point is right and half of the truth is missing.

    BundleSDF's form is half the sum of the two means whatever the clouds' sizes; one mean over both clouds, of which
    the true one is twice as large here, sees the missing half more.
    """
    half = sphere(0.05)
    half.update_faces(half.triangles_center[:, 2] > 0)
    found = chamfer_cm(half, se3.IDENTITY, reference)
    assert found["release"] > 1.15 * found["BundleSDF"]


def test_the_seen_part_is_what_faced_the_camera():
    sequence = open_sequence("synthetic/crossing")
    name = sequence.objects[0]
    points = np.loadtxt(sequence.path / f"models/{name}/points.xyz")
    one, said = seen_surface(sequence, name, points, np.array([0]))
    assert said == "seen part of the model points" and 0.15 * len(points) < len(one) < 0.6 * len(points)
    T_cam_model = sequence.truth[name].T_cam_model[0]
    z_m = se3.transform(T_cam_model, one)[:, 2]
    assert z_m.mean() < se3.transform(T_cam_model, points)[:, 2].mean(), "the near side"
    more, _ = seen_surface(sequence, name, points, np.arange(0, 100))
    assert len(more) > len(one)
