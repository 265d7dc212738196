"""Chamfer distance of a reconstructed mesh, in the two forms that the field's tables mix, and in a stricter one.

All place the mesh by the alignment of the poses, clean it and sample it; in the field's, a short ICP takes out what is
left of the frame. They differ in the last step. ``BundleSDF``: half the sum of the two mean distances, over all samples
of the mesh. ``release`` (the paper's): samples thinned to the same 5 mm grid as the reference, and one mean over both
directions together, so that the larger cloud weighs more. ``as aligned`` is half the sum of the two mean distances as
the poses place the mesh: no ICP, no grid.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.native import load_open3d
from p2p_lib.datasets.models import load_mesh
from p2p_lib.datasets.sequence import Sequence

if TYPE_CHECKING:
    import trimesh

#: The forms of the Chamfer distance.
FORMS = ("BundleSDF", "release", "as aligned")
GRID_M = 0.005
SAMPLES = 99_999
#: Samples of the true surface before it is thinned.
REFERENCE_SAMPLES = 120_000
FAR_M = 0.3  # vertices farther outside the reference's box are dropped
NEAR_M = 0.1  # the largest component that comes this near to the model's origin is kept
ICP_M = 0.02  # pairs farther apart are left out
_ICP_STEPS = 30
# A point is seen where the measured depth agrees with its own, in one of this many frames.
_AGREES_M, _VIEWS = 0.007, 40


def chamfer_cm(mesh: trimesh.Trimesh, T_model_obj: np.ndarray, reference: np.ndarray) -> dict[str, float]:
    """All forms in centimetres.

    mesh         in the object frame; T_model_obj (4, 4) takes it to the model's
    reference    (M, 3) the true surface in the model frame: what could be seen of it, see :func:`seen_surface`

    An empty dictionary where nothing of the mesh is near the reference.
    """
    import trimesh
    from scipy.spatial import cKDTree

    truth = thinned(reference)
    cleaned = _cleaned(mesh, T_model_obj, truth)
    if cleaned is None:
        return {}
    samples, _ = trimesh.sample.sample_surface(cleaned, SAMPLES, seed=0)
    as_aligned = (cKDTree(reference).query(samples)[0].mean() + cKDTree(samples).query(reference)[0].mean()) / 2
    samples = se3.transform(_icp(thinned(samples), truth), samples)
    tree = cKDTree(truth)
    to_truth, to_mesh = tree.query(samples)[0], cKDTree(samples).query(truth)[0]
    thin = thinned(samples)
    both = np.concatenate([tree.query(thin)[0], cKDTree(thin).query(truth)[0]])
    apart_m = (to_truth.mean() + to_mesh.mean()) / 2, both.mean(), as_aligned
    return {form: 100 * float(m) for form, m in zip(FORMS, apart_m, strict=True)}


def thinned(points: np.ndarray) -> np.ndarray:
    """One point per cell of a grid: the mean of the (N, 3) points in it."""
    cells = np.floor(points / GRID_M).astype(np.int64)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    sums = np.stack([np.bincount(cell.ravel(), points[:, k], len(count)) for k in range(3)], 1)
    return sums / count[:, None]


def seen_surface(sequence: Sequence, name: str, model: Path | np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, str]:
    """The part of an object's true surface that these frames show, (M, 3) in the model frame, and where it is from.

    ``visible_mesh.ply`` of the sequence where it is there (BundleSDF's download of HO3D has it); else the points of
    the model, sampled densely where it is a mesh, at which in one of 40 frames of the (k,) ``frames`` the measured
    depth agrees with the true pose.

    model  a mesh, or (V, 3) points where there is none
    """
    given = sequence.path / "visible_mesh.ply" if sequence.path else None
    if given and given.is_file():
        return dense(given), "visible_mesh.ply"
    points = dense(model)
    seen = np.zeros(len(points), bool)
    for k in np.unique(frames[np.linspace(0, len(frames) - 1, min(_VIEWS, len(frames))).astype(int)]):
        T_cam_model, depth_m = sequence.truth[name].T_cam_model[k], sequence.frame(int(k)).depth_m
        p_cam = se3.transform(T_cam_model, points)
        uv_px = sequence.camera.project(p_cam)
        inside = sequence.camera.inside(uv_px)
        u, v = np.where(inside, uv_px.T, 0).round().astype(int)
        seen |= inside & (np.abs(depth_m[v, u] - p_cam[:, 2]) < _AGREES_M)
    return points[seen], f"seen part of {model.name if isinstance(model, Path) else 'the model points'}"


def dense(model: Path | np.ndarray) -> np.ndarray:
    """(M, 3) points of a model: sampled densely where it is a mesh, else as they are."""
    import trimesh

    if not isinstance(model, Path):
        return model
    mesh = trimesh.Trimesh(*load_mesh(model), process=False)
    return trimesh.sample.sample_surface(mesh, REFERENCE_SAMPLES, seed=0)[0]


def _cleaned(mesh: trimesh.Trimesh, T_model_obj: np.ndarray, truth: np.ndarray) -> trimesh.Trimesh | None:
    """In the model frame, without what is far off; of its components the largest that is near the origin."""
    import trimesh

    vertices, faces = se3.transform(T_model_obj, np.asarray(mesh.vertices)), np.asarray(mesh.faces)
    near = ((vertices > truth.min(0) - FAR_M) & (vertices < truth.max(0) + FAR_M)).all(1)
    mesh = trimesh.Trimesh(vertices, faces[near[faces].all(1)], process=False)
    parts = sorted(mesh.split(only_watertight=False), key=lambda part: -len(part.vertices))
    at_origin = [part for part in parts if np.linalg.norm(part.vertices, axis=1).min() <= NEAR_M]
    return next(iter(at_origin or parts), None)


def _icp(source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """T_target_source (4, 4) by point-to-point ICP from the identity; pairs beyond 2 cm are left out."""
    open3d = load_open3d()
    registration = open3d.pipelines.registration
    clouds = (open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points)) for points in (source, target))
    method = registration.TransformationEstimationPointToPoint()
    end = registration.ICPConvergenceCriteria(1e-6, 1e-6, _ICP_STEPS)
    return registration.registration_icp(*clouds, ICP_M, np.eye(4), method, end).transformation
