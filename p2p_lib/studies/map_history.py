"""The life of every point of a keypoint map: born pending, promoted, retired; and how far from the truth it was."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from p2p_lib.core import se3
from p2p_lib.core.config import preset
from p2p_lib.datasets.sequence import Sequence
from p2p_lib.evaluation.true_tracks import TrueScene
from p2p_lib.method.pipeline import Point2Pose


@dataclass(frozen=True, eq=False)
class MapHistory:
    """One object's map over the first T frames; rows of points by id, frames counted from the first.

    born, promoted, gone  (N,) frame in which a point came, became a keypoint, was retired; T where it never did
    p_born, p_promoted    (N, 3) its place in the object frame then; NaN where it never was
    p_true                (N, 3) the true surface point behind its first pixel; NaN where the ray meets none
    keyframe              (T,) bool
    T_cam_obj             (T, 4, 4); NaN without a pose
    """

    name: str
    ids: np.ndarray
    born: np.ndarray
    promoted: np.ndarray
    gone: np.ndarray
    p_born: np.ndarray
    p_promoted: np.ndarray
    p_true: np.ndarray
    keyframe: np.ndarray
    T_cam_obj: np.ndarray

    @property
    def founding(self) -> np.ndarray:
        """(N,) bool: points of the first frame, which define the map and are keypoints at once."""
        return self.born == self.born.min(initial=0)

    @property
    def born_error_m(self) -> np.ndarray:
        """(N,) distance from the true surface point when lifted from a single frame."""
        return np.linalg.norm(self.p_born - self.p_true, axis=1)

    @property
    def promoted_error_m(self) -> np.ndarray:
        """(N,) the same at promotion, from all observations until then; NaN where there was none."""
        return np.linalg.norm(self.p_promoted - self.p_true, axis=1)


def follow_map(
    sequence: Sequence, name: str, frames: int, tracker: str = "builtin", seed: int = 0, start: int = 0
) -> MapHistory:
    """Run the pipeline on one object of a sequence with truth and write down what becomes of its points."""
    method = Point2Pose(sequence.camera, preset(seed=seed), tracker=tracker)
    scene, object = TrueScene.of(sequence), tuple(sequence.truth).index(name)
    method.add_object(name, mask=(sequence.masks(start) or {})[name])
    lives: dict[int, dict] = {}
    keyframe, poses, T_obj_model = np.zeros(frames, bool), np.full((frames, 4, 4), np.nan), np.full((4, 4), np.nan)
    for t in range(frames):
        frame = sequence.frame(start + t)
        shown = sequence.masks(start + t) or {}
        masks = {name: shown[name]} if name in shown else {}  # left out: hidden
        estimate = method.step(frame, masks)[name]
        keyframe[t], points = estimate.keyframe, method.objects[name].map
        if estimate.T_cam_obj is not None:
            poses[t] = estimate.T_cam_obj
        if not t:
            T_obj_model = se3.inverse(poses[0]) @ sequence.truth[name].T_cam_model[start]
        new = np.flatnonzero(~np.isin(points.ids, list(lives)))
        if len(new):
            uv_px = sequence.camera.project(se3.transform(poses[t], points.p_obj[new]))
            true = se3.transform(T_obj_model, scene.lift(frame, np.full(len(new), object), uv_px).p_model)
            for row, p_true in zip(new, true, strict=True):
                lives[int(points.ids[row])] = {"born": t, "p_born": points.p_obj[row].copy(), "p_true": p_true}
        held = dict(zip(points.ids.tolist(), range(len(points)), strict=True))
        for id, life in lives.items():
            if id not in held:
                life.setdefault("gone", t)
            elif points.promoted[held[id]] and "promoted" not in life:
                life |= {"promoted": t, "p_promoted": points.p_obj[held[id]].copy()}
    return _history(name, lives, keyframe, poses)


def _history(name: str, lives: dict[int, dict], keyframe: np.ndarray, poses: np.ndarray) -> MapHistory:
    ids = np.array(sorted(lives))
    never = {"promoted": len(keyframe), "gone": len(keyframe), "p_promoted": np.full(3, np.nan)}
    rows = [never | lives[id] for id in ids.tolist()]
    columns = {key: np.array([row[key] for row in rows]) for key in (*never, "born", "p_born", "p_true")}
    return MapHistory(name, ids, keyframe=keyframe, T_cam_obj=poses, **columns)
