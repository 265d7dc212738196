"""The smallest box around a surface: of a solid as trimesh has it, of what is flat or a line by its own axes."""

import numpy as np
import pytest
import trimesh

from p2p_lib.core import se3
from p2p_lib.core.mesh import oriented_box

TURN = se3.exp(np.array([0.3, -0.7, 0.4, 0.1, -0.2, 0.5]))


def grid(*sides_m: float) -> np.ndarray:
    """Points (N, 3) evenly over a box, a plate or a line."""
    return np.stack(np.meshgrid(*(np.linspace(0, side, 7 if side else 1) for side in sides_m)), -1).reshape(-1, 3)


@pytest.mark.parametrize(
    "sides_m",
    [(0.2, 0.1, 0.05), (0.2, 0.1, 0), (0.15, 0.15, 0), (0.2, 0, 0), (0, 0, 0)],
    ids=["solid", "plate", "square plate", "line", "point"],
)
@pytest.mark.parametrize("T", [np.eye(4), TURN], ids=["straight", "turned"])
def test_the_box_is_as_large_as_what_it_holds_however_thin_that_is(sides_m, T):
    p = se3.transform(T, grid(*sides_m))
    T_box, size_m = oriented_box(p)
    np.testing.assert_allclose(np.sort(size_m)[::-1], sides_m, atol=1e-7)
    se3.check("box", se3.orthonormalised(T_box))
    inside = se3.transform(T_box, p)
    np.testing.assert_allclose([inside.min(0), inside.max(0)], [-size_m / 2, size_m / 2], atol=1e-7)


def test_of_a_solid_it_is_trimeshs_to_the_last_bit():
    solid = trimesh.creation.box((0.2, 0.1, 0.05), TURN)
    for mine, theirs in zip(oriented_box(solid), trimesh.bounds.oriented_bounds(solid)):
        np.testing.assert_array_equal(mine, theirs)
    of_mesh = solid.bounding_box_oriented.primitive.transform
    np.testing.assert_array_equal(np.linalg.inv(oriented_box(solid)[0]), of_mesh)
