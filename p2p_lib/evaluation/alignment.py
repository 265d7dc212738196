"""How the tracker's object frame meets the model frame: one rigid constant T_obj_model.

``first`` takes it from the first scored frame (the field's habit); ``all`` fits it over all scored frames, so that
noise of the truth in one frame is not taken for tracking error.
"""

from __future__ import annotations

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.types import evenly
from p2p_lib.evaluation import metrics

#: What fits to a tenth of a millimetre fits, m: the proposal that refinement starts from, which fits its own frame
#: exactly, would else outweigh all others.
_EXACT_M = 1e-4


def align_first(T_cam_obj: np.ndarray, T_cam_model: np.ndarray, points: np.ndarray | None = None) -> np.ndarray:
    """T_obj_model (4, 4) from the first of the (m, 4, 4) poses, so that its error is zero.

    The prediction at t is then T_cam_obj(t) inv(T_cam_obj(f)) T_cam_model(f). f is the object's first scored
    frame; where the object has no pose there, the first scored frame that has one (those before are failures).
    """
    return se3.inverse(T_cam_obj[0]) @ T_cam_model[0]


def align_all(T_cam_obj: np.ndarray, T_cam_model: np.ndarray, points: np.ndarray) -> np.ndarray:
    """T_obj_model (4, 4) that fits all (m, 4, 4) poses best, with few of them wild.

    Every frame proposes Y_t = inv(T_cam_obj) T_cam_model. With M = mean of p p' over the homogeneous model points
    and M = L L', the root mean square distance of the points under X and under Y_t is the Frobenius norm of
    (X - Y_t) L. The constant minimises the sum of these distances, each cut off at 0.1 m where a pose
    scores nothing anyway: it starts at the best of the proposals and is refined by reweighted least squares,
    each step of which is closed form (the rigid transformation nearest to the weighted mean).
    """
    Y = (se3.inverse(T_cam_obj) @ T_cam_model)[:, :3]
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], 1)
    values, vectors = np.linalg.eigh(homogeneous.T @ homogeneous / len(points))
    L = vectors * np.sqrt(np.maximum(values, 0))
    tried = evenly(Y, 400)  # of long runs 400 evenly spread ones
    best = tried[np.argmin([_cost(_distances(X, Y, L)) for X in tried])]
    distances = _distances(best, Y, L)
    for _ in range(200):
        weights = (distances < metrics.MAX_M) / np.maximum(distances, _EXACT_M)
        if not weights.any():
            break
        X = _nearest_rigid(np.einsum("t,tij->ij", weights / weights.sum(), Y), points)
        moved = _distances(X, Y, L)
        gain = _cost(distances) - _cost(moved)
        if gain <= 0:
            break
        best, distances = X, moved
        if gain < 1e-9 * len(Y):
            break
    return se3.from_rt(best[:, :3], best[:, 3])


#: By name; each takes poses T_cam_obj and T_cam_model (m, 4, 4) and model points (V, 3).
ALIGNMENTS = {"first": align_first, "all": align_all}


def _distances(X: np.ndarray, Y: np.ndarray, L: np.ndarray) -> np.ndarray:
    """Root mean square distance (..., m) in metres of the model's points under X (..., 3, 4) and under each Y."""
    return np.linalg.norm((X[..., None, :, :] - Y) @ L, axis=(-2, -1))


def _cost(distances: np.ndarray) -> np.ndarray:
    return np.minimum(distances, metrics.MAX_M).sum(-1)


def _nearest_rigid(mean: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The rigid (3, 4) that moves the points nearest, in the mean square, to where the affine ``mean`` moves them."""
    centre = points.mean(0)
    spread = (points - centre).T @ (points - centre) / len(points)
    # A thousandth of isotropic spread: decides the turn about an axis on which all points lie, and nothing else.
    spread += np.eye(3) * (np.trace(spread) * 1e-3 + 1e-12)
    U, _, Vt = np.linalg.svd(mean[:, :3] @ spread)
    R = U * [1, 1, np.linalg.det(U @ Vt)] @ Vt
    return np.c_[R, mean[:, :3] @ centre + mean[:, 3] - R @ centre]
