"""Holes of meshes: their rims, and what closes them, against areas and volumes in closed form."""

import numpy as np
import pytest
import trimesh

from p2p_lib.core.raycasting import cast, ray_scene
from p2p_lib.offline import holes


def grid(height):
    """A sheet of 33 x 33 vertices over 10 x 10 cm: vertices and faces, of ``height`` (x, y) metres."""
    k = np.arange(33 * 33).reshape(33, 33)
    x, y = np.meshgrid(*[np.linspace(-0.05, 0.05, 33)] * 2)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel()
    return np.stack([x, y, height(x, y)], -1).reshape(-1, 3), np.concatenate([np.c_[a, b, d], np.c_[a, d, c]])


@pytest.mark.parametrize("most", [600, 40], ids=["all at once", "small corners first"])
def test_a_rim_is_closed_by_the_least_area(monkeypatch, most):
    """A lid of a ball: the rim is plane and curved, so the least is what it encloses."""
    monkeypatch.setattr(holes, "_MOST", most)
    ball = trimesh.creation.uv_sphere(0.05, count=[32, 64])
    ball.update_faces((ball.vertices[:, 2] < 0.02)[ball.faces].all(1))
    (rim,), (new,) = holes.rims(ball.faces), holes.closing(ball.vertices, ball.faces)
    assert len(new) == len(rim) - 2 > 50
    lid = trimesh.Trimesh(ball.vertices, new, process=False)
    turn = 2 * np.pi / len(rim)
    np.testing.assert_allclose(lid.area, len(rim) / 2 * np.sin(turn) * np.linalg.norm(ball.vertices[rim[0], :2]) ** 2)
    whole = trimesh.Trimesh(ball.vertices, np.concatenate([ball.faces, new]), process=False)
    assert whole.is_watertight and whole.is_winding_consistent and whole.volume > 0


def test_edges_go_through_the_mesh_where_they_must_alone():
    """A saddle: rims between the high sides stay above it, those between the low ones would go through."""
    vertices, faces = grid(lambda x, y: 6 * (x**2 - y**2))
    (new,) = holes.closing(vertices, faces)
    start, end = vertices[new[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)].transpose(1, 0, 2)
    way = end - start
    long = np.linalg.norm(way, axis=1) > 0.02
    met = cast(ray_scene(vertices, faces), (start + 0.2 * way)[long], way[long])["t_hit"] < 0.6
    assert long.sum() > 100 and met.mean() < 0.1, "a few graze it beside the rim"


def test_no_edge_gets_a_third_face():
    """Two faces at a right angle: the least area is the same two, on the edge that they have."""
    vertices = np.array([[-0.2, 0, 0], [0, 0, 1], [0.2, 0, 0], [0, -1, 0]])
    folded = np.array([[0, 1, 2], [0, 2, 3]])
    (new,) = holes.closing(vertices, folded)
    assert set(map(frozenset, new.tolist())) == {frozenset({0, 1, 3}), frozenset({1, 2, 3})}
    assert trimesh.Trimesh(vertices, np.concatenate([folded, new]), process=False).is_watertight


def test_where_rims_meet_faces_are_left_out():
    _, faces = grid(lambda x, y: 0 * x)
    middle = 16 * 33 + 16
    around = np.flatnonzero((faces == middle).any(1))
    pinched = np.delete(faces, around[:1], 0)  # one hole more, at a vertex of its own
    assert holes.unpinched(pinched).all() and len(holes.rims(pinched)) == 2
    apart = np.isin(faces, [middle - 34, middle + 34]).any(1)  # two holes that meet in the middle
    kept = holes.unpinched(faces[~apart])
    assert len(holes.rims(faces[~apart][kept])) == 2 and 0 < (~kept).sum() < 6
    third = np.concatenate([faces, [[middle, middle + 1, 0]]])  # at an edge that has two
    assert not np.isin(third[holes.unpinched(third)], [middle, middle + 1]).any()


def test_what_is_closed_has_no_rim():
    ball = trimesh.creation.icosphere(2)
    assert holes.closing(ball.vertices, ball.faces) == [] == holes.rims(ball.faces)
