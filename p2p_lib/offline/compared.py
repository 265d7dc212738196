"""Whether an offline result agrees better with what the camera saw than the run that it was made of does."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from p2p_lib.core.camera import Camera
from p2p_lib.datasets.keypoint_log import ObjectKeypoints, load_keypoints
from p2p_lib.datasets.runs import OFFLINE, ObjectRun, load_run
from p2p_lib.datasets.sequence import reopen
from p2p_lib.evaluation.consistency import consistency
from p2p_lib.evaluation.evidence import reprojected
from p2p_lib.evaluation.suspicions import OFF_PX

#: Frames of which the images are looked at.
_LOOKS = 30
#: What is compared, and how it is written.
_NUMBERS = {
    "depth_on_surface": "depth on surface {:.0f} -> {:.0f} %",
    "mask_iou": "mask IoU {:.0f} -> {:.0f} %",
    "reprojection_px": "reprojection {:.2g} -> {:.2g} px",
}
#: Offline poses are worse where keypoints are off in so many more of the frames, and masks agree. Alone neither tells:
#: keypoints lie where causal poses have put them, and the surface of a whole video reaches beyond masks (IoU 2 to 15 %
#: less on the real desk and table, with poses as good as before or better).
_MORE_OFTEN = 0.1


def compared(folder: str | Path) -> list[str]:
    """A line per object of a run that was refined: how well both results agree with depth, masks and tracks.

    By frames in which both have a pose; where keypoints and masks speak against the offline poses, it says so.
    """
    causal, offline = load_run(folder), load_run(Path(folder) / OFFLINE)
    sequence, points = reopen(causal.info), load_keypoints(causal.path)
    both = {name: obj.has_pose & offline.objects[name].has_pose for name, obj in causal.objects.items()}
    was, now = (_where(run.objects, both) for run in (causal, offline))
    before, after = (
        consistency(replace(run, objects=objects), sequence, _LOOKS).objects
        for run, objects in ((causal, was), (offline, now))
    )
    lines = []
    for name in was:
        pairs = {key: (before[name][key], after[name][key]) for key in _NUMBERS}
        said = [_NUMBERS[key].format(*pair) for key, pair in pairs.items() if np.isfinite(pair).all()]
        if not said:
            continue
        off, still = (_off(of[name], points[name], sequence.camera) if name in points else 0.0 for of in (was, now))
        worse = still - off > _MORE_OFTEN and after[name]["mask_iou"] < before[name]["mask_iou"]
        why = f"keypoints more than {OFF_PX:g} px off in {100 * off:.0f} -> {100 * still:.0f} % of the frames"
        lines.append(f"{name}: {', '.join(said)}" + f"; keep the causal one: {why}" * worse)
    return lines


def _where(objects: Mapping[str, ObjectRun], kept: Mapping[str, np.ndarray]) -> dict[str, ObjectRun]:
    """The objects without their poses in other frames than the ``kept`` (n,) bool ones."""
    posed = {name: np.where(kept[name][:, None, None], obj.T_cam_obj, np.nan) for name, obj in objects.items()}
    return {name: replace(obj, T_cam_obj=posed[name]) for name, obj in objects.items()}


def _off(obj: ObjectRun, points: ObjectKeypoints, camera: Camera) -> float:
    """The share of frames in which most keypoints of the final map are seen more than :data:`OFF_PX` beside it."""
    posed = zip(obj.frame_index[obj.has_pose].tolist(), obj.T_cam_obj[obj.has_pose], strict=True)
    each_px = [reprojected(points, frame, camera, T_cam_obj)[1] for frame, T_cam_obj in posed]
    off = [np.median(px) > OFF_PX for px in each_px if len(px)]
    return float(np.mean(off)) if off else 0.0
