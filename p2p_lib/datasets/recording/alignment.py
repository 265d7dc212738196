"""The mesh in its marker body: T_body_model, constant, since the markers are glued to the object.

First from where the markers sit on the mesh, in whatever order motion capture lists them; then, where depth was
recorded, by laying the surface seen over many frames onto the mesh.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.errors import BadInput

MOST_MARKERS = 7  # every order is tried
# A second order that fits nearly as well leaves open which way round the object is.
CLEARLY = 1.5
LEAST_RMS_M = 0.0005


@dataclass(frozen=True, eq=False)
class Alignment:
    """T_body_model (4, 4); rms_m how far the points miss; order[k] is the marker of the body at the mesh's k-th."""

    T_body_model: np.ndarray
    rms_m: float
    order: tuple[int, ...] = ()


def align_markers(p_body: np.ndarray, p_model: np.ndarray) -> Alignment:
    """From marker centres in the body's frame and on the mesh, both (K, 3) in metres, K from 3 to 7, in any order.

    Raises :class:`BadInput` where another order fits nearly as well: the markers then have a symmetry.
    """
    p_body, p_model = np.asarray(p_body, float), np.asarray(p_model, float)
    if (
        p_body.shape != p_model.shape
        or p_body.ndim != 2
        or p_body.shape[1] != 3
        or not 3 <= len(p_body) <= MOST_MARKERS
    ):
        got = f"{p_body.shape} and {p_model.shape}"
        raise BadInput("markers", got, f"as many in the body as on the mesh, 3 to {MOST_MARKERS}, (K, 3) each")
    orders = list(permutations(range(len(p_body))))
    fits = [rigid_fit(p_model, p_body[list(order)]) for order in orders]
    rms = np.array([fit[1] for fit in fits])
    first, second = np.argsort(rms)[:2]
    if rms[second] < CLEARLY * max(rms[first], LEAST_RMS_M):
        got = f"two orders that fit to {rms[first] * 1e3:.1f} and {rms[second] * 1e3:.1f} mm"
        raise BadInput("markers", got, "one that fits clearly best", "Place the markers without symmetry.")
    return Alignment(fits[first][0], float(rms[first]), orders[first])


def rigid_fit(p_from: np.ndarray, p_to: np.ndarray) -> tuple[np.ndarray, float]:
    """T_to_from (4, 4) that takes points (K, 3) to points best, and its root mean square miss."""
    centre_from, centre_to = p_from.mean(0), p_to.mean(0)
    U, _, Vt = np.linalg.svd((p_to - centre_to).T @ (p_from - centre_from))
    R = U * [1, 1, np.sign(np.linalg.det(U @ Vt))] @ Vt
    T = se3.from_rt(R, centre_to - R @ centre_from)
    return T, float(np.sqrt(np.mean(np.sum((se3.transform(T, p_from) - p_to) ** 2, 1))))


def surface_in_body(depth_m: np.ndarray, mask: np.ndarray, camera: Camera, T_cam_body: np.ndarray) -> np.ndarray:
    """(P, 3) points of the object in its body's frame, of one frame's depth (H, W) and mask (H, W)."""
    v, u = np.nonzero(mask & (depth_m > 0))
    p_cam = camera.unproject(np.stack([u, v], -1), depth_m[v, u])
    return se3.transform(se3.inverse(T_cam_body), p_cam)


def refine_on_surface(
    T_body_model: np.ndarray,
    p_body: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    rng: np.random.Generator,
    reach_m: float = 0.02,
    iterations: int = 60,
) -> Alignment:
    """Lay points (P, 3) seen in the body's frame onto a mesh, point to plane; what is further than reach_m is ignored.

    The points should show the object from several sides: what one side leaves open stays as it was.
    """
    import trimesh
    from scipy.spatial import cKDTree

    if len(p_body) < 100:
        raise BadInput("surface", f"{len(p_body)} points", "at least 100, from several sides")
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    surface, face = trimesh.sample.sample_surface(mesh, 30_000, seed=rng)
    normals, tree = mesh.face_normals[face], cKDTree(surface)
    chosen = rng.permutation(len(p_body))[:20_000]
    T, p_body = T_body_model, p_body[chosen]
    for k in range(iterations):
        p = se3.transform(se3.inverse(T), p_body)
        distance, nearest = tree.query(p)
        # From wide to narrow: the first rounds must reach, the last must not be pulled by stray points.
        near = distance < max(reach_m * 0.8**k, reach_m / 4)
        if near.sum() < 100:
            raise BadInput("surface", f"{near.sum()} points near the mesh", "at least 100", "Is the start right?")
        normal, p = normals[nearest[near]], p[near]
        miss = np.einsum("ni,ni->n", p - surface[nearest[near]], normal)
        J = np.concatenate([np.cross(p, normal), normal], 1)
        weight = 1 / np.maximum(1, np.abs(miss) / (1.345 * max(1.4826 * np.median(np.abs(miss)), 1e-5)))
        # The points move by exp(xi) onto the surface, so the model moves the other way. The least damping keeps
        # directions that the points leave open where they are.
        H = (J * weight[:, None]).T @ J
        xi = np.linalg.solve(H + 1e-6 * np.trace(H) * np.eye(6), -(J * weight[:, None]).T @ miss)
        T = T @ se3.inverse(se3.exp(xi))
        if np.linalg.norm(xi) < 1e-7 and k > 10:
            break
    return Alignment(T, float(np.sqrt(np.mean(miss**2))))
