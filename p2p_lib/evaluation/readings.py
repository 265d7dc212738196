"""Whether poses of another method were meant in another convention than they are scored in.

Units, directions and orders of quaternions differ between tools, and wrong ones give a low score without any error.
Each other reading is scored as the given one is; the score itself stays that of what was given.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from p2p_lib.core import se3
from p2p_lib.core.errors import doubt
from p2p_lib.core.types import evenly
from p2p_lib.datasets.runs import ObjectRun, Run
from p2p_lib.evaluation import metrics
from p2p_lib.evaluation.protocol import MIN_VISIBLE_PX, score, scored_frames

#: How far off a camera sees an object, m. Within, the unit is right, whatever another one would score: read a thousand
#: times smaller, an object that hardly moves loses the noise of its poses.
_NEAR_M, _FAR_M = 0.01, 10.0
#: Far better is a good score, and so many points more, of ADD-S AUC. Of 8,000 simulated methods with noise, drift, wild
#: and frozen poses none gained over 11 points to a good score by another reading; bad ones gain up to 40 by chance.
#: Quaternions in the wrong order, the mildest mistake, cost a slowly turning bottle 19 (97 to 78).
_GOOD, _POINTS = 85.0, 15.0
#: Frames and model points that decide, evenly spread: they give a score within about a point of that by all.
_FRAMES, _VERTICES = 100, 500
_FROM_OPENGL = np.diag([1.0, -1, -1, 1])


def _scaled(T: np.ndarray, times: float) -> np.ndarray:
    return se3.from_rt(T[:, :3, :3], T[:, :3, 3] * times)


def _scalar_first(T: np.ndarray) -> np.ndarray:
    q = se3.quaternion_xyzw(T)
    return se3.from_rt(Rotation.from_quat(np.roll(q, -1, axis=1)).as_matrix(), T[:, :3, 3])


#: What (m, 4, 4) poses read as T_cam_obj would be if they were written otherwise, and whether they may have been, by
#: their median distance in metres and by whether they were written with quaternions.
READINGS: dict[str, tuple[Callable[[np.ndarray], np.ndarray], Callable[[float, bool], bool]]] = {
    "in millimetres instead of metres": (lambda T: _scaled(T, 0.001), lambda far_m, _: far_m > _FAR_M),
    "in metres instead of millimetres": (lambda T: _scaled(T, 1000.0), lambda far_m, _: far_m < _NEAR_M),
    "as T_obj_cam, the inverse": (se3.inverse, lambda *_: True),
    "with OpenGL's camera axes, y up and z backwards": (lambda T: _FROM_OPENGL @ T, lambda *_: True),
    "with quaternions as w x y z": (_scalar_first, lambda _, quaternions: quaternions),
}


def doubt_reading(
    run: Run, quaternions: Collection[str] = (), align: str = "first", min_visible_px: int = MIN_VISIBLE_PX
) -> str:
    """Warn where a run's poses fit their truth far better in another of the :data:`READINGS`; returns what it says.

    quaternions  objects whose poses were written with some
    """
    found = [
        _scores(obj.select(np.asarray(at)), run.points[name], name in quaternions, align)
        for name, obj in run.objects.items()
        if name in run.points and (at := scored_frames(obj, min_visible_px) & obj.has_pose).any()
    ]
    if not found:
        return ""
    given, *others = np.mean(found, 0)
    best = max(others)
    if best < max(_GOOD, given + _POINTS):
        return ""
    reading = list(READINGS)[others.index(best)]
    got = f"poses that fit far better read {reading}: ADD-S AUC {best:.0f} instead of {given:.0f}, lost frames left out"
    fix = "They are scored as given: convert them if that is what they are; p2p eval --help says what is expected."
    return doubt(str(run.path), got, fix)


def _scores(obj: ObjectRun, points: np.ndarray, quaternions: bool, align: str) -> list[float]:
    """ADD-S AUC in percent of poses as given, then in each other reading; as given where one does not apply."""
    obj, points = obj.select(evenly(np.arange(len(obj)), _FRAMES)), evenly(points, _VERTICES)
    everywhere = np.ones(len(obj), bool)

    def area(T_cam_obj: np.ndarray) -> float:
        return metrics.auc_exact(score(replace(obj, T_cam_obj=T_cam_obj), everywhere, points, align).adds_m)

    given = area(obj.T_cam_obj)
    far_m = np.median(np.linalg.norm(obj.T_cam_obj[:, :3, 3], axis=1))
    return [given] + [
        area(read(obj.T_cam_obj)) if applies(far_m, quaternions) else given for read, applies in READINGS.values()
    ]
