"""What a fault does to a run: poses that are wrong and sure, frames until they are right again, what is left behind."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.types import DOUBTED
from p2p_lib.datasets.runs import ObjectRun
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.protocol import scored_frames

if TYPE_CHECKING:
    import trimesh

#: A pose that nobody doubts and that is farther off is a lie.
FAR_M = 0.05
#: Right again is a pose of a smaller error (ADD); a vertex farther than this from the true surface is wrong.
GOOD_M, OFF_M = 0.02, 0.01


def fault_score(
    obj: ObjectRun, T_obj_model: np.ndarray, points: np.ndarray, during: tuple[int, int]
) -> dict[str, float]:
    """What a fault in the frames from, to (``during``) did to an object; points (V, 3) of its model.

    T_obj_model  (4, 4) where the model lies in the object frame; NaN where there was never a pose

    ``frames`` with truth, from the fault's first on: ``lies_in`` the fault and ``lies_after`` are counted over all of
    them, hidden or not; ``longest`` stretch of lies; ``until_good``, frames in view from the fault's end until a pose
    is good: infinite where none is.
    """
    add_m = metrics.add_m(obj.T_cam_obj @ T_obj_model, obj.T_cam_model, points)
    since, after = obj.frame_index >= during[0], obj.frame_index >= during[1]
    lies = since & obj.has_truth & obj.has_pose & (obj.confidence > DOUBTED) & (add_m > FAR_M)
    in_view = after & scored_frames(obj)
    good = np.flatnonzero(add_m[in_view] < GOOD_M)
    until_good = float(good[0]) if len(good) else float("inf" if in_view.any() else "nan")
    return {
        "frames": int((since & obj.has_truth).sum()),
        "lies_in": int((lies & ~after).sum()),
        "lies_after": int((lies & after).sum()),
        "longest": longest_run(lies),
        "until_good": until_good,
    }


def longest_run(flags: np.ndarray) -> int:
    """The length of the longest stretch of True in (n,) bool."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]])))
    return int((edges[1::2] - edges[::2]).max(initial=0))


def mesh_off_share(mesh: trimesh.Trimesh, T_obj_model: np.ndarray, surface: np.ndarray) -> float:
    """The share of a mesh's vertices, in the object frame, that are off the true surface (M, 3) in the model's."""
    from scipy.spatial import cKDTree

    p_model = se3.transform(se3.inverse(T_obj_model), np.asarray(mesh.vertices))
    return float((cKDTree(surface).query(p_model)[0] > OFF_M).mean())
