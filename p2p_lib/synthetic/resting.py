"""How a thing can lie on a table."""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.synthetic.shapes import Mesh

#: Ways to lie whose downward directions differ by less are one; a base is flat up to this.
_ALIKE_DEG, _FLAT_M = 25.0, 0.0015


def resting(mesh: Mesh) -> np.ndarray:
    """Poses (N, 4, 4) at which a mesh lies on z = 0 with its middle above the origin, the widest base first.

    It lies on a face of its convex hull if the hull's middle is above what touches the table.
    """
    from scipy.spatial import ConvexHull

    hull = ConvexHull(mesh.vertices)
    corners, outline = mesh.vertices[hull.simplices], mesh.vertices[hull.vertices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    centre = area @ corners.mean(1) / area.sum()
    down = np.zeros((0, 3))
    # Many faces are as large as others: their order may not hang on the last bit, nor on how a processor sorts.
    for normal in hull.equations[np.argsort(-area.round(12), kind="stable"), :3]:
        if (down @ normal < np.cos(np.radians(_ALIKE_DEG))).all() and _stands(outline, centre, normal):
            down = np.vstack([down, normal])
    x = np.where(np.abs(down[:, :1]) < 0.8, [[1.0, 0, 0]], [[0, 1.0, 0]])
    x -= np.sum(x * down, -1, keepdims=True) * down
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R = np.stack([x, np.cross(-down, x), -down], 1)
    t = -(R @ centre)
    t[:, 2] = -(outline @ R[:, 2].T).min(0)
    return se3.from_rt(R, t)


def _stands(outline: np.ndarray, centre: np.ndarray, down: np.ndarray) -> bool:
    """Whether a thing with these outermost points (N, 3) stays as it is when its lowest ones are on a table."""
    from scipy.spatial import Delaunay, QhullError

    depth = outline @ down
    base = outline[depth > depth.max() - _FLAT_M]
    level = np.linalg.svd(np.eye(3) - np.outer(down, down))[0][:, :2]
    try:
        return bool(Delaunay(base @ level).find_simplex(centre @ level) >= 0)
    except (QhullError, ValueError):  # a point or a line
        return False
