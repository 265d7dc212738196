"""Rays against a mesh: which face, how far and which way it looks, against a box in closed form and against Open3D."""

import numpy as np
import pytest
import trimesh

from p2p_lib.core.errors import MissingBackend
from p2p_lib.core.native import load_open3d
from p2p_lib.core.raycasting import SurfaceDistance, blocked, cast, ray_scene


def test_a_box_in_closed_form():
    box = trimesh.creation.box((0.2, 0.4, 0.6))
    eye = np.array([0.05, 0.03, -1.0])
    rays = np.array([[0, 0, 1.0], [0, 0, 2.0], [0, 0, -1.0], [1.0, 0, 0]])  # the second twice as long
    found = cast(ray_scene(box.vertices, box.faces), eye, rays)
    np.testing.assert_allclose(found["t_hit"], [0.7, 0.35, np.inf, np.inf], rtol=1e-6)
    assert (found["primitive_ids"] >= 0).tolist() == [True, True, False, False]
    np.testing.assert_allclose(found["primitive_normals"], [[0, 0, -1], [0, 0, -1], [0, 0, 0], [0, 0, 0]], atol=1e-6)
    each = cast(
        ray_scene(box.vertices, box.faces), eye + np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0], [0, 0, 0]]), rays
    )
    np.testing.assert_allclose(each["t_hit"], [0.7, 0.25, np.inf, np.inf], rtol=1e-6)
    corners = box.vertices[box.faces[found["primitive_ids"][0]]]
    assert np.allclose(corners[:, 2], -0.3)


def test_open3d_sees_the_same():
    try:
        open3d = load_open3d()
    except MissingBackend as lacking:
        pytest.skip(str(lacking))
    ball, rng = trimesh.creation.icosphere(3, 0.1), np.random.default_rng(0)
    eye, rays = np.array([0.02, -0.01, -0.5]), np.c_[rng.uniform(-0.3, 0.3, (20_000, 2)), np.ones(20_000)]
    found = cast(ray_scene(ball.vertices, ball.faces), eye, rays)
    scene = open3d.t.geometry.RaycastingScene(nthreads=1)
    scene.add_triangles(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.uint32))
    lines = np.hstack([np.tile(eye, (len(rays), 1)), rays]).astype(np.float32)
    other = {key: value.numpy() for key, value in scene.cast_rays(open3d.core.Tensor(lines)).items()}
    faces, met = other["primitive_ids"].astype(np.int32), np.isfinite(other["t_hit"])
    assert 2000 < met.sum() < 15_000
    np.testing.assert_array_equal(found["primitive_ids"] >= 0, met)
    same = faces == found["primitive_ids"]
    assert same.mean() > 0.9999, "on an edge both faces are right"
    np.testing.assert_allclose(found["t_hit"][met], other["t_hit"][met], rtol=1e-5)
    np.testing.assert_allclose(
        found["primitive_normals"][met & same], other["primitive_normals"][met & same], atol=1e-5
    )


def test_what_is_in_the_way_and_how_far_a_surface_is():
    """Of a box: by arithmetic."""
    box, rng = trimesh.creation.box([0.2, 0.4, 0.6]), np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (2000, 3))
    off = np.abs(points) - np.array([0.1, 0.2, 0.3])
    outside = np.linalg.norm(np.maximum(off, 0), axis=1)
    true_m = np.where((off < 0).all(1), -off.max(1), outside)
    np.testing.assert_allclose(SurfaceDistance(box.vertices, box.faces)(points), true_m, atol=1e-6)
    below = (np.abs(points[:, :2]) < [0.1, 0.2]).all(1) & (points[:, 2] < 0.299)
    assert 50 < below.sum() < 1000
    np.testing.assert_array_equal(blocked(ray_scene(box.vertices, box.faces), points, np.array([0, 0, 1.0])), below)
