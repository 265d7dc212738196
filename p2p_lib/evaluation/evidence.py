"""What a run keeps, and its images where they can be had, as evidence for and against each object's poses.

Nothing here judges; :mod:`p2p_lib.evaluation.suspicions` does.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.camera import Camera
from p2p_lib.core.depth import depth_noise_m
from p2p_lib.core.errors import Doubt, MissingBackend
from p2p_lib.core.image import in_mask, mask_iou
from p2p_lib.core.mask_length import CELL_PX, CELLS
from p2p_lib.core.raycasting import cast, ray_scene
from p2p_lib.core.types import evenly
from p2p_lib.datasets.keypoint_log import ObjectKeypoints
from p2p_lib.datasets.mask_log import ObjectMasks
from p2p_lib.datasets.models import load_mesh
from p2p_lib.datasets.runs import ObjectRun
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX
from p2p_lib.evaluation.suspicions import FEW, RunEvidence
from p2p_lib.extended.depth_lag import as_the_run_took

#: As near to the surface is on it, or as near as depth is noisy there; so much before it, or twice that, is something
#: else that hides it.
ON_M, BEFORE_M = 0.005, 0.01
#: So far behind the surface, and so much of the range, nothing can be measured where the surface is.
_BEHIND_M, _BEHIND_SHARE = 0.02, 0.01
#: A keypoint so many cells outside a mask may lie on its rim.
_RIM_CELLS = 2
#: Gaps of a mask that are closed before its parts are told apart, in cells.
_GAP_CELLS = 3


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """How the surface lies in the images: (n,) shares each, NaN in frames that were not looked at.

    on_surface  of the surface in view, where depth was measured on it; through: behind it
    overlap     of its silhouette, where nothing hides it, with the mask (intersection over union)
    """

    on_surface: np.ndarray
    through: np.ndarray
    overlap: np.ndarray


def surface_in_view(
    obj: ObjectRun,
    sequence: Sequence | None,
    mesh: Path,
    masks: ObjectMasks | None,
    looks: int,
    measured_m: Callable[[int], np.ndarray] | None,
) -> SurfaceFit:
    """An object's surface at its poses, at every :data:`~p2p_lib.datasets.mask_log.CELLS` pixel of some frames.

    measured_m  the depth there of a frame by its number, :func:`depth_as_taken`
    """
    fit = SurfaceFit(*np.full((3, len(obj)), np.nan))
    if sequence is None or measured_m is None or not looks or not mesh.is_file():
        return fit
    try:
        scene, shape = ray_scene(*load_mesh(mesh)), (sequence.camera.height, sequence.camera.width)
    except MissingBackend:  # the other evidence is enough for a summary
        return fit
    for row in evenly(np.arange(len(obj)), looks):
        if not obj.has_pose[row]:
            continue
        index = int(obj.frame_index[row])
        depth_m = measured_m(index)
        surface_m = drawn_m(scene, sequence.camera, obj.T_cam_obj[row], CELLS)
        fit.on_surface[row], fit.through[row] = on_surface(surface_m, depth_m), _through(surface_m, depth_m)
        at = masks.row(index) if masks is not None else None
        if masks is not None and at is not None:
            fit.overlap[row] = _overlap(surface_m, depth_m, masks.cells(at, shape))
    return fit


def depth_as_taken(sequence: Sequence, doubts: Collection[Doubt], looks: int) -> Callable[[int], np.ndarray]:
    """What gives (h, w) metres at every :data:`~p2p_lib.datasets.mask_log.CELLS` pixel of a frame, each read once.

    doubts  of the run: depth is where the run moved it to
    looks   frames that are kept
    """
    return lru_cache(looks)(lambda i: as_the_run_took(sequence, i, doubts).depth_m[CELLS].copy())


def gathered(
    obj: ObjectRun,
    every: ObjectRun,
    sequence: Sequence | None,
    masks: ObjectMasks | None,
    keypoints: ObjectKeypoints | None,
    fit: SurfaceFit,
    doubts: tuple[str, ...],
    moved: Collection[int] = (),
    surface_m: float = float("nan"),
) -> RunEvidence:
    """All that is known of one object, frame by frame.

    every      the same object with the poses of all its maps
    doubts     what was doubted of it when the run was made
    moved      frames whose pose an offline pass has moved far
    surface_m  the length of its surface; NaN: unknown
    """
    n = len(obj)
    px, size_m, cut, apart = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, bool), 0.0
    if masks is not None:
        rows = np.flatnonzero(np.isin(obj.frame_index, masks.frame_index))
        at = np.searchsorted(masks.frame_index, obj.frame_index[rows])
        px[rows], size_m[rows] = masks.px[at], masks.size_m[at]
        if sequence is not None:
            cut[rows] = masks.at_the_border(sequence.camera)[at]
        apart = _apart(masks)
    of_points = np.full((4, n), np.nan)
    if keypoints is not None and sequence is not None:
        of_points = _of_keypoints(obj, keypoints, masks, sequence.camera)
    elsewhere = every.has_pose & ~obj.has_pose
    of_poses = obj.frame_index, obj.has_pose, elsewhere, obj.confidence
    seen, inside, off_px, jump_px = of_points
    compared = seen, inside, off_px, jump_px, fit.overlap, fit.through, fit.on_surface
    far = np.isin(obj.frame_index, list(moved))
    return RunEvidence(*of_poses, px, size_m, cut, *compared, far, doubts, apart, surface_m)


def drawn_m(scene: Any, camera: Camera, T_cam_obj: np.ndarray, at: Any = np.s_[:, :]) -> np.ndarray:
    """(H, W) depth in metres of a surface at a pose, or of some pixels ``at`` of it; 0 where it is not."""
    T_obj_cam, rays = se3.inverse(T_cam_obj), camera.rays[at]
    # Of a ray z is 1, so that its length is the depth.
    hit = cast(scene, T_obj_cam[:3, 3], rays.reshape(-1, 3) @ T_obj_cam[:3, :3].T)["t_hit"].reshape(rays.shape[:2])
    return np.where(np.isfinite(hit), hit, 0)


def on_surface(surface_m: np.ndarray, depth_m: np.ndarray) -> float:
    """The fraction of a drawn surface that nothing hides on which depth (H, W) was measured; NaN without any."""
    behind_m, noise_m = _behind_m(surface_m, depth_m)
    return float((np.abs(behind_m) < np.maximum(ON_M, noise_m)).mean()) if len(behind_m) else float("nan")


def reprojected(
    points: ObjectKeypoints, frame: int, camera: Camera, T_cam_obj: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 2) where the tracker saw keypoints of the final map in a frame, and (K,) pixels from there to their place.

    T_cam_obj  (4, 4) the pose, estimated or true, by which the map is laid into the image
    """
    _, uv_px, placed_px = _placed(points, frame, camera, T_cam_obj)
    return uv_px, np.linalg.norm(uv_px - placed_px, axis=1)


def _placed(
    points: ObjectKeypoints, frame: int, camera: Camera, T_cam_obj: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ids (K,) of keypoints of the final map that were seen in a frame, where (K, 2), and where a pose puts them."""
    now, keypoints = points.at(frame), np.flatnonzero(points.promoted)
    ids, seen, known = np.intersect1d(points.track_id[now], points.ids[keypoints], return_indices=True)
    uv_px = points.uv_px[now][seen].astype(float)
    return ids, uv_px, camera.project(se3.transform(T_cam_obj, points.p_obj[keypoints[known]]))


def _of_keypoints(obj: ObjectRun, points: ObjectKeypoints, masks: ObjectMasks | None, camera: Camera) -> np.ndarray:
    """(4, n): keypoints seen, the share of them in the mask, how far off they are, and how differently they move."""
    count, inside, off_px, jump_px = columns = np.full((4, len(obj)), np.nan)
    before: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    for row, index in enumerate(obj.frame_index.tolist()):
        uv_px = points.uv_px[points.at(index)].astype(float)
        count[row] = len(uv_px)
        if masks is not None and len(uv_px):
            inside[row] = _inside(uv_px, masks, index, (camera.height, camera.width))
        now = _placed(points, index, camera, obj.T_cam_obj[row]) if obj.has_pose[row] else None
        if now is not None and len(now[0]):
            off_px[row] = np.median(np.linalg.norm(now[1] - now[2], axis=1))
        if now is not None and before is not None:
            _, a, b = np.intersect1d(before[0], now[0], return_indices=True)
            apart_px = (now[2][b] - before[2][a]) - (now[1][b] - before[1][a])
            jump_px[row] = np.median(np.linalg.norm(apart_px, axis=1)) if len(a) >= FEW else np.nan
        before = now
    return columns


def _inside(uv_px: np.ndarray, masks: ObjectMasks, index: int, shape: tuple[int, int]) -> float:
    """The share of keypoints (K, 2) in the mask of a frame or on its rim; NaN where it counts as hidden."""
    at = masks.row(index)
    if at is None or masks.px[at] < MIN_VISIBLE_PX:
        return float("nan")
    near = cv2.dilate(masks.cells(at, shape).view(np.uint8), np.ones((2 * _RIM_CELLS + 1,) * 2)) > 0
    return float(in_mask(uv_px / CELL_PX, near).mean())


def _apart(masks: ObjectMasks) -> float:
    """The share of the first mask that counts which lies apart from its largest part."""
    counts = np.flatnonzero(masks.px >= MIN_VISIBLE_PX)
    if not len(counts):
        return 0.0
    top, left, rows, columns = masks.box[counts[0]].tolist()
    cells = masks.cells(counts[0], (CELL_PX * (top + rows), CELL_PX * (left + columns))).view(np.uint8)
    roomy = cv2.copyMakeBorder(cells, *(_GAP_CELLS,) * 4, cv2.BORDER_CONSTANT)
    closed = cv2.morphologyEx(roomy, cv2.MORPH_CLOSE, np.ones((_GAP_CELLS,) * 2))
    areas = np.sort(cv2.connectedComponentsWithStats(closed)[2][1:, cv2.CC_STAT_AREA])
    return float(1 - areas[-1] / areas.sum())


def _behind_m(surface_m: np.ndarray, depth_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K,) how far behind a drawn surface depth was measured, wherever nothing hides it, and (K,) its noise there."""
    both = (surface_m > 0) & (depth_m > 0)
    behind_m, noise_m = (depth_m - surface_m)[both], depth_noise_m(surface_m[both])
    shown = behind_m > -np.maximum(BEFORE_M, 2 * noise_m)
    return behind_m[shown], noise_m[shown]


def _through(surface_m: np.ndarray, depth_m: np.ndarray) -> float:
    """The share of a drawn surface that is seen through; NaN without any."""
    behind_m, _ = _behind_m(surface_m, depth_m)
    far_m = _BEHIND_M + _BEHIND_SHARE * float(np.median(surface_m[surface_m > 0])) if len(behind_m) else 0
    return float((behind_m > far_m).mean()) if len(behind_m) else float("nan")


def _overlap(surface_m: np.ndarray, depth_m: np.ndarray, mask: np.ndarray) -> float:
    """Intersection over union of a drawn surface, where nothing else hides it, and a mask."""
    hidden = (surface_m > 0) & (depth_m > 0) & (depth_m < surface_m - BEFORE_M) & ~mask
    return mask_iou((surface_m > 0) & ~hidden, mask)
