"""Holes of a triangle mesh, and the faces that close them.

A hole has a rim: a closed line of edges of one face each. Of all ways to span it by triangles between its vertices the
one of least area is taken (Barequet and Sharir, "Filling gaps in the boundary of a polyhedron", 1995), with as few
edges through the mesh as can be, and none that the mesh has elsewhere: no edge gets a third face.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from p2p_lib.core.raycasting import cast, ray_scene

#: Vertices of a rim, at most, between which the least area is looked for: it takes the cube of their number. Of a
#: longer rim the smallest corners are cut off first.
_MOST = 600
#: An edge goes through the mesh where it meets it so many of the mesh's edges from its ends: beside a rim all is near.
_NEAR = 2


def edges(faces: np.ndarray) -> np.ndarray:
    """(3 F, 2) the edges of faces (F, 3), as each goes around it."""
    return faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)


def unpinched(faces: np.ndarray) -> np.ndarray:
    """(F,) bool: the faces that are left when none is at a vertex at which rims meet, or at an edge of a third face."""
    rows = np.arange(len(faces))
    while True:
        way, times = np.unique(edges(faces[rows]), axis=0, return_counts=True)
        border = _open(way)
        out, at_start = np.unique(border[:, 0], return_counts=True)
        into, at_end = np.unique(border[:, 1], return_counts=True)
        pinched = np.concatenate([out[at_start > 1], into[at_end > 1], way[times > 1].ravel()])
        if not len(pinched):
            return np.isin(np.arange(len(faces)), rows)
        rows = rows[~np.isin(faces[rows], pinched).any(1)]


def _open(way: np.ndarray) -> np.ndarray:
    """Of directed edges (E, 2) those that are not there the other way round."""
    count = way.max(initial=0) + 1
    return way[~np.isin(way @ [count, 1], way @ [1, count])]


def rims(faces: np.ndarray) -> list[np.ndarray]:
    """The vertices of each rim, in the order in which faces that close it go around; of faces that are unpinched."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components, depth_first_order

    vertices, ends = np.unique(_open(edges(faces))[:, ::-1], return_inverse=True)
    start, end = ends.reshape(-1, 2).T
    graph = csr_array((np.ones(len(start)), (start, end)), (len(vertices), len(vertices)))
    if not len(vertices):
        return []
    firsts = np.unique(connected_components(graph)[1], return_index=True)[1]
    return [vertices[depth_first_order(graph, first, return_predecessors=False)] for first in firsts]


def closing(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    """The faces (n - 2, 3) that close each rim of a mesh; none for one that can be closed by edges it has alone."""
    found = rims(faces)
    if not found:
        return []
    scene = ray_scene(vertices, faces)
    start, end = np.unique(np.sort(edges(faces), 1), axis=0).T
    near_m = _NEAR * float(np.median(np.linalg.norm(vertices[start] - vertices[end], axis=1)))
    return [_spanned(vertices, faces, rim, scene, near_m) for rim in found]


def _spanned(vertices: np.ndarray, faces: np.ndarray, rim: np.ndarray, scene: Any, near_m: float) -> np.ndarray:
    place = np.full(len(vertices), -1)
    place[rim] = np.arange(n := len(rim))
    there = place[edges(faces)]
    there = there[(there >= 0).all(1)]
    there = there[~np.isin((there[:, 0] - there[:, 1]) % n, (1, n - 1))] @ [n, 1]  # the others are the rim's own
    p = vertices[rim]
    left, cut = _shortened(p, there)
    taken = np.isin(left[:, None] * n + left, there)
    cost = np.where(taken | taken.T, np.inf, _through(p[left], scene, near_m))
    least = _least_area(p[left], cost)
    return rim[np.concatenate([cut, left[least]])] if len(least) else np.zeros((0, 3), rim.dtype)


def _through(p: np.ndarray, scene: Any, near_m: float) -> np.ndarray:
    """(n, n) m2: of edges that go through the mesh more than any area between points (n, 3) of a rim; else 0."""
    start, end = np.triu_indices(len(p), 2)
    way = p[end] - p[start]
    long_m = np.linalg.norm(way, axis=1)
    near = near_m / np.maximum(long_m, near_m)
    met = cast(scene, p[start] + near[:, None] * way, way)["t_hit"] < 1 - 2 * near
    cost = np.zeros((len(p), len(p)))
    cost[start[met], end[met]] = len(p) * long_m.max(initial=0) ** 2
    return cost


def _shortened(p: np.ndarray, there: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which points of a rim (n, 3) are left of so many that can be spanned, and the corners (C, 3) cut off.

    there  edges i * n + j that cannot be made, one way each at least
    """
    n, left, cut = len(p), np.arange(len(p)), [np.zeros((0, 3), int)]
    while (over := len(left) - _MOST) > 0:
        before, after = np.roll(left, 1), np.roll(left, -1)
        area = np.linalg.norm(np.cross(p[left] - p[before], p[after] - p[before]), axis=1)
        area[np.isin(before * n + after, there) | np.isin(after * n + before, there)] = np.inf
        # No two neighbours at once.
        small = np.flatnonzero((area <= np.roll(area, 1)) & (area < np.roll(area, -1)))
        if not len(small):
            break
        small = small[np.argsort(area[small], kind="stable")][: min(over, len(small) // 2 + 1)]
        cut.append(np.stack([before, left, after], 1)[small])
        left = np.delete(left, small)
    return left, np.concatenate(cut)


def _least_area(p: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """The triangles (n - 2, 3) of least area, all together, that span points (n, 3) of a rim; none where none do.

    cost  (n, n) m2 of an edge besides, from the one with the lower number; infinite where it cannot be made

    By ever longer stretches of the rim: the best of one is a triangle on its two ends and the best of two shorter ones.
    """
    n, k = len(p), np.arange(len(p))
    squared = ((p[:, None] - p) ** 2).sum(-1)
    # In row i, column d: of the stretch from i to i + d, and of that from i - d to i.
    ahead = np.take_along_axis(squared, np.minimum(k[:, None] + k, n - 1), 1)
    back = np.take_along_axis(squared, np.maximum(k[:, None] - k, 0), 1)
    best_ahead, best_back, middle = np.zeros((n, n)), np.zeros((n, n)), np.zeros((n, n), int)
    for d in range(2, n):
        first, shorter, longer = k[: n - d], np.s_[: n - d, 1:d], np.s_[d:, d - 1 : 0 : -1]
        a, b, c = ahead[shorter], back[longer], ahead[: n - d, d, None]
        area = np.sqrt(np.maximum(4 * a * b - (a + b - c) ** 2, 0)) / 4  # Heron's
        area += best_ahead[shorter]
        area += best_back[longer]
        at = area.argmin(1)
        best = area[first, at] + cost[first, first + d]
        best_ahead[first, d], best_back[first + d, d], middle[first, first + d] = best, best, first + 1 + at
    if not np.isfinite(best_ahead[0, n - 1]):
        return np.zeros((0, 3), int)
    found, start, end = [], np.array([0]), np.array([n - 1])
    while len(start):
        between = middle[start, end]
        found.append(np.stack([start, between, end], 1))
        start, end = np.concatenate([start, between]), np.concatenate([between, end])
        long = end - start > 1
        start, end = start[long], end[long]
    return np.concatenate(found)
